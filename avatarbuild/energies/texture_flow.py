"""
The texture's differences against the picture's: E_flow of equation (6) [Ichim et al. 2015].

  r_vk = (rho_vk - rho_v) - (I(u_vk) - I(u_v)),   u_v = P(F_T(B_v, w)),   k = one footprint to the right, one up

rho and I are logarithms of grey, so that the gain of a frame and slow changes of the light drop out. Each sample is
three surface points: v, v + dv_x, v + dv_y. S samples, a shapes.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np


class Sight(NamedTuple):
    """
    What the picture shows at the samples' points: value (S, 3); by a motion of the point in the head frame, mm:
    slope (S, 3, 3); by a turn and a shift of the head: pose (S, 3, 6); known (S, 3) bool: lies in the picture.
    """

    value: np.ndarray
    slope: np.ndarray
    pose: np.ndarray
    known: np.ndarray


def sight(
    points: np.ndarray,
    visible: np.ndarray,
    picture: np.ndarray,
    corner: np.ndarray,
    scale: float,
    lens: np.ndarray,
    R: np.ndarray,
    t: np.ndarray,
) -> Sight:
    """
    I(u_v) and its derivatives: points (S, 3, 3) mm posed in the head frame; visible (S,) bool; picture (h, w) float32,
    a level of the pyramid of a crop that begins at `corner` (2,) of the frame, one of its pixels `scale` wide; lens
    (4,) f, k1, cx, cy; x_cam = exp([turn]_x) R x + t + shift.
    """
    S = len(points)
    out = Sight(np.zeros((S, 3)), np.zeros((S, 3, 3)), np.zeros((S, 3, 6)), np.zeros((S, 3), np.bool_))
    _sight(
        np.ascontiguousarray(points),
        visible,
        picture,
        *(float(corner[0]), float(corner[1]), float(scale)),
        lens,
        np.ascontiguousarray(R),
        t,
        *out,
    )
    return out


def residuals(rho: np.ndarray, seen: Sight) -> tuple[np.ndarray, np.ndarray]:
    """r (S, 2) of the module's docstring, rho (S, 3); and known (S, 2) bool: both ends lie in the picture."""
    r = (rho[:, 1:] - rho[:, :1]) - (seen.value[:, 1:] - seen.value[:, :1])
    known = seen.known[:, 1:] & seen.known[:, :1]
    return np.where(known, r, 0), known


def jacobian(moves: np.ndarray, seen: Sight) -> np.ndarray:
    """J (2 S, 6 + a) = dr / d(turn, shift, w); moves (S, 3, 3, a) mm of the points in the shapes."""
    J = np.empty((2 * len(moves), 6 + moves.shape[3]))
    _jacobian(moves, seen.slope, seen.pose, J)
    return J


@numba.njit(cache=True, inline="always")
def _look(picture: np.ndarray, x: float, y: float, out: np.ndarray) -> bool:
    """Value and gradient by the four pixels about (x, y), in pixels with the first centre at 0.5."""
    h, w = picture.shape
    x, y = x - 0.5, y - 0.5
    j, i = int(np.floor(x)), int(np.floor(y))
    if j < 1 or i < 1 or j >= w - 2 or i >= h - 2:
        return False
    fx, fy = x - j, y - i
    value, gx, gy = 0.0, 0.0, 0.0
    for di in range(2):
        wy = fy if di else 1 - fy
        for dj in range(2):
            share = wy * (fx if dj else 1 - fx)
            p, q = i + di, j + dj
            value += share * picture[p, q]
            gx += share * 0.5 * (picture[p, q + 1] - picture[p, q - 1])
            gy += share * 0.5 * (picture[p + 1, q] - picture[p - 1, q])
    out[0], out[1], out[2] = value, gx, gy
    return True


@numba.njit(cache=True, parallel=True)
def _jacobian(moves: np.ndarray, slope: np.ndarray, pose: np.ndarray, J: np.ndarray) -> None:
    a = moves.shape[3]
    for s in numba.prange(len(moves)):
        for k in range(1, 3):
            row = 2 * s + k - 1
            for i in range(6):
                J[row, i] = pose[s, 0, i] - pose[s, k, i]
            for j in range(a):
                J[row, 6 + j] = 0.0
            for i in range(3):
                here, there = slope[s, 0, i], slope[s, k, i]
                for j in range(a):
                    J[row, 6 + j] += here * moves[s, 0, i, j] - there * moves[s, k, i, j]


@numba.njit(cache=True, parallel=True)
def _sight(
    points: np.ndarray,
    visible: np.ndarray,
    picture: np.ndarray,
    x0: float,
    y0: float,
    scale: float,
    lens: np.ndarray,
    R: np.ndarray,
    t: np.ndarray,
    value: np.ndarray,
    slope: np.ndarray,
    pose: np.ndarray,
    known: np.ndarray,
) -> None:
    f, k1, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for s in numba.prange(len(points)):
        if not visible[s]:
            continue
        seen = np.zeros(3)
        X = np.zeros(3)
        for k in range(3):
            for i in range(3):
                X[i] = R[i, 0] * points[s, k, 0] + R[i, 1] * points[s, k, 1] + R[i, 2] * points[s, k, 2]
            z = X[2] + t[2]
            if z <= 1.0:
                continue
            p, q = (X[0] + t[0]) / z, (X[1] + t[1]) / z
            r2 = p * p + q * q
            d = 1 + k1 * r2
            u, v = cx + f * d * p, cy + f * d * q
            known[s, k] = _look(picture, (u - x0) / scale, (v - y0) / scale, seen)
            if not known[s, k]:
                continue
            value[s, k] = seen[0]
            gx, gy = seen[1] / scale * f, seen[2] / scale * f
            # through the lens: dI/d(p, q), then dI/dx_cam
            gp = gx * (d + 2 * k1 * p * p) + gy * 2 * k1 * p * q
            gq = gx * 2 * k1 * p * q + gy * (d + 2 * k1 * q * q)
            hx, hy, hz = gp / z, gq / z, -(gp * p + gq * q) / z
            pose[s, k, 0] = X[1] * hz - X[2] * hy
            pose[s, k, 1] = X[2] * hx - X[0] * hz
            pose[s, k, 2] = X[0] * hy - X[1] * hx
            pose[s, k, 3], pose[s, k, 4], pose[s, k, 5] = hx, hy, hz
            for i in range(3):
                slope[s, k, i] = R[0, i] * hx + R[1, i] * hy + R[2, i] * hz
