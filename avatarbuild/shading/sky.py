"""Where light comes to the skin of a posed head from, and where the head itself is in the way of it."""

from __future__ import annotations

import numpy as np

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.texture import occlusion

_COUNT = 200


def _spiral(count: int) -> np.ndarray:
    """(count, 3) unit directions, evenly spread."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


DIRECTIONS = _spiral(_COUNT)
"""(D, 3) unit, camera axes: each stands for 4 pi / D of the sphere, 16 degrees across."""


def sky(vertices: np.ndarray, triangles: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(v, D) bool: the directions that vertices `near` (v,) of a head see: (n, 3) mm, camera axes; triangles (m, 3)."""
    normals = vertex_normals(vertices, triangles)[near]
    return occlusion.seen(vertices, triangles, vertices[near], normals, DIRECTIONS)
