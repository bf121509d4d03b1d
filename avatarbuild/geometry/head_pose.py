"""The direction that a head is seen from, by one picture's landmarks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatarbuild.geometry.similarity import similarity


class HeadPose(NamedTuple):
    """
    rotation  (3, 3) x_cam = R x, in a camera whose optical axis is the line to the head
    scale     pixels a millimetre
    middle    (2,) pixels: the picture of the model's weighted mean
    misfit    mm: weighted RMS of what the alignment leaves
    """

    rotation: np.ndarray
    scale: float
    middle: np.ndarray
    misfit: float


def head_pose(model: np.ndarray, weight: np.ndarray, points: np.ndarray) -> HeadPose:
    """
    argmin_{s, R, t} sum_i w_i || s R x_i + t - p_i ||^2, in closed form [Umeyama 1991].

    model (n, 3) mm in head axes, weight (n,), points (n, 3) pixels with depth in pixels growing away. The landmark
    network draws faces as if seen from afar, whatever the lens, and its points lie where a long lens along the line
    to the head would see them: R is relative to that line, and no focal length is needed.
    """
    w = weight / weight.sum()
    middle, target = w @ model, w @ points
    a, b = model - middle, points - target
    scale, rotation, _ = similarity(model, points, weight)
    left = scale * a @ rotation.T - b
    misfit = float(np.sqrt(w @ (left**2).sum(1))) / scale
    return HeadPose(rotation, scale, target[:2], misfit)


def head_angles(rotation: np.ndarray, line: np.ndarray | None = None) -> np.ndarray:
    """
    (3,) degrees: yaw (positive: the subject looks to their left), pitch (positive: up), roll (positive: the crown
    leans to the subject's left), relative to the line from the camera to the head, so that a head at the picture's
    edge that looks at the camera has none.

    rotation (3, 3) x_cam = R x + t; `line` (3,) from the camera to the head, the optical axis where not given.
    With A the least turn of that line onto the optical axis, A R = Rz(roll) Rx(-pitch) Ry(-yaw) diag(1, -1, -1).
    """
    axis = np.array([0.0, 0.0, 1.0])
    line = axis if line is None else line / np.linalg.norm(line)
    aligned = _least_turn(line, axis) @ rotation
    camera = -aligned[2]  # the direction of the camera in the head frame
    yaw = -np.arctan2(camera[0], camera[2])
    pitch = -np.arctan2(camera[1], np.hypot(camera[0], camera[2]))
    roll = np.arctan2(aligned[0, 1], -aligned[1, 1])
    return np.degrees([yaw, pitch, roll])


def _least_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3, 3) the rotation of least angle that takes unit a to unit b != -a."""
    v = np.cross(a, b)
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + a @ b)
