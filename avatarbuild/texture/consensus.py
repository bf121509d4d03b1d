"""The colour that the photos agree on over a few millimetres: highlights move from photo to photo, skin does not.

With B_in the gain-corrected colour of photo i around node n, averaged over the surface that it sees, and w its weight,
q_n = the trimmed weighted mean of B_in over i, per channel. A texel of photo i becomes c + q - B_i: its fine structure,
on the common colour.
"""

from __future__ import annotations

import numba
import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry.meshes import adjacency


def averaged(
    values: np.ndarray, weight: np.ndarray, triangles: np.ndarray, rounds: tuple[int, ...]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """
    Values (p, n, c) averaged over neighbours where weight (p, n) says that they are known, and the averaged weight
    (p, n), after each number of `rounds`: steps of half a mean over the ring, which spread by sqrt(rounds) edges or so.
    """
    p, n, c = values.shape
    ring = adjacency(n, triangles)
    step = (0.5 * sp.identity(n) + 0.5 * sp.diags(1 / np.maximum(ring.sum(axis=1).A1, 1)) @ ring).tocsr()
    step = step.astype(np.float32)
    out = [(np.empty_like(values), np.empty_like(weight)) for _ in rounds]
    for i in range(p):
        columns = np.concatenate([values[i] * weight[i][:, None], weight[i][:, None]], axis=1).astype(np.float32)
        for turn in range(max(rounds) + 1):
            for (mean, total), wanted in zip(out, rounds):
                if turn == wanted:
                    total[i] = columns[:, c]
                    mean[i] = columns[:, :c] / np.maximum(columns[:, c:], 1e-8)
            columns = step @ columns
    return out


def trimmed(values: np.ndarray, weight: np.ndarray, low: float, high: float) -> np.ndarray:
    """
    (n, c): the weighted mean over p of what lies between the weighted quantiles `low` and `high` of values (p, n, c),
    weights (p, n), per channel; 0 where all weights are 0.

    Between neighbours in order the quantile function is constant, so that the mean is continuous.
    """
    out = np.zeros(values.shape[1:], np.float32)
    _trimmed(np.ascontiguousarray(values, np.float32), np.ascontiguousarray(weight, np.float32), low, high, out)
    return out


@numba.njit(cache=True, parallel=True)
def _trimmed(values: np.ndarray, weight: np.ndarray, low: float, high: float, out: np.ndarray) -> None:
    p, n, channels = values.shape
    for k in numba.prange(n):
        total = 0.0
        for i in range(p):
            total += weight[i, k]
        if total <= 0:
            continue
        for c in range(channels):
            gone, mean = 0.0, 0.0
            for o in np.argsort(values[:, k, c], kind="mergesort"):
                before, gone = gone, gone + weight[o, k] / total
                mean += max(min(gone, high) - max(before, low), 0.0) * values[o, k, c]
            out[k, c] = mean / (high - low)
