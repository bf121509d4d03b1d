"""Which features lie on the head, and whether the head turned against the room between the photos."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap

from avatarbuild.sfm.adjustment import adjust
from avatarbuild.sfm.features import Features

_GROW = 1.15  # the face's outline about its middle: ears and some hair belong to the head as well
_LEAST_TRANSFERRED = 12
_LEAST_POINTS = 60
_GAIN = 0.8


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


@dataclass(frozen=True)
class Settled:
    """
    A model of the head alone: cameras adjusted to its points, which the whole model had `before` and this one has
    `after` pixels from where they are seen, on average.
    """

    model: pycolmap.Reconstruction
    before: float
    after: float

    @property
    def head_moved(self) -> bool:
        """
        Whether the head turned against the room between the photos. A still head gains next to nothing from cameras of
        its own. Two-view geometries cannot tell: a head that turns about the axis round which the camera goes keeps to
        the epipolar lines.
        """
        return self.after < _GAIN * self.before


def settle(model: pycolmap.Reconstruction, heads: dict[str, np.ndarray]) -> Settled | None:
    """
    Keeps the points of a model that only head features observe, and adjusts cameras and points to them, lenses fixed.

    heads: image name -> (n,) bool of its features. None where the model has too few such points to tell.
    """
    votes: dict[int, list[bool]] = {}
    for number in model.reg_image_ids():
        image = model.images[number]
        for point, on_head in zip(image.points2D, heads[image.name]):
            if point.has_point3D():
                votes.setdefault(point.point3D_id, []).append(bool(on_head))
    kept = [number for number, on_head in votes.items() if all(on_head)]
    if len(kept) < _LEAST_POINTS:
        return None
    alone = pycolmap.Reconstruction(model)
    for number in set(votes) - set(kept):
        alone.delete_point3D(number)
    before = float(np.mean([alone.points3D[number].error for number in kept]))
    adjust(alone, lens=False)
    alone.update_point_3d_errors()
    return Settled(alone, before, float(np.mean([alone.points3D[number].error for number in kept])))
