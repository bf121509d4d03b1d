"""
corrections.json: points that the user has set by hand, on frames of the video and on photos.

docs/formats.md describes the file, docs/schemas/corrections.schema.json checks it. It counts pixels from 0 at the first
pixel's centre, as OpenCV does; inside the program that centre is at 0.5.
"""

from __future__ import annotations

import hashlib
import json
import math
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
_CENTRE = 0.5


@dataclass(frozen=True)
class Corrections:
    """
    video: decoded frame -> {one of the 68 points: (2,) pixels of the upright frame};  photo: name of the stored photo
    -> {contour: (q, 2) pixels}. The first pixel's centre is at 0.5.
    """

    video: dict[int, dict[int, np.ndarray]] = field(default_factory=dict)
    photo: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)

    def digest(self, section: str) -> str:
        """SHA-256 of what one section says, '' where it says nothing."""
        said = _document(self)[section]
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest() if said else ""


def read_corrections(data: bytes, name: str) -> Corrections:
    """The file's content; `name` is told in faults. Raises InputError for what is not this format."""
    try:
        found = json.loads(data)
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{name} is not valid JSON ({error}): mend or delete it") from None
    if not isinstance(found, dict) or found.get("version") != VERSION:
        raise InputError(f'{name} must be an object with "version": {VERSION}: mend or delete it')
    if unknown := set(found) - {"version", *SECTIONS}:
        raise InputError(f"{name} has an unknown section '{min(unknown)}': there are {' and '.join(SECTIONS)}")
    sections = [found.get(section, {}) for section in SECTIONS]
    for section, rows in zip(SECTIONS, sections, strict=True):
        if not isinstance(rows, dict) or not all(isinstance(points, dict) for points in rows.values()):
            raise InputError(f"{name}: '{section}' must hold an object of points for each picture")
    video: dict[int, dict[int, np.ndarray]] = {}
    for key, points in sections[0].items():
        if not key.isdecimal():
            raise InputError(f"{name}: video frame '{key}' is not the number of a decoded frame, 0 or more")
        where = f"{name}, video frame {key}"
        for point, at in points.items():
            video.setdefault(int(key), {})[_index(point, where)] = _pixels(at, f"{where}, point {point}")[0]
    photo = {
        key: {contour: _pixels(at, f"{name}, photo {key}, {contour}", many=True) for contour, at in contours.items()}
        for key, contours in sections[1].items()
    }
    return Corrections(video, {key: contours for key, contours in photo.items() if contours})


def corrections_bytes(c: Corrections) -> bytes:
    """The file's bytes: the same for the same corrections."""
    return (json.dumps({"version": VERSION, **_document(c)}, indent=1, ensure_ascii=False) + "\n").encode()


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
    if point.isdecimal() and int(point) < COUNT:
        return int(point)
    raise InputError(f"{where}: no point '{point}': name one of the 68 by its number, 0 to 67, or like 'noseTip'")


def _pixels(at: Any, where: str, many: bool = False) -> np.ndarray:
    """(q, 2) pixels, one where not `many`."""
    rows = at if many else [at]
    sound = isinstance(rows, list) and all(
        isinstance(row, list)
        and len(row) == 2
        and all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in row)
        for row in rows
    )
    if not sound or not rows:
        raise InputError(f"{where}: expected {'a list of ' if many else ''}[x, y] in pixels")
    return np.array(rows, np.float64) + _CENTRE
