"""Adaptive Catmull-Clark: refine some quads once, leave the rest, as one sparse matrix fine <- cage.

Every vertex is moved by the Catmull-Clark vertex rule, so that refined and plain quads lie on the same surface; plain
quads beside refined ones take the new edge points in and are triangulated. Source: Catmull & Clark 1978.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp


@dataclass(frozen=True)
class Fine:
    """matrix (n, c); triangles (m, 3); face (m,) the cage quad of each triangle; cage_vertex (n,) or -1;
    row_of_vertex (c,): the fine vertex of each cage vertex."""

    matrix: sp.csr_matrix
    triangles: np.ndarray
    face: np.ndarray
    row_of_vertex: np.ndarray
    row_of_edge: dict[tuple[int, int], int]


def refine(quads: np.ndarray, chosen: np.ndarray, positions: np.ndarray) -> Fine:
    """Refine the quads `chosen` (q,) bool of `quads` (q, 4); `positions` (c, 3) only decide diagonals."""
    c, q = len(positions), len(quads)
    half = np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2)
    edges, edge_of = np.unique(np.sort(half, axis=1), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(q, 4)
    k = len(edges)
    face_points = sp.csr_matrix((np.full(4 * q, 0.25), (np.repeat(np.arange(q), 4), quads.ravel())), shape=(q, c))
    edge_faces = sp.csr_matrix((np.ones(4 * q), (edge_of.ravel(), np.repeat(np.arange(q), 4))), shape=(k, q))
    border = np.asarray(edge_faces.sum(axis=1)).ravel() == 1
    ends = sp.csr_matrix((np.ones(2 * k), (np.repeat(np.arange(k), 2), edges.ravel())), shape=(k, c))
    edge_points = sp.diags(np.where(border, 0.5, 0.25)) @ ends + sp.diags(np.where(border, 0, 0.25)) @ (
        edge_faces @ face_points
    )
    vertex_points = _vertex_rule(quads, edges, border, ends, face_points, c)

    cut = np.zeros(k, bool)
    cut[edge_of[chosen]] = True
    row_of_edge = np.full(k, -1)
    row_of_edge[cut] = c + np.arange(cut.sum())
    row_of_face = np.full(q, -1)
    row_of_face[chosen] = c + cut.sum() + np.arange(chosen.sum())
    matrix = sp.vstack([vertex_points, edge_points.tocsr()[cut], face_points[chosen]]).tocsr()
    matrix.sort_indices()

    fine = matrix @ positions
    triangles, faces = _triangles(quads, chosen, edge_of, row_of_edge, row_of_face, fine)
    named = {(int(a), int(b)): int(row_of_edge[i]) for i, (a, b) in enumerate(edges) if cut[i]}
    return Fine(matrix, triangles, faces, np.arange(c), named)


def _vertex_rule(
    quads: np.ndarray, edges: np.ndarray, border: np.ndarray, ends: sp.csr_matrix, face_points: sp.csr_matrix, c: int
) -> sp.csr_matrix:
    """(c, c): interior F/n + 2R/n + (n-3)P/n; border (1, 6, 1)/8 along it."""
    q = len(quads)
    faces_at = sp.csr_matrix((np.ones(4 * q), (quads.ravel(), np.repeat(np.arange(q), 4))), shape=(c, q))
    n = np.asarray(faces_at.sum(axis=1)).ravel()
    middles = 0.5 * (ends.T @ ends)
    inside = sp.diags(1 / n**2) @ (faces_at @ face_points) + sp.diags(2 / n**2) @ middles + sp.diags((n - 3) / n)
    rim = edges[border]
    along = sp.csr_matrix(
        (np.full(2 * len(rim), 0.125), (np.r_[rim[:, 0], rim[:, 1]], np.r_[rim[:, 1], rim[:, 0]])), shape=(c, c)
    )
    outside = along + 0.75 * sp.identity(c)
    on_rim = np.zeros(c)
    on_rim[rim] = 1
    return (sp.diags(1 - on_rim) @ inside + sp.diags(on_rim) @ outside).tocsr()


def _triangles(
    quads: np.ndarray,
    chosen: np.ndarray,
    edge_of: np.ndarray,
    row_of_edge: np.ndarray,
    row_of_face: np.ndarray,
    fine: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (m, 3) over fine vertices and the cage quad (m,) of each; shorter diagonals win."""
    corner, middle = quads[chosen], row_of_edge[edge_of[chosen]]
    centre = row_of_face[chosen]
    small = np.stack(
        [np.stack([corner[:, i], middle[:, i], centre, middle[:, i - 1]], axis=1) for i in range(4)], axis=1
    ).reshape(-1, 4)
    triangles = [_split(small, fine)]
    faces = [np.repeat(np.repeat(np.flatnonzero(chosen), 4), 2)]
    for i in np.flatnonzero(~chosen):
        ring = []
        for corner_row, edge_row in zip(quads[i], row_of_edge[edge_of[i]], strict=True):
            ring += [corner_row, edge_row] if edge_row >= 0 else [corner_row]
        ears = _ears(ring, fine)
        triangles.append(np.array(ears))
        faces.append(np.full(len(ears), i))
    return np.concatenate(triangles).astype(np.int32), np.concatenate(faces)


def _split(quads: np.ndarray, fine: np.ndarray) -> np.ndarray:
    """(2 q, 3): each quad cut along its shorter diagonal, neighbours in the list."""
    a, b, c, d = quads.T
    first = np.linalg.norm(fine[a] - fine[c], axis=1) <= np.linalg.norm(fine[b] - fine[d], axis=1) + 1e-6
    one = np.where(first[:, None], np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    two = np.where(first[:, None], np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return np.stack([one, two], axis=1).reshape(-1, 3)


def _ears(ring: list[int], fine: np.ndarray) -> list[list[int]]:
    """A polygon cut into triangles, the ear with the shortest new edge first."""
    left = list(ring)
    ears = []
    while len(left) > 3:
        lengths = [np.linalg.norm(fine[left[i - 1]] - fine[left[(i + 1) % len(left)]]) for i in range(len(left))]
        i = int(np.argmin(np.round(lengths, 6)))
        ears.append([left[i - 1], left[i], left[(i + 1) % len(left)]])
        left.pop(i)
    return [*ears, left]
