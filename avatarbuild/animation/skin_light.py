"""Skin under the light of equation (1), its normals bent by detail maps: per pixel, compiled."""

from __future__ import annotations

import numba
import numpy as np

from avatarbuild.texture.occlusion import between_skin

_DARKEST = 0.02


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def bent(smooth: np.ndarray, tangents: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """
    (h, w, 3) float32 unit normals n' ~ n - a t - b (w n x t) of smooth normals n (h, w, 3), tangents t with their
    handedness w (h, w, 4), and slopes a, b (h, w, 2) of the relief along growing u and v.
    """
    out = np.zeros(smooth.shape, np.float32)
    for row in numba.prange(smooth.shape[0]):
        for column in range(smooth.shape[1]):
            nx, ny, nz = smooth[row, column, 0], smooth[row, column, 1], smooth[row, column, 2]
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length < 1e-6:
                continue
            nx, ny, nz = nx / length, ny / length, nz / length
            tx, ty, tz = tangents[row, column, 0], tangents[row, column, 1], tangents[row, column, 2]
            dot = nx * tx + ny * ty + nz * tz
            tx, ty, tz = tx - dot * nx, ty - dot * ny, tz - dot * nz
            length = max(np.sqrt(tx * tx + ty * ty + tz * tz), 1e-6)
            tx, ty, tz = tx / length, ty / length, tz / length
            side = 1.0 if tangents[row, column, 3] >= 0 else -1.0
            a, b = slopes[row, column, 0], side * slopes[row, column, 1]
            x = nx - a * tx - b * (ny * tz - nz * ty)
            y = ny - a * ty - b * (nz * tx - nx * tz)
            z = nz - a * tz - b * (nx * ty - ny * tx)
            length = max(np.sqrt(x * x + y * y + z * z), 1e-6)
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = x / length, y / length, z / length
    return out


@numba.njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def shading(normals: np.ndarray, y: np.ndarray) -> np.ndarray:
    """s(n) = max(y^T phi(n), 0.02): (h, w, 3) float32 of unit normals (h, w, 3), y (9, 3); zero where n is nil."""
    out = np.zeros(normals.shape, np.float32)
    for row in numba.prange(normals.shape[0]):
        for column in range(normals.shape[1]):
            a, b, c = normals[row, column, 0], normals[row, column, 1], normals[row, column, 2]
            if a * a + b * b + c * c < 0.25:
                continue
            for k in range(3):
                s = y[0, k] + y[1, k] * a + y[2, k] * b + y[3, k] * c + y[4, k] * a * b + y[5, k] * a * c
                s += y[6, k] * b * c + y[7, k] * (a * a - b * b) + y[8, k] * (3 * c * c - 1)
                out[row, column, k] = max(s, _DARKEST)
    return out


def shaded_hollows(open_: np.ndarray, skin_colour: np.ndarray) -> np.ndarray:
    """(h, w, 3) share of light in hollows of openness (h, w): light between skin and skin is not lost."""
    return between_skin(open_, skin_colour).astype(np.float32)
