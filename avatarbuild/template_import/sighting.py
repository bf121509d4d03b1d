"""Landmarks on a bare head by the face detector, on plain renderings of it.

The same detector on the same rendering of two heads errs alike on both, so that its points correspond even where
they miss the anatomy by a millimetre.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.raster import project, rasterise
from avatarbuild.landmarks import POINTS, find_faces

YAWS = (-24.0, 0.0, 24.0)  # degrees
SIZE = 448  # pixels
HEIGHT = 320.0  # mm of the head that the picture shows
DISTANCE = 1200.0  # mm from the camera
ABOVE_NOSE = (0.0, 15.0, -50.0)  # mm from the tip of the nose to the middle of the face
LEAST_FACING = 0.3  # cosine between surface and view
COLOUR = (0.80, 0.62, 0.54)


class Sighting(NamedTuple):
    """points (478, 3) mm on the surface; seen (478,) bool; the rest of the points is zero."""

    points: np.ndarray
    seen: np.ndarray


def sight(vertices: np.ndarray, triangles: np.ndarray, skin: np.ndarray) -> Sighting:
    """The detector's points on a head that looks along +z: the median over three views of what lies under each.

    vertices (v, 3) mm; triangles (m, 3); skin (m,) bool: where points may lie, in front of which everything occludes.
    """
    normals = vertex_normals(vertices, triangles)
    tip = vertices[np.unique(triangles[skin])]
    centre = tip[tip[:, 2].argmax()] + ABOVE_NOSE
    found = np.full((len(YAWS), POINTS, 3), np.nan)
    for k, yaw in enumerate(YAWS):
        found[k] = _view(vertices, triangles, skin, normals, centre, np.radians(yaw))
    seen = np.isfinite(found).all(axis=2).any(axis=0)
    points = np.zeros((POINTS, 3))
    points[seen] = np.nanmedian(found[:, seen], axis=0)
    return Sighting(points, seen)


def _view(vertices, triangles, skin, normals, centre, yaw) -> np.ndarray:
    """(478, 3) surface points under the detections of one view, NaN where there are none."""
    out = np.full((POINTS, 3), np.nan)
    cos, sin = np.cos(yaw), np.sin(yaw)
    rotation = np.diag([1.0, -1.0, -1.0]) @ np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    focal = SIZE * DISTANCE / HEIGHT
    camera = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1.0]])
    shift = np.array([0, 0, DISTANCE]) - rotation @ centre
    pixels, depth = project(vertices, camera, np.zeros(5), rotation, shift)
    raster = rasterise(pixels, depth, triangles, (SIZE, SIZE))
    corners = triangles[raster.triangle]
    b = raster.barycentric.astype(np.float64)
    normal = np.einsum("hwk,hwkx->hwx", b, normals[corners]) @ rotation.T
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    # meshes of either orientation: most of what is seen faces the camera, the rest is an inside through a hole
    normal *= -np.sign(np.median(normal[raster.triangle >= 0, 2]))
    light = np.array([-0.35, -0.45, -0.82])
    shade = 0.25 + 0.75 * np.clip(normal @ light, 0, 1)
    seen = raster.triangle >= 0
    picture = np.where(seen[..., None], shade[..., None] * COLOUR, 0.45)
    faces = find_faces((255 * np.clip(picture, 0, 1) ** (1 / 1.3)).astype(np.uint8), presence=0.5)
    if not faces:
        return out
    x, y = np.clip(faces[0].points[:, :2].astype(int), 0, SIZE - 1).T
    hit = seen[y, x] & skin[raster.triangle[y, x]] & (-normal[y, x, 2] > LEAST_FACING)
    place = np.einsum("ik,ikx->ix", b[y, x], vertices[corners[y, x]])
    out[hit] = place[hit]
    return out
