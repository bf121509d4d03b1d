"""Photos onto the chart: visibility by hand, gains and selection in small, a rendered head's texture found again."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
import synthetic

from avatarbuild.artefacts import StoredImage
from avatarbuild.errors import InputError
from avatarbuild.formats.images import encode_jpeg
from avatarbuild.geometry.mipmap import build_mipmap, sample_texture
from avatarbuild.geometry.raster import project, rasterise
from avatarbuild.options import stage_options
from avatarbuild.stages.albedo import left_out
from avatarbuild.texture import selection
from avatarbuild.texture.borders import border_pairs
from avatarbuild.texture.chart import draw_chart, seam_ties
from avatarbuild.texture.consensus import trimmed
from avatarbuild.texture.fused import Fused
from avatarbuild.texture.fusion import Choice, fuse
from avatarbuild.texture.gains import photo_gains
from avatarbuild.texture.photos import Photo, srgb_picture
from avatarbuild.texture.sampling import grouped, sample
from avatarbuild.texture.visibility import guard, sight

SIZE = 256


def photo_at(yaw: float, rgb: np.ndarray | None = None, number: int = 0, size: tuple[int, int] = (360, 480)) -> Photo:
    """A photo from `yaw` degrees to the subject's left, 450 mm away."""
    a = np.radians(yaw)
    ahead = -np.array([np.sin(a), 0, np.cos(a)])
    R = np.stack([np.cross([0, -1.0, 0], ahead), [0, -1.0, 0], ahead])
    centre = np.array([0, -20.0, -60]) - 450 * ahead
    K = np.array([[size[1] * 1.05, 0, size[0] / 2], [0, size[1] * 1.05, size[1] / 2], [0, 0, 1]])
    image = StoredImage(b"" if rgb is None else encode_jpeg(rgb, 98))
    return Photo(f"P{number}", number, number, image, size, K, np.zeros(5), R, -R @ centre)


@cache
def skin() -> np.ndarray:
    """(SIZE, SIZE, 3) linear: a texture with coarse and fine structure."""
    rng = np.random.default_rng(2)
    coarse = cv2.resize(rng.random((9, 9, 3)), (SIZE, SIZE), interpolation=cv2.INTER_CUBIC)
    return (np.array([0.5, 0.33, 0.25]) * (0.8 + 0.3 * coarse)).astype(np.float32)


@cache
def shots(gained: bool) -> tuple[Photo, ...]:
    """Photos of the mean head in this texture, unlit, before a grey wall; with a gain each, or with none."""
    t = synthetic.template()
    texture = build_mipmap(skin())
    made = []
    for i, yaw in enumerate((-75, -50, -25, 0, 25, 50, 75)):
        view = photo_at(yaw)
        pixels, depth = project(t.mean, view.K, view.dist, view.R, view.t)
        raster = rasterise(pixels, depth, t.triangles, view.size)
        picture = sample_texture(texture, raster, pixels, depth, t.triangles, t.uv, t.uv_triangles)
        picture[raster.triangle < 0] = 0.2
        made.append(photo_at(yaw, srgb_picture(picture * (1 + 0.08 * (i - 3) if gained else 1.0)), i))
    return tuple(made)


@cache
def fused(gained: bool, turn: int = 0) -> tuple[Fused, Choice, dict]:
    t = synthetic.template()
    photos = list(shots(gained))
    return fuse(t, t.mean, np.ones(t.vertex_count), photos, np.ones(len(photos), bool), SIZE, 8.0, None, lambda _: None)


def test_the_texture_of_rendered_photos_is_found_again() -> None:
    result, _, figures = fused(gained=False)
    well = result.seen > 0.4
    off = np.abs(result.colour - skin())[well] / skin()[well]
    assert 1e-4 < np.median(off) < 0.015
    assert np.percentile(off, 95) < 0.06
    assert figures["skin_seen"] > 0.5
    assert not result.colour[result.label < 0].any()
    assert (result.part[result.label >= 0] == 1).all()


