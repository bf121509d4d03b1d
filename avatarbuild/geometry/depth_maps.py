"""The search for one view's plane map, level by level, and what the maps of several views say of each other."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from avatarbuild.geometry import fusion, patchmatch, stereo_views
from avatarbuild.geometry.fusion import Agreement, Maps
from avatarbuild.geometry.stereo_views import Region, StereoView

UNKNOWN = np.float32(9.0)  # cost of a pixel without a plane


@dataclass(frozen=True)
class Search:
    """
    How one pyramid level is searched: sweeps, random changes and Gauss-Newton steps a pixel and sweep, the size of the
    first changes (of inverse depth, relative; of slope, as tangent), cost a pixel of reprojection error.
    """

    sweeps: int
    tries: int
    steps: int
    span: float
    tilt: float
    consistency: float = 0.0


def first_planes(view: StereoView, region: Region, level: int, seed: int) -> np.ndarray:
    """(h, w, 3) random planes inside the region."""
    K = view.calibration(level)
    shape = view.grey[level].shape
    low, high = stereo_views.region_bounds(region, K, view.R, view.t, shape)
    planes = np.zeros((*shape, 3), np.float32)
    patchmatch.random_planes(planes, np.argwhere(high > 0).astype(np.int32), low, high, np.float32(K[0, 0]), seed)
    return planes


def next_level(planes: np.ndarray, mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(h, w, 3) of the next finer level: what lies in the mask; unknown pixels take the nearest known one's plane."""
    known = (planes[..., 0] > 0) & mask
    if not known.any():
        return np.zeros((*shape, 3), np.float32)
    row, column = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled = planes[row, column]
    v, u = np.mgrid[: mask.shape[0], : mask.shape[1]]
    filled[..., 0] += filled[..., 1] * (u - column) + filled[..., 2] * (v - row)
    return patchmatch.finer(np.where(mask[..., None], filled, np.float32(0.0)).astype(np.float32), shape)


def search(
    views: list[StereoView],
    i: int,
    sources: list[int],
    region: Region,
    level: int,
    start: np.ndarray,
    active: np.ndarray | None,
    maps: list[np.ndarray] | None,
    how: Search,
    half_window: int,
    seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Planes (h, w, 3) and costs (h, w) of view i at a level, from the planes `start`; 0 and UNKNOWN without a plane.

    active  (h, w) bool: pixels to improve, the others only lend their planes; None: all
    maps    the planes of all views at this level, for the consistency of the reprojection
    """
    view = views[i]
    grey = view.grey[level]
    K = view.calibration(level)
    low, high = stereo_views.region_bounds(region, K, view.R, view.t, grey.shape)
    planes = start.copy()
    planes[(high <= 0) | (planes[..., 0] <= 0)] = 0.0
    known = planes[..., 0] > 0
    planes[..., 0] = np.where(known, np.clip(planes[..., 0], low, high), 0.0)
    pixels = np.argwhere(known if active is None else known & active).astype(np.int32)
    cost = np.full(grey.shape, UNKNOWN, np.float32)
    if not sources or not len(pixels):
        return planes, cost
    win = patchmatch.window(half_window)
    src = stereo_views.source_images(views, i, sources, level, maps)
    best = (len(sources) + 1) // 2
    weight = np.float32(how.consistency)
    patchmatch.plane_costs(grey, pixels, planes, cost, win, src, best, weight)
    for n in range(how.sweeps):
        shrink = 0.6**n
        span, tilt = np.float32(how.span * shrink), np.float32(how.tilt * shrink)
        patchmatch.sweep(
            *(grey, pixels, planes, cost, low, high, np.float32(K[0, 0]), win, src, best, weight),
            *((n + level) % 2 == 1, how.tries, how.steps, span, tilt, seed + n),
        )
    return planes, cost


def confidence(
    view: StereoView, level: int, planes: np.ndarray, cost: np.ndarray, worst: float, facing: float
) -> np.ndarray:
    """
    (h, w) float32 weight of each pixel's surface: cos(normal, ray) / ((0.05 + cost) size^2), size that of the pixel.

    0 where the cost is above `worst` or the cosine below `facing`.
    """
    K = view.calibration(level)
    v, u = np.mgrid[: planes.shape[0], : planes.shape[1]]
    rays = np.stack([u + 0.5, v + 0.5, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    cosine = -(patchmatch.plane_normals(planes, K) * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    size = 1.0 / np.maximum(planes[..., 0], 1e-12) / K[0, 0]
    weight = cosine / ((0.05 + np.maximum(cost, 0.0)) * size**2)
    return np.where((planes[..., 0] > 0) & (cost < worst) & (cosine > facing), weight, 0.0).astype(np.float32)


def joined(views: list[StereoView], planes: list[np.ndarray], weight: list[np.ndarray], level: int) -> Maps:
    """All views' maps of a level, without the pixels of no weight."""
    K = np.array([v.calibration(level) for v in views])
    clean = [np.where(w[..., None] > 0, p, np.float32(0.0)) for p, w in zip(planes, weight)]
    return fusion.join_maps(clean, weight, K, np.array([v.R for v in views]), np.array([v.t for v in views]))


def confirmed(maps: Maps, i: int, others: np.ndarray, rule: Agreement) -> np.ndarray:
    """(h, w) bool: pixels of view i that at least `rule.least` others confirm."""
    agree = np.zeros((maps.height[i], maps.width[i]), np.uint8)
    fusion.count_agreeing(maps, i, others, rule, agree)
    return agree >= rule.least


def surface_mask(sure: np.ndarray) -> np.ndarray:
    """
    The subject in the image, (h, w) bool, from its confirmed pixels: holes closed, specks dropped, two pixels of rim.

    Every piece of at least a fiftieth of the whole stays.
    """
    dense = cv2.blur(sure.astype(np.float32), (5, 5)) > 0.4
    dense = cv2.morphologyEx(dense.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)) > 0
    label, n = ndimage.label(dense)
    if n > 1:
        area = np.bincount(label.ravel())[1:]
        dense = np.isin(label, 1 + np.flatnonzero(area >= 0.02 * area.sum()))
    return cv2.dilate(dense.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
