"""How a pixel is lit: a soft lamp, ambient light with occlusion from the depth image. Linear light inside, sRGB out.

Images are (h, w); normals, depth and focal length are a pinhole camera's whose principal point is the picture's middle.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

_REACH = 11.0  # mm: surfaces nearer than this darken one another
_TAPS = 6  # directions that a pixel looks for them; its four neighbours look in others
_OCCLUSION, _DARKEST = 0.95, 0.25


class Light(NamedTuple):
    """One lamp and the room: direction (3,) from the surface to the lamp in camera axes, strengths as radiances of a
    white surface that faces it; `wrap` lets the lamp reach round the edge of what it lights."""

    direction: tuple[float, float, float] = (-0.45, -0.62, -0.80)
    lamp: float = 0.62
    above: float = 0.46
    below: float = 0.20
    wrap: float = 0.35
    gloss: float = 1.0


def lit(depth: np.ndarray, smooth: np.ndarray, image: np.ndarray, light: Light, focal: float) -> np.ndarray:
    """(h, w, 3) float32 linear radiance of a painted image, zero where depth (h, w) is infinite.

    L = c o (above (1 + n_up) / 2 + below (1 - n_up) / 2) + c (0.45 + 0.55 o) lamp max(0, (n.l + wrap) / (1 + wrap))
        + o gloss (n.h)^s

    with the paint c (h, w, 3), the lamp's direction l, the half vector h and the openness o to the surroundings;
    smooth (h, w, 4): normals n in camera axes, of any length, and gloss from 0 dull to 1 wet.
    """
    lamp = np.array(light.direction) / np.linalg.norm(light.direction)
    out = np.empty(image.shape, np.float32)
    _shade(depth, smooth, image, occlusion(depth, smooth, focal), lamp, np.array(light[1:]), focal, out)
    return out


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


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
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


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
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
