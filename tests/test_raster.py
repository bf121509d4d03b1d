"""The rasteriser against a brute-force oracle, exact coverage of shared edges, perspective, and texture filtering."""

import numba
import numpy as np
import pytest

from avatarbuild.geometry.mipmap import build_mipmap, sample_texture
from avatarbuild.geometry.raster import box_average, interpolate, project, rasterise


def _oracle(pixels, depth, triangles, size):
    """Nearest triangle of every pixel centre, by plain barycentric coordinates; also the gap to the second nearest
    and the smallest distance to an edge, to tell where rounding may decide."""
    w, h = size
    nearest = np.full((h, w), 1e8)
    second = np.full((h, w), 1e9)
    margin = np.full((h, w), np.inf)
    chosen = np.full((h, w), -1)
    y, x = np.mgrid[0:h, 0:w] + 0.5
    for f, face in enumerate(triangles):
        a, b, c = pixels[face]
        edges = np.array([b - a, c - a])
        area = np.linalg.det(edges)
        if abs(area) < 1e-12:
            continue
        l12 = np.stack([x - a[0], y - a[1]], -1) @ np.linalg.inv(edges)
        l = np.concatenate([1 - l12.sum(-1, keepdims=True), l12], -1)
        lengths = np.linalg.norm([c - b, a - c, b - a], axis=1)
        margin = np.minimum(margin, np.abs(l * abs(area) / lengths).min(-1))
        z = 1 / (l @ (1 / depth[face]))
        hit = (l >= 0).all(-1)
        closer = hit & (z < nearest)
        second = np.where(closer, nearest, np.where(hit, np.minimum(second, z), second))
        chosen = np.where(closer, f, chosen)
        nearest = np.where(closer, z, nearest)
    return chosen, nearest, second, margin


