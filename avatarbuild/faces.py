"""Who is in a picture, and which of the faces is the subject's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.focus import Measures, measure
from avatarbuild.geometry.head_pose import head_angles, head_pose
from avatarbuild.landmarks import Face, canonical_face, face_size, find_faces

# a face in an upright picture leans no further, and no face's rigid points lie further (mm) from the mean face's
_MAX_ROLL = 60.0
_MAX_MISFIT = 12.0
_ANOTHER_SIZE = 0.35  # faces smaller than this share of the subject's are passers-by and posters


@dataclass(frozen=True)
class Candidate:
    """
    A face in a picture.

    pose (3,) degrees: yaw, pitch, roll;  misfit mm of its rigid points against the mean face
    size pixels: its diagonal;  resolution pixels a millimetre
    shape (r, 3) mm: its rigid points in head axes
    """

    face: Face
    pose: np.ndarray
    misfit: float
    size: float
    resolution: float
    shape: np.ndarray
    measures: Measures

    @property
    def trustworthy(self) -> bool:
        """Whether it looks like a face at all, however sure the network is."""
        return abs(self.pose[2]) <= _MAX_ROLL and self.misfit <= _MAX_MISFIT


@dataclass(frozen=True)
class Look:
    """What one picture (width, height) shows: faces, the surest and largest first, and measures of the whole."""

    size: tuple[int, int]
    faces: list[Candidate]
    measures: Measures


def look(rgb: np.ndarray, presence: float, careful: bool = True) -> Look:
    """Finds, poses and measures the faces of an upright (h, w, 3) uint8 sRGB picture."""
    found = [candidate(rgb, face) for face in find_faces(rgb, presence, careful=careful)]
    faces = [face for face in found if face.trustworthy]
    return Look((rgb.shape[1], rgb.shape[0]), faces, measure(rgb, None))


def candidate(rgb: np.ndarray, face: Face) -> Candidate:
    """A face with its pose, shape and measures."""
    mean = canonical_face()
    rigid = rigid_points()
    pose = head_pose(mean.points, mean.rigidity, face.points[:468])
    middle = face.points[rigid].mean(0)
    shape = (face.points[rigid] - middle) @ pose.rotation / pose.scale
    angles = head_angles(pose.rotation)
    return Candidate(face, angles, pose.misfit, face_size(face.points), pose.scale, shape, measure(rgb, face.points))


def follow(looks: list[Look], presence: float, continuous: bool) -> list[int]:
    """
    For each picture the number of the subject's face in it, -1 where it has none.

    The path of least cost through the pictures (Viterbi): a face costs by how much smaller than the picture's
    largest it is and by what its presence lacks; in a `continuous` sequence also by how far, in its own size, it
    lies from the face before. Doubtful faces are followed only where they continue surer ones.
    """
    costs, paths = np.zeros(1), []
    before: list[Candidate | None] = [None]
    for item in looks:
        here: list[Candidate | None] = [*item.faces, None]
        largest = max((f.size for f in item.faces), default=1.0)
        own = np.array([4.0 if f is None else _cost(f, largest, presence) for f in here])
        step = np.array([[_step(a, b) if continuous else 0.0 for a in before] for b in here]).reshape(len(here), -1)
        total = costs[None] + step
        paths.append(total.argmin(1))
        costs = total.min(1) + own
        before = here
    at = int(costs.argmin())
    chosen = []
    for item, back in zip(reversed(looks), reversed(paths)):
        chosen.append(at if at < len(item.faces) else -1)
        at = int(back[at])
    return chosen[::-1]


def others(item: Look, subject: int, presence: float) -> int:
    """How many further sure faces of comparable size the picture shows."""
    if subject < 0:
        return 0
    least = _ANOTHER_SIZE * item.faces[subject].size
    return sum(f.face.presence >= presence and f.size >= least for i, f in enumerate(item.faces) if i != subject)


def rigid_points() -> np.ndarray:
    """(r,) the landmarks that expressions hardly move."""
    return np.flatnonzero(canonical_face().rigidity)


def _cost(face: Candidate, largest: float, presence: float) -> float:
    return 2.0 * float(np.log2(largest / face.size)) + (0.0 if face.face.presence >= presence else 2.0)


def _step(a: Candidate | None, b: Candidate | None) -> float:
    if a is None or b is None:
        return 0.5
    moved = np.linalg.norm(a.face.points[:, :2].mean(0) - b.face.points[:, :2].mean(0)) / min(a.size, b.size)
    return 2.0 * float(min(moved, 2.0) + abs(np.log2(a.size / b.size)))
