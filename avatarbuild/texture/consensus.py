"""The colour that the photos agree on over a few millimetres: highlights move from photo to photo, skin does not.

With B_in the gain-corrected colour of photo i around node n, averaged over the surface that it sees, and w its weight,
q_n = the weighted quantile of B_in over i, per channel. A texel of photo i becomes c + q - B_i: its fine structure, on
the common colour.
"""

from __future__ import annotations

import numba
import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry.meshes import adjacency


def averaged(values: np.ndarray, weight: np.ndarray, triangles: np.ndarray, rounds: int) -> tuple[np.ndarray, ...]:
    """
    Values (p, n, c) averaged over neighbours where weight (p, n) says that they are known, and the averaged weight
    (p, n); `rounds` steps of half a mean over the ring spread them over sqrt(rounds) edges' length or so.
    """
    p, n, c = values.shape
    ring = adjacency(n, triangles)
    step = (0.5 * sp.identity(n) + 0.5 * sp.diags(1 / np.maximum(ring.sum(axis=1).A1, 1)) @ ring).tocsr()
    step = step.astype(np.float32)
    out, total = np.empty_like(values), np.empty_like(weight)
    for i in range(p):
        columns = np.concatenate([values[i] * weight[i][:, None], weight[i][:, None]], axis=1).astype(np.float32)
        for _ in range(rounds):
            columns = step @ columns
        total[i] = columns[:, c]
        out[i] = columns[:, :c] / np.maximum(columns[:, c:], 1e-8)
    return out, total


def quantile(values: np.ndarray, weight: np.ndarray, share: float) -> np.ndarray:
    """(n, c): the weighted `share`-quantile over p of values (p, n, c), weights (p, n); 0 where all weights are 0.

    Between neighbours in order it is linear in the weights' midpoints, so that it is continuous in values and weights.
    """
    out = np.zeros(values.shape[1:], np.float32)
    _quantile(np.ascontiguousarray(values, np.float32), np.ascontiguousarray(weight, np.float32), share, out)
    return out


@numba.njit(cache=True, parallel=True)
def _quantile(values: np.ndarray, weight: np.ndarray, share: float, out: np.ndarray) -> None:
    p, n, channels = values.shape
    for k in numba.prange(n):
        total = 0.0
        for i in range(p):
            total += weight[i, k]
        if total <= 0:
            continue
        for c in range(channels):
            order = np.argsort(values[:, k, c], kind="mergesort")
            gone, before, at_before, done = 0.0, 0.0, 0.0, False
            started = False
            for o in order:
                w = weight[o, k]
                if w <= 0:
                    continue
                at = (gone + 0.5 * w) / total
                v = values[o, k, c]
                if at >= share:
                    if started:
                        out[k, c] = before + (v - before) * (share - at_before) / (at - at_before)
                    else:
                        out[k, c] = v
                    done = True
                    break
                gone += w
                before, at_before, started = v, at, True
            if not done:
                out[k, c] = before