def _grid(n, size, seed=0, jitter=0.2):
    """A jittered grid of (n + 1)^2 vertices over the rectangle 0 … size, 2 n^2 triangles that cover it exactly once."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : n + 1, 0 : n + 1].astype(float)
    inner = (x > 0) & (x < n) & (y > 0) & (y < n)
    x, y = x + rng.uniform(-jitter, jitter, x.shape) * inner, y + rng.uniform(-jitter, jitter, y.shape) * inner
    pixels = np.stack([x * size[0] / n, y * size[1] / n], -1).reshape(-1, 2)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1)
    triangles = np.concatenate([np.stack([i, i + n + 2, i + 1], 1), np.stack([i, i + n + 1, i + n + 2], 1)])
    return pixels, triangles


def _doubled_areas(pixels, triangles):
    a, b, c = np.moveaxis(pixels[triangles], 1, 0)
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def test_agrees_with_the_brute_force_oracle():
    rng = np.random.default_rng(3)
    pixels = rng.uniform(-15, 75, (90, 2))
    depth = rng.uniform(50, 90, 90)
    triangles = rng.integers(0, 90, (60, 3))
    triangles = triangles[(np.diff(np.sort(triangles, 1), axis=1) > 0).all(1)]
    size = (64, 48)
    drawn = rasterise(pixels, depth, triangles, size)
    chosen, nearest, second, margin = _oracle(pixels, depth, triangles, size)
    certain = (margin > 0.01) & (second - nearest > 0.05)
    assert certain.mean() > 0.4
    assert (drawn.triangle == chosen)[certain].all()
    covered = certain & (chosen >= 0)
    np.testing.assert_allclose(drawn.depth[covered], nearest[covered], rtol=2e-3)
    np.testing.assert_allclose(drawn.barycentric[drawn.triangle >= 0].sum(-1), 1, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_shared_edges_leave_no_gap_and_no_double(seed):
    size = (61, 47)
    pixels, triangles = _grid(12, size, seed)
    # Rounding to half pixels puts many edges and vertices exactly through pixel centres.
    for vertices in (pixels, np.round(pixels * 2) / 2):
        claims = np.zeros((size[1], size[0]), int)
        assert (_doubled_areas(vertices, triangles) < 0).all()
        for face in triangles:
            claims += rasterise(vertices, np.ones(len(vertices)), face[None], size).triangle >= 0
        assert (claims == 1).all()


def test_barycentric_is_perspective_correct():
    """Points of a slanted plane in space come back from barycentric interpolation of its corners."""
    K = np.array([[300, 0, 100], [0, 300, 80], [0, 0, 1.0]])
    corners = np.array([[-150, -100, 400], [180, -90, 900], [10, 160, 500.0]])
    pixels, depth = project(corners, K, np.zeros(5), np.eye(3), np.zeros(3))
    drawn = rasterise(pixels, depth, np.array([[0, 1, 2]]), (200, 160))
    inside = drawn.triangle >= 0
    assert inside.sum() > 2000
    space = interpolate(corners, np.array([[0, 1, 2]]), drawn.triangle, drawn.barycentric)
    y, x = np.nonzero(inside)
    again, z = project(space[inside].astype(float), K, np.zeros(5), np.eye(3), np.zeros(3))
    np.testing.assert_allclose(again, np.stack([x, y], 1) + 0.5, atol=2e-2)
    np.testing.assert_allclose(z, drawn.depth[inside], rtol=1e-5)


def test_near_plane_culling_and_ties():
    pixels = np.array([[1, 1], [1, 9], [9, 1], [1, 1], [1, 9], [9, 1.0]])
    depth = np.array([5, 5, 5, 5, 5, 5.0])
    front, back = [0, 1, 2], [3, 5, 4]
    assert (rasterise(pixels, depth, np.array([front, back]), (10, 10)).triangle >= 0).sum() == 36 - 8
    drawn = rasterise(pixels, depth, np.array([back, front]), (10, 10))
    assert set(np.unique(drawn.triangle)) == {-1, 0}
    drawn = rasterise(pixels, depth, np.array([back, front]), (10, 10), cull=True)
    assert set(np.unique(drawn.triangle)) == {-1, 1}
    assert (rasterise(pixels, depth, np.array([front]), (10, 10), near=6).triangle == -1).all()
    behind = np.array([5, -5, 5, 5, 5, 5.0])
    assert (rasterise(pixels, behind, np.array([front]), (10, 10)).triangle == -1).all()


def test_culling_keeps_what_faces_the_camera():
    corners = np.array([[0, 0, 0], [50, 0, 0], [0, 50, 0.0]])  # counter-clockwise seen from +z
    K = np.array([[100, 0, 50], [0, 100, 50], [0, 0, 1.0]])
    seen = project(corners, K, np.zeros(5), np.diag([1, -1, -1]), np.array([0, 0, 100]))
    assert (rasterise(*seen, np.array([[0, 1, 2]]), (100, 100), cull=True).triangle == 0).any()
    seen = project(corners, K, np.zeros(5), np.diag([-1, -1, 1]), np.array([0, 0, 100]))
    assert (rasterise(*seen, np.array([[0, 1, 2]]), (100, 100), cull=True).triangle == -1).all()


def test_projection_follows_the_distortion_model_of_opencv():
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(0)
    points = rng.uniform([-100, -100, 300], [100, 100, 500], (50, 3))
    K = np.array([[800, 0, 310], [0, 820, 250], [0, 0, 1.0]])
    dist = np.array([0.07, -0.17, 1e-3, -2e-3, 0.1])
    R, t = cv2.Rodrigues(np.array([0.1, -0.2, 0.05]))[0], np.array([5, -3, 20.0])
    expected = cv2.projectPoints(points, R, t, K, dist)[0][:, 0]
    np.testing.assert_allclose(project(points, K, dist, R, t)[0], expected, atol=1e-9)


def test_the_number_of_threads_does_not_matter():
    pixels, triangles = _grid(30, (200, 170))
    depth = np.random.default_rng(1).uniform(10, 20, len(pixels))
    results = []
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        before = numba.get_num_threads()
        numba.set_num_threads(threads)
        results.append(rasterise(pixels, depth, triangles, (200, 170)))
        numba.set_num_threads(before)
    for one, other in zip(*results):
        assert (one == other).all()


def test_texture_is_exact_on_linear_functions_and_upright():
    """A texture linear in u and v is reproduced away from its border, whatever the level that is chosen."""
    n = 64
    ramp = (np.arange(n) + 0.5) / n
    texture = np.stack(np.broadcast_arrays(ramp[None, :], 1 - ramp[:, None]), -1)
    K = np.array([[150, 0, 60], [0, 150, 50], [0, 0, 1.0]])
    corners = np.array([[-60, 50, 300], [60, 50, 200], [60, -50, 200], [-60, -50, 300.0]])
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    pixels, depth = project(corners, K, np.zeros(5), np.eye(3), np.zeros(3))
    drawn = rasterise(pixels, depth, triangles, (120, 100))
    found = sample_texture(build_mipmap(texture), drawn, pixels, depth, triangles, uv, triangles)
    expected = interpolate(uv, triangles, drawn.triangle, drawn.barycentric)
    inner = (drawn.triangle >= 0) & (np.abs(expected - 0.5) < 0.42).all(-1)
    assert inner.sum() > 1500
    np.testing.assert_allclose(found[inner], expected[inner], atol=5e-3)


def test_texture_is_filtered_where_it_is_finer_than_the_pixels():
    """A chequerboard seen from far is grey, and repeats when asked to."""
    y, x = np.mgrid[0:128, 0:128]
    texture = ((x + y) % 2).astype(float)[..., None]
    pixels = np.array([[0, 0], [16, 0], [16, 16], [0, 16.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    drawn = rasterise(pixels, np.ones(4), triangles, (16, 16))
    for uv in (np.array([[0, 1], [1, 1], [1, 0], [0, 0.0]]), np.array([[0, 3], [3, 3], [3, 0], [0, 0.0]])):
        seen = sample_texture(build_mipmap(texture), drawn, pixels, np.ones(4), triangles, uv, triangles, repeat=True)
        np.testing.assert_allclose(seen, 0.5, atol=1e-6)


def test_box_average_undoes_supersampling():
    image = np.random.default_rng(0).random((8, 12, 3)).astype(np.float32)
    big = image.repeat(3, axis=0).repeat(3, axis=1)
    np.testing.assert_allclose(box_average(big, 3), image, rtol=1e-6)
    np.testing.assert_allclose(box_average(big[..., 0], 3), image[..., 0], rtol=1e-6)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 6])
def test_every_channel_is_sampled(channels: int) -> None:
    pixels = np.array([[0.0, 0], [16, 0], [16, 16], [0, 16]])
    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    drawn = rasterise(pixels, np.ones(4), triangles, (16, 16))
    levels = np.arange(1.0, channels + 1)
    texture = np.tile(levels, (32, 32, 1))
    found = sample_texture(build_mipmap(texture), drawn, pixels, np.ones(4), triangles, uv, triangles)
    np.testing.assert_allclose(found, np.tile(levels, (16, 16, 1)), rtol=1e-6)
