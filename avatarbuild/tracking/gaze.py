"""Where the eyes look: the detector's iris points on the eyeballs."""

from __future__ import annotations

import numpy as np

from avatarbuild.geometry.iris import iris_circle
from avatarbuild.landmarks import IRIS_LEFT, IRIS_RIGHT
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.tracking.frames import Frame
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.samples import DARK

_IRISES = (IRIS_LEFT.start, IRIS_RIGHT.start)  # the detector's middle of the left and of the right iris
_IRIS_DEPTH = 10.4 / 12  # of the eyeball's radius: from its centre to the plane of the iris
_SIDES = ("Left", "Right")
_LEAST_RADIUS = 5.0  # pixels
_ROOM = 4.0  # radii about the iris that its rim is looked for in
_LEAST_SHOWN = 0.5  # of the angles that lids leave free
_LEAST_ALIKE, _MOST_ALIKE = 0.85, 1.05  # an iris' radius by its rim over the person's; turned aside it looks smaller


def irises(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """
    (2, 2) pixels: the middles of the left and right iris, and (2,) the radii of their rims, NaN where the frame shows
    none: the middle is the detector's then, which sees an eye look aside, but hardly up or down, and errs by ten
    degrees where lids move.
    """
    out, radii = np.empty((2, 2)), np.full(2, np.nan)
    for side, middle in enumerate(_IRISES):
        mark, rim = frame.marks[middle, :2], frame.marks[[middle + 1, middle + 3], :2]
        radius = float(np.linalg.norm(rim[0] - rim[1])) / 2
        out[side] = mark
        if radius >= _LEAST_RADIUS:
            low = np.maximum(np.floor(mark - frame.corner - _ROOM * radius), 0).astype(int)
            end = low + int(2 * _ROOM * radius) + 2
            window = frame.pyramid[0][low[1] : end[1], low[0] : end[0]]
            if min(window.shape) < radius:
                continue
            picture = 255 * np.maximum(np.exp(window) - DARK, 0) ** (1 / 2.2)
            found, size, shown = iris_circle(picture, mark - frame.corner - low, radius)
            if shown >= _LEAST_SHOWN:
                out[side], radii[side] = found + frame.corner + low, size
    return out, radii


def at_eye(radii: np.ndarray, centres: np.ndarray, lens: Lens, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(2,) mm: radii (2,) pixels of what lies at the distance of the eyeballs' centres (2, 3)."""
    return radii * (centres @ R.T + t)[:, 2] / lens.focal


def believed(radii: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """(2,) bool: irises' radii mm that are the person's, `usual` mm; a lid's edge or a fold makes another circle."""
    with np.errstate(invalid="ignore"):
        return (radii > _LEAST_ALIKE * usual) & (radii < _MOST_ALIKE * usual)


def gaze(
    marks: np.ndarray, centres: np.ndarray, radius: np.ndarray, lens: Lens, R: np.ndarray, t: np.ndarray
) -> np.ndarray:
    """
    (2, 2) radians, yaw and pitch of the left and right eye: where the ray through the middle of the iris, marks (2, 2)
    pixels, meets the sphere that its plane touches; NaN where it misses.

    centres (2, 3) and radius (2,) mm of the eyeballs in the head frame. Yaw is positive to the subject's left, pitch
    up.
    """
    out = np.full((2, 2), np.nan)
    w, h = lens.size
    eye = -R.T @ t
    for side in range(2):
        flat = (marks[side] - (w / 2, h / 2)) / lens.focal
        ray = R.T @ np.array([flat[0], flat[1], 1.0])
        ray /= np.linalg.norm(ray)
        to = eye - centres[side]
        along = float(ray @ to)
        inside = along**2 - float(to @ to) + (_IRIS_DEPTH * radius[side]) ** 2
        # a ray that passes by just outside still tells the direction
        at = to + ray * (-along - np.sqrt(max(inside, 0.0)))
        if inside > -((0.5 * radius[side]) ** 2):
            out[side] = np.arctan2(at[0], at[2]), np.arctan2(at[1], np.hypot(at[0], at[2]))
    return out


def yoked(angles: np.ndarray, shut: np.ndarray) -> np.ndarray:
    """
    (2, 2) both eyes' turn from their rest, yaw and pitch: the mean of the two, each worth 1 - shut (2,) in 0..1, or
    what is known of one of them, since a person's eyes turn together [Hering 1868]; their rest holds how they converge.
    """
    worth = np.isfinite(angles).all(axis=1) * np.clip(1.05 - shut, 0.05, 1)
    if worth.sum() == 0:
        return angles
    return np.repeat((worth @ np.nan_to_num(angles))[None] / worth.sum(), 2, axis=0)


def look_weights(template: Template, angles: np.ndarray) -> np.ndarray:
    """(52,) the eyeLook weights of gaze angles (2, 2), zero elsewhere and where they are NaN: an eye's turn over the
    shape's own at weight 1."""
    out = np.zeros(len(ARKIT_NAMES))
    for side, name in enumerate(_SIDES):
        yaw, pitch = np.nan_to_num(angles[side])
        outwards = yaw if name == "Left" else -yaw
        for way, angle in (("Out", outwards), ("In", -outwards), ("Up", pitch), ("Down", -pitch)):
            shape = f"eyeLook{way}{name}"
            if shape in template.eye_rotations:
                full = np.radians(template.eye_rotations[shape].degrees)
                out[template.expression_index[shape]] = np.clip(angle / full, 0, 1)
    return out


def turning(template: Template) -> np.ndarray:
    """(52,) bool: the shapes that go with the eyes' turning."""
    return np.array([name in template.eye_rotations for name in template.expression_names])


def held(angles: np.ndarray, known: np.ndarray) -> np.ndarray:
    """angles (f, 2, 2) with those not `known` (f, 2) or NaN interpolated from the frames before and after."""
    out = np.zeros_like(angles)
    at = np.arange(len(angles))
    for side in range(2):
        good = known[:, side] & np.isfinite(angles[:, side]).all(axis=1)
        if good.any():
            for k in range(2):
                out[:, side, k] = np.interp(at, at[good], angles[good, side, k])
    return out
