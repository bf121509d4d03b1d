"""A small renderer for looking at heads and clouds: one soft light, ambient light with occlusion, no shadows.

Linear light inside, sRGB out. A view's camera has its pixel centres at +0.5 and OpenCV's axes; x, y, z of the scene are
the head frame's (millimetres; x to the subject's left, y up, z out of the face). Letters: n vertices, m triangles,
h rows, w columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.mipmap import Mipmap, sample_texture
from avatarbuild.geometry.raster import Raster, box_average, interpolate, project, rasterise

PAPER = (0.60, 0.62, 0.65)  # linear: a grey that suits light and dark pages

_REACH = 11.0  # mm: surfaces nearer than this darken one another
_TAPS = 6  # directions that a pixel looks for them; its four neighbours look in others
_OCCLUSION, _DARKEST = 0.95, 0.25
_FAR_SHARE = 0.3  # of the splats' depth tolerance, in radii


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


class Light(NamedTuple):
    """One lamp and the room: direction (3,) from the surface to the lamp in camera axes, strengths as radiances of a
    white surface that faces it; `wrap` lets the lamp reach round the edge of what it lights."""

    direction: tuple[float, float, float] = (-0.45, -0.62, -0.80)
    lamp: float = 0.62
    above: float = 0.46
    below: float = 0.20
    wrap: float = 0.35
    gloss: float = 1.0


class Seen(NamedTuple):
    """What a view sees of a mesh, `factor` times as large as the picture: the raster, pixels (n, 2), depth (n,) and
    triangles (m, 3) that it came from, and the rotation (3, 3) and focal length (pixels) of its camera."""

    raster: Raster
    pixels: np.ndarray
    depth: np.ndarray
    triangles: np.ndarray
    rotation: np.ndarray
    focal: float


class Splats(NamedTuple):
    """What a view sees of a cloud, `factor` times as large as the picture: depth (h, w), infinite for nothing, normals
    (h, w, 3) in camera axes, not unit, colours (h, w, 3) linear, and the camera's focal length in pixels."""

    depth: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
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
    """(h, w, 3) float32 linear radiance of a painted image under a light; zero where nothing is seen.

    L = c o (above (1 + n_up) / 2 + below (1 - n_up) / 2 + lamp max(0, (n.l + wrap) / (1 + wrap))) + gloss (n.h)^s

    with the paint c (h, w, 3), the lamp's direction l, the half vector h and the openness o to the surroundings;
    normals (n, 3) in the scene, gloss (n,).
    """
    directions = (normals @ seen.rotation.T).astype(np.float32)
    columns = np.concatenate([directions, np.asarray(gloss, np.float32)[:, None]], axis=1)
    smooth = interpolate(columns, seen.triangles, seen.raster.triangle, seen.raster.barycentric)
    return _lit(seen.raster.depth, smooth, image, light, seen.focal)


def occlusion(depth: np.ndarray, normals: np.ndarray, focal: float) -> np.ndarray:
    """(h, w) float32: how open each pixel's point p is to its surroundings, 1 for a plane.

    o = max(0.25, 1 - a / k sum_i max(0, (q_i - p).n - bias) / (|q_i - p|^2 + eps)),  q_i the k points seen nearby.

    Source: McGuire, Osman, Bukowski, Hennessy, The Alchemy screen-space ambient obscurance algorithm, 2011.
    """
    out = np.ones(depth.shape, np.float32)
    share = (np.arange(_TAPS) + 0.5) / _TAPS
    angle = 2.399963 * np.arange(_TAPS) + 0.5 * np.pi / _TAPS * np.arange(4)[:, None]  # the golden angle, spread evenly
    _occlusion(depth, normals, focal, share[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1), out)
    return out


def finish(linear: np.ndarray, shown: np.ndarray, factor: int, paper: tuple[float, float, float] = PAPER) -> np.ndarray:
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
    paper: tuple[float, float, float] = PAPER,
) -> np.ndarray:
    """(h, w, 3) uint8 sRGB: the mesh as it looks, supersampled by `factor`."""
    seen = look(vertices, triangles, view, factor)
    normals = vertex_normals(vertices, triangles)
    linear = shade(seen, normals, colour_image(seen, paint), paint.gloss, light or Light())
    return finish(linear, seen.raster.triangle >= 0, factor, paper)


