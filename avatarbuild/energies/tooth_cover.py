"""
Teeth behind the skin: seen from outside in cylinder coordinates about the mouth, no tooth lies before lip or cheek.

About a vertical axis behind the front teeth a point is (angle, height, radius). Where the outermost skin of an (angle,
height) is outer skin, not the inside of the mouth, and a tooth's radius is larger, the tooth pokes out by the
difference. The mouth's inside, which folds when lips close over an open jaw, is kept behind the skin likewise.
n vertices of all parts; millimetres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry import rings
from avatarbuild.geometry.raster import Raster, rasterise

STEP = 0.4  # mm a cell, at the front teeth
HALF_ANGLE = 1.3  # radians to either side
AXIS_BEHIND = 35.0  # mm from the front of the teeth to the axis
DEEP = 8.0  # mm; a tooth that far before the skin is seen through the open mouth
FAR = 1e4  # mm from which the raster looks: the nearest thing is the outermost one
MARGIN = 12.0  # mm above and below the teeth that are looked at
ROUNDS, WIDENED = 3, 3  # times that things are moved off each other; rings that go along
SPARE, BAG_SPARE = 0.05, 0.3  # mm beyond


@dataclass(frozen=True)
class Mouth:
    """outer, bag, teeth: triangles (., 3) of the face, of the mouth's inside, of both rows; lips (k,) ids of the outer
    skin about the mouth; axis (3,) and radius mm of the cylinder; average (n, n) means of neighbours."""

    outer: np.ndarray
    bag: np.ndarray
    teeth: np.ndarray
    lips: np.ndarray
    axis: np.ndarray
    radius: float
    average: sp.csr_matrix

    def teeth_out(self, vertices: np.ndarray) -> np.ndarray:
        """(n,) mm by which teeth stand before the outer skin at each of its vertices (n, 3)."""
        skin, tooth = self._heights(vertices, np.concatenate([self.outer, self.bag]), self.teeth)
        return _at_corners(len(vertices), skin, tooth, self.outer, 0)

    def bag_out(self, vertices: np.ndarray) -> np.ndarray:
        """(n,) mm by which each vertex of the mouth's inside stands before the outer skin."""
        skin, bag = self._heights(vertices, self.outer, self.bag)
        return _at_corners(len(vertices), bag, skin, self.bag, 1)

    def _heights(self, vertices: np.ndarray, before: np.ndarray, behind: np.ndarray) -> tuple[Raster, Raster]:
        """What is seen from outside of two sets of triangles, (angle, height) -> (triangle, FAR - radius)."""
        offset = vertices - self.axis
        r, angle = np.hypot(offset[:, 0], offset[:, 2]), np.arctan2(offset[:, 0], offset[:, 2])
        used = offset[np.unique(self.teeth), 1]
        low, high = used.min() - MARGIN, used.max() + MARGIN
        size = int(2 * HALF_ANGLE * self.radius / STEP), int((high - low) / STEP) + 1
        pixels = np.stack([(angle + HALF_ANGLE) * self.radius, offset[:, 1] - low], axis=1) / STEP
        depth = np.where(np.abs(angle) < HALF_ANGLE + 0.5, FAR - r, -1)
        seen = [rasterise(pixels, depth, triangles, size, near=1.0) for triangles in (before, behind)]
        return seen[0], seen[1]

    def covered(self, vertices: np.ndarray, allowed: Callable[[], tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """vertices (n, 3) with the skin moved off teeth, and the mouth's inside off the skin, that are out by more than
        is allowed: (n,) mm of teeth and of the inside, asked for only where anything is out."""
        out = vertices
        within = np.zeros(len(vertices), bool)
        within[self.bag] = True
        limits: tuple[np.ndarray, np.ndarray] | None = None
        for _ in range(ROUNDS):
            teeth, bag = self.teeth_out(out), self.bag_out(out)
            if teeth.max() + bag.max() <= 0:
                break
            limits = limits or allowed()
            push, sink = self._widened(teeth - limits[0], SPARE), self._widened(bag - limits[1], BAG_SPARE) * within
            if push.max() + sink.max() <= 0:
                break
            offset = (out - self.axis) * [1, 0, 1]
            direction = offset / np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-9)
            out = out + (push - sink)[:, None] * direction
        return out

    def _widened(self, lack: np.ndarray, spare: float) -> np.ndarray:
        move = np.where(lack > 0, lack + spare, 0)
        for _ in range(WIDENED):
            move = np.maximum(move, self.average @ move)
        return move


def _at_corners(n: int, own: Raster, other: Raster, triangles: np.ndarray, side: int) -> np.ndarray:
    """(n,) the most by which the inner thing is out, at the corners of the `own` raster's triangles; `side` 0: own is
    the outer one."""
    both = (own.triangle >= 0) & (own.triangle < len(triangles)) & (other.triangle >= 0)
    height = np.where(both, own.depth, 0) - np.where(both, other.depth, 0)
    height = height if side == 0 else -height
    row, column = np.nonzero(both & (height > 0) & (height < DEEP))
    out = np.zeros(n)
    np.maximum.at(out, triangles[own.triangle[row, column]].ravel(), np.repeat(height[row, column], 3).astype(float))
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
