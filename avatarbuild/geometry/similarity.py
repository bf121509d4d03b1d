"""The similarity between two sets of corresponding points."""

from __future__ import annotations

import numpy as np


def similarity(a: np.ndarray, b: np.ndarray, weights: np.ndarray | None = None) -> tuple[float, np.ndarray, np.ndarray]:
    """
    argmin_{s, R, t} sum_i w_i || s R a_i + t - b_i ||^2, in closed form [Umeyama 1991].

    a, b (n, 3), weights (n,). Returns s, R (3, 3) a rotation, t (3,).
    """
    w = np.full(len(a), 1.0 / len(a)) if weights is None else weights / weights.sum()
    mean_a, mean_b = w @ a, w @ b
    x, y = a - mean_a, b - mean_b
    u, sigma, vt = np.linalg.svd((y * w[:, None]).T @ x)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((sigma * sign).sum() / (w @ (x**2).sum(axis=1)))
    return scale, rotation, mean_b - scale * rotation @ mean_a