def splat(
    points: np.ndarray, normals: np.ndarray, colours: np.ndarray, radius: float, view: View, factor: int = 2
) -> Splats:
    """Draws a cloud: every point that faces the eye is a disc of `radius` mm.

    points (n, 3), normals (n, 3) unit, colours (n, 3) linear. What lies within a radius of the nearest disc is
    averaged, each disc fading towards its edge; so the drawing does not depend on the points' order beyond rounding.
    """
    K, R, t = pinhole(view, factor)
    size = (view.size[1] * factor, view.size[0] * factor)
    total, nearest = np.zeros((*size, 7), np.float32), np.full(size, np.inf, np.float32)
    p, n, c = (np.ascontiguousarray(a, np.float32) for a in (points, normals, colours))
    _splat(p, n, c, R, t, float(K[0, 0]), radius, total, nearest)
    mean = total[..., :6] / np.maximum(total[..., 6:], np.float32(1e-9))
    return Splats(nearest, np.ascontiguousarray(mean[..., 3:]), np.ascontiguousarray(mean[..., :3]), float(K[0, 0]))


def draw_splats(
    splats: Splats,
    *,
    clay: float | None = None,
    light: Light | None = None,
    factor: int = 2,
    paper: tuple[float, float, float] = PAPER,
) -> np.ndarray:
    """(h, w, 3) uint8 sRGB of a splatted cloud in its colours, or all of one grey, `clay`, which shows shape alone."""
    image = splats.colours if clay is None else np.full_like(splats.colours, clay)
    dull = np.zeros((*splats.depth.shape, 1), np.float32)
    linear = _lit(splats.depth, np.concatenate([splats.normals, dull], axis=2), image, light or Light(), splats.focal)
    return finish(linear, np.isfinite(splats.depth), factor, paper)


def decode_srgb(value: np.ndarray | Sequence[float]) -> np.ndarray:
    """Linear light of sRGB values: uint8 in 0..255, floats in 0..1."""
    array = np.asarray(value)
    v = array / 255.0 if array.dtype == np.uint8 else array.astype(np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """uint8 sRGB of linear light, clipped to 0..1."""
    v = np.clip(linear, 0, 1)
    return np.round(255 * np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)).astype(np.uint8)