def test_gains_between_photos_are_found_and_leave_no_seam() -> None:
    plain, _, _ = fused(gained=False)
    result, choice, _ = fused(gained=True)
    wanted = 1 / (1 + 0.08 * (np.arange(7) - 3))
    assert np.abs(choice.gains / wanted[:, None] - 1).max() < 0.02
    well = (result.seen > 0.4) & (plain.seen > 0.4)
    assert np.percentile(np.abs(result.colour / np.maximum(plain.colour, 1e-3) - 1)[well], 95) < 0.03
    pairs = border_pairs(result.label)
    off = (result.colour - skin()).reshape(-1, 3)
    assert np.abs(off[pairs[:, 0]] - off[pairs[:, 1]]).mean() < 0.01


def test_fusing_repeats_bit_for_bit() -> None:
    first, _, _ = fused(gained=True)
    again, _, _ = fused(gained=True, turn=1)
    assert first is not again
    assert np.array_equal(first.colour, again.colour)
    assert np.array_equal(first.label, again.label)


def test_a_ball_hides_the_plane_behind_it_and_a_margin_around() -> None:
    # a square plane 100 mm behind a square "ball" of 40 mm, seen from straight ahead
    quad = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    vertices = np.concatenate([150 * quad, 20 * quad + [0, 0, 100]]) + [0, -20, -100]
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    photo = photo_at(0)
    points = np.array([[0.0, 0, 0], [10, 0, 0], [60, 0, 0], [0, 0, 100]]) + [0, -20, -100]
    # the near square's rim on the plane, seen from the camera, and just outside of it
    rim = 20 * np.linalg.norm(photo.centre - points[0]) / np.linalg.norm(photo.centre - points[3])
    beside = points[0] + np.array([[rim + 0.7, 0, 0], [rim + 6.0, 0, 0]])
    seen = sight(
        photo, guard(photo, vertices, triangles), np.concatenate([points, beside]), np.tile([0, 0, 1.0], (6, 1))
    )
    assert seen.seen.tolist() == [False, False, True, True, False, True]
    assert seen.cosine[0] == pytest.approx(1.0)


def test_what_faces_away_or_lies_off_the_picture_is_not_seen() -> None:
    quad = 60 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, -20, -60]
    photo = photo_at(0)
    shield = guard(photo, quad, np.array([[0, 1, 2], [0, 2, 3]]))
    points = np.array([[0, -20.0, -60], [0, -20, -60], [1000, -20, -60]])
    seen = sight(photo, shield, points, np.array([[0, 0, 1.0], [0, 0, -1], [0, 0, 1]]))
    assert seen.seen.tolist() == [True, False, False]


def test_the_trimmed_mean_by_hand() -> None:
    values = np.array([1.0, 2, 3, 100]).reshape(4, 1, 1)
    weight = np.ones((4, 1))
    assert trimmed(values, weight, 0.25, 0.75)[0, 0] == pytest.approx(2.5)
    assert trimmed(values, weight, 0.0, 0.5)[0, 0] == pytest.approx(1.5)
    weight[3] = 0
    assert trimmed(values, weight, 0.0, 1.0)[0, 0] == pytest.approx(2.0)
    assert trimmed(values, 0 * weight, 0.0, 1.0)[0, 0] == 0


def test_gains_outlast_highlights() -> None:
    rng = np.random.default_rng(4)
    skin_colour = 0.2 + 0.3 * rng.random((1, 400, 3))
    gain = np.exp(rng.normal(0, 0.2, (6, 1, 3)))
    colour = skin_colour * gain * np.exp(rng.normal(0, 0.01, (6, 400, 3)))
    colour[2, :80] += 0.4  # a highlight
    weight = (rng.random((6, 400)) < 0.7).astype(float)
    found, _ = photo_gains(colour, weight)
    off = np.log(found * gain[:, 0])
    off -= np.median(off, axis=0)
    assert 1e-5 < np.abs(off).max() < 0.01


