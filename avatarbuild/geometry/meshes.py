"""Triangle meshes: normals, areas, edges and the discrete gradient and Laplacian. n vertices, m triangles."""

from __future__ import annotations

import igl
import numpy as np
import scipy.sparse as sp


def face_vectors(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m, 3) = (b - a) x (c - a): along each triangle's normal, twice its area long."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def face_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m, 3) unit normals; zero for a triangle without area."""
    v = face_vectors(vertices, triangles)
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)


def face_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m,)"""
    return np.linalg.norm(face_vectors(vertices, triangles), axis=1) / 2


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals, each triangle weighted by its area; zero at a vertex without triangles."""
    total = corner_sums(face_vectors(vertices, triangles), triangles, len(vertices))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def corner_sums(values: np.ndarray, triangles: np.ndarray, n: int) -> np.ndarray:
    """(n, 3): at every vertex the sum of values (m, 3) over the triangles that have it as a corner."""
    corners = triangles.ravel()
    return np.stack([np.bincount(corners, np.repeat(values[:, k], 3), n) for k in range(3)], axis=1)


def vertex_of_uv(triangles: np.ndarray, uv_triangles: np.ndarray, count: int) -> np.ndarray:
    """(count,) the vertex that each texture coordinate belongs to, of triangles and uv_triangles (m, 3)."""
    found = np.zeros(count, np.int64)
    found[uv_triangles.reshape(-1)] = triangles.reshape(-1)
    return found


def vertex_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) a third of the area of the triangles around each vertex."""
    share = np.repeat(face_areas(vertices, triangles) / 3, 3)
    return np.bincount(triangles.ravel(), share, len(vertices))


def edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(e, 2) undirected edges, lower vertex first, sorted; and (e,) how many triangles each belongs to."""
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(pairs, axis=0, return_counts=True)
    return unique, count


def border(n: int, triangles: np.ndarray) -> np.ndarray:
    """(n,) bool: vertices of edges that belong to one triangle."""
    pairs, count = edges(triangles)
    on = np.zeros(n, bool)
    on[pairs[count == 1]] = True
    return on


def adjacency(n: int, triangles: np.ndarray) -> sp.csr_matrix:
    """(n, n) 1 where two vertices share an edge."""
    pairs, _ = edges(triangles)
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    return sp.csr_matrix((np.ones(len(i)), (i, j)), shape=(n, n))


def gradient(vertices: np.ndarray, triangles: np.ndarray) -> sp.csr_matrix:
    """(3 m, n) G: the gradient of a piecewise linear function; rows are all triangles' x, then y, then z."""
    return sp.csr_matrix(igl.grad(np.ascontiguousarray(vertices, np.float64), triangles.astype(np.int64)))


def laplacian(vertices: np.ndarray, triangles: np.ndarray) -> sp.csr_matrix:
    """(n, n) L = -G^T diag(areas) G, the cotangent Laplacian: negative semidefinite, not divided by areas."""
    return sp.csr_matrix(igl.cotmatrix(np.ascontiguousarray(vertices, np.float64), triangles.astype(np.int64)))