def _lit(depth: np.ndarray, smooth: np.ndarray, image: np.ndarray, light: Light, focal: float) -> np.ndarray:
    """smooth (h, w, 4): normals in camera axes, and gloss."""
    lamp = np.array(light.direction) / np.linalg.norm(light.direction)
    out = np.empty(image.shape, np.float32)
    _shade(depth, smooth, image, occlusion(depth, smooth, focal), lamp, np.array(light[1:]), focal, out)
    return out


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _occlusion(depth: np.ndarray, normals: np.ndarray, focal: float, taps: np.ndarray, out: np.ndarray) -> None:
    h, w = depth.shape
    for row in numba.prange(h):
        for column in range(w):
            z = depth[row, column]
            if not np.isfinite(z):
                continue
            nx, ny, nz = normals[row, column, 0], normals[row, column, 1], normals[row, column, 2]
            length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-6)
            nx, ny, nz = nx / length, ny / length, nz / length
            x, y = (column + 0.5 - 0.5 * w) / focal * z, (row + 0.5 - 0.5 * h) / focal * z
            reach = _REACH * focal / z
            own = 2 * (row % 2) + column % 2
            total = 0.0
            for k in range(_TAPS):
                j = column + int(np.floor(reach * taps[own, k, 0] + 0.5))
                i = row + int(np.floor(reach * taps[own, k, 1] + 0.5))
                if i < 0 or j < 0 or i >= h or j >= w or not np.isfinite(depth[i, j]):
                    continue
                zq = depth[i, j]
                dx, dy = (j + 0.5 - 0.5 * w) / focal * zq - x, (i + 0.5 - 0.5 * h) / focal * zq - y
                dz = zq - z
                square = dx * dx + dy * dy + dz * dz
                away = np.sqrt(square)
                along = dx * nx + dy * ny + dz * nz - 0.06 * away
                if along > 0 and away < 2 * _REACH:
                    total += along * away / (square + 1.0)
            out[row, column] = max(_DARKEST, 1.0 - _OCCLUSION * 2 * total / _TAPS)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _shade(
    depth: np.ndarray,
    smooth: np.ndarray,
    image: np.ndarray,
    open_: np.ndarray,
    lamp: np.ndarray,
    light: np.ndarray,
    focal: float,
    out: np.ndarray,
) -> None:
    h, w = depth.shape
    strength, above, below, wrap, gloss = light
    for row in numba.prange(h):
        for column in range(w):
            if not np.isfinite(depth[row, column]):
                out[row, column] = 0
                continue
            nx, ny, nz = smooth[row, column, 0], smooth[row, column, 1], smooth[row, column, 2]
            length = max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-6)
            nx, ny, nz = nx / length, ny / length, nz / length
            towards = nx * lamp[0] + ny * lamp[1] + nz * lamp[2]
            o = open_[row, column]
            ambient = o * (above * 0.5 * (1 - ny) + below * 0.5 * (1 + ny))
            direct = strength * max(0.0, (towards + wrap) / (1 + wrap)) * (0.45 + 0.55 * o)
            ex, ey = -(column + 0.5 - 0.5 * w) / focal, -(row + 0.5 - 0.5 * h) / focal
            far = np.sqrt(ex * ex + ey * ey + 1)
            hx, hy, hz = lamp[0] + ex / far, lamp[1] + ey / far, lamp[2] - 1 / far
            half = max(np.sqrt(hx * hx + hy * hy + hz * hz), 1e-6)
            wet = smooth[row, column, 3]
            mirror = max(0.0, (nx * hx + ny * hy + nz * hz) / half)
            shine = 0.0
            if mirror > 0.6:
                shine = gloss * o * (0.10 * wet + 0.75 * wet**3) * mirror ** (12.0 + 240.0 * wet * wet)
            for c in range(3):
                out[row, column, c] = image[row, column, c] * (ambient + direct) + shine


@numba.njit(cache=True, inline="always")
def _turned(R: np.ndarray, v: np.ndarray) -> tuple[float, float, float]:
    return (
        R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
        R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
        R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2],
    )


@numba.njit(cache=True)
def _splat(
    points: np.ndarray,
    normals: np.ndarray,
    colours: np.ndarray,
    R: np.ndarray,
    t: np.ndarray,
    focal: float,
    radius: float,
    total: np.ndarray,
    nearest: np.ndarray,
) -> None:
    h, w = nearest.shape
    for turn in range(2):
        for p in range(len(points)):
            x, y, z = _turned(R, points[p])
            x, y, z = x + t[0], y + t[1], z + t[2]
            nx, ny, nz = _turned(R, normals[p])
            if z < 1.0 or x * nx + y * ny + z * nz >= 0:
                continue
            u, v = focal * x / z + 0.5 * w - 0.5, focal * y / z + 0.5 * h - 0.5
            r = max(radius * focal / z, 0.75)
            for i in range(max(0, int(np.ceil(v - r))), min(h - 1, int(np.floor(v + r))) + 1):
                for j in range(max(0, int(np.ceil(u - r))), min(w - 1, int(np.floor(u + r))) + 1):
                    off = ((i - v) ** 2 + (j - u) ** 2) / (r * r)
                    if off > 1:
                        continue
                    if turn == 0:
                        nearest[i, j] = min(nearest[i, j], np.float32(z))
                    elif z <= nearest[i, j] + radius * (1 + _FAR_SHARE):
                        weight = np.float32(1.05 - off)
                        for c in range(3):
                            total[i, j, c] += weight * colours[p, c]
                        total[i, j, 3] += weight * nx
                        total[i, j, 4] += weight * ny
                        total[i, j, 5] += weight * nz
                        total[i, j, 6] += weight
