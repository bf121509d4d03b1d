from __future__ import annotations

import cv2
import numpy as np
import pytest
from captures import benchmark_photo

from avatarbuild.focus import blur_radius, measure
from avatarbuild.landmarks import find_faces


def blobs(seed: int = 0) -> np.ndarray:
    """Sharp-edged discs drawn four times too large and averaged down."""
    rng = np.random.default_rng(seed)
    canvas = np.full((1600, 1600, 3), 128, np.uint8)
    for _ in range(60):
        x, y, r = rng.integers(0, 1600), rng.integers(0, 1600), rng.integers(60, 200)
        cv2.circle(canvas, (int(x), int(y)), int(r), rng.integers(30, 226, 3).tolist(), -1)
    return cv2.resize(canvas, (400, 400), interpolation=cv2.INTER_AREA)


def blurred(rgb: np.ndarray, width: float) -> np.ndarray:
    return cv2.GaussianBlur(rgb, (0, 0), width) if width else rgb


@pytest.mark.parametrize("width", [1.0, 1.5, 2.0, 3.0])
def test_a_known_blur_is_measured(width: float) -> None:
    assert blur_radius(blurred(blobs(), width)) == pytest.approx(width, rel=0.2)


def test_blur_grows_and_sharp_edges_are_sharp() -> None:
    radii = [blur_radius(blurred(blobs(), width)) for width in (0.0, 1.0, 2.0, 4.0)]
    assert radii[0] < 0.6
    assert radii == sorted(radii)


def test_motion_in_one_direction_counts_whatever_the_direction() -> None:
    radii = []
    for angle in (0, 45, 90, 160):
        kernel = np.zeros((15, 15), np.float32)
        d = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))]) * 5
        cv2.line(kernel, tuple(np.round(7 - d).astype(int).tolist()), tuple(np.round(7 + d).astype(int).tolist()), 1)
        radii.append(blur_radius(cv2.filter2D(blobs(), -1, kernel / kernel.sum())))
    assert min(radii) > 2.0
    assert max(radii) < 5.0


def test_a_flat_picture_is_blurred() -> None:
    assert blur_radius(np.full((50, 50, 3), 90, np.uint8)) == 20.0


def test_colours_by_hand() -> None:
    rgb = np.zeros((40, 60, 3), np.uint8)
    rgb[:] = (188, 188, 128)
    rgb[:, :15] = 255
    m = measure(rgb, None)
    low = ((128 / 255 + 0.055) / 1.055) ** 2.4
    high = ((188 / 255 + 0.055) / 1.055) ** 2.4
    assert m.exposure == pytest.approx(0.9278 * high + 0.0722 * low)
    assert m.clipped == pytest.approx(0.25)
    assert m.white_balance[0] == pytest.approx(0.0)
    assert m.white_balance[1] == pytest.approx(np.log((3 * low + 1) / (3 * high + 1)))
    assert np.isnan(m.side_light)


def test_a_face_lit_from_one_side_and_its_mirror_image() -> None:
    rgb = benchmark_photo(18)
    points = find_faces(rgb)[0].points
    m = measure(rgb, points)
    flipped = np.ascontiguousarray(rgb[:, ::-1])
    other = measure(flipped, find_faces(flipped)[0].points)
    assert abs(m.side_light) > 0.5
    assert other.side_light == pytest.approx(-m.side_light, abs=0.15)
    assert other.exposure == pytest.approx(m.exposure, rel=0.05)
    assert measure(blurred(rgb, 3.0), points).blur > m.blur + 1
