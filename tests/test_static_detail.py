"""Normal and occlusion maps: flat stays flat, a known bump comes back, noise does not, dark pores are pits."""

from __future__ import annotations

from functools import lru_cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.template import Template
from avatarbuild.texture import static_detail
from avatarbuild.texture.chart import draw_chart

SIZE = 512


@lru_cache
def scene() -> SimpleNamespace:
    """Points all over the mean head's face, on the curved surface, with their normals."""
    template = Template.load()
    rng = np.random.default_rng(5)
    faces = template.triangles[template.parts["skin"].triangles]
    face = template.regions["face"][faces].all(axis=1)
    corners = template.mean[faces[face]]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    pick = rng.choice(len(corners), 150_000, p=area / area.sum())
    b = rng.dirichlet([1, 1, 1], len(pick))
    normals = vertex_normals(template.mean, template.triangles)[faces[face]][pick]
    foot = np.einsum("kc,kcx->kx", b, corners[pick])
    normal = np.einsum("kc,kcx->kx", b, normals)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    lift = sum(
        0.75 * (b[:, c] * ((corners[pick, c] - foot) * normals[:, c]).sum(1))[:, None] * normals[:, c] for c in range(3)
    )
    chart = draw_chart(template, template.uv, template.uv_triangles, SIZE)
    return SimpleNamespace(template=template, points=foot + lift, normal=normal, chart=chart, rng=rng)


def relief(height: np.ndarray) -> np.ndarray:
    s = scene()
    return static_detail.cloud_relief(s.template, s.template.mean, s.points + height[:, None] * s.normal, SIZE)


def cheek() -> np.ndarray:
    """(s, s) bool: within 12 mm of a place on the left cheek."""
    s = scene()
    centre = s.template.landmarks(s.template.mean)[280]
    return np.linalg.norm(s.chart.field(s.template.mean, s.template.triangles) - centre, axis=-1) < 12


def test_a_smooth_cloud_has_no_relief() -> None:
    assert np.abs(relief(np.zeros(len(scene().points)))[cheek()]).max() < 0.02


def test_noise_is_shrunk_away() -> None:
    s = scene()
    noise = 0.15 * np.random.default_rng(6).standard_normal(len(s.points))
    assert relief(noise)[cheek()].std() < 0.02


def test_a_bump_comes_back() -> None:
    s = scene()
    centre = s.template.landmarks(s.template.mean)[280]
    bump = lambda x: 0.25 * np.exp(-((np.linalg.norm(x - centre, axis=-1) / 2.0) ** 2))  # noqa: E731
    noise = 0.03 * np.random.default_rng(7).standard_normal(len(s.points))
    found = relief(bump(s.points) + noise)
    assert 0.12 < found[cheek()].max() < 0.26
    position = s.chart.field(s.template.mean, s.template.triangles)
    true = bump(position)
    assert np.corrcoef(found[cheek()], true[cheek()])[0, 1] > 0.85


def test_dark_is_deep() -> None:
    x, y = np.meshgrid(np.arange(SIZE), np.arange(SIZE))
    luminance = (0.3 * np.exp(0.1 * np.sin(x * 2.2) * np.sin(y * 2.2))).astype(np.float32)
    height = static_detail.pores(luminance, np.ones((SIZE, SIZE), np.float32), 1.3, static_detail.DetailWeights())
    inner = np.s_[50:-50, 50:-50]
    assert np.corrcoef(height[inner].ravel(), luminance[inner].ravel())[0, 1] > 0.9
    rows, columns = np.gradient(height)
    assert np.sqrt((rows**2 + columns**2).mean()) * 1.3 == pytest.approx(0.07, rel=0.02)


def test_maps_of_a_flat_colour_are_flat_and_open_in_front() -> None:
    s = scene()
    made = static_detail.maps(
        *(s.template, s.template.mean, s.points[:0], np.full((SIZE, SIZE, 3), 0.3), np.ones((SIZE, SIZE))), size=SIZE
    )
    assert made.normal.shape == (SIZE, SIZE, 3)
    assert (np.abs(made.normal.astype(int) - [128, 128, 255]) <= 1).all()
    nose = s.template.landmarks(s.template.mean)[4]
    position = s.chart.field(s.template.mean, s.template.triangles)
    assert np.median(made.occlusion[np.linalg.norm(position - nose, axis=-1) < 3]) > 235
    eyes = [number for number, part in enumerate(s.template.parts, 1) if part.startswith("eye_")]
    assert (made.occlusion[np.isin(s.chart.part, eyes)] == 255).all()
    mouth = s.chart.field(s.template.regions["mouth"].astype(np.float32), s.template.triangles) > 0
    assert made.occlusion[(s.chart.part == 1) & ~mouth].min() >= 76


def test_the_mouth_is_darker_the_farther_in() -> None:
    template = scene().template
    open_ = static_detail.mouth_openness(template)
    assert not open_[template.parts["eye_left"].vertices].any()
    for part, least in (("teeth_upper", 0.4), ("teeth_lower", 0.3), ("tongue", 0.1)):
        vertices = template.parts[part].vertices
        depth, value = template.mean[vertices, 2], open_[vertices]
        front = value[depth > np.percentile(depth, 90)]
        assert front.max() > least
        assert np.median(value[depth < np.percentile(depth, 40)]) < 0.25 * front.max()


def test_normals_lean_away_from_a_rise() -> None:
    """Height grows along u: the normal leans to -u, red below the middle; along v (up the picture): green below."""
    height = np.tile(np.arange(64, dtype=np.float32) * 0.01, (64, 1))
    metric, inside = np.full((64, 64, 2), 10.0), np.ones((64, 64), bool)
    along = static_detail._normals(height, metric, inside)[32, 32]
    assert along[0] < 120
    assert along[1] == 128
    up = static_detail._normals(height.T[::-1], metric, inside)[32, 32]
    assert up[1] < 120
    assert up[0] == 128
    slope = -(along[0] / 127.5 - 1) / (along[2] / 127.5 - 1)
    assert slope == pytest.approx(0.1, abs=0.01)


def test_it_repeats() -> None:
    s = scene()
    albedo = cv2.GaussianBlur(np.random.default_rng(8).random((SIZE, SIZE, 3)).astype(np.float32), (0, 0), 1.0)
    one, two = (
        static_detail.maps(s.template, s.template.mean, s.points[:20000], albedo, np.ones((SIZE, SIZE)), size=SIZE)
        for _ in range(2)
    )
    assert np.array_equal(one.normal, two.normal)
    assert np.array_equal(one.occlusion, two.occlusion)
