"""PatchMatch: the kernel against a slow oracle, identities, recovery of known surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import stereo_scenes as scenes

from avatarbuild.geometry import patchmatch, stereo_views

SHAPE = (96, 96)
TARGET = np.array([0.0, 0.0, 0.0])
NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
K = scenes.calibration(200.0, *SHAPE)


@pytest.fixture(scope="module")
def plane_views():
    poses = [scenes.orbit(a, b, 200.0, TARGET) for a, b in ((0, 0), (14, 0), (-14, 2), (3, 15), (0, -13))]
    depth = [scenes.plane_depth(K, R, t, SHAPE, TARGET, NORMAL) for R, t in poses]
    return [scenes.view(i, K, R, t, z, 1) for i, ((R, t), z) in enumerate(zip(poses, depth))], depth


def true_planes(depth):
    """Planes of a planar depth map: inverse depth and its (constant) slopes."""
    q = 1.0 / depth
    slopes = np.stack([np.gradient(q, axis=1), np.gradient(q, axis=0)], axis=-1)
    return np.concatenate([q[..., None], slopes], axis=-1).astype(np.float32)


def oracle(views, plane, u, v, s, affine, half=5):
    """1 - NCC by the textbook: each sample through the plane's homography, or its derivative; bilinear; weighted."""
    ref, other = views[0], views[s]
    q, qu, qv = plane
    win = patchmatch.window(half)
    R = other.R @ ref.R.T
    t = other.t - R @ ref.t
    image = other.grey[0].astype(float)

    def lands(du, dv):
        pixel = np.array([u + du + 0.5, v + dv + 0.5, 1.0])
        x, y, depth = other.K @ (R @ (np.linalg.inv(ref.K) @ pixel / (q + qu * du + qv * dv)) + t)
        return np.array([x, y]) / depth - 0.5

    along_u, along_v = (lands(0.01, 0) - lands(-0.01, 0)) / 0.02, (lands(0, 0.01) - lands(0, -0.01)) / 0.02
    p, g, w = [], [], []
    for du, dv, spatial in zip(win.du, win.dv, win.w):
        x, y = lands(0, 0) + along_u * du + along_v * dv if affine else lands(du, dv)
        ix, iy = int(x), int(y)
        top = image[iy, ix] * (1 - x + ix) + image[iy, ix + 1] * (x - ix)
        low = image[iy + 1, ix] * (1 - x + ix) + image[iy + 1, ix + 1] * (x - ix)
        p.append(float(ref.grey[0][v + int(dv), u + int(du)]))
        g.append(top * (1 - y + iy) + low * (y - iy))
        w.append(spatial / (1 + ((p[-1] - float(ref.grey[0][v, u])) / 18.0) ** 2) ** 2)
    p, g, w = np.array(p), np.array(g), np.array(w) / np.sum(w)
    p, g = p - w @ p, g - w @ g
    return 1.0 - (w @ (p * g)) / np.sqrt((w @ p**2 + 1.0) * (w @ g**2 + 1.0))


def test_window_is_symmetric_and_of_32_samples():
    for half in (3, 5, 8):
        win = patchmatch.window(half)
        assert len(win.du) == 32
        assert np.allclose(np.sort(win.du), np.sort(-win.du))
        assert np.abs(win.du).max() == half
        assert np.allclose(win.du, np.round(win.du))


def test_cost_matches_the_oracle(plane_views):
    views, depth = plane_views
    planes = true_planes(depth[0])
    planes[..., 0] *= 1.004  # away from the optimum, so that the correlation is neither 1 nor noise
    planes[..., 1] *= 1.3
    pixels = np.array([[40, 50], [30, 33], [60, 41]], np.int32)
    for s in (1, 2, 3):
        cost = np.zeros(SHAPE, np.float32)
        src = stereo_views.source_images(views, 0, [s], 0, None)
        patchmatch.plane_costs(views[0].grey[0], pixels, planes, cost, patchmatch.window(5), src, 1, np.float32(0))
        for v, u in pixels:
            plane = planes[v, u].astype(float)
            expected = oracle(views, plane, u, v, s, affine=True)
            assert 0.01 < expected < 1.9
            assert cost[v, u] == pytest.approx(expected, abs=5e-4)
            # the window is 11 mm at 200 mm here, closer than any photo: the derivative serves for the homography
            assert cost[v, u] == pytest.approx(oracle(views, plane, u, v, s, affine=False), rel=0.15, abs=0.01)


def test_cost_is_the_mean_of_the_best(plane_views):
    views, depth = plane_views
    planes = true_planes(depth[0])
    planes[..., 0] *= 1.004
    pixels = np.array([[40, 50]], np.int32)

    def cost(sources, best):
        c = np.zeros(SHAPE, np.float32)
        src = stereo_views.source_images(views, 0, sources, 0, None)
        patchmatch.plane_costs(views[0].grey[0], pixels, planes, c, patchmatch.window(5), src, best, np.float32(0))
        return c[40, 50]

    single = sorted(cost([s], 1) for s in (1, 2, 3, 4))
    assert cost([1, 2, 3, 4], 2) == pytest.approx(np.mean(single[:2]), abs=1e-6)
    assert cost([1, 2, 3, 4], 3) == pytest.approx(np.mean(single[:3]), abs=1e-6)


