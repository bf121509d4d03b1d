"""A small renderer for looking at heads: textured meshes, perspective, one light, supersampled.

Linear light inside, sRGB out. A view's camera has its pixel centres at +0.5 and OpenCV's axes; x, y, z of the scene are
the head frame's (millimetres; x to the subject's left, y up, z out of the face). Letters: n vertices, m triangles,
h rows, w columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from avatarbuild.formats.colour import encode_srgb
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.mipmap import Mipmap, sample_texture
from avatarbuild.geometry.raster import Raster, box_average, interpolate, project, rasterise
from avatarbuild.report.shading import Light, lit

_PAPER = (0.60, 0.62, 0.65)  # linear: a grey that suits light and dark pages


class View(NamedTuple):
    """A camera that looks at `centre` (3,) from `distance` mm, turned by yaw and pitch degrees; `height` mm fill it.

    Positive yaw shows the subject's left side, positive pitch the head from above; size (w, h) in pixels.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    size: tuple[int, int] = (480, 560)
    height: float = 330.0
    centre: tuple[float, float, float] = (0.0, -15.0, -20.0)
    distance: float = 1400.0


class Seen(NamedTuple):
    """What a view sees of a mesh, `factor` times as large as the picture: the raster, pixels (n, 2), depth (n,) and
    triangles (m, 3) that it came from, and the rotation (3, 3) and focal length (pixels) of its camera."""

    raster: Raster
    pixels: np.ndarray
    depth: np.ndarray
    triangles: np.ndarray
    rotation: np.ndarray
    focal: float


class Decal(NamedTuple):
    """A texture (linear) on the triangles of a slice: uv (u, 2), uv_triangles (m, 3) over all of the mesh's."""

    where: slice
    texture: Mipmap
    uv: np.ndarray
    uv_triangles: np.ndarray


@dataclass(frozen=True)
class Paint:
    """What a mesh looks like: colours (n, 3) linear, gloss (n,) from 0 dull to 1 wet, and decals over the colours."""

    colours: np.ndarray
    gloss: np.ndarray
    decals: Sequence[Decal] = ()


def pinhole(view: View, factor: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K (3, 3), R (3, 3), t (3,) of a view whose picture is `factor` times as large."""
    w, h = view.size[0] * factor, view.size[1] * factor
    f = h * view.distance / view.height
    y, p = np.radians([view.yaw, view.pitch])
    turn_y = np.array([[np.cos(y), 0, -np.sin(y)], [0, 1, 0], [np.sin(y), 0, np.cos(y)]])
    turn_x = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
    R = np.diag([1.0, -1.0, -1.0]) @ turn_x @ turn_y
    t = np.array([0, 0, view.distance]) - R @ np.array(view.centre)
    return np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1.0]]), R, t


def look(vertices: np.ndarray, triangles: np.ndarray, view: View, factor: int = 2, *, cull: bool = False) -> Seen:
    """Draws a mesh (n, 3), (m, 3) without colour; `cull` leaves out what is seen from behind."""
    K, R, t = pinhole(view, factor)
    pixels, depth = project(vertices, K, np.zeros(5), R, t)
    size = (view.size[0] * factor, view.size[1] * factor)
    return Seen(rasterise(pixels, depth, triangles, size, cull=cull), pixels, depth, triangles, R, float(K[0, 0]))


def colour_image(seen: Seen, paint: Paint) -> np.ndarray:
    """(h, w, 3) float32 linear: the paint that each pixel sees, before any light."""
    image = interpolate(paint.colours, seen.triangles, seen.raster.triangle, seen.raster.barycentric)
    for decal in paint.decals:
        inside = (seen.raster.triangle >= decal.where.start) & (seen.raster.triangle < decal.where.stop)
        if inside.any():
            part = Raster(np.where(inside, seen.raster.triangle, np.int32(-1)), *seen.raster[1:])
            on = (seen.pixels, seen.depth, seen.triangles, decal.uv, decal.uv_triangles)
            image[inside] = sample_texture(decal.texture, part, *on)[inside]
    return image


def shade(seen: Seen, normals: np.ndarray, image: np.ndarray, gloss: np.ndarray, light: Light) -> np.ndarray:
    """(h, w, 3) float32 linear radiance of an image (h, w, 3) painted on what is seen, zero where nothing is.

    normals (n, 3) in the scene, gloss (n,) from 0 dull to 1 wet; `shading.lit` gives the formula.
    """
    directions = (normals @ seen.rotation.T).astype(np.float32)
    columns = np.concatenate([directions, np.asarray(gloss, np.float32)[:, None]], axis=1)
    smooth = interpolate(columns, seen.triangles, seen.raster.triangle, seen.raster.barycentric)
    return lit(seen.raster.depth, smooth, image, light, seen.focal)


def finish(
    linear: np.ndarray, shown: np.ndarray, factor: int, paper: tuple[float, float, float] = _PAPER
) -> np.ndarray:
    """(h / factor, w / factor, 3) uint8 sRGB of a drawing, before a background that darkens towards its rim.

    linear (h, w, 3) float32, zero where shown (h, w) bool says that there is nothing.
    """
    cover = box_average(shown.astype(np.float32), factor)
    h, w = cover.shape
    y, x = np.ogrid[:h, :w]
    off = ((x + 0.5) / w - 0.5) ** 2 + ((y + 0.5) / h - 0.42) ** 2
    back = np.array(paper) * (1 - 0.75 * off)[..., None]
    return encode_srgb(box_average(linear, factor) + (1 - cover)[..., None] * back)


def draw(
    vertices: np.ndarray,
    triangles: np.ndarray,
    paint: Paint,
    view: View,
    *,
    light: Light | None = None,
    factor: int = 2,
) -> np.ndarray:
    """(h, w, 3) uint8 sRGB: the mesh as it looks, supersampled by `factor`."""
    seen = look(vertices, triangles, view, factor)
    normals = vertex_normals(vertices, triangles)
    linear = shade(seen, normals, colour_image(seen, paint), paint.gloss, light or Light())
    return finish(linear, seen.raster.triangle >= 0, factor)
