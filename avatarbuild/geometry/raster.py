"""Rasterisation of triangle meshes on the CPU: which triangle each pixel sees, and where on it.

Pixel centres lie at +0.5: the pixel of column j and row i samples the point (j + 0.5, i + 0.5). Letters: n vertices,
m triangles, h rows, w columns. Everything repeats bit for bit, whatever the number of threads: a band of rows belongs
to one thread and draws its triangles in their order.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

_BITS = 10  # vertices are snapped to 2**-10 pixel, so that edge functions are exact integers
_UNIT = 1 << _BITS
_FARTHEST = float(1 << 18)  # pixels; products of snapped coordinates below this fit 64 bits
_BAND = 16  # rows


class Raster(NamedTuple):
    """What each pixel sees: triangle (h, w) int32, -1 for none; barycentric (h, w, 3) float32, perspective-correct and
    zero for none; depth (h, w) float32 in the unit of the input, infinite for none."""

    triangle: np.ndarray
    barycentric: np.ndarray
    depth: np.ndarray


def project(
    points: np.ndarray, K: np.ndarray, dist: np.ndarray, R: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """u = K distort(x_cam / z_cam), x_cam = R x + t.

    points (n, 3); K (3, 3) with its principal point in the caller's pixel convention; dist (5,) k1, k2, p1, p2, k3 of
    OpenCV's model; returns pixels (n, 2) and depth z_cam (n,). Points with z_cam <= 0 have no image: their pixels
    are NaN.
    """
    camera = points @ np.asarray(R).T + np.asarray(t).reshape(3)
    z = camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.where(z > 0, camera[:, :2].T / z, np.nan)
    k1, k2, p1, p2, k3 = np.asarray(dist, np.float64).reshape(-1)[:5]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([K[0, 0] * u + K[0, 1] * v + K[0, 2], K[1, 1] * v + K[1, 2]], axis=1), z


def rasterise(
    pixels: np.ndarray,
    depth: np.ndarray,
    triangles: np.ndarray,
    size: tuple[int, int],
    *,
    near: float = 1e-6,
    cull: bool = False,
) -> Raster:
    """The nearest triangle of every pixel. 1/z is affine over the image of a triangle, hence

    b_i = (l_i / z_i) / sum_j l_j / z_j,    l the barycentric coordinates in the image.

    pixels (n, 2) and depth (n,) of the vertices; triangles (m, 3); size (w, h). A triangle with a vertex nearer than
    `near`, or over 2**18 pixels away, or without an image is left out as a whole. `cull` leaves out the triangles
    whose back is seen, that is, whose corners run clockwise to the eye. Two triangles that share an edge never both
    claim a pixel and never both miss it (top-left rule on snapped vertices, exact integers); equal depths go to the
    earlier triangle.

    Source: Pineda, A parallel algorithm for polygon rasterization, 1988.
    """
    w, h = int(size[0]), int(size[1])
    faces = np.ascontiguousarray(triangles, np.int32).reshape(-1, 3)
    z = np.ascontiguousarray(depth, np.float64)
    p = np.ascontiguousarray(pixels, np.float64)
    with np.errstate(invalid="ignore"):
        usable = (z >= near) & (np.abs(p) < _FARTHEST).all(axis=1)
    snapped = np.round(np.where(usable[:, None], p, 0.0) * _UNIT).astype(np.int64)
    inverse = np.where(usable, 1.0 / np.where(usable, z, 1.0), 0.0)
    first, last = _rows(snapped, usable, faces, h, cull)
    bands = -(-h // _BAND)
    starts, members = _bins(first, last, bands)
    out = Raster(np.empty((h, w), np.int32), np.empty((h, w, 3), np.float32), np.empty((h, w), np.float32))
    _draw(snapped, inverse, faces, starts, members, first, last, out.triangle, out.barycentric, out.depth)
    return out


def interpolate(
    attributes: np.ndarray, triangles: np.ndarray, triangle: np.ndarray, barycentric: np.ndarray
) -> np.ndarray:
    """a(pixel) = sum_i b_i a[triangles[triangle(pixel), i]]: (h, w, c) float32, zero where triangle (h, w) is -1.

    attributes (n, c) or (n,); triangles (m, 3) may be those of another topology over the same faces, such as UVs'.
    """
    values = np.ascontiguousarray(attributes, np.float32)
    flat = values.reshape(len(values), -1)
    out = np.empty((*triangle.shape, flat.shape[1]), np.float32)
    _interpolate(flat, np.ascontiguousarray(triangles, np.int32), triangle, barycentric, out)
    return out[..., 0] if values.ndim == 1 else out


def box_average(image: np.ndarray, factor: int) -> np.ndarray:
    """(h / factor, w / factor, …) means of factor x factor pixels: brings a drawing of `factor` times the size back."""
    h, w = image.shape[0] // factor, image.shape[1] // factor
    flat = np.ascontiguousarray(image).reshape(*image.shape[:2], -1)
    out = np.empty((h, w, flat.shape[2]), image.dtype)
    _box_average(flat, factor, out)
    return out.reshape(h, w, *image.shape[2:])


@numba.njit(cache=True, nogil=True, parallel=True)
def _box_average(image: np.ndarray, factor: int, out: np.ndarray) -> None:
    for row in numba.prange(out.shape[0]):
        for column in range(out.shape[1]):
            for c in range(out.shape[2]):
                total = 0.0
                for i in range(factor):
                    for j in range(factor):
                        total += image[row * factor + i, column * factor + j, c]
                out[row, column, c] = total / (factor * factor)


@numba.njit(cache=True, nogil=True)
def _rows(
    snapped: np.ndarray, usable: np.ndarray, faces: np.ndarray, h: int, cull: bool
) -> tuple[np.ndarray, np.ndarray]:
    """First and last pixel row of every triangle (m,); last < first where there is nothing to draw."""
    m = len(faces)
    first, last = np.zeros(m, np.int32), np.full(m, -1, np.int32)
    half = _UNIT // 2
    for f in range(m):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if not (usable[a] and usable[b] and usable[c]):
            continue
        ax, ay = snapped[a, 0], snapped[a, 1]
        area = (snapped[b, 0] - ax) * (snapped[c, 1] - ay) - (snapped[b, 1] - ay) * (snapped[c, 0] - ax)
        if area == 0 or (cull and area > 0):
            continue
        low = min(ay, snapped[b, 1], snapped[c, 1])
        high = max(ay, snapped[b, 1], snapped[c, 1])
        first[f] = max(0, -((half - low) >> _BITS))
        last[f] = min(h - 1, (high - half) >> _BITS)
    return first, last


@numba.njit(cache=True, nogil=True)
def _bins(first: np.ndarray, last: np.ndarray, bands: int) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of every band of rows, in order: members[starts[b]:starts[b + 1]]."""
    starts = np.zeros(bands + 1, np.int64)
    for f in range(len(first)):
        if last[f] >= first[f]:
            for b in range(first[f] // _BAND, last[f] // _BAND + 1):
                starts[b + 1] += 1
    for b in range(bands):
        starts[b + 1] += starts[b]
    members = np.empty(starts[bands], np.int32)
    fill = starts[:-1].copy()
    for f in range(len(first)):
        if last[f] >= first[f]:
            for b in range(first[f] // _BAND, last[f] // _BAND + 1):
                members[fill[b]] = f
                fill[b] += 1
    return starts, members


@numba.njit(cache=True, inline="always")
def _edge(ax: int, ay: int, bx: int, by: int, x: int, y: int) -> int:
    return (bx - ax) * (y - ay) - (by - ay) * (x - ax)


@numba.njit(cache=True, inline="always")
def _bias(ax: int, ay: int, bx: int, by: int) -> int:
    """0 on a top or left edge of a triangle of positive area (y down), -1 on the others: they do not own their line."""
    return 0 if by < ay or (by == ay and bx > ax) else -1


@numba.njit(cache=True, nogil=True, parallel=True)
def _draw(
    snapped: np.ndarray,
    inverse: np.ndarray,
    faces: np.ndarray,
    starts: np.ndarray,
    members: np.ndarray,
    first: np.ndarray,
    last: np.ndarray,
    triangle: np.ndarray,
    barycentric: np.ndarray,
    depth: np.ndarray,
) -> None:
    h, w = triangle.shape
    half = _UNIT // 2
    for band in numba.prange(len(starts) - 1):
        top, bottom = band * _BAND, min(h, (band + 1) * _BAND)
        nearness = np.zeros((bottom - top, w), np.float64)
        triangle[top:bottom] = -1
        for k in range(starts[band], starts[band + 1]):
            f = members[k]
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay, bx, by, cx, cy = (
                *(snapped[a, 0], snapped[a, 1], snapped[b, 0], snapped[b, 1], snapped[c, 0], snapped[c, 1]),
            )
            area = _edge(ax, ay, bx, by, cx, cy)
            if area < 0:
                b, c = c, b
                bx, by, cx, cy = cx, cy, bx, by
                area = -area
            left = max(0, -((half - min(ax, bx, cx)) >> _BITS))
            right = min(w - 1, (max(ax, bx, cx) - half) >> _BITS)
            if right < left:
                continue
            up, down = max(top, first[f]), min(bottom - 1, last[f])
            x, y = left * _UNIT + half, up * _UNIT + half
            e0 = _edge(bx, by, cx, cy, x, y) + _bias(bx, by, cx, cy)
            e1 = _edge(cx, cy, ax, ay, x, y) + _bias(cx, cy, ax, ay)
            e2 = _edge(ax, ay, bx, by, x, y) + _bias(ax, ay, bx, by)
            dx0, dx1, dx2 = (by - cy) * _UNIT, (cy - ay) * _UNIT, (ay - by) * _UNIT
            dy0, dy1, dy2 = (cx - bx) * _UNIT, (ax - cx) * _UNIT, (bx - ax) * _UNIT
            z0, z1, z2 = inverse[a] / area, inverse[b] / area, inverse[c] / area
            dz = dx0 * z0 + dx1 * z1 + dx2 * z2
            for row in range(up, down + 1):
                g0, g1, g2 = e0, e1, e2
                s = g0 * z0 + g1 * z1 + g2 * z2
                for column in range(left, right + 1):
                    if (g0 | g1 | g2) >= 0:
                        q = s + (column - left) * dz
                        if q > nearness[row - top, column]:
                            nearness[row - top, column] = q
                            triangle[row, column] = f
                    g0 += dx0
                    g1 += dx1
                    g2 += dx2
                e0 += dy0
                e1 += dy1
                e2 += dy2
        for row in range(top, bottom):
            for column in range(w):
                f = triangle[row, column]
                if f < 0:
                    depth[row, column] = np.inf
                    barycentric[row, column, 0] = 0
                    barycentric[row, column, 1] = 0
                    barycentric[row, column, 2] = 0
                    continue
                a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                x, y = column * _UNIT + half, row * _UNIT + half
                ax, ay, bx, by, cx, cy = (
                    *(snapped[a, 0], snapped[a, 1], snapped[b, 0], snapped[b, 1], snapped[c, 0], snapped[c, 1]),
                )
                area = _edge(ax, ay, bx, by, cx, cy)
                l0 = _edge(bx, by, cx, cy, x, y) / area * inverse[a]
                l1 = _edge(cx, cy, ax, ay, x, y) / area * inverse[b]
                l2 = _edge(ax, ay, bx, by, x, y) / area * inverse[c]
                z = 1.0 / (l0 + l1 + l2)
                depth[row, column] = z
                barycentric[row, column, 0] = l0 * z
                barycentric[row, column, 1] = l1 * z
                barycentric[row, column, 2] = l2 * z


@numba.njit(cache=True, nogil=True, parallel=True)
def _interpolate(
    values: np.ndarray, faces: np.ndarray, triangle: np.ndarray, barycentric: np.ndarray, out: np.ndarray
) -> None:
    h, w = triangle.shape
    for row in numba.prange(h):
        for column in range(w):
            f = triangle[row, column]
            for c in range(values.shape[1]):
                total = np.float32(0)
                if f >= 0:
                    for k in range(3):
                        total += barycentric[row, column, k] * values[faces[f, k], c]
                out[row, column, c] = total
