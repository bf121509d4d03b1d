"""Lips that are sealed: the line where they meet closes in the neutral face of every identity and in closed shapes.

Around the mouth bag's texture border the fine vertices form rings of equal length; each ring splits at the corners into
an upper and a lower half. Bringing both to one line is linear in the vertices, so that it holds for the whole identity
space.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

CONTACT = 3  # ring where the lips meet
ROUNDS = 6
REACH = 12  # rings over which a correction dies out
PRESS = 0.3  # mm by which each lip passes the line
SEALED = (
    *("jawForward", "jawLeft", "jawRight", "mouthPucker", "mouthLeft", "mouthRight", "mouthSmileLeft"),
    *("mouthSmileRight", "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight"),
    *("mouthStretchLeft", "mouthStretchRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower"),
    *("mouthShrugUpper", "mouthPressLeft", "mouthPressRight", "cheekPuff", "noseSneerLeft", "noseSneerRight"),
    *("cheekSquintLeft", "cheekSquintRight"),
)


@dataclass(frozen=True)
class LipBand:
    """ring (n,) outside the mouth bag's border (99 far), negative inside; halves ring -> (upper, lower) vertices, each
    from the left corner to the right one; upper, lower: the contact line without its corners; spread_*: their
    corrections over the skin; to_upper: heights of the lower line below the upper vertices, to_lower the reverse."""

    ring: np.ndarray
    halves: dict[int, tuple[np.ndarray, np.ndarray]]
    upper: np.ndarray
    lower: np.ndarray
    spread_upper: sp.csr_matrix
    spread_lower: sp.csr_matrix
    to_upper: sp.csr_matrix
    to_lower: sp.csr_matrix


def lip_band(vertices: np.ndarray, triangles: np.ndarray, in_mouth: np.ndarray) -> LipBand:
    """Rings around the mouth; `in_mouth` (m,) bool marks the mouth bag's triangles."""
    n = len(vertices)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    graph = sp.coo_matrix((np.ones(2 * len(edges)), (np.r_[edges[:, 0], edges[:, 1]], np.r_[edges[:, 1], edges[:, 0]])))
    graph = graph.tocsr()
    graph.data[:] = 1
    inside, outside = np.zeros(n, bool), np.zeros(n, bool)
    inside[triangles[in_mouth]] = True
    outside[triangles[~in_mouth]] = True
    ring = np.full(n, 99)
    ring[inside & outside] = 0
    for k in range(1, 24):
        ring[((graph @ (ring == k - 1)) > 0) & (ring == 99) & ~inside] = k
    for k in range(1, 12):
        ring[((graph @ (ring == 1 - k)) > 0) & (ring == 99) & inside] = -k
    halves = {k: halves_of(vertices, graph, np.flatnonzero(ring == k)) for k in range(16)}
    upper, lower = halves[CONTACT][0][1:-1], halves[CONTACT][1][1:-1]
    spread = _spread(graph, ring, np.concatenate([upper, lower]), halves[CONTACT][0][[0, -1]])
    spreads = spread[:, : len(upper)].tocsr(), spread[:, len(upper) :].tocsr()
    x, y = (np.minimum.accumulate(vertices[half, 0]) - 1e-6 * np.arange(len(half)) for half in (upper, lower))
    return LipBand(ring, halves, upper, lower, *spreads, _at(x, y), _at(y, x))


def halves_of(vertices: np.ndarray, graph: sp.csr_matrix, loop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed ring cut at its leftmost and rightmost vertex: the upper and the lower half, corners in both."""
    inside = set(loop.tolist())
    links = {v: [w for w in graph[v].indices.tolist() if w in inside] for v in loop.tolist()}
    left = int(loop[np.argmax(vertices[loop, 0])])
    right = int(loop[np.argmin(vertices[loop, 0])])
    found = []
    for start in links[left]:
        walk = [left, start]
        while walk[-1] != right:
            walk.append(next(w for w in links[walk[-1]] if w != walk[-2]))
        found.append(np.array(walk))
    first, second = found
    return (first, second) if vertices[first, 1].mean() > vertices[second, 1].mean() else (second, first)


def _spread(graph: sp.csr_matrix, ring: np.ndarray, fixed: np.ndarray, corners: np.ndarray) -> sp.csr_matrix:
    """(n, k): 1 on each fixed vertex, biharmonic around, 0 at the corners and REACH rings away."""
    n, k = len(ring), len(fixed)
    degree = np.asarray(graph.sum(axis=1)).ravel()
    laplacian = sp.identity(n) - sp.diags(1 / np.maximum(degree, 1)) @ graph
    bilaplacian = (laplacian.T @ laplacian).tocsr()
    held = np.zeros(n, bool)
    held[fixed] = held[corners] = True
    free = np.flatnonzero((ring < REACH) & (ring > -6) & ~held)
    weights = sp.lil_matrix((n, k))
    weights[free] = splu(bilaplacian[free][:, free].tocsc()).solve(-bilaplacian[free][:, fixed].toarray())
    weights[fixed, np.arange(k)] = 1
    return weights.tocsr()


def _at(x: np.ndarray, line: np.ndarray) -> sp.csr_matrix:
    """(len(x), len(line)) linear interpolation of values at positions `line`, which fall, at positions x."""
    rising = line[::-1]
    upper = np.clip(np.searchsorted(rising, x), 1, len(line) - 1)
    share = np.clip((x - rising[upper - 1]) / (rising[upper] - rising[upper - 1]), 0, 1)
    rows = np.arange(len(x))
    columns = len(line) - 1 - np.concatenate([upper - 1, upper])
    return sp.csr_matrix((np.r_[1 - share, share], (np.r_[rows, rows], columns)), shape=(len(x), len(line)))


def seal(shape: np.ndarray, band: LipBand, press: float = 0.0) -> np.ndarray:
    """`shape` (n, 3), positions or deltas, with each contact vertex at the height of the other lip's line below it."""
    out = shape.copy()
    for _ in range(ROUNDS):
        upper, lower = out[band.upper, 1], out[band.lower, 1]
        out[:, 1] += band.spread_upper @ ((band.to_upper @ lower - upper) / 2)
        out[:, 1] += band.spread_lower @ ((band.to_lower @ upper - lower) / 2)
    out[:, 1] += band.spread_lower @ np.full(len(band.lower), press)
    out[:, 1] -= band.spread_upper @ np.full(len(band.upper), press)
    return out
