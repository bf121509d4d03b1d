"""Ambient occlusion in texture space: a plane, a corner by its formula, rays, invariances."""

from __future__ import annotations

import numpy as np
import pytest

from avatarbuild.details.ambient_occlusion import ambient_occlusion, surface_normals, texel_areas
from avatarbuild.geometry.rotations import rotation
from avatarbuild.texture.occlusion import ambient

SIDE = 128


def _plane(step: float = 0.5) -> np.ndarray:
    """(s, s, 3): x along the columns, y up the rows."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    return np.stack([columns * step, -rows * step, np.zeros((SIDE, SIDE))], axis=-1)


def _bumps() -> np.ndarray:
    x = _plane(0.4)
    x[..., 2] = 0.5 * np.sin(x[..., 0] / 1.2) * (1 + 0.5 * np.sin(x[..., 1] / 3)) + 4 * np.cos(x[..., 0] / 9)
    return x


def _open(x: np.ndarray, **more: np.ndarray) -> np.ndarray:
    mask = np.ones(x.shape[:2], bool)
    return ambient_occlusion(x, surface_normals(x, mask), mask, **more)


def test_a_plane_is_open():
    assert (_open(_plane()) == 1).all()


def test_areas_and_normals_of_a_slope():
    x = _plane()
    x[..., 2] = x[..., 0]
    mask = np.ones((SIDE, SIDE), bool)
    assert np.allclose(texel_areas(x, mask), 0.25 * np.sqrt(2))
    assert np.allclose(surface_normals(x, mask), np.array([-1, 0, 1]) / np.sqrt(2))


def test_a_wall_hides_what_its_view_factor_says():
    # the columns of the first half are the floor, those of the second climb a wall of 32 mm
    x = _plane()
    half = SIDE // 2
    x[:, half:, 2] = x[:, half:, 0] - x[0, half, 0]
    x[:, half:, 0] = x[0, half, 0]
    found = _open(x)
    for column in (40, 48, 56):
        away = x[0, half, 0] - x[0, column, 0]
        # perpendicular strip without ends: (1 - 1 / sqrt(1 + (h / d)^2)) / 2; this one ends 32 mm to both sides
        endless = 0.5 * (1 - 1 / np.sqrt(1 + (x[0, -1, 2] / away) ** 2))
        assert 0.85 * endless < 1 - found[half, column] < 1.03 * endless


def test_against_rays():
    x = _bumps()
    found = _open(x)
    number = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    square = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    triangles = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]])
    inner = number[16:-16:5, 16:-16:5].reshape(-1)
    normals = surface_normals(x, np.ones((SIDE, SIDE), bool)).reshape(-1, 3)[inner]
    true, _ = ambient(x.reshape(-1, 3), triangles, x.reshape(-1, 3)[inner], normals.astype(float), 200, 0.01)
    error = np.abs(found.reshape(-1)[inner] - true).mean()
    assert 1e-4 < error < 0.4 * np.abs(true - np.median(true)).mean()


def test_size_and_place_do_not_matter():
    x = _bumps()
    turned = 3 * x @ rotation(np.array([0.4, 1.0, -0.3])).T + [5.0, -8.0, 2.0]
    assert np.abs(_open(turned) - _open(x)).max() < 1e-3


def test_the_same_every_time_and_only_where_asked():
    x = _bumps()
    first = _open(x)
    assert np.array_equal(first, _open(x))
    wanted = np.zeros((SIDE, SIDE), bool)
    wanted[30:50, 60:90] = True
    some = _open(x, wanted=wanted)
    assert np.array_equal(some[wanted], first[wanted])
    assert (some[~wanted] == 1).all()


def test_what_is_no_surface_hides_nothing():
    x = _bumps()
    mask = np.ones((SIDE, SIDE), bool)
    mask[:, 70:] = False
    spoilt = x.copy()
    spoilt[:, 70:] = np.nan
    normals = surface_normals(np.where(mask[..., None], x, 0), mask)
    with np.errstate(invalid="ignore"):
        found = ambient_occlusion(spoilt, normals, mask)
    assert np.isfinite(found).all()
    assert (found[:, 70:] == 1).all()
    assert found[:, :70].min() < 0.9


@pytest.mark.parametrize("side", [100, 64])
def test_sides_are_multiples_of_sixteen(side):
    x, mask = np.zeros((side, side, 3)), np.ones((side, side), bool)
    if side % 16:
        with pytest.raises(AssertionError):
            ambient_occlusion(x, x, mask)
    else:
        assert (ambient_occlusion(x, x, mask) == 1).all()
