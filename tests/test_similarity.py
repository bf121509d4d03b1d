"""The similarity between corresponding points."""

import numpy as np
from scipy.spatial.transform import Rotation

from avatarbuild.geometry.similarity import similarity


def test_recovers_a_similarity_exactly() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(20, 3))
    rotation = Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix()
    b = 2.5 * a @ rotation.T + [1, -2, 3]
    s, r, t = similarity(a, b, rng.uniform(0.1, 1, 20))
    np.testing.assert_allclose(s, 2.5)
    np.testing.assert_allclose(r, rotation, atol=1e-12)
    np.testing.assert_allclose(t, [1, -2, 3], atol=1e-12)


def test_never_mirrors_and_ignores_points_of_no_weight() -> None:
    a = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [9, 9, 9]])
    _, r, _ = similarity(a, a * [-1, 1, 1])
    assert np.linalg.det(r) > 0
    b = a.copy()
    b[4] = [-50, 3, 7]
    s, r, t = similarity(a, b, np.array([1.0, 1, 1, 1, 0]))
    np.testing.assert_allclose((s, *np.diag(r), *t), (1, 1, 1, 1, 0, 0, 0), atol=1e-12)
