"""What the head template tells the viewer's page of the skin: lips, inside of the mouth, scalp, the rim of the neck."""

from __future__ import annotations

import logging

import numpy as np

from avatarbuild.formats import avatar_glb
from avatarbuild.formats.gltf import Gltf
from avatarbuild.geometry.meshes import adjacency, border
from avatarbuild.template import Template

log = logging.getLogger(__name__)

_FADE = 35.0  # mm from the rim of the neck over which the skin ends


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
        apart = positions[:n, None] - positions[:n][rim]
        distance = np.sqrt(np.einsum("vrc,vrc->vr", apart, apart).min(axis=1))
    rows = np.concatenate([soft, np.clip(distance / _FADE, 0, 1)[:, None]], axis=1)
    lines = [template.contours[name] for name in ("lips_inner_upper", "lips_inner_lower")]
    gap = np.array([line[len(line) // 2] for line in lines], "<u4")
    return gap.tobytes() + np.round(255 * rows[split.sources]).astype(np.uint8).tobytes()
