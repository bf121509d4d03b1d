"""Points in space from rays."""

import numpy as np

from avatarbuild.geometry.triangulation import triangulate


def rays(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    d = points[:, None] - centres
    return d / np.linalg.norm(d, axis=2, keepdims=True)


def test_two_rays_by_hand() -> None:
    centres = np.array([[0.0, 0, 0], [2, 0, 0]])
    x, angles = triangulate(centres, rays(np.array([[1.0, 0, 5]]), centres), np.ones((1, 2)))
    np.testing.assert_allclose(x, [[1, 0, 5]], atol=1e-9)
    np.testing.assert_allclose(angles, 0, atol=1e-9)


def test_outliers_and_missing_views_do_not_matter() -> None:
    rng = np.random.default_rng(1)
    centres = np.c_[np.linspace(-300, 300, 12), np.zeros(12), np.full(12, -400.0)]
    points = rng.normal(size=(30, 3)) * 40
    directions = rays(points, centres)
    directions += rng.normal(size=directions.shape) * 0.0005
    directions[:, 3] += [0.1, 0.05, 0]
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    weights = np.ones((30, 12))
    weights[:10, 6:] = 0
    weights[29, 1:] = 0
    x, angles = triangulate(centres, directions, weights)
    error = np.linalg.norm(x - points, axis=1)
    assert 0.01 < np.median(error[:29]) < 0.6
    assert error[:29].max() < 3
    assert np.isnan(x[29]).all()
    assert np.isnan(angles[:10, 6:]).all()
