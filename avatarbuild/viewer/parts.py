"""What the viewer's page asks for after its first picture: traits of the skin, the performance, the transferred rig."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from avatarbuild.artefacts import Blendshapes
from avatarbuild.errors import InputError
from avatarbuild.formats import avatar_glb
from avatarbuild.formats.gltf import Gltf
from avatarbuild.geometry.head_pose import head_angles
from avatarbuild.geometry.meshes import adjacency, border
from avatarbuild.project import Project
from avatarbuild.template import ARKIT_NAMES, Template

log = logging.getLogger(__name__)

_LEAST_MOTION, _LEAST_TURN = 0.02, 0.6  # mm, degrees: less than this the other rig leaves out
_FADE = 35.0  # mm from the rim of the neck over which the skin ends
_PIXEL = np.full((1, 1, 3), 128, np.uint8)


def traits(template: Template, glb: Gltf) -> bytes:
    """
    What the template tells of mesh `head`. Two vertices (uint32, little-endian) whose distance is the gap between the
    lips; then four bytes a vertex: lips, inside of the mouth, scalp (0 or 255, softened over two rings), and the
    distance to the rim of the neck, 255 from 35 mm on. Plain skin where the template does not fit the file.
    """
    primitive = glb.named("meshes", "head")["primitives"][0]
    positions = glb.accessor(primitive["attributes"]["POSITION"]) / avatar_glb.METRES
    skin = template.parts["skin"]
    n = skin.vertices.stop
    split = avatar_glb.split_at_seams(
        template.triangles[skin.triangles], template.uv_triangles[skin.triangles], template.uv, n
    )
    if len(split.sources) != len(positions):
        log.warning("avatar.glb was made with another head template: lips and scalp look like the rest of the skin")
        return np.full(2, 2**32 - 1, "<u4").tobytes() + bytes((0, 0, 0, 255)) * len(positions)
    regions = {name: mask[:n] for name, mask in template.regions.items()}
    masks = np.stack(
        [regions["lips"], regions["mouth"] & ~regions["face"] & ~regions["lips"], regions["scalp"]], axis=1
    )
    near = adjacency(n, template.triangles[skin.triangles])
    near = near.multiply(1 / np.maximum(near.sum(axis=1), 1)).tocsr()
    soft = masks.astype(np.float64)
    for _ in range(2):
        soft = 0.5 * soft + 0.5 * (near @ soft)
    rim = border(n, template.triangles[skin.triangles]) & regions["neck"]
    distance = np.full(n, _FADE)
    if rim.any():
        distance = cKDTree(positions[:n][rim]).query(positions[:n])[0]
    rows = np.concatenate([soft, np.clip(distance / _FADE, 0, 1)[:, None]], axis=1)
    lines = [template.contours[name] for name in ("lips_inner_upper", "lips_inner_lower")]
    gap = np.array([line[len(line) // 2] for line in lines], "<u4")
    return gap.tobytes() + np.round(255 * rows[split.sources]).astype(np.uint8).tobytes()


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
