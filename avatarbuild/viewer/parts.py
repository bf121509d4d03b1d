"""What the viewer's page asks for last: the performance, and the transferred rig when it is chosen."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from avatarbuild.artefacts import Blendshapes
from avatarbuild.errors import InputError
from avatarbuild.formats import avatar_glb
from avatarbuild.geometry.head_pose import head_angles
from avatarbuild.project import Project
from avatarbuild.template import ARKIT_NAMES, Template

_LEAST_MOTION, _LEAST_TURN = 0.02, 0.6  # mm, degrees: less than this the other rig leaves out
_PIXEL = np.full((1, 1, 3), 128, np.uint8)


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


def transferred(project: Project, template: Template) -> bytes:
    """The rig of stage blendshapes, transferred from the template, as a GLB with the same meshes and no pictures."""
    rig = project.read("blendshapes", Blendshapes)
    pixel = cv2.imencode(".png", _PIXEL)[1].tobytes()
    grey = cv2.imencode(".png", _PIXEL[..., 0])[1].tobytes()
    shapes = avatar_glb.Rig(rig.neutral, rig.deltas, rig.eye_centres, _LEAST_MOTION, _LEAST_TURN)
    return avatar_glb.write(template, shapes, avatar_glb.Pictures(pixel, pixel, pixel, grey), {}).glb
