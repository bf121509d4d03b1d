"""Where patches of different photos meet on the chart: the pairs of texels, and the step between the photos there."""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, parallel=True)
def texel_labels(
    triangle: np.ndarray, barycentric: np.ndarray, triangles: np.ndarray, label: np.ndarray, out: np.ndarray
) -> None:
    """out (s, s) int16: the label with the largest barycentric share among the corners' labels (n,), -1 outside."""
    h, w = triangle.shape
    for i in numba.prange(h):
        for j in range(w):
            f = triangle[i, j]
            out[i, j] = -1
            if f < 0:
                continue
            a, b, c = label[triangles[f, 0]], label[triangles[f, 1]], label[triangles[f, 2]]
            u, v, t = barycentric[i, j, 0], barycentric[i, j, 1], barycentric[i, j, 2]
            if a == b:
                u, v = u + v, np.float32(-1)
            if a == c:
                u, t = u + t, np.float32(-1)
            elif b == c:
                v, t = v + t, np.float32(-1)
            out[i, j] = a if u >= v and u >= t else b if v >= t else c


def border_pairs(label: np.ndarray) -> np.ndarray:
    """(l, 2) flat indices of neighbours, right or down, whose labels (s, s) differ and are not -1."""
    s = label.shape[1]
    across = (label[:, :-1] != label[:, 1:]) & (label[:, :-1] >= 0) & (label[:, 1:] >= 0)
    row, column = np.nonzero(across)
    right = row * s + column
    row, column = np.nonzero((label[:-1] != label[1:]) & (label[:-1] >= 0) & (label[1:] >= 0))
    down = row * s + column
    return np.concatenate([np.stack([right, right + 1], axis=1), np.stack([down, down + s], axis=1)])


@numba.njit(cache=True, parallel=True)
def correct(
    colour: np.ndarray,
    label: np.ndarray,
    texel: np.ndarray,
    triangle: np.ndarray,
    barycentric: np.ndarray,
    triangles: np.ndarray,
    gains: np.ndarray,
    offset: np.ndarray,
) -> None:
    """colour (n, 3) of texels (n,) <- gain colour + offset (p, n, 3) of the photo label (n,), interpolated."""
    for i in numba.prange(len(label)):
        k = label[i]
        if k < 0:
            continue
        f = triangle[texel[i]]
        for c in range(3):
            shift = np.float32(0)
            for corner in range(3):
                shift += barycentric[texel[i], corner] * offset[k, triangles[f, corner], c]
            colour[i, c] = gains[k, c] * colour[i, c] + shift
