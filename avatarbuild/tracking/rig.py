"""Points that ride on the head's surface, in a few numbers each: where they rest and where each shape takes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

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
        moves = np.empty((len(corners), 3, len(self.deltas)))
        for j, delta in enumerate(self.deltas):
            moves[:, :, j] = np.einsum("pk,pkc->pc", places.barycentric, delta[corners])
        return Rider(places.on(self.neutral, self.triangles), moves)

    def posed(self, weights: np.ndarray) -> np.ndarray:
        """(n, 3)"""
        return self.neutral + np.tensordot(weights, self.deltas, 1)
