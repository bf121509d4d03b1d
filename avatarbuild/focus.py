"""How sharp, bright, coloured and evenly lit a picture's face is, in numbers."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.linalg import eigh

from avatarbuild.formats.colour import LUMINANCE, decode_srgb
from avatarbuild.landmarks import crop, region_about
from avatarbuild.portrait import BROW, CHEEK, EYE, LIPS, OVAL, twin

_FINE, _COARSE = 1.0, 2.5  # pixels: standard deviations of the two Gaussians that edges are compared at
_EDGES = 0.9  # only gradients above this quantile tell the blur; the rest is noise and smooth skin
_LEAST_BLUR = 0.3  # pixels: what a sharp edge measures after a camera's demosaicing, about
_PATCH = 192  # pixels: the upright face crop that colours are measured in
_LOOKED = 1024  # pixels: the middle of a picture without a face, whose blur is measured
_SATURATED = 250  # of 255, in any channel


class Measures(NamedTuple):
    """
    blur           pixels: standard deviation of the Gaussian that would blur a step as much, in the worst direction
    exposure       median linear luminance, 0..1
    white_balance  (2,) log(R/G), log(B/G) of the linear means
    clipped        share of pixels with a saturated channel
    side_light     log2 of the left cheek's over the right cheek's luminance (the subject's); NaN without a face
    contrast       log2 of the 95th over the 25th percentile of luminance: highlights over shaded skin
    """

    blur: float
    exposure: float
    white_balance: np.ndarray
    clipped: float
    side_light: float
    contrast: float


def measure(rgb: np.ndarray, points: np.ndarray | None) -> Measures:
    """The measures of an (h, w, 3) uint8 sRGB picture's face with landmarks (478, 3), or of the whole picture."""
    if points is None:
        scale = min(1.0, _PATCH * 2 / max(rgb.shape[:2]))
        small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        skin = np.ones(small.shape[:2], bool)
        side = np.nan
        y, x = (max(0, (n - _LOOKED) // 2) for n in rgb.shape[:2])
        blur = blur_radius(rgb[y : y + _LOOKED, x : x + _LOOKED])
    else:
        small, to_picture = crop(rgb, region_about(points), _PATCH)
        local = np.linalg.solve(to_picture[:, :2], (points[:, :2] - to_picture[:, 2]).T).T
        skin = _filled(local, [OVAL]) & ~_filled(local, [EYE, twin(EYE), BROW, twin(BROW), LIPS], grow=4)
        if not skin.any():
            skin = np.ones(small.shape[:2], bool)
        luminance = decode_srgb(small) @ LUMINANCE
        right, left = (luminance[_filled(local, [ring])] for ring in (CHEEK, twin(CHEEK)))
        side = float(np.log2(np.median(left) / np.median(right))) if min(left.size, right.size) > 20 else np.nan
        low = np.maximum(points[:468, :2].min(0), 0).astype(int)
        high = points[:468, :2].max(0).astype(int)
        part = rgb[low[1] : high[1], low[0] : high[0]]
        blur = blur_radius(part if min(part.shape[:2]) > 16 else rgb)
    colours = decode_srgb(small[skin])
    luminance = colours @ LUMINANCE
    mean = np.maximum(colours.mean(0), 1e-4)
    shade, light = np.maximum(np.percentile(luminance, [25, 95]), 1e-4)
    return Measures(
        blur,
        float(np.median(luminance)),
        np.log(mean[[0, 2]] / mean[1]),
        float((small[skin] >= _SATURATED).any(1).mean()),
        side,
        float(np.log2(light / shade)),
    )


def blur_radius(rgb: np.ndarray) -> float:
    """
    Pixels: the blur b of a picture's edges in the direction where they are blurred most.

    A step blurred by b and then by a Gaussian derivative of width s holds squared gradient in proportion to
    1 / sqrt(b^2 + s^2). With M_s = sum g g^T over edge pixels, the least generalised eigenvalue r of
    M_fine v = r M_coarse v is that ratio in the worst direction: r^2 = (b^2 + c^2) / (b^2 + f^2).
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = _gradients(grey, _FINE), _gradients(grey, _COARSE)
    strength = coarse[0] ** 2 + coarse[1] ** 2
    edges = strength >= np.quantile(strength[::2, ::2], _EDGES)
    # an edge's fine gradient lies within reach of its coarse one
    edges = cv2.dilate(edges.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    a = np.stack([g[edges] for g in fine]).astype(np.float64)
    b = np.stack([g[edges] for g in coarse]).astype(np.float64)
    ground = 1e-6 * np.eye(2) * edges.sum()
    ratio = float(eigh(a @ a.T + ground, b @ b.T + ground, eigvals_only=True)[0])
    squared = ratio**2
    if squared <= 1.0 + 1e-6:
        return 20.0
    blur = np.sqrt(max((_COARSE**2 - squared * _FINE**2) / (squared - 1.0), 0.0))
    return float(np.clip(blur, _LEAST_BLUR, 20.0))


def _gradients(grey: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    smooth = cv2.GaussianBlur(grey, (0, 0), width)
    return cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1)


def _filled(local: np.ndarray, rings: list[list[int]], grow: int = 0) -> np.ndarray:
    """(s, s) bool: pixels of the face crop inside the rings of landmarks, grown by some pixels."""
    mask = np.zeros((_PATCH, _PATCH), np.uint8)
    for ring in rings:
        cv2.fillPoly(mask, [np.round(local[ring] - 0.5).astype(np.int32)], (1,))
    return cv2.dilate(mask, np.ones((1 + grow, 1 + grow), np.uint8)).astype(bool)
