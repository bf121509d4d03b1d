"""Which frames become keyframes: one after the other, the one that would help all frames' maps most."""

from __future__ import annotations

import numpy as np

from avatarbuild.details.distances import shares

_CANDIDATES = 16  # frames looked at for each keyframe: those that the fit so far misses most


def choose(
    maps: np.ndarray,
    sure: np.ndarray,
    points: np.ndarray,
    ends: np.ndarray,
    strains: np.ndarray,
    count: int,
    beta: float,
    ridge: float,
) -> list[int]:
    """
    Rows of `count` keyframes: to the fit so far is added, of the frames that it misses most (sum c |r_f|^2, as the
    paper has it), the one that a further term phi would take most from the error of all frames by,

    argmax_k sum_t |sum_f c r phi|^2 / (sum_f c (phi - its part in the terms so far)^2 + rho mean(phi^2)).

    One frame's noise is the largest error of a map, but no other frame has it. maps (f, t, 4) and confidence (f, t) at
    some texels, points (f, t, 3) mm where they lie, ends (f, e, 2, 3) mm of the edges, strains (f, e) in units of
    their spread.
    """
    f, t = sure.shape
    terms = np.ones((f, t, 1))
    flat = np.array([0.0, 0.0, 1.0, 1.0])
    prior = [ridge]
    rows: list[int] = []
    for _ in range(min(count, f)):
        left = np.einsum("ft,fta,ftb->tab", sure, terms, terms, optimize=True) + np.diag(prior)
        right = np.einsum("ft,fta,ftl->tal", sure, terms, maps, optimize=True)
        right[:, 0] += ridge * flat
        rest = maps - np.einsum("fta,tal->ftl", terms, np.linalg.solve(left, right))
        missed = np.einsum("ft,ftl,ftl->f", sure, rest, rest, optimize=True)
        missed[rows] = -1
        best, helped, taken = -1, -1.0, np.zeros((f, t))
        for k in np.argsort(-missed, kind="stable")[:_CANDIDATES]:
            if missed[k] < 0:
                continue
            phi = _phi(points[k], ends[k], strains, strains[k], beta)
            weighted = sure * phi
            along = np.einsum("ft,fta->ta", weighted, terms)
            own = (weighted * phi).sum(axis=0) - (along * np.linalg.solve(left, along[..., None])[..., 0]).sum(axis=1)
            gain = (np.einsum("ft,ftl->tl", weighted, rest) ** 2).sum(axis=1)
            gain_all = float((gain / (np.maximum(own, 0) + ridge * np.mean(phi**2) + 1e-12)).sum())
            if gain_all > helped:
                best, helped, taken = int(k), gain_all, phi
        rows.append(best)
        terms = np.concatenate([terms, taken[..., None]], axis=2)
        prior.append(ridge * float(np.mean(taken**2)))
    return rows


def _phi(points: np.ndarray, ends: np.ndarray, strains: np.ndarray, key: np.ndarray, beta: float) -> np.ndarray:
    """(f, t): |D^(1/2) (f - f_k)| at points (t, 3) of keyframe k."""
    alpha = shares(points, ends[:, 0], ends[:, 1], beta)
    return np.sqrt((strains - key) ** 2 @ alpha.T.astype(np.float64))
