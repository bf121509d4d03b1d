"""Rings of vertices about a set, and how smooth a field over them is. n vertices, m triangles."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp


def rings(adjacency: sp.csr_matrix, seeds: np.ndarray, count: int) -> np.ndarray:
    """(n,) int: edges to the nearest of `seeds` (ids) by adjacency (n, n), up to `count`; count + 1 beyond."""
    ring = np.full(adjacency.shape[0], count + 1)
    ring[seeds] = 0
    for k in range(1, count + 1):
        ring[(adjacency @ (ring == k - 1).astype(float) > 0) & (ring > count)] = k
    return ring


def rings_of_opening(adjacency: sp.csr_matrix, triangles: np.ndarray, inside: np.ndarray, count: int) -> np.ndarray:
    """
    (n,) int: rings outwards from the border between the triangles (m, 3) that lie in `inside` (n,) bool and the others.

    0 on the border, -1 within, count + 1 far away.
    """
    within = inside[triangles].all(axis=1)
    a, b = np.zeros_like(inside), np.zeros_like(inside)
    a[triangles[within]] = True
    b[triangles[~within]] = True
    ring = rings(adjacency, np.flatnonzero(a & b), count)
    ring[a & ~b] = -1
    return ring


def neighbour_mean(adjacency: sp.csr_matrix) -> sp.csr_matrix:
    """(n, n) takes a field to the mean of each vertex's neighbours."""
    degree = np.maximum(np.asarray(adjacency.sum(axis=1)).ravel(), 1)
    return (sp.diags(1 / degree) @ adjacency).tocsr()


def bilaplacian(adjacency: sp.csr_matrix) -> sp.csr_matrix:
    """(n, n) L^T L with L = I - neighbour_mean: how far a field is from smooth, whatever the triangles' sizes."""
    L = sp.identity(adjacency.shape[0]) - neighbour_mean(adjacency)
    return (L.T @ L).tocsr()
