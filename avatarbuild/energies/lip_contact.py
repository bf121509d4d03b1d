"""
Lips that stay together: where the source's upper and lower lip move as one, the target's do.

u_i the upper line's vertices, P the lower line's point below each (linear interpolation along x at rest); with
displacements D (target) and E (source), the error is

  e_i = k_i [ (D_u - P D_l) - (E_u - P E_l) ]_i,   k_i from 1 where |E_u - P E_l| is SEALED to 0 where it is PARTED

and, where the lips part, its downward excess. Half of e goes to each lip, spread biharmonically over the skin. Where
target and source are equal nothing changes. n vertices of the skin, u of the upper line, l of the lower; millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry import rings
from avatarbuild.geometry.smooth_step import smooth_step

REACH = 12  # rings from the lines over which corrections die out
SEALED, PARTED = 0.6, 2.0  # mm of vertical parting in the source
ROUNDS = 25


@dataclass(frozen=True)
class LipBand:
    """
    upper (u,), lower (l,) ids from x low to high, corners in both; below (u, l) and above (l, u) interpolate the lower
    and the upper line at the other's places. Corrections c (h, 3) of the ids `held` (h,) spread to the ids `free` (f,)
    as x with system x = coupling c.
    """

    upper: np.ndarray
    lower: np.ndarray
    below: sp.csr_matrix
    above: sp.csr_matrix
    free: np.ndarray
    held: np.ndarray
    system: sp.csr_matrix
    coupling: sp.csr_matrix


def lip_band(vertices: np.ndarray, graph: sp.csr_matrix, upper: np.ndarray, lower: np.ndarray) -> LipBand:
    """The band about the lines `upper` (u,) and `lower` (l,) of the source's skin (n, 3), its adjacency (n, n)."""
    held = np.concatenate([upper[1:-1], lower[1:-1]])
    ring = rings.rings(graph, np.concatenate([upper, lower]), REACH)
    fixed = np.union1d(held, [upper[0], upper[-1], lower[0], lower[-1]])
    free = np.setdiff1d(np.flatnonzero(ring < REACH), fixed)
    energy = rings.bilaplacian(graph)
    x, y = _rising(vertices[upper, 0]), _rising(vertices[lower, 0])
    system, coupling = energy[free][:, free].tocsr(), -energy[free][:, held]
    return LipBand(upper, lower, _at(x, y), _at(y, x), free, held, system, coupling.tocsr())


def _rising(x: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(x) + 1e-6 * np.arange(len(x))


def _at(x: np.ndarray, line: np.ndarray) -> sp.csr_matrix:
    """(len(x), len(line)) linear interpolation at x of values at the rising places `line`."""
    right = np.clip(np.searchsorted(line, x), 1, len(line) - 1)
    share = np.clip((x - line[right - 1]) / (line[right] - line[right - 1]), 0, 1)
    rows = np.arange(len(x))
    data, columns = np.r_[1 - share, share], np.r_[right - 1, right]
    return sp.csr_matrix((data, (np.r_[rows, rows], columns)), shape=(len(x), len(line)))


def lip_errors(band: LipBand, delta: np.ndarray, source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """e (u, 3) on the upper and e (l, 3) on the lower line; delta, source (n, 3) displacements."""
    out = []
    for own, other, at, sign in ((band.upper, band.lower, band.below, 1), (band.lower, band.upper, band.above, -1)):
        wanted, now = source[own] - at @ source[other], delta[own] - at @ delta[other]
        parting = np.abs(wanted[:, 1])
        share = smooth_step(parting, PARTED, SEALED)
        error = share[:, None] * (now - wanted)
        # past each other: the upper lip's vertex below the lower's point, farther than the source's
        lack = sign * now[:, 1] - np.minimum(sign * wanted[:, 1], 0)
        crossing = np.where(lack < 0, sign * lack, 0)
        error[:, 1] = np.where(sign * crossing < sign * error[:, 1], crossing, error[:, 1])
        error[[0, -1]] = 0
        out.append(error)
    return out[0], out[1]


def corrections(band: LipBand, delta: np.ndarray, source: np.ndarray) -> np.ndarray:
    """(held, 3) displacements of the lines' inner vertices, upper then lower, that remove the errors."""
    work = delta.copy()
    for _ in range(ROUNDS):
        e_upper, e_lower = lip_errors(band, work, source)
        work[band.upper] -= e_upper / 2
        work[band.lower] -= e_lower / 2
    return (work - delta)[band.held]
