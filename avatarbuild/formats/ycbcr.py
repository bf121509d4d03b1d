"""Y'CbCr pictures as video stores them, to R'G'B'."""

from __future__ import annotations

import numba
import numpy as np

# kr, kb of the luma equation Y' = kr R' + kg G' + kb B'
BT709, BT601, BT2020 = (0.2126, 0.0722), (0.299, 0.114), (0.2627, 0.0593)


def rgb_from_planes(
    y: np.ndarray,
    cb: np.ndarray,
    cr: np.ndarray,
    bits: int,
    luma: tuple[float, float],
    full: bool,
    deep: bool,
) -> np.ndarray:
    """
    R' = Y' + 2 (1 - kr) Cr,  B' = Y' + 2 (1 - kb) Cb,  G' = (Y' - kr R' - kb B') / kg   (ITU-R BT.709, 601, 2020)

    (h, w, 3) uint8, or uint16 if deep, from luma (h, w) and chroma (h or h / 2, w or w / 2), uint8 or uint16 of `bits`.
    Limited range: Y' = (D / 2^(n-8) - 16) / 219, C = (D / 2^(n-8) - 128) / 224. Chroma is interpolated linearly; halved
    samples lie on the left luma sample of two and midway between rows (H.264 and HEVC, type 0).
    """
    kr, kb = luma
    kg = 1.0 - kr - kb
    one = 2.0 ** (bits - 8)
    top = 65535.0 if deep else 255.0
    y_zero, y_gain = (0.0, top / (256.0 * one - 1.0)) if full else (16.0 * one, top / (219.0 * one))
    c_gain = top / (256.0 * one - 1.0) if full else top / (224.0 * one)
    terms = [
        2.0 * (1.0 - kr) * c_gain,
        -2.0 * kb * (1.0 - kb) / kg * c_gain,
        -2.0 * kr * (1.0 - kr) / kg * c_gain,
        2.0 * (1.0 - kb) * c_gain,
    ]
    rgb = np.empty((*y.shape, 3), np.uint16 if deep else np.uint8)
    constants = np.array([y_zero, y_gain, 128.0 * one, *terms, top], np.float32)
    _convert(y, cb, cr, constants, rgb)
    return rgb


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _convert(y, cb, cr, constants, rgb):  # type: ignore[no-untyped-def]
    """Fills rgb; constants are y zero, y gain, chroma zero, R of Cr, G of Cb, G of Cr, B of Cb, top."""
    h, w = y.shape
    rows, columns = cb.shape
    y0, yg, c0, r_cr, g_cb, g_cr, b_cb, top = constants
    half = np.float32(0.5)
    near, far = np.float32(0.75), np.float32(0.25)
    u, v = np.empty(columns + 1, np.float32), np.empty(columns + 1, np.float32)
    wide_u, wide_v = np.empty(w + 1, np.float32), np.empty(w + 1, np.float32)
    for j in range(h):
        if rows == h:
            a, b = j, j
        else:
            a = min(j // 2, rows - 1)
            b = min(max(a - 1 if j % 2 == 0 else a + 1, 0), rows - 1)
        for i in range(columns):
            u[i] = near * np.float32(cb[a, i]) + far * np.float32(cb[b, i]) - c0
            v[i] = near * np.float32(cr[a, i]) + far * np.float32(cr[b, i]) - c0
        u[columns], v[columns] = u[columns - 1], v[columns - 1]
        if columns == w:
            for i in range(w):
                wide_u[i], wide_v[i] = u[i], v[i]
        else:
            for i in range((w + 1) // 2):
                wide_u[2 * i], wide_u[2 * i + 1] = u[i], half * (u[i] + u[i + 1])
                wide_v[2 * i], wide_v[2 * i + 1] = v[i], half * (v[i] + v[i + 1])
        for i in range(w):
            light = (np.float32(y[j, i]) - y0) * yg + half
            rgb[j, i, 0] = int(min(max(light + r_cr * wide_v[i], half), top))
            rgb[j, i, 1] = int(min(max(light + g_cb * wide_u[i] + g_cr * wide_v[i], half), top))
            rgb[j, i, 2] = int(min(max(light + b_cb * wide_u[i], half), top))
