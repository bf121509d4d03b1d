"""The depth of the mouth's expressions: its corners slide round the dental arch, and the lower lip rolls in over it.

The source's shapes were drawn to look right from the front. Everything here moves along z only, on the cage.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import lips
import numpy as np
import scipy.sparse as sp
from cage import HEAD, MOUTH, Cage
from scipy.sparse.linalg import splu
from scipy.spatial import ConvexHull

SLIDING = ("mouthSmile", "mouthStretch", "mouthDimple", "mouthFrown", "mouthPress")  # pairs whose corners keep to it
SHARED = 8.0  # mm to either side of the middle over which a left shape's correction passes to the right one's
ALONG = (-1, 3)  # rings of the cage about the mouth bag's border that slide
ROLLED = (-4, 5)  # rings of the lower lip and its wall that roll in as the upper ones do
ROLL = 0.9  # of the upper lip's depth that the lower one gets
REACH, INSIDE = 9, -6  # rings at which corrections have died out, outside and inside


@dataclass(frozen=True)
class Rings:
    """ring (c,) of each skin vertex of the cage about the mouth bag's border, negative inside, 99 far away; halves
    ring -> (upper, lower) vertices, each from the left corner to the right one; bilaplacian (c, c)."""

    ring: np.ndarray
    halves: dict[int, tuple[np.ndarray, np.ndarray]]
    bilaplacian: sp.csr_matrix


@dataclass(frozen=True)
class Arch:
    """The teeth and gums as a mesh (v, 3), (t, 3), and the outline (k, 2) of the upper teeth in x and z, convex,
    counter-clockwise."""

    vertices: np.ndarray
    triangles: np.ndarray
    outline: np.ndarray

    def distance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(k,) mm of points (k, 3) from the arch: the mean of the distances from the nearest tooth or gum and from the
        cylinder over the outline; and (k,) the z of the cylinder's unit normal there."""
        near = np.sqrt(igl.point_mesh_squared_distance(points, self.vertices, self.triangles)[0])
        start, along = self.outline, np.roll(self.outline, -1, axis=0) - self.outline
        offset = points[:, None, [0, 2]] - start
        share = np.clip((offset * along).sum(axis=2) / (along**2).sum(axis=1), 0, 1)
        away = offset - share[..., None] * along
        length = np.linalg.norm(away, axis=2)
        best = length.argmin(axis=1)
        rows = np.arange(len(points))
        return (near + length[rows, best]) / 2, away[rows, best, 1] / length[rows, best]


def arch(vertices: np.ndarray, triangles: np.ndarray, upper: np.ndarray) -> Arch:
    """Teeth and gums together, and the vertices (u, 3) of the upper teeth."""
    flat = upper[:, [0, 2]]
    return Arch(vertices, triangles.astype(np.int64), flat[ConvexHull(flat).vertices])


def rings(vertices: np.ndarray, cage: Cage) -> Rings:
    """Rings about the mouth of the cage's skin (c, 3)."""
    n = cage.skin
    a, b = cage.quads.ravel(), np.roll(cage.quads, -1, axis=1).ravel()
    graph = sp.coo_matrix((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(n, n)).tocsr()
    graph.data[:] = 1
    inside, outside = np.zeros(n, bool), np.zeros(n, bool)
    inside[cage.quads[cage.labels == MOUTH]] = True
    outside[cage.quads[cage.labels == HEAD]] = True
    ring = np.full(n, 99)
    ring[inside & outside] = 0
    for k in range(1, REACH + 1):
        ring[((graph @ (ring == k - 1)) > 0) & (ring == 99) & ~inside] = k
    for k in range(1, 1 - INSIDE):
        ring[((graph @ (ring == 1 - k)) > 0) & (ring == 99) & inside] = -k
    chosen = range(min(ALONG[0], ROLLED[0]), max(ALONG[1], ROLLED[1]) + 1)
    halves = {k: lips.halves_of(vertices, graph, np.flatnonzero(ring == k)) for k in chosen}
    laplacian = sp.identity(n) - sp.diags(1 / np.asarray(graph.sum(axis=1)).ravel()) @ graph
    return Rings(ring, halves, (laplacian.T @ laplacian).tocsr())


def _extended(about: Rings, known: np.ndarray, values: np.ndarray, still: np.ndarray | None = None) -> np.ndarray:
    """(c,) the values at the vertices `known`, biharmonic between them and 0 at REACH, INSIDE and where `still`."""
    free = (about.ring < REACH) & (about.ring > INSIDE)
    free[known] = False
    if still is not None:
        free[still] = False
    out = np.zeros(len(about.ring))
    out[known] = values
    rows = np.flatnonzero(free)
    system = about.bilaplacian[rows]
    out[rows] = splu(system[:, rows].tocsc()).solve(-(system @ out))
    return out


def slide(vertices: np.ndarray, left: np.ndarray, right: np.ndarray, about: Rings, teeth: Arch) -> np.ndarray:
    """(c, 3) the left shape of a pair on the cage (c, 3), with the lips' corners as far from the arch as in neutral.

    Where lips and corners leave the arch in both shapes together they go back by as much; what comes nearer to the
    teeth is left, for lips that are drawn out are thinner.
    """
    known = np.unique(np.concatenate([np.concatenate(about.halves[k]) for k in range(ALONG[0], ALONG[1] + 1)]))
    start = vertices[known]
    posed = start + left[known] + right[known]
    lack = np.zeros(len(known))
    for _ in range(4):
        moved = posed + np.stack([0 * lack, 0 * lack, lack], axis=1)
        away, forward = teeth.distance(moved)
        lack = np.minimum(0, lack - (away - teeth.distance(start)[0]) / np.maximum(forward, 0.5))
    t = np.clip(start[:, 0] / SHARED / 2 + 0.5, 0, 1)
    out = left.copy()
    out[:, 2] += _extended(about, known, lack * t * t * (3 - 2 * t))
    return out


def roll(vertices: np.ndarray, lower: np.ndarray, upper: np.ndarray, about: Rings) -> np.ndarray:
    """(c, 3) mouthRollLower on the cage with the depth of mouthRollUpper (c, 3), ring by ring, times ROLL."""
    known, values, still = [], [], []
    for k in range(ROLLED[0], ROLLED[1] + 1):
        above, below = about.halves[k]
        order = np.argsort(vertices[above, 0])
        wanted = ROLL * np.interp(vertices[below, 0], vertices[above, 0][order], upper[above, 2][order])
        known.append(below)
        values.append(np.minimum(0, wanted - lower[below, 2]))
        still.append(above[1:-1])
    out = lower.copy()
    out[:, 2] += _extended(about, np.concatenate(known), np.concatenate(values), np.concatenate(still))
    return out
