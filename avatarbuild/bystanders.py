"""Faces besides the subject's: the detector sees a whole picture in 128 pixels, too few for somebody behind."""

from __future__ import annotations

import cv2
import numpy as np

from avatarbuild.landmarks import DETECTOR_SIZE, Face, detect_in_windows, face_size, same_place, trace

_REACH = 1.75  # side of a window in sizes of the subject's face: faces of 0.35 to 1 times that size are seen in it
_LEAST_SIDE = 0.45  # of the picture's longer side, whatever the face's size
_THRESHOLD = 0.65  # of the detector: profiles score 0.7 and more, animals and patterns on the wall 0.6 at most


def further_faces(rgb: np.ndarray, faces: list[Face], presence: float) -> list[Face]:
    """
    The faces of at least `presence` that windows of the upright (h, w, 3) uint8 picture show besides those known.

    The first of the known faces, the subject's, tells how large others may be.
    """
    h, w = rgb.shape[:2]
    side = max(_REACH * face_size(faces[0].points), _LEAST_SIDE * max(h, w))
    if side >= max(h, w):
        return []
    scale = DETECTOR_SIZE / side
    small = cv2.resize(rgb, (round(w * scale), round(h * scale)), interpolation=cv2.INTER_AREA)
    known, further = list(faces), []
    for detection in detect_in_windows(small, DETECTOR_SIZE, _THRESHOLD):
        centre, reach = detection.region.centre / scale, detection.region.side / scale
        if any(_about(centre, face) for face in known):
            continue
        face = trace(rgb, detection.region._replace(centre=centre, side=reach), careful=False)
        if face.presence >= presence and not any(same_place(face.points, other.points) for other in known):
            known.append(face)
            further.append(face)
    return further


def _about(centre: np.ndarray, face: Face) -> bool:
    """Whether a detection's centre lies within a known face."""
    return bool(np.linalg.norm(centre - face.points[:468, :2].mean(0)) < 0.4 * face_size(face.points))
