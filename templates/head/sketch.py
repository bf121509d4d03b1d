"""Plain pictures of the head, for finding landmarks and for looking: vertex colours under two lights, perspective."""

from __future__ import annotations

import numpy as np

from avatarbuild.geometry.raster import box_average, interpolate, project, rasterise
from avatarbuild.report.rendering import View, pinhole

SKIN, LIP, BROW = (0.80, 0.62, 0.54), (0.68, 0.38, 0.36), (0.26, 0.19, 0.15)
WHITE, IRIS, PUPIL = (0.93, 0.92, 0.90), (0.36, 0.22, 0.12), (0.03, 0.03, 0.03)
TOOTH, GUM, TONGUE, INSIDE = (0.93, 0.89, 0.80), (0.72, 0.36, 0.36), (0.72, 0.38, 0.38), (0.34, 0.12, 0.12)


def look(vertices: np.ndarray, triangles: np.ndarray, view: View, factor: int = 1):
    """The raster of a view and the pixels (n, 2) and depths (n,) of the vertices."""
    k, r, t = pinhole(view, factor)
    pixels, depth = project(vertices, k, np.zeros(5), r, t)
    return rasterise(pixels, depth, triangles, (view.size[0] * factor, view.size[1] * factor)), pixels, depth


def draw(
    vertices: np.ndarray,
    triangles: np.ndarray,
    colours: np.ndarray,
    view: View,
    *,
    factor: int = 2,
    background: tuple[float, float, float] = (0.45, 0.47, 0.5),
) -> np.ndarray:
    """(h, w, 3) uint8 sRGB picture; colours (n, 3) in 0..1 as they shall look, supersampled by `factor`."""
    seen, _, _ = look(vertices, triangles, view, factor)
    _, r, _ = pinhole(view)
    normals = vertex_normals(vertices, triangles)
    smooth = interpolate(np.concatenate([colours, normals @ r.T], 1), triangles, seen.triangle, seen.barycentric)
    colour, normal = smooth[..., :3], smooth[..., 3:]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    shade = np.full(normal.shape[:2], 0.38)
    for direction, strength in (((0.3, -0.5, -1.0), 0.55), ((-0.7, -0.2, -0.6), 0.22)):
        d = np.array(direction) / np.linalg.norm(direction)
        shade += strength * np.clip(normal @ d, 0, None)
    half = np.array([0.15, -0.25, -1.0]) / np.linalg.norm([0.15, -0.25, -1.0])
    gloss = 0.06 * np.clip(normal @ half, 0, 1) ** 24
    picture = np.where((seen.triangle >= 0)[..., None], colour * shade[..., None] + gloss[..., None], background)
    return np.round(np.clip(box_average(picture.astype(np.float32), factor), 0, 1) * 255).astype(np.uint8)


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n, 3) unit normals, area weighted."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for axis in range(3):
        normals[:, axis] = sum(np.bincount(triangles[:, k], face[:, axis], len(vertices)) for k in range(3))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def paint(template) -> np.ndarray:
    """(n, 3) colours by part and region of a template (anything with mean, parts, regions, eye_centres)."""
    colours = np.tile(np.array(SKIN), (len(template.mean), 1))
    mouth = template.regions["mouth"] & ~template.regions["face"]
    for mask, colour in ((template.regions["lips"], LIP), (template.regions["brows"], BROW), (mouth, INSIDE)):
        colours[mask] = colour
    for name, colour in (("teeth_upper", TOOTH), ("teeth_lower", TOOTH), ("gums", GUM), ("tongue", TONGUE)):
        if name in template.parts:
            colours[template.parts[name].vertices] = colour
    for name, centre in zip(("eye_left", "eye_right"), template.eye_centres, strict=True):
        if name in template.parts:
            rows = template.parts[name].vertices
            offset = template.mean[rows] - centre
            across = np.hypot(offset[:, 0], offset[:, 1])
            front = offset[:, 2] > 0
            colours[rows] = np.where(
                (front & (across < 2.3))[:, None], PUPIL, np.where((front & (across < 6.2))[:, None], IRIS, WHITE)
            )
    return colours


def sheet(pictures: list[np.ndarray], columns: int, labels: list[str] | None = None) -> np.ndarray:
    """Pictures of one size in rows, each with its label above it."""
    import cv2

    h, w = pictures[0].shape[:2]
    band = 18 if labels else 0
    rows = -(-len(pictures) // columns)
    page = np.full((rows * (h + band), columns * w, 3), 255, np.uint8)
    for i, picture in enumerate(pictures):
        y, x = divmod(i, columns)
        page[y * (h + band) + band : (y + 1) * (h + band), x * w : (x + 1) * w] = picture
        if labels:
            cv2.putText(page, labels[i], (x * w + 3, y * (h + band) + 13), 0, 0.38, (0, 0, 0), 1, cv2.LINE_AA)
    return page
