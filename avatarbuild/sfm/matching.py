"""Which photos are matched, and the matches of a pair: nearest neighbours both ways, then epipolar geometry."""

from __future__ import annotations

import numba
import numpy as np
import pycolmap

from avatarbuild.sfm.features import Features

_BLOCK = 1024


def unit_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """(n, 128) uint8 -> float32 of unit length."""
    d = descriptors.astype(np.float32)
    return d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-6)


@numba.njit(cache=True, nogil=True)
def _best_two(similarity, first_row, best, second, best_column, column_best, column_row):  # type: ignore[no-untyped-def]
    rows, columns = similarity.shape
    for i in range(rows):
        b, s, at = np.float32(-2), np.float32(-2), -1
        for j in range(columns):
            v = similarity[i, j]
            if v > b:
                s, b, at = b, v, j
            elif v > s:
                s = v
            if v > column_best[j]:
                column_best[j] = v
                column_row[j] = first_row + i
        best[first_row + i], second[first_row + i], best_column[first_row + i] = b, s, at


def match(a: np.ndarray, b: np.ndarray, ratio: float = 0.8, furthest: float = 0.7) -> np.ndarray:
    """
    Mutual nearest neighbours of unit descriptors a (n, 128), b (m, 128) that pass Lowe's ratio test.

    Angles arccos(a . b) are compared as COLMAP does: below `furthest` radians and below `ratio` times the second best.
    Returns (p, 2) uint32 indices into a and b.
    """
    n, m = len(a), len(b)
    if n < 2 or m < 2:
        return np.empty((0, 2), np.uint32)
    best, second = np.empty(n, np.float32), np.empty(n, np.float32)
    column = np.empty(n, np.int64)
    column_best, column_row = np.full(m, -2, np.float32), np.full(m, -1, np.int64)
    transposed = np.ascontiguousarray(b.T)
    for start in range(0, n, _BLOCK):
        _best_two(a[start : start + _BLOCK] @ transposed, start, best, second, column, column_best, column_row)
    angle, runner_up = np.arccos(np.clip(best, -1, 1)), np.arccos(np.clip(second, -1, 1))
    good = (column_row[column] == np.arange(n)) & (angle < furthest) & (angle < ratio * runner_up)
    rows = np.flatnonzero(good)
    return np.stack([rows, column[rows]], axis=1).astype(np.uint32)


def likeness(features: list[Features], most: int = 700) -> np.ndarray:
    """(k, k) int: mutual matches among each photo's `most` largest features, a cheap measure of overlap."""
    units = [unit_descriptors(f.descriptors[:most]) for f in features]
    k = len(features)
    counts = np.zeros((k, k), int)
    for i in range(k):
        for j in range(i + 1, k):
            counts[i, j] = counts[j, i] = len(match(units[i], units[j]))
    return counts


def choose_pairs(alike: np.ndarray, overlap: int, loops: int, exhaustive_up_to: int) -> list[tuple[int, int]]:
    """
    Pairs (i < j) of k photos in shooting order: all of them in small sets; else each with its next `overlap`
    neighbours, and with the `loops` others that are most alike by `likeness`.
    """
    k = len(alike)
    if k <= exhaustive_up_to:
        return [(i, j) for i in range(k) for j in range(i + 1, k)]
    pairs = {(i, j) for i in range(k) for j in range(i + 1, min(i + overlap + 1, k))}
    for i in range(k):
        others = [j for j in np.argsort(-alike[i], kind="stable") if abs(j - i) > overlap and alike[i, j] >= 8]
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in others[:loops]}
    return sorted(pairs)


def verify(
    a: Features, b: Features, matches: np.ndarray, cameras: tuple[pycolmap.Camera, pycolmap.Camera]
) -> pycolmap.TwoViewGeometry:
    """The two-view geometry that most of the matches agree with (RANSAC from a fixed seed)."""
    options = pycolmap.TwoViewGeometryOptions()
    options.detect_watermark = False
    options.ransac.random_seed = 0
    # pairs that share nothing would be tried a hundred thousand times
    options.ransac.min_inlier_ratio = 0.15
    options.ransac.max_num_trials = 3000
    options.compute_relative_pose = False
    return pycolmap.estimate_two_view_geometry(
        cameras[0], a.points.astype(float), cameras[1], b.points.astype(float), matches, options
    )
