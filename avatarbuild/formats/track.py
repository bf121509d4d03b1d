"""
The tracked performance as track.json, which has everything, and track.csv, with the columns of Live Link Face.

Both count pixels from 0 at the first pixel's centre, as OpenCV does; docs/formats.md gives signs and units. f frames.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from avatarbuild.artefacts import Performance
from avatarbuild.errors import InputError
from avatarbuild.formats.avatar_glb import METRES
from avatarbuild.formats.rounding import rounded
from avatarbuild.geometry.head_pose import head_angles
from avatarbuild.template import ARKIT_NAMES

TRACK_VERSION = 1
_SWAPPED = {"jawLeft": "jawRight", "jawRight": "jawLeft", "mouthLeft": "mouthRight", "mouthRight": "mouthLeft"}
CSV_SHAPES = tuple(_SWAPPED.get(name, name) for name in ARKIT_NAMES)  # the order of Live Link Face's own files
_ANGLES = tuple(f"{part}{angle}" for part in ("Head", "LeftEye", "RightEye") for angle in ("Yaw", "Pitch", "Roll"))
CSV_COLUMNS = ("Timecode", "BlendShapeCount", *(name[0].upper() + name[1:] for name in CSV_SHAPES), *_ANGLES)


def poses(performance: Performance) -> np.ndarray:
    """(f, 4, 4): P x takes a point of avatar.glb's scene, metres, to OpenCV camera coordinates in metres."""
    made = np.tile(np.eye(4), (len(performance.times), 1, 1))
    made[:, :3, :3] = performance.rotation
    made[:, :3, 3] = performance.translation * METRES
    return made


def track_json(performance: Performance) -> bytes:
    """The file's bytes, one line a frame; docs/schemas/track.schema.json."""
    w, h = performance.size
    f = round(performance.focal, 4)
    about = {
        "version": TRACK_VERSION,
        "video": PurePosixPath(performance.video).name,
        "fps": round(performance.fps, 6),
        "image_size": [int(w), int(h)],
        "intrinsics": {
            "K": [[f, 0.0, w / 2 - 0.5], [0.0, f, h / 2 - 0.5], [0.0, 0.0, 1.0]],
            "dist": [round(performance.k1, 8), 0.0, 0.0, 0.0, 0.0],
        },
    }
    times, weights = rounded(performance.times, 6), rounded(performance.weights, 5)
    pose, quality = rounded(poses(performance), 8), rounded(performance.quality, 4)
    gaze = rounded(performance.gaze, 5)
    lines = [
        _line(
            {
                "frame": i,
                "time": times[i],
                "weights": dict(zip(ARKIT_NAMES, weights[i], strict=True)),
                "pose": pose[i],
                "quality": quality[i],
                "eyes": {"left": gaze[i][0], "right": gaze[i][1]},
            }
        )
        for i in range(len(times))
    ]
    return (_line(about)[:-1] + ', "frames": [\n' + ",\n".join(lines) + "\n]}\n").encode()


def track_bytes(path: Path) -> Callable[[Performance], bytes]:
    """What writes a performance in the format that a file's ending names. Raises InputError for other endings."""
    writers = {".json": track_json, ".csv": track_csv}
    if path.suffix.lower() not in writers:
        raise InputError(f"{path}: the ending must be .csv (Live Link Face) or .json (with the head's place)")
    return writers[path.suffix.lower()]


def track_csv(performance: Performance) -> bytes:
    """The file's bytes: a header and a line a frame. The head: R = Rz(roll) Rx(-pitch) Ry(-yaw) diag(1, -1, -1)."""
    places = [ARKIT_NAMES.index(name) for name in CSV_SHAPES]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for i, time in enumerate(performance.times):
        head = np.radians(head_angles(performance.rotation[i]))
        eyes = np.column_stack([performance.gaze[i], np.zeros(2)])  # eyes do not roll
        values = np.concatenate([performance.weights[i, places], head, eyes.ravel()])
        writer.writerow([timecode(float(time), performance.fps), 61, *(f"{v:.6f}" for v in values + 0.0)])
    return text.getvalue().encode()


def timecode(seconds: float, fps: float) -> str:
    """hh:mm:ss:ff.mmm: whole seconds of the clip's clock, and the rest in frames of 1 / fps s and their thousandths."""
    whole = int(seconds)
    thousandths = round((seconds - whole) * fps * 1000)
    if thousandths >= round(fps * 1000):
        whole, thousandths = whole + 1, 0
    frame, part = divmod(thousandths, 1000)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}:{frame:02d}.{part:03d}"


def _line(value: dict[str, Any]) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)
