"""The tongue: rounded cross-sections along a curve, in three poses with one topology.

Rest lies in the lower arch, the tip behind the lower incisors. The deltas lead from rest to the other two poses;
both are meant in the frame of the lower jaw, which carries the tongue.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .part import Floats, Half, Part, fan_triangles, grid_triangles, reflect
from .teeth import DEPTH, WIDTH

_STATIONS = 16
_COLUMNS = 10  # of the half, from the middle of the back of the tongue to the middle of its underside
_UV_MARGIN = 0.006


@dataclass(frozen=True)
class _Pose:
    """Middle curve and sizes at knots from tip to root: z, y, half width, height above and depth below (mm)."""

    share: tuple[float, ...]
    z: tuple[float, ...]
    y: tuple[float, ...]
    half_width: tuple[float, ...]
    above: tuple[float, ...]
    below: tuple[float, ...]
    groove: float


_SHARE = (0.0, 0.12, 0.3, 0.5, 0.7, 0.88, 1.0)
REST = _Pose(
    _SHARE,
    (-9.5, -15.0, -23.0, -33.0, -43.0, -52.0, -57.0),
    (-3.6, -3.6, -2.8, -1.6, -1.8, -5.0, -9.0),
    (7.0, 11.0, 14.5, 16.5, 17.5, 17.0, 15.0),
    (2.2, 3.8, 5.2, 6.6, 7.0, 6.6, 5.8),
    (2.2, 3.6, 5.5, 7.5, 8.5, 8.0, 6.5),
    0.9,
)
LOW = _Pose(
    _SHARE,
    (-9.8, -15.3, -23.3, -33.3, -43.0, -52.0, -57.0),
    (-5.6, -7.2, -9.2, -10.8, -11.6, -12.0, -12.5),
    (7.0, 11.2, 14.8, 16.8, 17.8, 17.2, 15.0),
    (2.0, 3.1, 3.9, 4.5, 4.8, 4.8, 4.6),
    (2.1, 3.2, 4.6, 6.0, 7.2, 7.4, 6.3),
    1.3,
)
OUT = _Pose(
    _SHARE,
    (31.0, 26.5, 15.0, -2.0, -22.0, -44.0, -55.0),
    (-8.0, -1.6, 6.2, 8.2, 4.5, -2.5, -9.0),
    (7.0, 11.5, 14.0, 14.0, 14.5, 16.5, 15.0),
    (1.9, 2.7, 3.4, 4.0, 5.2, 6.4, 5.8),
    (1.9, 2.6, 3.2, 3.8, 6.5, 7.5, 6.5),
    0.7,
)


def tongue(width: float | None = None, depth: float | None = None) -> Part:
    """A closed tongue in the mouth frame, fitting `teeth("lower", width, depth)`; 290 vertices, 576 triangles.

    Groups: `tip`, `top`. Deltas at weight 1: `tongueOut` (over the lower lip, for a jaw opened by 10 mm or more) and
    `jawOpen` (lower and flatter in the jaw's frame, tip behind the incisors; add it before the jaw's rigid motion).
    """
    scale = np.array([(width or WIDTH["lower"]) / WIDTH["lower"], 1.0, (depth or DEPTH["lower"]) / DEPTH["lower"]])
    rest, low, out = (_surface(pose) * scale for pose in (REST, LOW, OUT))
    ids = np.arange(_STATIONS * _COLUMNS, dtype=np.int32).reshape(_STATIONS, _COLUMNS)
    tip, root = ids.size, ids.size + 1
    triangles = np.concatenate(
        [fan_triangles(ids[0][::-1], tip), grid_triangles(ids.T)[:, ::-1], fan_triangles(ids[-1], root)]
    )
    # the texture unrolls the tube to both sides of the middle, tip below
    grid = rest[: ids.size].reshape(_STATIONS, _COLUMNS, 3)
    spine = np.concatenate([rest[tip : tip + 1], grid[:, 0], rest[root : root + 1]])
    v = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(spine, axis=0), axis=1))])
    u = np.concatenate([np.zeros((_STATIONS, 1)), np.cumsum(np.linalg.norm(np.diff(grid, axis=1), axis=2), 1)], 1)
    points = np.concatenate(
        [np.stack([u, np.repeat(v[1:-1, None], _COLUMNS, 1)], -1).reshape(-1, 2), [[0, 0], [0, v[-1]]]]
    )
    uv = np.array([0.5, _UV_MARGIN]) + points * (1 - 2 * _UV_MARGIN) / max(2 * u.max(), v[-1])
    groups = {"tip": np.append(ids[0], tip), "top": np.append(ids[:, : _COLUMNS // 2].ravel(), tip)}
    up = np.concatenate([np.broadcast_to(np.cos(np.linspace(0, np.pi, _COLUMNS)), ids.shape).ravel(), [0.5, 0.0]])
    half = Half(
        rest,
        triangles.astype(np.int32),
        uv,
        triangles.astype(np.int32),
        {k: g.astype(np.int32) for k, g in groups.items()},
        {"tongueOut": out - rest, "jawOpen": low - rest},
        {"up": up, "along": np.concatenate([np.repeat(np.linspace(0, 1, _STATIONS), _COLUMNS), [0.0, 1.0]])},
    )
    return reflect("tongue", half)


def _surface(pose: _Pose) -> Floats:
    """Half surface (161 + 1, 3): cross-sections normal to the middle curve, then tip and root."""
    fine = np.linspace(0.0, 1.0, 401)
    table = np.stack([pose.z, pose.y, pose.half_width, pose.above, pose.below])
    curves = np.stack([_rounded(fine, pose.share, row) for row in table])
    share = 0.5 - 0.5 * np.cos(np.pi * (0.08 + 0.92 * np.linspace(0, 1, _STATIONS)))
    share = (share - share[0]) / (share[-1] - share[0]) * 0.96 + 0.02
    z, y, half_width, above, below = (np.interp(share, fine, c) for c in curves)
    slope = np.stack([np.interp(share, fine, np.gradient(c, fine)) for c in curves[:2]], 1)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    # the tip and the root close as a quarter of an ellipse
    close = np.minimum(1.0, share / 0.14)
    round_tip = np.sqrt(1 - (1 - close) ** 2)
    round_root = np.sqrt(1 - (1 - np.minimum(1.0, (1 - share) / 0.1)) ** 2)
    turn = np.linspace(0.0, np.pi, _COLUMNS)
    x = (half_width * round_tip * round_root)[:, None] * np.sin(turn) ** 0.8
    side = np.where(np.cos(turn)[None] > 0, above[:, None], below[:, None]) * (round_tip * round_root)[:, None] ** 0.8
    across = side * np.sign(np.cos(turn)) * np.abs(np.cos(turn)) ** 0.9
    groove = np.where(turn < np.pi / 2, np.exp(-((x / 3.0) ** 2)), 0.0)
    across = across - pose.groove * groove * (np.sin(np.pi * np.clip(share * 1.1, 0, 1)))[:, None]
    normal = np.stack([slope[:, 1], -slope[:, 0]], 1)  # (z, y): upwards when the curve runs to the back
    grid = np.stack(
        [x, y[:, None] + across * normal[:, 1:], z[:, None] + across * normal[:, :1]],
        -1,
    )
    ends = np.stack([np.zeros(2), curves[1][[0, -1]], curves[0][[0, -1]]], 1)
    return np.concatenate([grid.reshape(-1, 3), ends])


def _rounded(fine: Floats, share: tuple[float, ...], values: Floats) -> Floats:
    """The polyline through the knots, smoothed by a moving mean that keeps its ends."""
    line = np.interp(fine, share, values)
    window = 41
    padded = np.concatenate([2 * line[0] - line[window:0:-1], line, 2 * line[-1] - line[-2 : -window - 2 : -1]])
    kernel = np.hanning(2 * window + 1)
    return np.convolve(padded, kernel / kernel.sum(), "valid")
