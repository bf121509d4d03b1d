"""Which features lie on the head, and whether the head turned against the room between the photos."""

from __future__ import annotations

import cv2
import numpy as np

from avatarbuild.sfm.features import Features

_GROW = 1.15  # the face's outline about its middle: ears and some hair belong to the head as well
_LEAST_TRANSFERRED = 12


def head_features(
    features: list[Features], landmarks: np.ndarray, matches: dict[tuple[int, int], np.ndarray]
) -> list[np.ndarray]:
    """
    For each photo (n_i,) bool: features within the outline of the landmarks (k, 478, 3; NaN where no face was found).

    Photos without landmarks take the outline of their features that match head features of the photo that shares most
    of them; photos that share too few have none.
    """
    marks: list[np.ndarray | None] = [
        _inside(f.points, points[:468, :2]) if np.isfinite(points[:468, :2]).all() else None
        for f, points in zip(features, landmarks)
    ]
    while True:
        best, best_points = -1, np.empty((0, 2))
        for (i, j), pair in matches.items():
            for known, unknown, a, b in ((i, j, pair[:, 0], pair[:, 1]), (j, i, pair[:, 1], pair[:, 0])):
                mark = marks[known]
                if mark is not None and marks[unknown] is None:
                    shared = features[unknown].points[b[mark[a]]]
                    if len(shared) > max(len(best_points), _LEAST_TRANSFERRED):
                        best, best_points = unknown, shared
        if best < 0:
            return [np.zeros(len(f), bool) if m is None else m for f, m in zip(features, marks)]
        marks[best] = _inside(features[best].points, _core(best_points))


def _core(points: np.ndarray) -> np.ndarray:
    """The points within three robust deviations of their median."""
    middle = np.median(points, axis=0)
    spread = 1.4826 * np.median(np.abs(points - middle), axis=0) + 1.0
    kept = points[(np.abs(points - middle) < 3 * spread).all(axis=1)]
    return kept if len(kept) >= 3 else points


def _inside(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    hull = cv2.convexHull(outline.astype(np.float32))[:, 0]
    middle = (hull.min(axis=0) + hull.max(axis=0)) / 2
    hull = middle + _GROW * (hull - middle)
    ahead = np.roll(hull, -1, axis=0) - hull
    turn = np.sign((ahead[:, 0] * np.roll(ahead[:, 1], -1) - ahead[:, 1] * np.roll(ahead[:, 0], -1)).sum())
    offset = points[:, None] - hull
    side = ahead[:, 0] * offset[..., 1] - ahead[:, 1] * offset[..., 0]
    return (side * turn >= 0).all(axis=1)


def agreement(
    heads: list[np.ndarray],
    together: dict[tuple[int, int], np.ndarray],
    alone: dict[tuple[int, int], np.ndarray],
) -> float:
    """
    The share of the head's own matches that the whole picture's two-view geometries explain as well.

    together, alone: inlier matches (p, 2) of pairs, of all features and of head features by themselves. About 1 where
    the head kept still in the room; well below where it turned. NaN where the head has too few matches to tell.
    """
    explained = total = 0
    for pair, matches in alone.items():
        if pair not in together:
            continue
        i, j = pair
        among = together[pair]
        explained += min(int((heads[i][among[:, 0]] & heads[j][among[:, 1]]).sum()), len(matches))
        total += len(matches)
    return explained / total if total >= 100 else float("nan")
