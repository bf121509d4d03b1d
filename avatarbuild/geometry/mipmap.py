"""Sampling of textures through a raster, filtered to the footprint of each pixel.

A texture is (th, tw, c) float32 with its first row on top; coordinates have their origin at the bottom left, as in
OBJ: u = 0 … 1 runs over the columns, v = 0 … 1 over the rows from the bottom, and texel centres lie at +0.5.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from avatarbuild.geometry.raster import Raster


class Mipmap(NamedTuple):
    """A texture and its ever coarser means, in one array: level k is texels[starts[k]:starts[k + 1]], row by row.

    texels (t, c) float32; starts (levels + 1,) and shapes (levels, 2) int64: rows, columns.
    """

    texels: np.ndarray
    starts: np.ndarray
    shapes: np.ndarray


def build_mipmap(texture: np.ndarray) -> Mipmap:
    """The texture (th, tw, c) and its means over 2 x 2, 4 x 4 … texels, down to 4 texels on the shorter side."""
    level = np.ascontiguousarray(texture, np.float32)
    levels = [level]
    while min(level.shape[:2]) >= 8:
        h, w = level.shape[0] // 2 * 2, level.shape[1] // 2 * 2
        even = level[:h, :w]
        level = 0.25 * (even[0::2, 0::2] + even[1::2, 0::2] + even[0::2, 1::2] + even[1::2, 1::2])
        levels.append(level)
    starts = np.zeros(len(levels) + 1, np.int64)
    np.cumsum([x.shape[0] * x.shape[1] for x in levels], out=starts[1:])
    texels = np.concatenate([x.reshape(-1, x.shape[2]) for x in levels])
    return Mipmap(texels, starts, np.array([x.shape[:2] for x in levels], np.int64))


def sample_texture(
    texture: Mipmap,
    raster: Raster,
    pixels: np.ndarray,
    depth: np.ndarray,
    triangles: np.ndarray,
    uv: np.ndarray,
    uv_triangles: np.ndarray,
    *,
    repeat: bool = False,
    bias: float = 0.0,
    taps: int = 8,
) -> np.ndarray:
    """The texture seen by each pixel, (h, w, c) float32, zero where the raster is empty.

    The raster with the `pixels` (n, 2), `depth` (n,) and `triangles` (m, 3) that it was drawn from; uv (u, 2),
    uv_triangles (m, 3); `repeat` continues the texture periodically, else its border is held; `bias` in levels,
    negative is sharper. The footprint of a pixel is the image of the unit square under

    d(u, v)/d(x, y) = sum_i grad l_i (z / z_i) ((u, v)_i - (u, v)),    l the barycentric coordinates in the image;

    its shorter axis chooses the level (trilinear), along its longer axis up to `taps` samples are averaged.
    """
    h, w = raster.triangle.shape
    out = np.empty((h, w, texture.texels.shape[1]), np.float32)
    _sample(
        texture.texels.reshape(-1),
        texture.texels.shape[1],
        texture.starts,
        texture.shapes,
        *raster,
        np.ascontiguousarray(np.nan_to_num(pixels), np.float64),
        np.ascontiguousarray(depth, np.float64),
        np.ascontiguousarray(triangles, np.int32),
        np.ascontiguousarray(uv, np.float64),
        np.ascontiguousarray(uv_triangles, np.int32),
        repeat,
        float(bias),
        taps,
        out,
    )
    return out


@numba.njit(cache=True, inline="always")
def _texel(i: int, n: int, repeat: bool) -> int:
    return i % n if repeat else min(max(i, 0), n - 1)


@numba.njit(cache=True, inline="always")
def _add_bilinear(
    texels: np.ndarray,
    channels: int,
    start: int,
    th: int,
    tw: int,
    u: float,
    v: float,
    repeat: bool,
    weight: float,
    total: np.ndarray,
) -> None:
    """total += weight * texture(u, v), texels flat."""
    x, y = u * tw - 0.5, (1.0 - v) * th - 0.5
    j, i = int(np.floor(x)), int(np.floor(y))
    fx, fy = np.float32(x - j), np.float32(y - i)
    one, share = np.float32(1), np.float32(weight)
    j0, j1 = _texel(j, tw, repeat), _texel(j + 1, tw, repeat)
    i0, i1 = start + _texel(i, th, repeat) * tw, start + _texel(i + 1, th, repeat) * tw
    a, b = np.uint64((i0 + j0) * channels), np.uint64((i0 + j1) * channels)
    c, d = np.uint64((i1 + j0) * channels), np.uint64((i1 + j1) * channels)
    wa, wb = share * (one - fx) * (one - fy), share * fx * (one - fy)
    wc, wd = share * (one - fx) * fy, share * fx * fy
    for k in range(np.uint64(channels)):
        total[k] += wa * texels[a + k] + wb * texels[b + k] + wc * texels[c + k] + wd * texels[d + k]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _sample(
    texels: np.ndarray,
    channels: int,
    starts: np.ndarray,
    shapes: np.ndarray,
    triangle: np.ndarray,
    barycentric: np.ndarray,
    depth: np.ndarray,
    pixels: np.ndarray,
    vertex_depth: np.ndarray,
    faces: np.ndarray,
    uv: np.ndarray,
    uv_faces: np.ndarray,
    repeat: bool,
    bias: float,
    most: int,
    out: np.ndarray,
) -> None:
    h, w = triangle.shape
    top_level = len(shapes) - 1
    th, tw = shapes[0]
    for row in numba.prange(h):
        total = np.zeros(channels, np.float32)
        previous = -1
        a, b, c, p, q, r = 0, 0, 0, 0, 0, 0
        g1x, g1y, g2x, g2y = 0.0, 0.0, 0.0, 0.0
        for column in range(w):
            f = triangle[row, column]
            if f < 0:
                for k in range(channels):
                    out[row, column, k] = 0
                continue
            if f != previous:
                previous = f
                a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                p, q, r = uv_faces[f, 0], uv_faces[f, 1], uv_faces[f, 2]
                ex, ey = pixels[b, 0] - pixels[a, 0], pixels[b, 1] - pixels[a, 1]
                hx, hy = pixels[c, 0] - pixels[a, 0], pixels[c, 1] - pixels[a, 1]
                area = ex * hy - ey * hx
                area = area if abs(area) > 1e-9 else 1e-9
                g1x, g1y, g2x, g2y = hy / area, -hx / area, -ey / area, ex / area
            b0, b1, b2 = barycentric[row, column, 0], barycentric[row, column, 1], barycentric[row, column, 2]
            z = depth[row, column]
            u = b0 * uv[p, 0] + b1 * uv[q, 0] + b2 * uv[r, 0]
            v = b0 * uv[p, 1] + b1 * uv[q, 1] + b2 * uv[r, 1]
            n0, n1, n2 = z / vertex_depth[a], z / vertex_depth[b], z / vertex_depth[c]
            du0, du1, du2 = n0 * (uv[p, 0] - u) * tw, n1 * (uv[q, 0] - u) * tw, n2 * (uv[r, 0] - u) * tw
            dv0, dv1, dv2 = n0 * (uv[p, 1] - v) * th, n1 * (uv[q, 1] - v) * th, n2 * (uv[r, 1] - v) * th
            ux = (du1 - du0) * g1x + (du2 - du0) * g2x
            uy = (du1 - du0) * g1y + (du2 - du0) * g2y
            vx = (dv1 - dv0) * g1x + (dv2 - dv0) * g2x
            vy = (dv1 - dv0) * g1y + (dv2 - dv0) * g2y
            square_x, square_y = ux * ux + vx * vx, uy * uy + vy * vy
            if square_x >= square_y:
                major, mu, mv = np.sqrt(square_x), ux, vx
            else:
                major, mu, mv = np.sqrt(square_y), uy, vy
            minor = abs(ux * vy - uy * vx) / max(major, 1e-9)
            taps = int(min(max(np.round(major / max(minor, 1e-3)), 1.0), most))
            width = max(minor, major / taps)
            level = min(max(np.log2(max(width, 1e-6)) + bias, 0.0), float(top_level))
            fine = int(level)
            coarse = min(fine + 1, top_level)
            share = level - fine
            for k in range(channels):
                total[k] = 0
            for tap in range(taps):
                s = (tap + 0.5) / taps - 0.5
                us, vs = u + s * mu / tw, v + s * mv / th
                n, m = shapes[fine, 0], shapes[fine, 1]
                _add_bilinear(texels, channels, starts[fine], n, m, us, vs, repeat, (1 - share) / taps, total)
                if share > 0:
                    n, m = shapes[coarse, 0], shapes[coarse, 1]
                    _add_bilinear(texels, channels, starts[coarse], n, m, us, vs, repeat, share / taps, total)
            for k in range(channels):
                out[row, column, k] = total[k]
