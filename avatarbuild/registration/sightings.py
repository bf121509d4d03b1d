"""Where the photos see the landmarks, ready for a fit: pictures without distortion, cameras, and points in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.geometry.triangulation import triangulate
from avatarbuild.sfm.metric import Placed

_ROBUST = 0.004  # radians: landmarks that miss by more hardly count


@dataclass(frozen=True)
class Sightings:
    """
    k trusted photos of 478 landmarks.

    photo (k,) into the capture's photos; rotation (k, 3, 3), translation (k, 3), focal (k,) pixels; pictures
    (k, 478, 2) on the plane z = 1; pose (k, 3) degrees; points (478, 3) triangulated, NaN where too few photos agree;
    precision (478, 3, 3) = mean over photos of w (I - d d^T): across the rays 1, along a common ray 0. drawn: the
    template's contours whose landmarks lie where the user has drawn them.
    """

    photo: np.ndarray
    rotation: np.ndarray
    translation: np.ndarray
    focal: np.ndarray
    pictures: np.ndarray
    pose: np.ndarray
    points: np.ndarray
    precision: np.ndarray
    drawn: frozenset[str] = frozenset()

    @property
    def centres(self) -> np.ndarray:
        """(k, 3) where the cameras stand."""
        return -np.einsum("kji,kj->ki", self.rotation, self.translation)


def sightings(placed: Placed, landmarks: np.ndarray, pose: np.ndarray, trusted: np.ndarray) -> Sightings:
    """landmarks (photos, 478, 3) pixels, pose (photos, 3), trusted (photos,) bool, all of the capture's photos."""
    use = np.flatnonzero(trusted[placed.index])
    photo = placed.index[use]
    pictures = np.stack([np.asarray(placed.cameras[u].cam_from_img(landmarks[p, :, :2])) for u, p in zip(use, photo)])
    rotation, translation = placed.rotation[use], placed.translation[use]
    directions = np.stack([placed.rays(int(u), landmarks[p, :, :2]) for u, p in zip(use, photo)], axis=1)
    centres = placed.centres[use]
    points, angles = triangulate(centres, directions, np.ones(directions.shape[:2]), _ROBUST)
    weight = 1 / (1 + (angles / _ROBUST) ** 2)
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    precision = np.einsum("pk,pkij->pij", weight, across) / weight.sum(axis=1)[:, None, None]
    focal = np.array([placed.cameras[u].mean_focal_length() for u in use])
    return Sightings(photo, rotation, translation, focal, pictures, pose[photo], points, precision)
