"""
Deformation transfer: how the source's triangles deform, done to the target's [Sumner and Popović 2004].

  min_D  sum_j area_j || (S_j - I) - grad_j D ||_F^2,     D = 0 where the source does not move

D (n, 3) the target's displacement, grad_j its gradient on triangle j of the target, S_j (3, 3) the deformation gradient
of the source's triangle. Sumner's form adds a fourth vertex off each triangle, so that the gradient is 3 x 3; that
vertex belongs to one triangle only, and eliminating it leaves the residual within the target's plane: this form. Areas
make it the Poisson equation of Botsch, Sumner, Pauly and Gross 2006, which does not depend on how finely a part is
meshed. n vertices, m triangles, e expressions, lengths in millimetres.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry import meshes

LEAST_AREA = 1e-9  # mm^2


def displacement_gradients(rest: np.ndarray, deltas: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """
    (e, m, 3, 3) S_j - I, S_j = V'_j V_j^-1 with V_j = [b - a, c - a, n / sqrt|n|], n = (b - a) x (c - a), and V' the
    same at rest (n, 3) + deltas (e, n, 3).

    The normal's column grows like the edges do. A triangle without area gives zero.
    """
    out = np.zeros((len(deltas), len(triangles), 3, 3))
    whole = meshes.face_areas(rest, triangles) > LEAST_AREA
    frames = np.zeros((len(triangles), 3, 3))
    frames[whole] = np.linalg.inv(_frames(rest, triangles[whole]))
    for gradients, delta in zip(out, deltas, strict=True):
        moved = np.flatnonzero(whole & (delta[triangles] != 0).any(axis=(1, 2)))
        gradients[moved] = _frames(rest + delta, triangles[moved]) @ frames[moved] - np.eye(3)
    return out


def _frames(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    normal = np.cross(u, v)
    root = np.sqrt(np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))
    return np.stack([u, v, normal / root], axis=2)


def transfer_system(target: np.ndarray, triangles: np.ndarray) -> tuple[sp.csr_matrix, sp.csr_matrix, sp.csr_matrix]:
    """
    A (n, n) = G^T diag(areas) G, B (n, 3 m) = G^T diag(areas) and the gradient G (3 m, n) itself: A D = B rows(S - I)
    minimises the energy.

    A is singular until a vertex of every connected piece is held. Vertices that have only triangles without area get a
    one on A's diagonal and stay where they are.
    """
    areas = meshes.face_areas(target, triangles)
    G = meshes.gradient(target, triangles)
    G.data[~np.isfinite(G.data)] = 0
    B = (G.T @ sp.diags(np.tile(np.where(areas > LEAST_AREA, areas, 0), 3))).tocsr()
    A = (B @ G).tocsr()
    return (A + sp.diags((A.diagonal() <= 0).astype(float))).tocsr(), B, G


def gradient_rows(gradients: np.ndarray) -> np.ndarray:
    """(3 m, 3 e): gradients (e, m, 3, 3) in the order of G's rows, all triangles' d/dx, then d/dy, then d/dz."""
    e, m = gradients.shape[:2]
    return np.ascontiguousarray(gradients.transpose(3, 1, 0, 2)).reshape(3 * m, 3 * e)
