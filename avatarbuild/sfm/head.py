"""Which features lie on the head, and whether the head turned against the room between the photos."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from avatarbuild.sfm.features import Features

_GROW = 1.15  # the face's outline about its middle: ears and some hair belong to the head as well
_LEAST_TRANSFERRED = 12
_LEAST_TO_TELL = 200  # matches
_LOW_SHARE, _HIGH_ERROR = 0.75, 1.6


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


class Agreement(NamedTuple):
    """
    How well a model explains the head and the room: the share of matches whose two features observe one point, and the
    mean reprojection error (pixels) of the points. NaN where
    there are too few matches to tell.
    """

    head_share: float
    room_share: float
    head_error: float
    room_error: float

    @property
    def head_moved(self) -> bool:
        """
        Whether the head turned against the room. Where it turned a little, its points fit badly; where it turned much,
        they are torn apart. Two photos of a head that turns about the axis round which the camera goes agree with each
        other whatever it does; three do not, so that two-view geometries tell nothing.
        """
        return self.head_share < _LOW_SHARE * self.room_share or self.head_error > _HIGH_ERROR * self.room_error


def agreement(
    observed: list[np.ndarray | None],
    errors: dict[int, float],
    heads: list[np.ndarray],
    matches: dict[tuple[int, int], np.ndarray],
) -> Agreement:
    """
    observed[i] (n_i,) the point that each feature of photo i observes, -1 for none; None for photos not placed.
    errors: point -> its mean reprojection error. heads[i] (n_i,) bool; matches (p, 2) of pairs.
    """
    explained, total, misfit = np.zeros(2), np.zeros(2), np.zeros(2)
    for (i, j), pair in matches.items():
        first, second = observed[i], observed[j]
        if first is None or second is None:
            continue
        a, b = pair[:, 0], pair[:, 1]
        same = (first[a] == second[b]) & (first[a] >= 0)
        for number, side in enumerate((heads[i][a] & heads[j][b], ~heads[i][a] & ~heads[j][b])):
            explained[number] += np.count_nonzero(same & side)
            total[number] += np.count_nonzero(side)
            misfit[number] += sum(errors[int(point)] for point in first[a[same & side]])
    enough = (total >= _LEAST_TO_TELL) & (explained >= _LEAST_TO_TELL / 10)
    share, error = (
        np.where(enough, of / np.maximum(by, 1), np.nan) for of, by in ((explained, total), (misfit, explained))
    )
    return Agreement(float(share[0]), float(share[1]), float(error[0]), float(error[1]))
