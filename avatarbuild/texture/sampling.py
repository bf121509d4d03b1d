"""Colours of texels in the photos they were given, by cubic interpolation in linear light."""

from __future__ import annotations

import numba
import numpy as np

from avatarbuild.parallel import in_order
from avatarbuild.texture.photos import Photo, linear_picture, shrunk


def sample(photos: list[Photo], label: np.ndarray, position: np.ndarray, texels_per_mm: float) -> np.ndarray:
    """
    (n, 3) float32 linear colours of points position (n, 3) mm, each in the photo label (n,); 0 where label < 0.

    A photo finer than the texture is averaged first.
    """
    out = np.zeros((len(label), 3), np.float32)
    order, starts = grouped(label, len(photos))
    wanted = [k for k in range(len(photos)) if starts[k + 1] > starts[k]]

    def load(k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        which = order[starts[k] : starts[k + 1]]
        photo = photos[k]
        pixels = np.empty((len(which), 2), np.float32)
        _project(photo.lens(), position, which, pixels)
        depth = float(np.linalg.norm(photo.centre - position[which[:: max(len(which) // 100, 1)]], axis=1).mean())
        factor = max(1, int(photo.K[0, 0] / depth / texels_per_mm + 0.3))
        low = np.maximum(np.floor(np.nanmin(pixels, axis=0)).astype(int) - 4 * factor, 0)
        high = np.maximum(np.ceil(np.nanmax(pixels, axis=0)).astype(int) + 4 * factor, low + 4 * factor)
        picture = shrunk(linear_picture(photo.image.rgb()[low[1] : high[1], low[0] : high[0]]), factor)
        return which, (pixels - low.astype(np.float32)) / factor, picture

    for which, pixels, picture in in_order(load, wanted, ahead=0):
        _cubic(np.ascontiguousarray(picture), pixels, which, out)
    return out


def grouped(label: np.ndarray, labels: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices ordered by label, and where each label's begin (labels + 1,); negative labels are left out."""
    order = np.empty(int((label >= 0).sum()), np.int32)
    starts = np.zeros(labels + 1, np.int64)
    _group(label, order, starts)
    return order, starts


@numba.njit(cache=True, nogil=True)
def _group(label: np.ndarray, order: np.ndarray, starts: np.ndarray) -> None:
    for i in range(len(label)):
        if label[i] >= 0:
            starts[label[i] + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    at = starts[:-1].copy()
    for i in range(len(label)):
        k = label[i]
        if k >= 0:
            order[at[k]] = i
            at[k] += 1


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _project(lens: np.ndarray, position: np.ndarray, which: np.ndarray, out: np.ndarray) -> None:
    """As geometry.raster.project, of some points only, in one pass."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = lens[12:21]
    for i in range(len(which)):
        a, b, c = position[which[i], 0], position[which[i], 1], position[which[i], 2]
        z = lens[6] * a + lens[7] * b + lens[8] * c + lens[11]
        x = (lens[0] * a + lens[1] * b + lens[2] * c + lens[9]) / z
        y = (lens[3] * a + lens[4] * b + lens[5] * c + lens[10]) / z
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        out[i, 0] = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
        out[i, 1] = fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy


@numba.njit(cache=True, inline="always")
def _kernel(t: float, weights: np.ndarray) -> None:
    """Catmull and Rom's cubic at -1 - t, -t, 1 - t, 2 - t."""
    weights[0] = 0.5 * t * (-1 + t * (2 - t))
    weights[1] = 0.5 * (2 + t * t * (-5 + 3 * t))
    weights[2] = 0.5 * t * (1 + t * (4 - 3 * t))
    weights[3] = 0.5 * t * t * (t - 1)


@numba.njit(cache=True, parallel=True, nogil=True)
def _cubic(picture: np.ndarray, pixels: np.ndarray, which: np.ndarray, out: np.ndarray) -> None:
    h, w = picture.shape[:2]
    block = 4096
    for part in numba.prange(-(-len(which) // block)):
        wx, wy = np.zeros(4, np.float32), np.zeros(4, np.float32)
        for i in range(part * block, min((part + 1) * block, len(which))):
            x, y = pixels[i, 0] - np.float32(0.5), pixels[i, 1] - np.float32(0.5)
            j, r = int(np.floor(x)), int(np.floor(y))
            _kernel(x - j, wx)
            _kernel(y - r, wy)
            red, green, blue = np.float32(0), np.float32(0), np.float32(0)
            for a in range(4):
                row = min(max(r - 1 + a, 0), h - 1)
                for b in range(4):
                    column = min(max(j - 1 + b, 0), w - 1)
                    weight = wy[a] * wx[b]
                    red += weight * picture[row, column, 0]
                    green += weight * picture[row, column, 1]
                    blue += weight * picture[row, column, 2]
            k = which[i]
            out[k, 0] = max(red, np.float32(0))
            out[k, 1] = max(green, np.float32(0))
            out[k, 2] = max(blue, np.float32(0))
