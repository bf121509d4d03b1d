"""Which points of the head a photo sees, with a margin at silhouettes and where something nearer hides what is behind.

A point is seen where it faces the camera and where, in the depth map of the whole head, the window of 2 r + 1 pixels
around its image holds neither background nor anything that lies nearer by more than the surface's own slope explains:

z - min depth <= tolerance + r (z / f) tan(theta),    theta the angle between normal and line of sight.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from avatarbuild.geometry.raster import project, rasterise
from avatarbuild.texture.photos import Photo

_STEP = 2  # pixels of the photo to one of the depth map
_MARGIN = 1.2  # mm to silhouettes and nearer surfaces
_TOLERANCE = 0.6  # mm
_LEAST_COSINE = 0.17
_EMPTY = np.float32(1e9)


class Guard(NamedTuple):
    """Nearest depth in each window, (h, w) float32, `empty` where it holds background; radius r in its pixels."""

    nearest: np.ndarray
    empty: np.ndarray
    radius: int


class Sight(NamedTuple):
    """Of n points: pixels (n, 2), depth (n,) mm, cosine (n,) between normal and line of sight, seen (n,) bool."""

    pixels: np.ndarray
    depth: np.ndarray
    cosine: np.ndarray
    seen: np.ndarray


def guard(photo: Photo, vertices: np.ndarray, triangles: np.ndarray) -> Guard:
    """The depth map of vertices (n, 3), triangles (m, 3) in a photo, widened by _MARGIN mm."""
    pixels, depth = project(vertices, photo.K, photo.dist, photo.R, photo.t)
    size = (-(-photo.size[0] // _STEP), -(-photo.size[1] // _STEP))
    z = rasterise(pixels / _STEP, depth, triangles, size).depth
    near = depth[depth > 0]
    middle = float(np.median(near)) if len(near) else 1.0
    radius = max(1, round(_MARGIN * photo.K[0, 0] / middle / _STEP))
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    nothing = ~np.isfinite(z)
    filled = np.where(nothing, _EMPTY, z)
    nearest = cv2.erode(filled, window, borderType=cv2.BORDER_REPLICATE)
    empty = cv2.dilate(nothing.astype(np.uint8), window, borderType=cv2.BORDER_REPLICATE).astype(bool)
    return Guard(nearest, empty, radius)


def sight(photo: Photo, seen_by: Guard, points: np.ndarray, normals: np.ndarray) -> Sight:
    """How a photo sees points (n, 3) with unit normals (n, 3)."""
    pixels, depth = project(points, photo.K, photo.dist, photo.R, photo.t)
    towards = photo.centre - points
    cosine = np.einsum("ij,ij->i", towards, normals) / np.linalg.norm(towards, axis=1)
    h, w = seen_by.nearest.shape
    with np.errstate(invalid="ignore"):
        column, row = np.floor(np.nan_to_num(pixels, nan=-1e6) / _STEP).astype(np.int64).T
    inside = (column >= 1) & (column < w - 1) & (row >= 1) & (row < h - 1) & (depth > 0)
    at = (np.clip(row, 0, h - 1), np.clip(column, 0, w - 1))
    c = np.clip(cosine, 0.05, 1.0)
    slope = np.sqrt(1 - c * c) / c
    reach = _TOLERANCE + seen_by.radius * _STEP * depth / photo.K[0, 0] * slope
    hidden = depth - seen_by.nearest[at] > reach
    return Sight(pixels, depth, cosine, inside & ~hidden & ~seen_by.empty[at] & (cosine > _LEAST_COSINE))
