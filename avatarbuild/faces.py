"""Who is in a picture, and which of the faces is the subject's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from avatarbuild.bystanders import further_faces
from avatarbuild.focus import Measures, measure
from avatarbuild.geometry.head_pose import head_angles, head_pose
from avatarbuild.landmarks import Face, canonical_face, face_size, find_faces
from avatarbuild.portrait import MAX_YAW, likeness, portrait

# a face in an upright picture leans no further, and no face's rigid points lie further (mm) from the mean face's
_MAX_ROLL = 60.0
_MAX_MISFIT = 12.0
# portraits of one person correlate by 0.6 and more, mostly by 0.9, those of two by 0.1 to 0.57; their shapes lie
# 1 to 4 mm apart, those of two people 4 to 8
_LIKE, _UNLIKE, _APART = 0.7, 0.45, 2.5
ANOTHER = 0.8  # unlikeness from which a face seems to be another person's
_NOBODY = 6.0  # what it costs to follow no face, in the units of `follow`
_ANOTHER_SIZE = 0.35  # faces smaller than this share of the subject's are passers-by and posters
_ANOTHER_SURE = 0.8  # of the presence that the subject needs: nobody poses in the background


@dataclass(frozen=True)
class Candidate:
    """
    A face in a picture.

    pose (3,) degrees: yaw, pitch, roll;  misfit mm of its rigid points against the mean face
    size pixels: its diagonal;  resolution pixels a millimetre
    shape (r, 3) mm: its rigid points in head axes;  portrait: its skin, None where it is turned away too far
    """

    face: Face
    pose: np.ndarray
    misfit: float
    size: float
    resolution: float
    shape: np.ndarray
    portrait: np.ndarray | None
    measures: Measures

    @property
    def trustworthy(self) -> bool:
        """Whether it looks like a face at all, however sure the network is."""
        return abs(self.pose[2]) <= _MAX_ROLL and self.misfit <= _MAX_MISFIT


@dataclass(frozen=True)
class Look:
    """What one picture (width, height) shows: faces, the surest and largest first; without any, its own measures."""

    size: tuple[int, int]
    faces: list[Candidate]
    measures: Measures | None


class Identity(NamedTuple):
    """The portrait and the shape that a person's frontal faces have in common."""

    portrait: np.ndarray
    shape: np.ndarray


def look(rgb: np.ndarray, presence: float, careful: bool = True, further: bool = False) -> Look:
    """
    Finds, poses and measures the faces of an upright (h, w, 3) uint8 sRGB picture; `further` looks in its parts for
    people behind one that is seen well.
    """
    seen = find_faces(rgb, presence, careful=careful)
    if further and seen and seen[0].presence >= presence:
        seen += further_faces(rgb, seen, _ANOTHER_SURE * presence)
    found = [candidate(rgb, face) for face in seen]
    faces = [face for face in found if face.trustworthy]
    return Look((rgb.shape[1], rgb.shape[0]), faces, None if faces else measure(rgb, None))


def candidate(rgb: np.ndarray, face: Face) -> Candidate:
    """A face with its pose, shape and measures."""
    mean = canonical_face()
    rigid = rigid_points()
    pose = head_pose(mean.points, mean.rigidity, face.points[:468])
    middle = face.points[rigid].mean(0)
    shape = (face.points[rigid] - middle) @ pose.rotation / pose.scale
    angles = head_angles(pose.rotation)
    flat = portrait(rgb, face.points) if abs(angles[0]) <= MAX_YAW else None
    size = face_size(face.points)
    return Candidate(face, angles, pose.misfit, size, pose.scale, shape, flat, measure(rgb, face.points))


def follow(looks: list[Look], presence: float, continuous: bool, known: Identity | None = None) -> list[int]:
    """
    For each picture the number of the subject's face in it, -1 where it has none.

    The path of least cost through the pictures (Viterbi): a face costs by how much smaller than the picture's
    largest it is, by what its presence lacks and by how unlike the `known` person it is; in a `continuous` sequence
    also by how far, in its own size, it lies from the face before. A photo that seems to show only another person
    counts as one without a face; a sequence keeps its face, which a doubt of the person should not lose.
    """
    doubt = 2.0 if continuous else 7.0
    costs, paths = np.zeros(1), []
    before: list[Candidate | None] = [None]
    for item in looks:
        here: list[Candidate | None] = [*item.faces, None]
        largest = max((f.size for f in item.faces), default=1.0)
        own = np.array([_NOBODY if f is None else _cost(f, largest, presence, known, doubt) for f in here])
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


def least_unlikeness(item: Look, known: Identity | None, presence: float) -> float:
    """The unlikeness of a picture's most alike sure face; NaN without a frontal one."""
    values = [unlikeness(f, known) for f in item.faces if f.face.presence >= presence] if known is not None else []
    return min((v for v in values if np.isfinite(v)), default=np.nan)


def identity(looks: list[Look], chosen: list[int], presence: float) -> Identity | None:
    """What the sure, frontal ones of the chosen faces have in common; None without any."""
    some = [look.faces[i] for look, i in zip(looks, chosen) if i >= 0]
    some = [face for face in some if face.portrait is not None and face.face.presence >= presence]
    if not some:
        return None
    return Identity(
        np.median([face.portrait for face in some], axis=0), np.median([face.shape for face in some], axis=0)
    )


def unlikeness(face: Candidate, known: Identity) -> float:
    """0 for the known person, above 1 for one who seems to be another; NaN where the face is turned away too far."""
    if face.portrait is None:
        return np.nan
    apart = float(np.sqrt(((face.shape - known.shape) ** 2).sum(1).mean()))
    unlike = (_LIKE - likeness(face.portrait, known.portrait)) / (_LIKE - _UNLIKE)
    return max(0.0, unlike) * min(1.0, max(0.0, apart / _APART)) ** 0.5


def others(item: Look, subject: int, presence: float) -> int:
    """How many further sure faces of comparable size the picture shows."""
    if subject < 0:
        return 0
    least = _ANOTHER_SIZE * item.faces[subject].size
    sure = _ANOTHER_SURE * presence
    return sum(f.face.presence >= sure and f.size >= least for i, f in enumerate(item.faces) if i != subject)


def rigid_points() -> np.ndarray:
    """(r,) the landmarks that expressions hardly move."""
    return np.flatnonzero(canonical_face().rigidity)


def _cost(face: Candidate, largest: float, presence: float, known: Identity | None, doubt: float) -> float:
    unsure = 0.0 if face.face.presence >= presence else 2.0
    unlike = 0.0 if known is None or face.portrait is None else min(2.0, unlikeness(face, known))
    return 2.0 * float(np.log2(largest / face.size)) + unsure + doubt * unlike


def _step(a: Candidate | None, b: Candidate | None) -> float:
    if a is None or b is None:
        return 0.5
    moved = np.linalg.norm(a.face.points[:, :2].mean(0) - b.face.points[:, :2].mean(0)) / min(a.size, b.size)
    return 2.0 * float(min(moved, 2.0) + abs(np.log2(a.size / b.size)))
