"""The cage: which quads of the base mesh are the head, and a shoulder rim cut along a geodesic isoline.

Below the jaw the quads form closed loops around the neck. The columns across the loops are resampled so that their last
vertices lie at one geodesic distance from the first loop. A cage vertex is a linear combination of base vertices, so
that every target carries over.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import igl
import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree
from source import BODY_VERTICES, Source

RINGS = 6  # closed rings of quads below the first edge loop around the neck
RIM_DISTANCE = 82.0  # mm of geodesic distance from that loop to the rim
GUIDES = ("helper-upper-teeth", "helper-lower-teeth", "helper-tongue")
SOCKET_RINGS = 4  # rings of quads kept behind each lid rim
HEAD, MOUTH, SOCKET_RIGHT, SOCKET_LEFT, NECK = range(5)


@dataclass(frozen=True)
class Cage:
    """matrix (c, v) cage <- base vertices; quads (q, 4); labels (q,) HEAD ... NECK; mirror (c,) vertex on the other
    side; neutral (c, 3) mm: the average young adult before any sampling. The source's
    own teeth and tongue follow the cage's vertices as guides, `guides` name -> rows."""

    matrix: sp.csr_matrix
    quads: np.ndarray
    labels: np.ndarray
    mirror: np.ndarray
    neutral: np.ndarray
    guides: dict[str, np.ndarray]

    @property
    def skin(self) -> int:
        """The number of skin vertices, which come before the guides."""
        return int(self.quads.max()) + 1


def average_adult(source: Source) -> np.ndarray:
    """(v, 3) the base mesh moved to the mean of both genders and three ethnicities, young, average weight."""
    shape = source.base.copy()
    for gender in ("male", "female"):
        for people in ("african", "asian", "caucasian"):
            shape += source.targets[f"macrodetails/{people}-{gender}-young"] / 6
        shape += source.targets[f"macrodetails/universal-{gender}-young-averagemuscle-averageweight"] / 2
    return shape


def build_cage(source: Source) -> Cage:
    """Cut the head out of the body's quads."""
    shape = average_adult(source)
    quads, islands = source.quads, source.islands
    head, mouth, sockets = _name_islands(source)
    labels = np.full(len(quads), -1)
    labels[islands == head] = HEAD
    labels[islands == mouth] = MOUTH
    for island in sockets:
        side = SOCKET_LEFT if source.base[quads[islands == island]][..., 0].mean() > 0 else SOCKET_RIGHT
        inside = islands == island
        labels[_rings(quads, inside, np.unique(quads[labels == HEAD]), SOCKET_RINGS)] = side
    below = ~np.isin(islands, [head, mouth, *sockets])
    loop = _neck_loop(quads, below, np.unique(quads[labels == HEAD]), source.base)
    labels[_flood(quads, below, np.unique(quads[labels == HEAD]), loop)] = NECK
    columns, neck = _columns(quads, below & (labels < 0), loop)
    labels[neck] = NECK
    moves = _resample(columns, _geodesic(shape, quads, loop))

    kept = labels >= 0
    used = np.unique(quads[kept])
    place = np.full(len(source.base), -1)
    place[used] = np.arange(len(used))
    matrix = sp.identity(len(source.base), format="lil")
    for vertex, (a, b, share) in moves.items():
        matrix[vertex] = 0
        matrix[vertex, a] = 1 - share
        matrix[vertex, b] += share
    guides, rows = {}, len(used)
    for name in GUIDES:
        guides[name] = rows + np.arange(len(source.groups[name]))
        used = np.concatenate([used, source.groups[name]])
        rows = len(used)
    matrix = matrix.tocsr()[used]
    gap, mirror = cKDTree(source.base[used]).query(source.base[used] * np.array([-1, 1, 1]))
    assert gap.max() < 0.5, gap.max()
    return Cage(matrix, place[quads[kept]], labels[kept], mirror, matrix @ shape, guides)


def refined(cage: Cage) -> np.ndarray:
    """(q,) bool: the quads worth a finer mesh: face, lids with their sockets, the mouth's inner rim."""
    middle = cage.neutral[cage.quads].mean(axis=1)
    down = cage.neutral[: cage.skin, 1].max() - middle[:, 1]
    ear = (np.abs(middle[:, 0]) > 70) & (middle[:, 2] < 72) & (down > 85) & (down < 175)
    face = (cage.labels == HEAD) & (middle[:, 2] > 50) & (down > 30) & (down < 235) & ~ear
    rim = _rings(cage.quads, cage.labels == MOUTH, np.unique(cage.quads[cage.labels == HEAD]), 1)
    return face | rim | np.isin(cage.labels, [SOCKET_LEFT, SOCKET_RIGHT])