def test_a_photo_against_itself_costs_only_the_noise(plane_views):
    """With the same camera every plane maps every pixel to itself: 1 - var / (var + e^2)."""
    views, depth = plane_views
    pixels = np.argwhere(np.ones(SHAPE, bool)).astype(np.int32)
    inside = (np.abs(pixels - 48) < 36).all(axis=1)
    cost = np.full(SHAPE, 9, np.float32)
    src = stereo_views.source_images([views[0], views[0]], 0, [1], 0, None)
    planes = true_planes(depth[0]) * np.float32(1.2)
    patchmatch.plane_costs(views[0].grey[0], pixels[inside], planes, cost, patchmatch.window(5), src, 1, np.float32(0))
    found = cost[13:84, 13:84]
    assert found.max() < 0.05
    assert found.min() > 1e-5


def test_the_true_plane_is_cheap_and_consistent(plane_views):
    views, depth = plane_views
    planes = [true_planes(z) for z in depth]
    pixels = np.array([[v, u] for v in range(30, 66) for u in range(30, 66)], np.int32)
    costs = []
    for weight in (0.0, 0.15):
        cost = np.zeros(SHAPE, np.float32)
        src = stereo_views.source_images(views, 0, [1, 2, 3, 4], 0, planes)
        patchmatch.plane_costs(
            views[0].grey[0], pixels, planes[0], cost, patchmatch.window(5), src, 2, np.float32(weight)
        )
        costs.append(cost[30:66, 30:66])
    assert np.median(costs[0]) < 0.02
    assert np.abs(costs[1] - costs[0]).max() < 0.15 * 0.05  # the sources' own planes lead back to within 0.05 pixel


def run_search(views, planes, sweeps, tries, steps, span):
    cost = np.full(SHAPE, 9, np.float32)
    low, high = np.full(SHAPE, 1 / 300, np.float32), np.full(SHAPE, 1 / 100, np.float32)
    pixels = np.argwhere(np.ones(SHAPE, bool)).astype(np.int32)
    src = stereo_views.source_images(views, 0, [1, 2, 3, 4], 0, None)
    win = patchmatch.window(5)
    patchmatch.plane_costs(views[0].grey[0], pixels, planes, cost, win, src, 2, np.float32(0))
    first = cost.copy()
    for n in range(sweeps):
        patchmatch.sweep(
            *(views[0].grey[0], pixels, planes, cost, low, high, np.float32(K[0, 0]), win, src, 2, np.float32(0)),
            *(n % 2 == 1, tries, steps, np.float32(span * 0.6**n), np.float32(0.6**n), 10 + n),
        )
    return first, cost


def test_search_from_random_planes_finds_the_plane(plane_views):
    views, depth = plane_views
    planes = np.zeros((*SHAPE, 3), np.float32)
    pixels = np.argwhere(np.ones(SHAPE, bool)).astype(np.int32)
    low, high = np.full(SHAPE, 1 / 300, np.float32), np.full(SHAPE, 1 / 100, np.float32)
    patchmatch.random_planes(planes, pixels, low, high, np.float32(K[0, 0]), 3)
    assert planes[..., 0].min() >= low.min()
    assert planes[..., 0].max() <= high.max()
    first, cost = run_search(views, planes, 5, 5, 1, 0.1)
    assert (cost <= first).all()
    error = np.abs(1 / planes[16:80, 16:80, 0] - depth[0][16:80, 16:80])
    assert 1e-5 < np.median(error) < 0.1  # a pixel is 1 mm here
    assert np.quantile(error, 0.95) < 1.0
    normals = patchmatch.plane_normals(planes, K)[16:80, 16:80] @ views[0].R
    assert np.median(np.degrees(np.arccos(np.clip(normals @ NORMAL, -1, 1)))) < 3.0


def test_gauss_newton_alone_returns_to_the_plane(plane_views):
    views, depth = plane_views
    planes = true_planes(depth[0]) * np.array([1.003, 0.8, 1.2], np.float32)
    before = np.abs(1 / planes[24:72, 24:72, 0] - depth[0][24:72, 24:72])
    run_search(views, planes, 1, 0, 5, 0.0)
    after = np.abs(1 / planes[24:72, 24:72, 0] - depth[0][24:72, 24:72])
    assert 1e-4 < np.median(after) < 0.2 * np.median(before)


def test_search_repeats_bit_for_bit(plane_views):
    views, depth = plane_views
    runs = []
    for _ in range(2):
        planes = true_planes(depth[0]) * np.float32(1.02)
        run_search(views, planes, 2, 3, 1, 0.05)
        runs.append(planes.tobytes())
    assert runs[0] == runs[1]


def test_finer_is_exact_on_planes():
    def plane(shape, step):
        v, u = (np.mgrid[: shape[0], : shape[1]] + 0.5) * step
        q = 0.005 + 1e-5 * u - 2e-5 * v
        return np.stack([q, np.full(shape, 1e-5 * step), np.full(shape, -2e-5 * step)], axis=-1).astype(np.float32)

    assert np.allclose(patchmatch.finer(plane((5, 7), 2), (10, 14)), plane((10, 14), 1), atol=1e-9)


def test_normals_by_hand():
    planes = np.zeros((2, 2, 3), np.float32)
    planes[0] = (0.01, 0.0, 0.0)
    normals = patchmatch.plane_normals(planes, np.diag([100.0, 100.0, 1.0]))
    assert np.allclose(normals[0], [0, 0, -1])
    assert (normals[1] == 0).all()
    # x + z = 100: q = (1 + u / f) / 100
    _, u = np.mgrid[:2, :2] + 0.5
    tilted = np.stack([(1 + u / 100) / 100, np.full((2, 2), 1e-4), np.zeros((2, 2))], axis=-1)
    assert np.allclose(patchmatch.plane_normals(tilted, np.diag([100.0, 100.0, 1.0])), [-(0.5**0.5), 0, -(0.5**0.5)])