def test_single_preferences_give_way_to_patches() -> None:
    # ten nodes in a row: the first half sees photo 0 better, the second photo 1, and one node is contrary
    score = np.where(np.arange(10) < 5, [[1.0], [0.7]], [[0.7], [1.0]])
    score[:, 2] = [0.7, 1.0]
    edges = np.stack([np.arange(9), np.arange(1, 10)], axis=1)
    loose = selection.choose(score, edges, np.full(9, 0.01), 20)
    firm = selection.choose(score, edges, np.full(9, 0.3), 20)
    assert loose.tolist() == [0, 0, 1, 0, 0, 1, 1, 1, 1, 1]
    assert firm.tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1, 1]
    score[:, 9] = 0
    assert selection.choose(score, edges, np.full(9, 0.3), 20)[9] == -1


def test_few_photos_serve() -> None:
    score = np.array([[1.0, 1, 0.1, 0.1], [0.1, 0.1, 1, 1], [0.9, 0.9, 0.9, 0.9], [0, 0, 0, 0.5]])
    assert selection.few(score, np.ones(4), 8, 0.2).tolist() == [2]
    assert selection.few(score, np.ones(4), 8, 0.01).tolist() == [0, 1, 2]


def test_cubic_sampling_is_exact_where_light_is_linear_in_place() -> None:
    y, x = np.mgrid[:480, :360]
    ramp = np.stack([x / 720 + 0.2, y / 960 + 0.2, (x + y) / 1680 + 0.1], axis=2)
    photo = photo_at(10, srgb_picture(ramp))
    points = np.random.default_rng(3).uniform(-40, 40, (200, 3)) + [0, -20, -60]
    label = np.zeros(200, np.int16)
    label[5] = -1
    found = sample([photo], label, points.astype(np.float32), 1.0)
    pixels, _ = project(points, photo.K, photo.dist, photo.R, photo.t)
    u, v = pixels.T - 0.5
    wanted = np.stack([u / 720 + 0.2, v / 960 + 0.2, (u + v) / 1680 + 0.1], axis=1)
    keep = label >= 0
    assert np.abs(found - wanted)[keep].mean() < 0.004
    assert not found[5].any()


def test_grouping_is_stable() -> None:
    order, starts = grouped(np.array([1, 0, -1, 1, 2, 0], np.int16), 4)
    assert order.tolist() == [1, 5, 0, 3, 4]
    assert starts.tolist() == [0, 2, 4, 5, 5]


def test_ties_join_texels_that_touch_on_the_head() -> None:
    t = synthetic.template()
    chart = draw_chart(t, t.uv, t.uv_triangles, 512)
    ties = seam_ties(t, chart)
    assert len(ties) > 200
    position = chart.field(t.mean, t.triangles).reshape(-1, 3)
    apart = np.linalg.norm(position[ties[:, 0]] - position[ties[:, 1]], axis=1)
    # at the back of the head a texel of 512 is up to three millimetres
    assert np.median(apart) < 4
    assert np.percentile(apart, 99) < 12
    row, column = ties // 512, ties % 512
    away = np.hypot(row[:, 0] - row[:, 1], column[:, 0] - column[:, 1])
    assert np.median(away) > 100


def test_names_to_leave_out_are_checked() -> None:
    class Named:
        names = ("IMG_0001", "IMG_0002")

    assert left_out(Named(), " IMG_0002.jpg, IMG_0001") == {0, 1}  # type: ignore[arg-type]
    with pytest.raises(InputError, match="did you mean 'IMG_0001'"):
        left_out(Named(), "IMG_0011")  # type: ignore[arg-type]
    assert stage_options("standard", {"capture.leave_out": "a, b"})["albedo"].leave_out == "a, b"
