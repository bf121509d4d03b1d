"""The thin shell's elastic energy: stretching and bending away from a rest shape, both co-rotated.

E(X) = w_s sum_ij c_ij || (x_i - x_j) - R_ij (y_i - y_j) ||^2 + w_b sum_i (1 / a_i) || (L X)_i - R_i (L Y)_i ||^2

with Y the rest shape, c the cotangent weights (the first sum is sum_f area_f || grad X - R grad Y ||_F^2), L the
cotangent Laplacian, a the vertex areas, R_i rotations fitted to X and R_ij the mean of two. Source: method, section 2
(b); Sorkine and Alexa 2007 for the rotations; Botsch et al. 2010.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry import meshes

_LEAST_COTANGENT = 0.02  # obtuse triangles give negative weights, which would reward stretching


@dataclass(frozen=True)
class ThinShell:
    """
    A rest shape (n, 3) mm and its operators: stretch (n, n) and bend (n, n) positive semidefinite, areas (n,) mm^2.
    """

    rest: np.ndarray
    stretch: sp.csr_matrix
    bend: sp.csr_matrix
    areas: np.ndarray
    _pairs: np.ndarray
    _weights: np.ndarray
    _scatter: sp.csr_matrix
    _laplacian: sp.csr_matrix

    @staticmethod
    def of(rest: np.ndarray, triangles: np.ndarray) -> ThinShell:
        """The shell of a mesh: rest (n, 3), triangles (m, 3)."""
        n = len(rest)
        L = meshes.laplacian(rest, triangles)
        upper = sp.triu(L, 1).tocoo()
        pairs = np.stack([upper.row, upper.col], axis=1)
        weights = np.maximum(upper.data, _LEAST_COTANGENT)
        e = len(pairs)
        ends = sp.csr_matrix((np.tile([1.0, -1.0], e), (np.repeat(np.arange(e), 2), pairs.ravel())), shape=(e, n))
        scatter = (ends.T @ sp.diags(weights)).tocsr()
        areas = np.maximum(meshes.vertex_areas(rest, triangles), 1e-6)
        bend = (L.T @ sp.diags(1 / areas) @ L).tocsr()
        return ThinShell(rest, (scatter @ ends).tocsr(), bend, areas, pairs, weights, scatter, L)

    def rotations(self, x: np.ndarray) -> np.ndarray:
        """(n, 3, 3) R_i = argmin sum_j c_ij || (x_i - x_j) - R_i (y_i - y_j) ||^2, by the polar decomposition."""
        i, j = self._pairs.T
        outer = self._weights[:, None, None] * np.einsum("ea,eb->eab", x[i] - x[j], self.rest[i] - self.rest[j])
        flat = outer.reshape(len(outer), 9)
        n = len(x)
        total = np.stack(
            [np.bincount(i, flat[:, k], n) + np.bincount(j, flat[:, k], n) for k in range(9)], axis=1
        ).reshape(n, 3, 3)
        u, _, vt = np.linalg.svd(total)
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        return u @ vt

    def matrix(self, stretching: float, bending: float) -> sp.csr_matrix:
        """(n, n) A with E(X) = tr X^T A X - 2 tr X^T b + constant, for w_s = stretching, w_b = bending."""
        return stretching * self.stretch + bending * self.bend

    def right_side(self, rotations: np.ndarray, stretching: float, bending: float) -> np.ndarray:
        """(n, 3) b of the same quadratic form."""
        i, j = self._pairs.T
        turned = np.einsum("eab,eb->ea", (rotations[i] + rotations[j]) / 2, self.rest[i] - self.rest[j])
        curved = np.einsum("nab,nb->na", rotations, self._laplacian @ self.rest)
        return stretching * (self._scatter @ turned) + bending * (self._laplacian.T @ (curved / self.areas[:, None]))

    def energy(self, x: np.ndarray, rotations: np.ndarray, stretching: float, bending: float) -> float:
        """E(X)."""
        i, j = self._pairs.T
        stretch = (x[i] - x[j]) - np.einsum(
            "eab,eb->ea", (rotations[i] + rotations[j]) / 2, self.rest[i] - self.rest[j]
        )
        bend = self._laplacian @ x - np.einsum("nab,nb->na", rotations, self._laplacian @ self.rest)
        first = (self._weights[:, None] * stretch**2).sum()
        return float(stretching * first + bending * (bend**2 / self.areas[:, None]).sum())
