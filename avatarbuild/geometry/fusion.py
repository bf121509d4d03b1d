"""Depth maps against each other: which pixels agree with other views, and the points that they make together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit


class Maps(NamedTuple):
    """
    The plane maps of k views, end to end in flat arrays.

    planes  (p, 3) float32, 0 where unknown;  weight (p,) float32 confidence;  start, width, height (k,) int64
    K, R    (k, 3, 3);  t (k, 3) float64: x_cam = R x + t
    """

    planes: np.ndarray
    weight: np.ndarray
    start: np.ndarray
    width: np.ndarray
    height: np.ndarray
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray


class Agreement(NamedTuple):
    """
    When two surfaces count as one.

    tolerance   pixels (of the coarser of both views) between them
    cos_normal  cosine of the largest angle between their normals
    least       views that must agree, besides the one that a point comes from
    cos_spread  cosine of the angle that the rays of the agreeing views must span: neighbours make the same mistakes
    doubt       views that see through a point, allowed for each that agrees
    """

    tolerance: float
    cos_normal: float
    least: int
    cos_spread: float
    doubt: float


def join_maps(planes: list[np.ndarray], weight: list[np.ndarray], K: np.ndarray, R: np.ndarray, t: np.ndarray) -> Maps:
    """`Maps` of k maps (h, w, 3) and their weights (h, w)."""
    sizes = np.array([a.shape[:2] for a in planes], np.int64).reshape(-1, 2)
    start = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))])[:-1].astype(np.int64)
    flat = np.concatenate([a.reshape(-1, 3) for a in planes]).astype(np.float32)
    w = np.concatenate([a.ravel() for a in weight]).astype(np.float32)
    return Maps(flat, w, start, sizes[:, 1].copy(), sizes[:, 0].copy(), K, R, t)


@njit(nogil=True, error_model="numpy", inline="always")
def _unproject(maps, i, u, v):
    """World point and outward unit normal of pixel (u, v) of view i, and the pixel's size there; size 0 if unknown."""
    at = maps.start[i] + v * maps.width[i] + u
    q = float(maps.planes[at, 0])
    if q <= 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    qu = float(maps.planes[at, 1])
    qv = float(maps.planes[at, 2])
    fx, fy, cx, cy = maps.K[i, 0, 0], maps.K[i, 1, 1], maps.K[i, 0, 2], maps.K[i, 1, 2]
    z = 1.0 / q
    x0 = (u + 0.5 - cx) / fx * z - maps.t[i, 0]
    x1 = (v + 0.5 - cy) / fy * z - maps.t[i, 1]
    x2 = z - maps.t[i, 2]
    n0 = -qu * fx
    n1 = -qv * fy
    n2 = -(q - qu * (u + 0.5 - cx) - qv * (v + 0.5 - cy))
    s = 1.0 / np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    R = maps.R
    return (
        R[i, 0, 0] * x0 + R[i, 1, 0] * x1 + R[i, 2, 0] * x2,
        R[i, 0, 1] * x0 + R[i, 1, 1] * x1 + R[i, 2, 1] * x2,
        R[i, 0, 2] * x0 + R[i, 1, 2] * x1 + R[i, 2, 2] * x2,
        (R[i, 0, 0] * n0 + R[i, 1, 0] * n1 + R[i, 2, 0] * n2) * s,
        (R[i, 0, 1] * n0 + R[i, 1, 1] * n1 + R[i, 2, 1] * n2) * s,
        (R[i, 0, 2] * n0 + R[i, 1, 2] * n1 + R[i, 2, 2] * n2) * s,
        z / fx,
    )


@njit(nogil=True, error_model="numpy", inline="always")
def _meet(maps, j, x, y, z):
    """
    View j at world point (x, y, z): index of its pixel or -1, how far the point lies in front of its surface, the
    outward normal there, the pixel's size.

    j's plane is n . Y = 1 in camera axes, with n = K^T (qu, qv, q at pixel (0, 0)): the distance is (1 - n . Y) / |n|.
    """
    R = maps.R
    y0 = R[j, 0, 0] * x + R[j, 0, 1] * y + R[j, 0, 2] * z + maps.t[j, 0]
    y1 = R[j, 1, 0] * x + R[j, 1, 1] * y + R[j, 1, 2] * z + maps.t[j, 1]
    y2 = R[j, 2, 0] * x + R[j, 2, 1] * y + R[j, 2, 2] * z + maps.t[j, 2]
    fx, fy, cx, cy = maps.K[j, 0, 0], maps.K[j, 1, 1], maps.K[j, 0, 2], maps.K[j, 1, 2]
    iz = 1.0 / y2
    a = fx * y0 * iz + cx
    b = fy * y1 * iz + cy
    if not (y2 > 0.0 and a >= 0.0 and b >= 0.0 and a < maps.width[j] and b < maps.height[j]):
        return -1, 0.0, 0.0, 0.0, 0.0, 0.0
    u = int(a)
    v = int(b)
    at = maps.start[j] + v * maps.width[j] + u
    q = float(maps.planes[at, 0])
    if q <= 0.0:
        return -1, 0.0, 0.0, 0.0, 0.0, 0.0
    qu = float(maps.planes[at, 1])
    qv = float(maps.planes[at, 2])
    n0 = qu * fx
    n1 = qv * fy
    n2 = q - qu * (u + 0.5 - cx) - qv * (v + 0.5 - cy)
    s = 1.0 / np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    return (
        at,
        (1.0 - (n0 * y0 + n1 * y1 + n2 * y2)) * s,
        -(R[j, 0, 0] * n0 + R[j, 1, 0] * n1 + R[j, 2, 0] * n2) * s,
        -(R[j, 0, 1] * n0 + R[j, 1, 1] * n1 + R[j, 2, 1] * n2) * s,
        -(R[j, 0, 2] * n0 + R[j, 1, 2] * n1 + R[j, 2, 2] * n2) * s,
        y2 / fx,
    )


