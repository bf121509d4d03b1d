"""Points that ride on the head's surface, in a few numbers each: where they rest and where each shape takes them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numba
import numpy as np


class Places(NamedTuple):
    """p points of the surface: triangle (p,) and barycentric (p, 3)."""

    triangle: np.ndarray
    barycentric: np.ndarray

    def on(self, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """(p, c) of a quantity (n, c) at the vertices."""
        return np.einsum("pk,pkc->pc", self.barycentric, vertices[triangles[self.triangle]])


@dataclass(frozen=True)
class Rider:
    """x_p(w) = rest_p + sum_j w_j moves_pj: rest (p, 3), moves (p, 3, a) mm of a shapes."""

    rest: np.ndarray
    moves: np.ndarray

    def at(self, weights: np.ndarray) -> np.ndarray:
        """(p, 3) at weights (a,)."""
        return self.rest + self.moves @ weights


@dataclass(frozen=True)
class Rig:
    """neutral (n, 3) and deltas (a, n, 3) mm in the head frame; triangles (m, 3)."""

    neutral: np.ndarray
    deltas: np.ndarray
    triangles: np.ndarray

    def rider(self, places: Places) -> Rider:
        """Points of the surface that move with the shapes: at rest, and by how much at weight 1 of each."""
        corners = self.triangles[places.triangle]
        rest = places.on(self.neutral, self.triangles)
        return Rider(rest, _moves(self._by_vertex, corners, np.asarray(places.barycentric, np.float64)))

    @cached_property
    def _by_vertex(self) -> np.ndarray:
        """(n, 3, a) the deltas, a vertex' own side by side."""
        return np.ascontiguousarray(self.deltas.transpose(1, 2, 0), np.float64)

    def posed(self, weights: np.ndarray) -> np.ndarray:
        """(n, 3)"""
        return self.neutral + np.tensordot(weights, self.deltas, 1)


@numba.njit(cache=True, nogil=True)
def _moves(deltas: np.ndarray, corners: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    """(p, 3, a) of deltas (n, 3, a) at points with corners (p, 3) and barycentric (p, 3)."""
    a = deltas.shape[2]
    out = np.zeros((len(corners), 3, a))
    for p in range(len(corners)):
        for k in range(3):
            share = barycentric[p, k]
            for c in range(3):
                for j in range(a):
                    out[p, c, j] += share * deltas[corners[p, k], c, j]
    return out
