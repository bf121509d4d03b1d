"""Exposure and white balance of each photo, from the surface that photos see in common.

log c_in = g_i + t_n + e,    c_in the colour of node n in photo i, g_i the photo's gain, t_n the node's own colour,

per channel, by least squares reweighted for Cauchy's loss: the surface sends other light to other sides (highlights),
and what moved or was misplaced differs by more than any gain. The median photo has gain 1.
"""

from __future__ import annotations

import numpy as np

_ROUNDS = 12
_SPREAD = 0.06  # of log colour: where the loss turns from squares to logarithms
_DARK = 0.004  # linear light that is too little to compare
_MOST = 5000  # nodes that are compared, evenly among those shared by two photos or more
_RIDGE = 1e-4  # of the mean diagonal: a photo without overlaps keeps gain 1


def photo_gains(colour: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """
    (p, 3) factors that bring the photos' colours together, and the weighted rms log disagreement that remains.

    colour (p, n, 3) linear; weight (p, n) >= 0, 0 where a photo does not see a node or is saturated there.
    """
    gains = np.ones((len(colour), 3))
    left, total = 0.0, 0.0
    shared = np.flatnonzero((weight > 0).sum(axis=0) >= 2)
    shared = shared[:: max(1, len(shared) // _MOST)]
    w0 = np.where(colour[:, shared].min(axis=2) > _DARK, weight[:, shared], 0).astype(np.float64)
    for channel in range(3):
        y = np.log(np.maximum(colour[:, shared, channel], _DARK)).astype(np.float64)
        g, residual, w = _solve(y, w0)
        gains[:, channel] = np.exp(-g)
        left += float((w * residual**2).sum())
        total += float(w.sum())
    return gains, float(np.sqrt(left / max(total, 1e-12)))


def _solve(y: np.ndarray, w0: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """g (p,), residuals (p, n) and the last weights (p, n)."""
    p = len(y)
    w, g, residual = w0, np.zeros(p), np.zeros_like(y)
    for _ in range(_ROUNDS):
        sums = np.maximum(w.sum(axis=0), 1e-12)
        # t eliminated: A g = b
        A = np.diag(w.sum(axis=1)) - (w / sums) @ w.T
        b = (w * (y - (w * y).sum(axis=0) / sums)).sum(axis=1)
        A += _RIDGE * max(float(np.trace(A)) / p, 1e-12) * np.eye(p)
        g = np.linalg.solve(A, b)
        known = w0.sum(axis=1) > 0
        g -= np.median(g[known]) if known.any() else 0.0
        g[~known] = 0
        t = (w * (y - g[:, None])).sum(axis=0) / sums
        residual = np.where(w0 > 0, y - g[:, None] - t, 0)
        w = w0 / (1 + (residual / _SPREAD) ** 2)
    return g, residual, w