def _name_islands(source: Source) -> tuple[int, int, list[int]]:
    """The texture islands of the head's skin, the mouth bag and the two eye sockets, told by where they lie."""
    sizes = {}
    for island in np.unique(source.islands):
        points = source.base[np.unique(source.quads[source.islands == island])]
        sizes[int(island)] = (points.min(axis=0), points.max(axis=0))
    top = source.base[:BODY_VERTICES, 1].max()
    head = next(i for i, (_, high) in sizes.items() if high[1] > top - 1)
    inside = [
        i
        for i, (low, high) in sizes.items()
        if i != head and (low > sizes[head][0]).all() and (high < sizes[head][1]).all()
    ]
    mouth = next(i for i in inside if sizes[i][0][0] < 0 < sizes[i][1][0])
    return head, mouth, [i for i in inside if i != mouth]


def _rings(quads: np.ndarray, inside: np.ndarray, start: np.ndarray, count: int) -> np.ndarray:
    """(f,) bool: quads of `inside` within `count` rings of the vertices `start`."""
    reached = np.zeros(quads.max() + 1, bool)
    reached[start] = True
    chosen = np.zeros(len(quads), bool)
    for _ in range(count):
        chosen |= inside & reached[quads].any(axis=1)
        reached[quads[chosen]] = True
    return chosen


def _neighbours(quads: np.ndarray) -> dict[int, set[int]]:
    """vertex -> the vertices at the other end of its edges."""
    found: dict[int, set[int]] = defaultdict(set)
    for a, b in np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2).tolist():
        found[a].add(b)
        found[b].add(a)
    return found


def _neck_loop(quads: np.ndarray, below: np.ndarray, head: np.ndarray, base: np.ndarray) -> np.ndarray:
    """The highest closed edge loop around the neck that touches no vertex of the head's texture island."""
    neighbours = _neighbours(quads)
    faces_at = defaultdict(set)
    for i, quad in enumerate(quads.tolist()):
        for vertex in quad:
            faces_at[vertex].add(i)
    allowed = set(np.unique(quads[below]).tolist()) - set(head.tolist())
    middle = [v for v in sorted(allowed) if abs(base[v, 0]) < 1e-3 and base[v, 2] > 40]
    for start in sorted(middle, key=lambda v: -base[v, 1]):
        second = min(v for v in neighbours[start] if base[v, 0] > 1e-3)
        loop = [start, second]
        while len(neighbours[loop[-1]]) == 4 and loop[-1] in allowed:
            shared = faces_at[loop[-2]] & faces_at[loop[-1]]
            beside = {v for i in shared for v in quads[i].tolist()}
            onward = [v for v in neighbours[loop[-1]] if v not in beside]
            if len(onward) != 1 or onward[0] in loop[1:]:
                break
            if onward[0] == start:
                return np.array(loop)
            loop.append(onward[0])
    raise ValueError("no closed edge loop around the neck")


def _flood(quads: np.ndarray, below: np.ndarray, head: np.ndarray, loop: np.ndarray) -> np.ndarray:
    """(f,) bool: quads of `below` between the head's vertices and the loop."""
    reached = np.zeros(quads.max() + 1, bool)
    reached[head] = True
    stop = np.zeros(quads.max() + 1, bool)
    stop[loop] = True
    while True:
        chosen = below & (reached & ~stop)[quads].any(axis=1)
        grown = reached.copy()
        grown[quads[chosen]] = True
        if (grown == reached).all():
            return chosen
        reached = grown


def _columns(quads: np.ndarray, below: np.ndarray, loop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """((RINGS + 1, k) vertices loop by loop downwards, (f,) bool quads between them)."""
    columns = [loop]
    chosen = np.zeros(len(quads), bool)
    for _ in range(RINGS):
        last = set(columns[-1].tolist())
        ring = below & ~chosen & np.isin(quads, columns[-1]).any(axis=1)
        chosen |= ring
        next_of = {}
        for a, b in np.stack([quads[ring], np.roll(quads[ring], -1, axis=1)], axis=2).reshape(-1, 2).tolist():
            if (a in last) != (b in last):
                next_of[a if a in last else b] = b if a in last else a
        columns.append(np.array([next_of[v] for v in columns[-1].tolist()]))
    return np.array(columns), chosen


def _geodesic(shape: np.ndarray, quads: np.ndarray, border: np.ndarray) -> np.ndarray:
    """(BODY_VERTICES,) exact geodesic distance in mm from the loop `border` over the triangulated body."""
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int64)
    none = np.zeros(0, np.int64)
    everywhere = np.arange(BODY_VERTICES, dtype=np.int64)
    return igl.exact_geodesic(shape[:BODY_VERTICES], triangles, border.astype(np.int64), none, everywhere, none)


def _resample(columns: np.ndarray, distance: np.ndarray) -> dict[int, tuple[int, int, float]]:
    """vertex -> (a, b, share): its new place (1 - share) a + share b on its column, the last at RIM_DISTANCE."""
    moves = {}
    for column in columns.T:
        at = distance[column]
        wanted = at * RIM_DISTANCE / at[-1]
        for k in range(1, len(column)):
            upper = int(np.clip(np.searchsorted(at, wanted[k]), 1, len(at) - 1))
            share = (wanted[k] - at[upper - 1]) / (at[upper] - at[upper - 1])
            moves[int(column[k])] = (int(column[upper - 1]), int(column[upper]), float(share))
    return moves