@njit(nogil=True, cache=True, error_model="numpy")
def count_agreeing(maps, i, others, rule, agree):
    """
    Fills agree (h, w) uint8: how many views of `others` agree with each pixel of view i; 0 if too many see through it.
    """
    for v in range(agree.shape[0]):
        for u in range(agree.shape[1]):
            agree[v, u] = 0
            x, y, z, a, b, c, size = _unproject(maps, i, u, v)
            if size <= 0.0:
                continue
            count = 0
            through = 0
            for k in range(others.size):
                at, e, ja, jb, jc, other_size = _meet(maps, others[k], x, y, z)
                if at < 0:
                    continue
                limit = rule.tolerance * max(size, other_size)
                if abs(e) <= limit:
                    if a * ja + b * jb + c * jc >= rule.cos_normal:
                        count += 1
                elif e > limit:
                    through += 1
            if through <= rule.doubt * count:
                agree[v, u] = count


@njit(nogil=True, cache=True, error_model="numpy")
def fuse(maps, i, others, centres, rule, point, normal, views):
    """
    The points of view i: its own, moved along the mean normal to the weighted mean of the agreeing surfaces.

    centres (k, 3) of the cameras. point, normal (h, w, 3) float32 to fill; views (h, w) uint8: how many agree, i
    included, 0 where there is no point.
    """
    n = others.size
    e = np.empty(n)
    w = np.empty(n)
    m = np.empty((n, 3))
    for v in range(views.shape[0]):
        for u in range(views.shape[1]):
            views[v, u] = 0
            x, y, z, a, b, c, size = _unproject(maps, i, u, v)
            if size <= 0.0:
                continue
            r0 = centres[i, 0] - x
            r1 = centres[i, 1] - y
            r2 = centres[i, 2] - z
            own_range = np.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
            spread = 1.0
            count = 0
            through = 0
            for k in range(n):
                j = others[k]
                at, gap, ja, jb, jc, other_size = _meet(maps, j, x, y, z)
                if at < 0:
                    continue
                limit = rule.tolerance * max(size, other_size)
                if abs(gap) <= limit:
                    if a * ja + b * jb + c * jc >= rule.cos_normal:
                        s0 = centres[j, 0] - x
                        s1 = centres[j, 1] - y
                        s2 = centres[j, 2] - z
                        s = np.sqrt(s0 * s0 + s1 * s1 + s2 * s2)
                        spread = min(spread, (r0 * s0 + r1 * s1 + r2 * s2) / (own_range * s))
                        e[count] = gap
                        w[count] = maps.weight[at]
                        m[count, 0] = ja
                        m[count, 1] = jb
                        m[count, 2] = jc
                        count += 1
                elif gap > limit:
                    through += 1
            if count < rule.least or through > rule.doubt * count or spread > rule.cos_spread:
                continue
            total = float(maps.weight[maps.start[i] + v * maps.width[i] + u])
            a *= total
            b *= total
            c *= total
            shift = 0.0
            for k in range(count):
                total += w[k]
                shift -= w[k] * e[k]
                a += w[k] * m[k, 0]
                b += w[k] * m[k, 1]
                c += w[k] * m[k, 2]
            shift /= total
            s = 1.0 / np.sqrt(a * a + b * b + c * c)
            normal[v, u, 0] = a * s
            normal[v, u, 1] = b * s
            normal[v, u, 2] = c * s
            point[v, u, 0] = x + shift * a * s
            point[v, u, 1] = y + shift * b * s
            point[v, u, 2] = z + shift * c * s
            views[v, u] = count + 1


@njit(nogil=True, cache=True, error_model="numpy")
def owned(maps, i, others, rule, keep):
    """
    Marks in keep (h, w) bool the pixels of view i that no other view shows better: greatest weight, then lowest index.

    maps.weight must be 0 where a view has no point.
    """
    for v in range(keep.shape[0]):
        for u in range(keep.shape[1]):
            keep[v, u] = False
            own = maps.weight[maps.start[i] + v * maps.width[i] + u]
            if own <= 0.0:
                continue
            x, y, z, a, b, c, size = _unproject(maps, i, u, v)
            if size <= 0.0:
                continue
            keep[v, u] = True
            for k in range(others.size):
                j = others[k]
                at, e, ja, jb, jc, other_size = _meet(maps, j, x, y, z)
                if at < 0:
                    continue
                other = maps.weight[at]
                if other < own or (other == own and j > i):
                    continue
                if abs(e) <= rule.tolerance * max(size, other_size) and a * ja + b * jb + c * jc >= rule.cos_normal:
                    keep[v, u] = False
                    break
