"""The tracked performance as the viewer's page plays it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from avatarbuild.errors import InputError
from avatarbuild.geometry.head_pose import head_angles
from avatarbuild.template import ARKIT_NAMES


def performance(track: Path) -> dict[str, Any]:
    """track.json with its numbers in rows: weights (f, 52) in ARKit's order, poses (f, 12), head angles (f, 3)."""
    try:
        about = json.loads(track.read_text(encoding="utf-8"))
        frames = about["frames"]
        poses = np.array([frame["pose"] for frame in frames])
        return {
            "name": about["video"],
            "fps": about["fps"],
            "size": about["image_size"],
            "focal": about["intrinsics"]["K"][1][1],
            "times": [frame["time"] for frame in frames],
            "quality": [round(frame["quality"], 3) for frame in frames],
            "weights": [[round(frame["weights"].get(name, 0), 4) for name in ARKIT_NAMES] for frame in frames],
            "poses": np.round(poses[:, :3].reshape(len(frames), 12), 6).tolist(),
            "angles": np.round(np.radians([head_angles(pose[:3, :3]) for pose in poses]), 5).tolist(),
        }
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{track} is damaged ({error}): run stage avatar again") from error
