"""
corrections.json: points that the user has set by hand, on frames of the video and on photos.

docs/formats.md describes the file, docs/schemas/corrections.schema.json checks it. It counts pixels from 0 at the first
pixel's centre, as OpenCV does; inside the program that centre is at 0.5.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from avatarbuild.errors import InputError

VERSION = 1
SECTIONS = ("video", "photo")
COUNT = 68
# names for some of the 68 points (iBUG's order); right and left are the subject's
POINT_NAMES = {
    "chin": 8,
    "browOuterRight": 17,
    "browInnerRight": 21,
    "browInnerLeft": 22,
    "browOuterLeft": 26,
    "noseBridge": 27,
    "noseTip": 30,
    "nostrilRight": 31,
    "noseBase": 33,
    "nostrilLeft": 35,
    "eyeOuterRight": 36,
    "eyeInnerRight": 39,
    "eyeInnerLeft": 42,
    "eyeOuterLeft": 45,
    "mouthCornerRight": 48,
    "upperLipTop": 51,
    "mouthCornerLeft": 54,
    "lowerLipBottom": 57,
    "upperLipBottom": 62,
    "lowerLipTop": 66,
}
# lids, lips and the middles of the brows, each a line from the subject's right to their left
CONTOURS = (
    *("lidUpperRight", "lidLowerRight", "lidUpperLeft", "lidLowerLeft", "browRight", "browLeft"),
    *("lipsOuterUpper", "lipsOuterLower", "lipsInnerUpper", "lipsInnerLower"),
)
_CENTRE = 0.5
_DIGITS = 9
_FARTHEST = 1e6  # pixels


@dataclass(frozen=True)
class Corrections:
    """
    video: decoded frame -> {one of the 68 points: (2,) pixels of the upright frame};  photo: name of the stored photo
    -> {one of CONTOURS: (q, 2) pixels}. The first pixel's centre is at 0.5.  reviewed: frames that the user has looked
    at; nothing depends on it.
    """

    video: dict[int, dict[int, np.ndarray]] = field(default_factory=dict)
    photo: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    reviewed: tuple[int, ...] = ()

    def digest(self, section: str) -> str:
        """SHA-256 of what one section says, '' where it says nothing."""
        said = _document(self)[section]
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest() if said else ""


def read_corrections(data: bytes, name: str) -> Corrections:
    """The file's content; `name` is told in faults. Raises InputError for what is not this format."""
    try:
        found = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is not valid JSON ({error}): mend or delete it") from None
    if not isinstance(found, dict) or found.get("version") != VERSION:
        raise InputError(f'{name} must be an object with "version": {VERSION}: mend or delete it')
    if unknown := set(found) - {"version", *SECTIONS, "reviewed"}:
        raise InputError(f"{name} has an unknown section '{min(unknown)}': there are {', '.join(SECTIONS)}, reviewed")
    sections = [found.get(section, {}) for section in SECTIONS]
    for section, rows in zip(SECTIONS, sections, strict=True):
        if not isinstance(rows, dict) or not all(isinstance(points, dict) for points in rows.values()):
            raise InputError(f"{name}: '{section}' must hold an object of points for each picture")
    video: dict[int, dict[int, np.ndarray]] = {}
    for key, points in sections[0].items():
        if not key.isdecimal() or len(key) > _DIGITS:
            raise InputError(f"{name}: video frame '{key}' is not the number of a decoded frame, 0 or more")
        where = f"{name}, video frame {key}"
        for point, at in points.items():
            video.setdefault(int(key), {})[_index(point, where)] = _pixels(at, f"{where}, point {point}")[0]
    photo: dict[str, dict[str, np.ndarray]] = {}
    for key, contours in sections[1].items():
        for contour, at in contours.items():
            where = f"{name}, photo {key}, {contour}"
            if contour not in CONTOURS:
                raise InputError(f"{where}: no such contour: there are {', '.join(CONTOURS)}")
            photo.setdefault(key, {})[contour] = _pixels(at, where, least=2)
    return Corrections(video, photo, _frames(found.get("reviewed", []), name))


def corrections_bytes(c: Corrections) -> bytes:
    """The file's bytes: the same for the same corrections."""
    more = {"reviewed": sorted(set(c.reviewed))} if c.reviewed else {}
    return (json.dumps({"version": VERSION, **_document(c), **more}, indent=1, ensure_ascii=False) + "\n").encode()


def _document(c: Corrections) -> dict[str, Any]:
    video = {
        str(frame): {str(i): _list(at) for i, at in sorted(points.items())}
        for frame, points in sorted(c.video.items())
        if points
    }
    photo = {
        name: {contour: _list(at) for contour, at in sorted(contours.items())}
        for name, contours in sorted(c.photo.items())
        if contours
    }
    return {"video": video, "photo": photo}


def _list(at: np.ndarray) -> Any:
    return np.round(np.asarray(at, np.float64) - _CENTRE, 3).tolist()


def _index(point: str, where: str) -> int:
    if point in POINT_NAMES:
        return POINT_NAMES[point]
    if point.isdecimal() and len(point) <= _DIGITS and int(point) < COUNT:
        return int(point)
    raise InputError(f"{where}: no point '{point}': name one of the 68 by its number, 0 to 67, or like 'noseTip'")


def _frames(rows: Any, name: str) -> tuple[int, ...]:
    if not isinstance(rows, list) or not all(type(frame) is int and frame >= 0 for frame in rows):
        raise InputError(f"{name}: 'reviewed' must be a list of numbers of decoded frames, 0 or more")
    return tuple(sorted(set(rows)))


def _pixels(at: Any, where: str, least: int = 0) -> np.ndarray:
    """(q, 2) pixels, q at least `least`; one where that is 0."""
    rows = at if least else [at]
    sound = isinstance(rows, list) and all(
        isinstance(row, list)
        and len(row) == 2
        and all(isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < _FARTHEST for v in row)
        for row in rows
    )
    if not sound or len(rows) < least:
        raise InputError(f"{where}: expected {f'a list of {least} or more ' if least else ''}[x, y] in pixels")
    return np.array(rows, np.float64) + _CENTRE
