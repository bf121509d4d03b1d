"""The rim of the iris in a picture."""

from __future__ import annotations

import cv2
import numpy as np

# The upper lid covers the rim above, the lower one touches it below: degrees below the horizontal, either side.
_SIDE = np.radians(np.linspace(-20, 50, 29))
_ANGLES = np.concatenate([_SIDE, np.pi - _SIDE])
_WINDOW, _RADIUS = 128, 32.0  # pixels: the eye is looked at in a window in which its iris has this radius
_REACH = 8.0  # pixels of the window: how far the rim may lie from where the detector says
_STEPS = (2.0, 1.0, 0.5, 0.25)
_NEAR = 2.5  # pixels of the window: edges nearer to the best circle belong to the rim
_LEAST_EDGES = 6


def iris_circle(grey: np.ndarray, centre: np.ndarray, radius: float) -> tuple[np.ndarray, float, float]:
    """
    argmax_{c, r} sum_a min(max(dI/dr, 0), cap) at c + r e_a over the angles a that the lids leave free: Daugman's
    integro-differential operator (1993), capped so that a highlight's edge counts no more than the rim's; then
    the circle through the steepest points beside it, by least squares.

    grey (h, w) uint8 or float, centre (2,) pixels (first pixel's centre at 0.5) and radius from a detector, right
    within a fifth of the radius. Returns centre, radius (sub-pixel) and the share of angles that show the rim on its
    poorer side, 0 where there is none to be trusted.
    """
    scale = _RADIUS / radius
    matrix = np.array([[scale, 0, _WINDOW / 2 - scale * centre[0]], [0, scale, _WINDOW / 2 - scale * centre[1]]])
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5  # OpenCV counts from the first pixel's centre
    flags = cv2.INTER_AREA if scale < 0.5 else cv2.INTER_CUBIC
    shape = (_WINDOW, _WINDOW)
    window = cv2.warpAffine(grey.astype(np.float32), matrix, shape, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    window = cv2.GaussianBlur(window, (0, 0), max(1.5, 0.6 * scale))
    best: np.ndarray = np.array([_WINDOW / 2, _WINDOW / 2, _RADIUS])
    reach = np.arange(_RADIUS - _REACH, _RADIUS + _REACH + 0.5, 0.5)
    steepest = _slope(window, np.c_[np.tile(best[:2], (len(reach), 1)), reach]).max(axis=0)
    cap = 0.7 * float(np.median(steepest))
    if cap <= 0.3:  # grey levels a pixel of the window
        return centre, radius, 0.0
    moves = np.array([(x, y, r) for x in range(-4, 5) for y in range(-4, 5) for r in range(-4, 5)], float)
    for step in _STEPS:
        candidates = best + moves * step
        candidates = candidates[np.abs(candidates[:, 2] - _RADIUS) <= _REACH]
        best = candidates[np.argmax(np.clip(_slope(window, candidates), 0, cap).sum(axis=1))]
    fine = np.arange(-_NEAR, _NEAR + 0.05, 0.1)
    slopes = _slope(window, np.c_[np.tile(best[:2], (len(fine), 1)), best[2] + fine])
    at = slopes.argmax(axis=0)
    edges = (slopes.max(axis=0) > 0.5 * cap) & (at > 0) & (at < len(fine) - 1)
    sides = edges[: len(_SIDE)].sum(), edges[len(_SIDE) :].sum()
    if min(sides) < _LEAST_EDGES:
        return centre, radius, 0.0
    rim = _circle(best[:2], best[2] + fine[at[edges]], _ANGLES[edges])
    return (rim[:2] - _WINDOW / 2) / scale + centre, float(rim[2] / scale), float(min(sides)) / len(_SIDE)


def _slope(window: np.ndarray, circles: np.ndarray, h: float = 1.0) -> np.ndarray:
    """(n, angles) outward slope of the window at circles (n, 3) of centre and radius, by central differences."""
    ends = []
    for offset in (h, -h):
        radius = circles[:, 2:] + offset
        x = (circles[:, :1] + radius * np.cos(_ANGLES) - 0.5).astype(np.float32)
        y = (circles[:, 1:2] + radius * np.sin(_ANGLES) - 0.5).astype(np.float32)
        ends.append(cv2.remap(window, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return (ends[0] - ends[1]) / (2 * h)


def _circle(middle: np.ndarray, radii: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """(3,) the circle through points given about a middle: r_a = r + dx cos a + dy sin a, by Huber's least squares."""
    a = np.stack([np.cos(angles), np.sin(angles), np.ones_like(angles)], axis=1)
    weight: np.ndarray = np.ones(len(radii))
    x = np.zeros(3)
    for _ in range(8):
        x = np.linalg.lstsq(a * weight[:, None], radii * weight, rcond=None)[0]
        weight = np.sqrt(1 / np.maximum(np.abs(a @ x - radii) / 0.4, 1))
    return np.array([middle[0] + x[0], middle[1] + x[1], x[2]])
