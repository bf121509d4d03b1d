"""The small renderer: shading by hand, where a point lands, clouds, repeatability."""

from __future__ import annotations

import numpy as np
import pytest

from avatarbuild.formats import colour
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.report import rendering, shading, splats
from avatarbuild.report.rendering import Decal, Paint, View
from avatarbuild.report.shading import Light


def sphere(radius: float = 60.0, n: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """A sphere about the origin: vertices (n * n, 3), triangles."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, n), np.linspace(0, np.pi, n))
    vertices = radius * np.stack([np.sin(v) * np.sin(u), np.cos(v), np.sin(v) * np.cos(u)], -1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    return vertices, np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)])


def square(half: float, z: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A square that faces +z: vertices (4, 3) and two triangles."""
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners, np.array([[0, 1, 2], [0, 2, 3]])


FRONT = View(size=(120, 120), height=160.0, centre=(0.0, 0.0, 0.0), distance=4000.0)


def test_a_spheres_shading() -> None:
    """L = c (above (1 + n_up) / 2 + below (1 - n_up) / 2 + lamp max(0, (n.l + wrap) / (1 + wrap))) on a convex body."""
    vertices, triangles = sphere()
    light = Light(direction=(-1.0, -1.0, -1.0), lamp=0.5, above=0.3, below=0.1, wrap=0.25, gloss=0.0)
    seen = rendering.look(vertices, triangles, FRONT, 1)
    white = np.ones((120, 120, 3), np.float32)
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    drawn = rendering.shade(seen, normals, white, np.zeros(len(vertices)), light)
    for row, column in ((60, 60), (40, 45), (75, 80), (30, 60), (60, 92)):
        x, y = (column + 0.5 - 60) * 160 / 120, (60 - row - 0.5) * 160 / 120  # millimetres; far away, so parallel
        n = np.array([x, y, np.sqrt(60.0**2 - x * x - y * y)]) / 60
        towards = n @ np.array([-1, 1, 1]) / np.sqrt(3)
        expected = 0.3 * (1 + n[1]) / 2 + 0.1 * (1 - n[1]) / 2 + 0.5 * max(0, (towards + 0.25) / 1.25)
        np.testing.assert_allclose(drawn[row, column], expected, atol=0.012)
    assert drawn[0, 0].max() == 0


def test_a_point_lands_on_its_pixel() -> None:
    """A small square about (x, y) shows where a pinhole with centres at +0.5 puts it; +x is on the right, +y above."""
    vertices, triangles = square(1.0)
    seen = rendering.look(vertices + [30, 20, 0], triangles, FRONT._replace(size=(160, 160)), 1)
    rows, columns = np.nonzero(seen.raster.triangle >= 0)
    assert (columns.min(), columns.max() + 1) == (80 + 29, 80 + 31)
    assert (rows.min(), rows.max() + 1) == (80 - 21, 80 - 19)


def test_positive_yaw_shows_the_left_side_and_positive_pitch_the_top() -> None:
    for view, point in ((FRONT._replace(yaw=60), [50, 0, 0]), (FRONT._replace(pitch=60), [0, 50, 0])):
        _, R, t = rendering.pinhole(view)
        near, far = R @ np.array(point) + t, R @ -np.array(point) + t
        assert near[2] < far[2]


def test_occlusion_of_a_plane_and_of_a_pit() -> None:
    flat = np.full((60, 60), 1000.0, np.float32)
    normals = np.zeros((60, 60, 3), np.float32)
    normals[..., 2] = -1
    assert shading.occlusion(flat, normals, 2000.0).min() == 1
    pit = flat.copy()
    pit[25:35, 25:35] += 12
    open_ = shading.occlusion(pit, normals, 2000.0)
    assert open_[30, 30] < 0.6 < open_[5, 5]


def test_supersampling_covers_by_area() -> None:
    """An edge through the middle of a pixel leaves it half covered."""
    shown = np.zeros((4, 4), bool)
    shown[:, :3] = True
    linear = np.where(shown[..., None], 1.0, 0.0).astype(np.float32) * np.ones(3, np.float32)
    drawn = rendering.finish(linear, shown, 2, (0.0, 0.0, 0.0))
    assert drawn[0, 0].tolist() == [255] * 3
    assert drawn[0, 1].tolist() == colour.encode_srgb(np.full(3, 0.5)).tolist() == [188] * 3


def test_a_decal_covers_its_triangles_alone() -> None:
    vertices, triangles = square(40.0)
    texture = build_mipmap(np.full((8, 8, 3), 0.25, np.float32))
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    paint = Paint(np.full((4, 3), 0.75), np.zeros(4), [Decal(slice(0, 1), texture, uv, triangles)])
    seen = rendering.look(vertices, triangles, FRONT, 1)
    image = rendering.colour_image(seen, paint)
    np.testing.assert_allclose(image[seen.raster.triangle == 0], 0.25, atol=1e-6)
    np.testing.assert_allclose(image[seen.raster.triangle == 1], 0.75, atol=1e-6)


def test_splats_hide_what_lies_behind_and_what_faces_away() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-50, 50, (6000, 2))
    front = np.column_stack([xy, np.zeros(6000)])
    behind, away = front - [0, 0, 30], front + [0, 0, 30]
    towards = np.tile([0.0, 0, 1], (6000, 1))
    points, normals = np.concatenate([front, behind, away]), np.concatenate([towards, towards, -towards])
    colours = np.repeat(np.eye(3), 6000, axis=0)
    drawn = splats.splat(points, normals, colours, 2.5, FRONT, 1)
    inside = drawn.colours[35:85, 35:85].reshape(-1, 3)
    assert (inside[:, 0] > 0.99).mean() > 0.99
    assert inside[:, 2].max() == 0
    depth = drawn.depth[35:85, 35:85]
    np.testing.assert_allclose(depth[np.isfinite(depth)].min(), 4000.0, atol=0.01)


def test_a_splats_place_and_size() -> None:
    drawn = splats.splat(
        np.array([[20.0, -10.0, 0.0]]),
        np.array([[0.0, 0, 1]]),
        np.ones((1, 3)),
        4.0,
        FRONT._replace(size=(160, 160)),
        1,
    )
    rows, columns = np.nonzero(np.isfinite(drawn.depth))
    assert columns.mean() + 0.5 == pytest.approx(100.0)
    assert rows.mean() + 0.5 == pytest.approx(90.0)
    assert len(rows) == pytest.approx(np.pi * 16, rel=0.1)


def test_drawing_repeats() -> None:
    vertices, triangles = sphere()
    paint = Paint(np.abs(vertices) / 60, np.full(len(vertices), 0.5))
    first, second = (rendering.draw(vertices, triangles, paint, FRONT) for _ in range(2))
    assert first.tobytes() == second.tobytes()
    clouds = [splats.draw_splats(splats.splat(vertices, vertices / 60, paint.colours, 3.0, FRONT)) for _ in "ab"]
    assert clouds[0].tobytes() == clouds[1].tobytes()
