"""Sampling of textures through a raster, filtered to the footprint of each pixel.

A texture is (th, tw, c) float32 with its first row on top; coordinates have their origin at the bottom left, as in
OBJ: u = 0 … 1 runs over the columns, v = 0 … 1 over the rows from the bottom, and texel centres lie at +0.5.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from avatarbuild.geometry.raster import Raster

MOST_CHANNELS = 6


class Mipmap(NamedTuple):
    """A texture and its ever coarser means, in one array: level k is texels[starts[k]:starts[k + 1]], row by row.

    texels (t, c) float32; starts (levels + 1,) and shapes (levels, 2) int64: rows, columns.
    """

    texels: np.ndarray
    starts: np.ndarray
    shapes: np.ndarray


def build_mipmap(texture: np.ndarray) -> Mipmap:
    """The texture (th, tw, c), c up to MOST_CHANNELS, and its means over 2 x 2, 4 x 4 … texels, down to 4 texels on the
    shorter side."""
    assert texture.shape[2] <= MOST_CHANNELS
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
def _floor(x: float) -> int:
    i = int(x)  # truncated; cheaper than np.floor
    return i - 1 if i > x else i


@numba.njit(cache=True, inline="always")
def _corners(j: int, i: int, start: int, th: int, tw: int, repeat: bool) -> tuple[int, int, int, int]:
    """Texels (i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1) of a level."""
    if 0 <= j < tw - 1 and 0 <= i < th - 1:
        a = start + i * tw + j
        return a, a + 1, a + tw, a + tw + 1
    if repeat:
        j0, j1, i0, i1 = j % tw, (j + 1) % tw, i % th, (i + 1) % th
    else:
        j0, j1 = min(max(j, 0), tw - 1), min(max(j + 1, 0), tw - 1)
        i0, i1 = min(max(i, 0), th - 1), min(max(i + 1, 0), th - 1)
    i0, i1 = start + i0 * tw, start + i1 * tw
    return i0 + j0, i0 + j1, i1 + j0, i1 + j1


@numba.njit(cache=True, inline="always")
def _mix(texels: np.ndarray, corners: tuple[int, int, int, int], weights: tuple[np.floating, ...], lane: int) -> float:
    i, j, k, m = corners
    wa, wb, wc, wd = weights
    a, b, c, d = np.uint64(i + lane), np.uint64(j + lane), np.uint64(k + lane), np.uint64(m + lane)
    return wa * texels[a] + wb * texels[b] + wc * texels[c] + wd * texels[d]


# Products may be fused with sums; the rest of fastmath would let results depend on how the loop is vectorised.
@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy", fastmath={"contract"})
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
    one, none = np.float32(1), np.float32(0)
    # Six sums in registers are a third faster than an array of `channels`; the idle ones repeat the last channel.
    last = channels - 1
    k1, k2, k3, k4 = min(1, last), min(2, last), min(3, last), min(4, last)
    for row in numba.prange(h):
        previous = -1
        ua, va, ub, vb, uc, vc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        near_a, near_b, near_c = 0.0, 0.0, 0.0
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
                ua, va, ub, vb, uc, vc = uv[p, 0], uv[p, 1], uv[q, 0], uv[q, 1], uv[r, 0], uv[r, 1]
                near_a, near_b, near_c = 1 / vertex_depth[a], 1 / vertex_depth[b], 1 / vertex_depth[c]
            b0, b1, b2 = barycentric[row, column, 0], barycentric[row, column, 1], barycentric[row, column, 2]
            z = depth[row, column]
            u = b0 * ua + b1 * ub + b2 * uc
            v = b0 * va + b1 * vb + b2 * vc
            n0, n1, n2 = z * near_a, z * near_b, z * near_c
            du0, du1, du2 = n0 * (ua - u) * tw, n1 * (ub - u) * tw, n2 * (uc - u) * tw
            dv0, dv1, dv2 = n0 * (va - v) * th, n1 * (vb - v) * th, n2 * (vc - v) * th
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
            share = level - fine
            t0, t1, t2, t3, t4, t5 = none, none, none, none, none, none
            for step in range(2 if share > 0 else 1):
                at = min(fine + step, top_level)
                n, m, start = shapes[at, 0], shapes[at, 1], starts[at]
                weight = np.float32((share if step else 1 - share) / taps)
                for tap in range(taps):
                    s = (tap + 0.5) / taps - 0.5
                    x, y = (u + s * mu / tw) * m - 0.5, (1.0 - v - s * mv / th) * n - 0.5
                    j, i = _floor(x), _floor(y)
                    fx, fy = np.float32(x - j), np.float32(y - i)
                    a4 = _corners(j, i, start, n, m, repeat)
                    corners = a4[0] * channels, a4[1] * channels, a4[2] * channels, a4[3] * channels
                    low, high = weight * (one - fy), weight * fy
                    shares = low * (one - fx), low * fx, high * (one - fx), high * fx
                    t0 += _mix(texels, corners, shares, 0)
                    t1 += _mix(texels, corners, shares, k1)
                    t2 += _mix(texels, corners, shares, k2)
                    if channels > 3:
                        t3 += _mix(texels, corners, shares, k3)
                        t4 += _mix(texels, corners, shares, k4)
                        t5 += _mix(texels, corners, shares, last)
            out[row, column, 0], out[row, column, k1], out[row, column, k2] = t0, t1, t2
            if channels > 3:
                out[row, column, k3], out[row, column, k4], out[row, column, last] = t3, t4, t5
