"""
Teeth behind the skin: seen from outside in cylinder coordinates about the mouth, no tooth lies before lip or cheek.

About a vertical axis behind the front teeth a point is (angle, height, radius). Where the outermost skin of an (angle,
height) is outer skin, not the inside of the mouth, and a tooth's radius is larger, the tooth pokes out by the
difference. n vertices of all parts; millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry import rings
from avatarbuild.geometry.raster import rasterise

STEP = 0.4  # mm a cell, at the front teeth
HALF_ANGLE = 1.3  # radians to either side
AXIS_BEHIND = 35.0  # mm from the front of the teeth to the axis
DEEP = 8.0  # mm; a tooth that far before the skin is seen through the open mouth
FAR = 1e4  # mm from which the raster looks: the nearest thing is the outermost one
ROUNDS, WIDENED, SPARE = 3, 3, 0.05  # times that the skin is moved off; rings that go along; mm beyond


@dataclass(frozen=True)
class Mouth:
    """outer, inner, teeth: triangles (., 3) of the face, of the mouth's inside, of both rows; lips (k,) ids of the
    outer skin about the mouth; axis (3,) and radius mm of the cylinder; average (n, n) means of neighbours."""

    outer: np.ndarray
    inner: np.ndarray
    teeth: np.ndarray
    lips: np.ndarray
    axis: np.ndarray
    radius: float
    average: sp.csr_matrix

    def poke(self, vertices: np.ndarray) -> np.ndarray:
        """(n,) mm by which teeth stand before the outer skin at each of its vertices (n, 3)."""
        offset = vertices - self.axis
        r, angle = np.hypot(offset[:, 0], offset[:, 2]), np.arctan2(offset[:, 0], offset[:, 2])
        used = offset[np.unique(self.teeth), 1]
        low, high = used.min() - 2, used.max() + 2
        size = int(2 * HALF_ANGLE * self.radius / STEP), int((high - low) / STEP) + 1
        pixels = np.stack([(angle + HALF_ANGLE) * self.radius, offset[:, 1] - low], axis=1) / STEP
        depth = np.where(np.abs(angle) < HALF_ANGLE + 0.5, FAR - r, -1)
        skin = np.concatenate([self.outer, self.inner])
        before = rasterise(pixels, depth, skin, size, near=1.0)
        tooth = rasterise(pixels, depth, self.teeth, size, near=1.0)
        both = (before.triangle >= 0) & (before.triangle < len(self.outer)) & (tooth.triangle >= 0)
        height = np.where(both, before.depth - np.where(both, tooth.depth, 0), 0)
        row, column = np.nonzero(both & (height > 0) & (height < DEEP))
        out = np.zeros(len(vertices))
        np.maximum.at(out, skin[before.triangle[row, column]].ravel(), np.repeat(height[row, column], 3).astype(float))
        return out

    def covered(self, vertices: np.ndarray, allowed: np.ndarray) -> np.ndarray:
        """vertices (n, 3) with the skin moved outwards where a tooth pokes out by more than allowed (n,) mm."""
        out = vertices.copy()
        for _ in range(ROUNDS):
            lack = np.maximum(self.poke(out) - allowed, 0)
            if lack.max() <= 0:
                break
            push = np.where(lack > 0, lack + SPARE, 0)
            for _ in range(WIDENED):
                push = np.maximum(push, self.average @ push)
            offset = (out - self.axis) * [1, 0, 1]
            out += push[:, None] * offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
        return out


def mouth_of(
    vertices: np.ndarray,
    skin: np.ndarray,
    graph: sp.csr_matrix,
    inside: np.ndarray,
    face: np.ndarray,
    teeth: np.ndarray,
) -> Mouth:
    """
    The mouth of a head at rest: vertices (n, 3), skin and teeth triangles (., 3), the skin's adjacency `graph` (s, s),
    inside and face (n,) bool of the mouth's bag and of the outer face.
    """
    bag = inside[skin].all(axis=1)
    front = vertices[np.unique(teeth), 2].max()
    middle = vertices[np.unique(teeth)].mean(axis=0)
    axis = np.array([middle[0], middle[1], front - AXIS_BEHIND])
    outer = skin[~bag & face[skin].any(axis=1)]
    average = rings.neighbour_mean(graph)
    average.resize((len(vertices), len(vertices)))
    near = np.abs(vertices - [middle[0], middle[1], front]).max(axis=1) < 45
    lips = np.intersect1d(np.unique(outer), np.flatnonzero(near))
    return Mouth(outer, skin[bag], teeth, lips, axis, AXIS_BEHIND, average)
