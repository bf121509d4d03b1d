"""Fusion of known plane maps; clean-up of point clouds."""

from __future__ import annotations

import numpy as np
import pytest
import stereo_scenes as scenes

from avatarbuild.geometry import fusion, patchmatch, point_clouds

SHAPE = (60, 60)
K = scenes.calibration(120.0, *SHAPE)
RULE = fusion.Agreement(1.0, np.cos(np.radians(40)), 2, np.cos(np.radians(5)), 0.5)


def wall(poses, offsets=None, weights=None, normal=(0.0, 0.0, 1.0)):
    """Maps of a plane through the origin, each camera's moved by its offset towards it."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    planes = []
    for i, (R, t) in enumerate(poses):
        q = 1.0 / scenes.plane_depth(K, R, t, SHAPE, (offsets[i] if offsets else 0.0) * normal, normal)
        planes.append(np.stack([q, np.gradient(q, axis=1), np.gradient(q, axis=0)], axis=-1).astype(np.float32))
    weight = [np.full(SHAPE, w, np.float32) for w in (weights or [1.0] * len(poses))]
    R, t = np.array([p[0] for p in poses]), np.array([p[1] for p in poses])
    return fusion.join_maps(planes, weight, np.array([K] * len(poses)), R, t), -np.einsum("kji,kj->ki", R, t)


def poses(angles):
    return [scenes.orbit(a, 0.0, 120.0, np.zeros(3)) for a in angles]


def fused(maps, centres, i, others, rule=RULE):
    point, normal = np.zeros((*SHAPE, 3), np.float32), np.zeros((*SHAPE, 3), np.float32)
    views = np.zeros(SHAPE, np.uint8)
    fusion.fuse(maps, i, np.array(others, np.int64), centres, rule, point, normal, views)
    return point, normal, views


MIDDLE = (slice(20, 40), slice(20, 40))


def test_points_lie_at_the_weighted_mean():
    maps, centres = wall(poses((0, 12, -12)), [0.0, 0.3, 0.6], [1.0, 2.0, 1.0])
    point, normal, views = fused(maps, centres, 0, [1, 2])
    assert (views[MIDDLE] == 3).all()
    assert np.allclose(point[MIDDLE][..., 2], (0.0 + 2 * 0.3 + 0.6) / 4, atol=1e-4)
    assert np.allclose(normal[MIDDLE], [0, 0, 1], atol=1e-4)


def test_a_view_that_is_off_takes_no_part():
    maps, centres = wall(poses((0, 12, -12, 20)), [0.0, 0.2, 0.1, -8.0])
    point, _, views = fused(maps, centres, 0, [1, 2, 3])
    assert (views[MIDDLE] == 3).all()
    assert np.allclose(point[MIDDLE][..., 2], 0.1, atol=1e-4)


@pytest.mark.parametrize(
    "angles, offsets, why",
    [
        ((0, 12), [0, 0], "one agreeing view is too few"),
        ((0, 2, -2), [0, 0, 0], "they span too small an angle"),
        ((0, 12, -12, 20, -20), [0, 0, 0, -8, -8], "as many see through the point as agree"),
    ],
)
def test_what_is_not_confirmed_is_dropped(angles, offsets, why):
    maps, centres = wall(poses(angles), [float(o) for o in offsets])
    assert not fused(maps, centres, 0, range(1, len(angles)))[2][MIDDLE].any(), why


def test_a_hidden_point_is_no_contradiction():
    """Views whose surface lies before the point cannot see it."""
    maps, centres = wall(poses((0, 12, -12, 20, -20)), [0.0, 0.0, 0.0, 8.0, 8.0])
    assert (fused(maps, centres, 0, range(1, 5))[2][MIDDLE] == 3).all()


def test_normals_must_agree():
    maps, _ = wall(poses((0, 12, -12)))
    tilted, _ = wall(poses((0, 12, -12)), normal=(1.0, 0.0, 0.7))
    size = SHAPE[0] * SHAPE[1]
    maps.planes[size:] = tilted.planes[size:]
    agree = np.zeros(SHAPE, np.uint8)
    fusion.count_agreeing(maps, 0, np.array([1, 2], np.int64), RULE, agree)
    assert not agree.any()


def test_one_view_owns_each_point():
    """Equal weights: the lowest index; greater weight: that view. Together one sample a surface element."""
    for weights, owner in (([1.0, 1.0, 1.0], 0), ([1.0, 3.0, 1.0], 1)):
        maps, _ = wall(poses((0, 12, -12)), weights=weights)
        shares = []
        for i in range(3):
            keep = np.zeros(SHAPE, np.bool_)
            fusion.owned(maps, i, np.array([j for j in range(3) if j != i], np.int64), RULE, keep)
            shares.append(keep[MIDDLE].mean())
        assert shares[owner] == 1.0
        assert sum(shares) == 1.0


def test_agreement_does_not_depend_on_the_order_of_views():
    maps, centres = wall(poses((0, 12, -12, 20)), [0.0, 0.3, 0.1, 0.2])
    first = fused(maps, centres, 0, [1, 2, 3])
    second = fused(maps, centres, 0, [3, 1, 2])
    assert np.array_equal(first[2], second[2])
    assert np.allclose(first[0], second[0], atol=1e-5)


def test_a_sphere_fused_from_its_true_maps():
    radius = 40.0
    views = [scenes.orbit(a, b, 200.0, np.zeros(3)) for a, b in ((0, 0), (15, 0), (-15, 0), (0, 15))]
    Ks = scenes.calibration(200.0, *SHAPE)
    planes = []
    for R, t in views:
        z = scenes.sphere_depth(Ks, R, t, SHAPE, np.zeros(3), radius)
        q = np.where(np.isfinite(z), 1.0 / z, 0.0)
        planes.append(np.stack([q, np.gradient(q, axis=1), np.gradient(q, axis=0)], axis=-1).astype(np.float32))
    R, t = np.array([v[0] for v in views]), np.array([v[1] for v in views])
    maps = fusion.join_maps(planes, [p[..., 0] for p in planes], np.array([Ks] * 4), R, t)
    point, normal, seen = fused(maps, -np.einsum("kji,kj->ki", R, t), 0, [1, 2, 3])
    good = seen[MIDDLE] >= 3
    assert good.mean() > 0.99
    distance = np.linalg.norm(point[MIDDLE][good], axis=-1)
    assert 1e-5 < np.abs(distance - radius).max() < 0.2  # a pixel is 0.8 mm; planes are cords of the sphere
    outward = (normal[MIDDLE][good] * point[MIDDLE][good]).sum(axis=-1) / distance
    assert outward.min() > np.cos(np.radians(5))
    assert np.allclose(patchmatch.plane_normals(planes[0], Ks)[30, 30], [0, 0, -1], atol=0.05)


def grid(n=30):
    return np.stack(np.meshgrid(np.arange(n), np.arange(n), [0.0]), axis=-1).reshape(-1, 3)


def test_lonely_points_go_and_the_rim_stays():
    points = np.vstack([grid(), [[15.0, 15.0, 20.0], [50.0, 50.0, 0.0]]])
    alone = point_clouds.lonely(points)
    assert alone[-2:].all()
    assert not alone[:-2].any()


def test_small_pieces_go():
    points = np.vstack([grid(), grid(5) + [100.0, 0.0, 0.0]])
    small = point_clouds.small_pieces(points, 2.0, 100)
    assert small[-25:].all()
    assert not small[:-25].any()
    assert not point_clouds.small_pieces(points, 2.0, 25).any()


def test_points_within_an_outline():
    """A square of 20 pixels around the middle, seen by two of three cameras; the third faces away."""
    cams = poses((0, 15, 180))
    P = [K @ np.hstack([R, t[:, None]]) for R, t in cams]
    centres = np.array([-R.T @ t for R, t in cams])
    square = np.array([[20.0, 20.0], [40.0, 20.0], [40.0, 40.0], [20.0, 40.0]])
    points = np.array([[0.0, 0.0, 0.0], [25.0, 0.0, 0.0], [0.0, -30.0, 0.0]])
    inside = point_clouds.within_outlines(points, np.tile([0.0, 0.0, 1.0], (3, 1)), P, centres, [[square]] * 3)
    assert inside.tolist() == [True, False, False]
