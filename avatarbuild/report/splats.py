"""Oriented, coloured clouds drawn as discs, and lit as meshes are."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from avatarbuild.report.rendering import View, finish, pinhole
from avatarbuild.report.shading import Light, lit

_FAR_SHARE = 0.3  # of the splats' depth tolerance, in radii


class Splats(NamedTuple):
    """What a view sees of a cloud, `factor` times as large as the picture: depth (h, w), infinite for nothing, normals
    (h, w, 3) in camera axes, not unit, colours (h, w, 3) linear, and the camera's focal length in pixels."""

    depth: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    focal: float


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
) -> np.ndarray:
    """(h, w, 3) uint8 sRGB of a splatted cloud in its colours, or all of one grey, `clay`, which shows shape alone."""
    image = splats.colours if clay is None else np.full_like(splats.colours, clay)
    dull = np.zeros((*splats.depth.shape, 1), np.float32)
    linear = lit(splats.depth, np.concatenate([splats.normals, dull], axis=2), image, light or Light(), splats.focal)
    return finish(linear, np.isfinite(splats.depth), factor)


@numba.njit(cache=True, inline="always")
def _turned(R: np.ndarray, v: np.ndarray) -> tuple[float, float, float]:
    return (
        R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
        R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
        R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2],
    )


@numba.njit(cache=True, nogil=True)
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
