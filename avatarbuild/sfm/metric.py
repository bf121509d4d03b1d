"""Millimetres and the head frame for a COLMAP model, from the face in the photos."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pycolmap

from avatarbuild.geometry.iris import iris_circle
from avatarbuild.geometry.similarity import similarity
from avatarbuild.geometry.triangulation import triangulate
from avatarbuild.landmarks import IRIS_LEFT, IRIS_RIGHT

IRIS_SPREAD = 0.5  # mm: standard deviation of the iris diameter among adults
_IRIS_DEPTH = 10.4  # mm from an eyeball's centre to the plane of its iris
_EYE_TO_LENS = 35.0  # degrees of yaw up to which an iris is measured
_LEAST_SHOWN = 0.6  # share of the angles at which the rim must show
_SURE = 3
_LEAST_RADIUS = 8.0  # pixels


@dataclass(frozen=True)
class Placed:
    """
    The placed photos of a model. index (p,) into the capture's photos, camera each one's pycolmap.Camera, rotation
    (p, 3, 3) and translation (p, 3) of x_cam = R x + t.
    """

    index: np.ndarray
    cameras: list[pycolmap.Camera]
    rotation: np.ndarray
    translation: np.ndarray

    @property
    def centres(self) -> np.ndarray:
        """(p, 3)"""
        return -np.einsum("pji,pj->pi", self.rotation, self.translation)

    def rays(self, photo: int, pixels: np.ndarray) -> np.ndarray:
        """(n, 3) unit directions in the world of pixels (n, 2) of placed photo number `photo`."""
        flat = np.asarray(self.cameras[photo].cam_from_img(pixels.astype(float)))
        d = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) @ self.rotation[photo]
        return d / np.linalg.norm(d, axis=1, keepdims=True)


def placed_photos(model: pycolmap.Reconstruction, names: list[str]) -> Placed:
    """The placed photos among `names` (as in the model), in that order."""
    images = {model.images[i].name: model.images[i] for i in model.reg_image_ids()}
    index = np.array([i for i, name in enumerate(names) if name in images], int)
    found = [images[names[i]] for i in index]
    poses = [image.cam_from_world() for image in found]
    return Placed(
        index,
        [model.cameras[image.camera_id] for image in found],
        np.array([pose.rotation.matrix() for pose in poses]).reshape(-1, 3, 3),
        np.array([pose.translation for pose in poses]).reshape(-1, 3),
    )


def face_points(placed: Placed, landmarks: np.ndarray, trusted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    The landmarks in space: (478, 3) in the model's units, and the median angle (radians) by which photos disagree.

    landmarks (k, 478, 3), trusted (k,) bool of all the capture's photos.
    """
    use = np.flatnonzero(trusted[placed.index])
    directions = np.stack([placed.rays(int(p), landmarks[placed.index[p], :, :2]) for p in use], axis=1)
    x, angles = triangulate(placed.centres[use], directions, np.ones(directions.shape[:2]))
    return x, np.nanmedian(angles, axis=1)


@dataclass(frozen=True)
class IrisSize:
    """diameter in the model's units, its relative spread over count measurements, pixels (photo, side, diameter)."""

    diameter: float
    spread: float
    count: int
    pixels: list[tuple[int, str, float]]


def iris_size(
    placed: Placed, points: np.ndarray, landmarks: np.ndarray, trusted: np.ndarray, yaw: np.ndarray, grey: Any
) -> IrisSize | None:
    """
    The horizontal iris diameter 2 r z / f from the rim found in the photos that see the face from the front; None where
    no rim is clear.

    points (478, 3) landmarks in space, yaw (k,) degrees, grey(i) -> (h, w) picture i of the capture.
    """
    order = sorted((abs(yaw[placed.index[p]]), p) for p in np.flatnonzero(trusted[placed.index]))
    found: list[tuple[float, float, int, str, float]] = []
    for turn, p in order:
        if turn > _EYE_TO_LENS or (turn > 15 and len(found) >= 2 * _SURE) or len(found) >= 24:
            break
        photo = int(placed.index[p])
        picture = grey(photo)
        camera = placed.cameras[p]
        for side, iris in (("right", IRIS_RIGHT), ("left", IRIS_LEFT)):
            marks = landmarks[photo, iris, :2]
            radius = float(np.linalg.norm(marks[1] - marks[3])) / 2
            if radius < _LEAST_RADIUS:
                continue
            middle, radius, shown = iris_circle(picture, marks[0], radius)
            if shown < _LEAST_SHOWN:
                continue
            rim = np.stack([middle - [radius, 0], middle + [radius, 0]])
            flat = np.asarray(camera.cam_from_img(rim.astype(float)))
            depth = placed.rotation[p, 2] @ points[iris.start] + placed.translation[p, 2]
            size = float(np.linalg.norm(flat[1] - flat[0]) * depth)
            found.append((size, turn, photo, side, 2 * float(radius)))
    if not found:
        return None
    sizes = np.array([f[0] for f in found])
    middle_size = float(np.median(sizes))
    spread = 1.4826 * float(np.median(np.abs(sizes - middle_size))) / middle_size
    return IrisSize(middle_size, spread, len(sizes), [(f[2], f[3], f[4]) for f in found])


def known_length(placed: Placed, ends: list[tuple[int, np.ndarray, np.ndarray]]) -> tuple[float, float] | None:
    """
    The distance, in the model's units, between two points marked in photos, and its relative disagreement among them.

    ends: (photo of the capture, a (2,), b (2,) pixels). None where fewer than two of these photos are placed.
    """
    rows = {int(photo): p for p, photo in enumerate(placed.index)}
    use = [(rows[photo], a, b) for photo, a, b in ends if photo in rows]
    if len(use) < 2:
        return None
    directions = np.stack([placed.rays(p, np.stack([a, b])) for p, a, b in use], axis=1)
    x, angles = triangulate(placed.centres[[p for p, _, _ in use]], directions, np.ones(directions.shape[:2]))
    length = float(np.linalg.norm(x[1] - x[0]))
    distance = float(np.linalg.norm(placed.centres[[p for p, _, _ in use]] - x.mean(axis=0), axis=1).mean())
    miss = float(np.sqrt((angles**2).mean())) * distance
    return length, miss / length / np.sqrt(len(use) - 1)


def head_rotation(points: np.ndarray, canonical: np.ndarray, rigidity: np.ndarray) -> tuple[float, np.ndarray]:
    """
    Scale and rotation (3, 3) that lay the landmarks in space onto the mean face.

    points (478, 3) in the model; canonical (468, 3) mm in head axes, rigidity (468,) weights.
    """
    weights = np.where(np.isfinite(points[:468]).all(axis=1), rigidity, 0.0)
    use = weights > 0
    scale, rotation, _ = similarity(points[:468][use], canonical[use], weights[use])
    return scale, rotation


def head_origin(points: np.ndarray, scale: float, rotation: np.ndarray) -> np.ndarray:
    """t of x_head = scale R x + t with the origin midway between the eyeballs' centres, behind the irises."""
    irises = scale * points[[468, 473]].mean(axis=0) @ rotation.T
    return np.array([0.0, 0.0, _IRIS_DEPTH]) - irises
