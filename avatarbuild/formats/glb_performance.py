"""
The tracked performance inside avatar.glb: one animation of the shapes, the eyes and the head, and the video's camera.

glTF cameras look along -z with y up: with D = diag(1, -1, -1, 1) and P_f of frame f from the scene to OpenCV's camera
axes, D P_f goes to glTF's. The head rests where it is; the camera's node C is placed so that the first good frame g
holds at rest, C = (D P_g)^-1, and the head is keyed by C D P_f. f frames.
"""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from avatarbuild.artefacts import Performance
from avatarbuild.formats.gltf import Writer
from avatarbuild.formats.track import poses
from avatarbuild.template import EYE_PARTS, Template

CAMERA, ANIMATION = "video_camera", "performance"
_NEAR = 0.01  # metres before the camera from which a viewer draws
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def add(writer: Writer, template: Template, performance: Performance, nodes: dict[str, int]) -> int:
    """Adds camera, its node and the animation to a file whose parts are at `nodes`; returns the camera's node."""
    views = _FLIP @ poses(performance)
    place = np.linalg.inv(views[_rest(performance)])
    heads = place @ views
    node = {
        "name": CAMERA,
        "camera": writer.add("cameras", _camera(performance)),
        "translation": place[:3, 3].tolist(),
        "rotation": Rotation.from_matrix(place[:3, :3]).as_quat().tolist(),
    }
    camera = writer.add("nodes", node)
    clock = writer.keys(performance.times, bounds=True)
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []

    def sampled(values: np.ndarray) -> int:
        samplers.append({"input": clock, "output": writer.keys(values), "interpolation": "LINEAR"})
        return len(samplers) - 1

    def keyed(sampler: int, index: int, path: str) -> None:
        channels.append({"sampler": sampler, "target": {"node": index, "path": path}})

    shapes = sampled(np.asarray(performance.weights).ravel())  # one set of keys serves every mesh
    for index in nodes.values():
        mesh = writer.tree["meshes"][writer.tree["nodes"][index]["mesh"]]
        if "targets" in mesh["primitives"][0]:
            keyed(shapes, index, "weights")
    turns = np.stack([template.eye_rotation_matrices(w) for w in performance.weights])
    for side, eye in enumerate(EYE_PARTS):
        if eye in nodes:
            keyed(sampled(quaternions(turns[:, side])), nodes[eye], "rotation")
    keyed(sampled(heads[:, :3, 3]), nodes["skin"], "translation")
    keyed(sampled(quaternions(heads[:, :3, :3])), nodes["skin"], "rotation")
    writer.add("animations", {"name": ANIMATION, "samplers": samplers, "channels": channels})
    return camera


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """(f, 4) x, y, z, w of rotations (f, 3, 3), each of the sign that is nearer to the one before it."""
    q = Rotation.from_matrix(rotations).as_quat()
    turned = np.where((q[1:] * q[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return q * np.concatenate([[1.0], np.cumprod(turned)])[:, None]


def _camera(performance: Performance) -> dict[str, Any]:
    w, h = performance.size
    lens = {"focal": performance.focal, "k1": performance.k1, "size": [int(w), int(h)]}
    return {
        "name": CAMERA,
        "type": "perspective",
        "perspective": {"yfov": float(2 * np.arctan(h / 2 / performance.focal)), "aspectRatio": w / h, "znear": _NEAR},
        "extras": {"video": PurePosixPath(performance.video).name, **lens},
    }


def _rest(performance: Performance) -> int:
    """The first good frame, else the best."""
    good = performance.good
    return int(good.argmax() if good.any() else np.argmax(performance.quality))
