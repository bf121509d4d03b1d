"""Expression weights over time, read from a table: track.csv, Live Link Face's files, or any with ARKit's names."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatarbuild.errors import InputError
from avatarbuild.geometry.rotations import rotation
from avatarbuild.template import ARKIT_NAMES

_HEAD = ("headyaw", "headpitch", "headroll")


@dataclass(frozen=True)
class WeightsTable:
    """weights (f, 52) in ARKit's order, 0..1; head (f, 3, 3) rotations of the head in head axes, None if not told."""

    weights: np.ndarray
    head: np.ndarray | None


def read_weights(path: Path) -> WeightsTable:
    """
    The table at `path`: a header with shapes' names in any order and case, a line a frame; HeadYaw, HeadPitch and
    HeadRoll in radians (docs/formats.md) are read if they are all there, other columns are not.

    Raises InputError for files that cannot be read, without one shape's column or one line, and naming the line of a
    value that is no number.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as f:
            rows = [row for row in csv.reader(f) if any(cell.strip() for cell in row)]
    except OSError as error:
        raise InputError(f"{path}: cannot be opened ({error.strerror or error}); name a CSV file of weights") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV file in UTF-8 ({error}); export the weights again") from None
    header = [name.strip().lower() for name in rows[0]] if rows else []
    columns = {name: header.index(name.lower()) for name in ARKIT_NAMES if name.lower() in header}
    if not columns:
        raise InputError(f"{path}: no column of its first line is an ARKit shape such as JawOpen; give it a header")
    if len(rows) < 2:
        raise InputError(f"{path}: holds no frame; a line of weights for every frame is needed")
    weights = np.zeros((len(rows) - 1, len(ARKIT_NAMES)))
    for name, column in columns.items():
        weights[:, ARKIT_NAMES.index(name)] = _column(path, rows, column)
    head = None
    if all(name in header for name in _HEAD):
        head = head_rotations(*(_column(path, rows, header.index(name)) for name in _HEAD))
    return WeightsTable(np.clip(weights, 0, 1), head)


def head_rotations(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """
    (f, 3, 3) Rz(-roll) Rx(-pitch) Ry(yaw) in the head's axes at rest, of angles (f,) in radians: yaw positive to the
    subject's left, pitch up, roll where the crown leans to the subject's left, as `geometry.head_pose.head_angles`.
    """
    x, y, z = np.eye(3)
    turns = zip(yaw, pitch, roll, strict=True)
    return np.stack([rotation(-r * z) @ rotation(-p * x) @ rotation(w * y) for w, p, r in turns])


def _column(path: Path, rows: list[list[str]], column: int) -> np.ndarray:
    values = np.empty(len(rows) - 1)
    for i, row in enumerate(rows[1:]):
        try:
            values[i] = float(row[column])
        except (ValueError, IndexError):
            values[i] = np.nan
        if not np.isfinite(values[i]):
            found = row[column] if column < len(row) else ""
            raise InputError(f"{path}: frame {i + 1}, column {rows[0][column]} holds '{found}'; a number is needed")
    return values
