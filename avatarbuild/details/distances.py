"""
How far an expression is from the keyframes, as each place of the face sees it: the strain of near edges counts.

Letters: k keyframes, e edges, u texture coordinates of the template (its vertices, cut at the seams).
"""

from __future__ import annotations

import numpy as np

BETA = 0.15  # 1/mm


def shares(points: np.ndarray, first: np.ndarray, second: np.ndarray, beta: float = BETA) -> np.ndarray:
    """
    alpha_e = abar_e / sum abar, abar_e = exp(-beta (|p - e1| + |p - e2| - |e1 - e2|))   (17)

    (u, e) float32 of points (u, 3) and ends (e, 3), (e, 3) mm of one keyframe. The length is that of the keyframe as
    well, so that the bracket is nil on the edge itself and nowhere negative.
    """
    p = np.asarray(points, np.float64)
    excess = -np.linalg.norm(first - second, axis=1) + np.zeros((len(p), 1))
    for end in (first, second):
        excess += np.linalg.norm(p[:, None] - end, axis=2)
    # far from all edges every exponential is nil, but not their ratios
    weight = np.exp(-beta * (excess - excess.min(axis=1, keepdims=True)))
    return (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)


def distances(alpha: np.ndarray, strain: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """phi_k = |D_k^(1/2) (f - f_k)|, phi(x) = x of (16): (u, k) float32 of alpha (k, u, e), f (e,), f_k (k, e)."""
    square = ((strain - keys) ** 2).astype(np.float32)
    return np.sqrt(np.stack([a @ s for a, s in zip(alpha, square, strict=True)], axis=1))


def positions_at(maps: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """
    (k, u, 3) float32: position maps (k, s, s, 3), row 0 on top (v = 1), read bilinearly at uv (u, 2).

    The border is held; texel centres lie at +0.5. The shader reads the same four texels.
    """
    side = maps.shape[1]
    column = np.clip(uv[:, 0] * side - 0.5, 0, side - 1).astype(np.float32)
    row = np.clip((1 - uv[:, 1]) * side - 0.5, 0, side - 1).astype(np.float32)
    j, i = np.minimum(column.astype(int), side - 2), np.minimum(row.astype(int), side - 2)
    x, y = (column - j)[:, None], (row - i)[:, None]
    top = maps[:, i, j] * (1 - x) + maps[:, i, j + 1] * x
    bottom = maps[:, i + 1, j] * (1 - x) + maps[:, i + 1, j + 1] * x
    return top * (1 - y) + bottom * y
