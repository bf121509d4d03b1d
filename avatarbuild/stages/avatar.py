"""The deliverables: avatar.glb, which any viewer opens, and avatar.json, which says where it comes from."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from avatarbuild import __version__
from avatarbuild.artefacts import Avatar, Blendshapes, Cameras, Capture, Cloud, Neutral
from avatarbuild.formats import avatar_glb
from avatarbuild.formats.images import encode_png
from avatarbuild.options import AvatarOptions
from avatarbuild.progress import Progress
from avatarbuild.report.page import page
from avatarbuild.template import Template

AVATAR_VERSION = 1
NEAR = 2.0  # mm: points of the cloud this near a vertex of the face show its colour
LEAST_COLOURS = 100  # points, below which no colour of the skin is told


def run(
    capture: Capture,
    cameras: Cameras,
    points: Cloud,
    neutral: Neutral,
    blendshapes: Blendshapes,
    options: AvatarOptions,
    progress: Progress,
    stamps: Sequence[dict[str, Any]] = (),
) -> Avatar:
    """The files of the avatar folder; each is complete on its own. `stamps`: what the stages before left behind."""
    template = Template.load()
    warnings: list[str] = []
    colour = skin_colour(template, neutral, points)
    if colour is None:
        warnings.append("skin colour: the cloud shows too little of the face to tell; avatar.glb has a general one")
    rig = avatar_glb.Rig(
        blendshapes.neutral, blendshapes.deltas, blendshapes.eye_centres, options.least_motion, options.least_turn
    )
    with progress.task("avatar.glb", 1) as task:
        pictures = avatar_glb.Pictures(eye=encode_png(neutral.eye_texture))
        scale = {key: value for key, value in plain(cameras.scale).items() if not isinstance(value, list | dict)}
        made = avatar_glb.write(template, rig, pictures, colour, {"scale": scale})
        task.advance()
    stages = {
        "capture": capture,
        "cameras": cameras,
        "points": points,
        "neutral": neutral,
        "blendshapes": blendshapes,
    }
    about = provenance(template, capture, cameras, blendshapes, made, stages)
    files = {
        "avatar.glb": made.glb,
        "avatar.json": (json.dumps(about, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode(),
    }
    with progress.task("report.html", 1) as task:
        files["report.html"] = page(capture, cameras, points, neutral, blendshapes, template, list(stamps))
        task.advance()
    figures = {
        "glb_mb": round(len(made.glb) / 1e6, 2),
        "shapes": len(template.expression_names) - len(about["no_effect"]["anywhere"]),
        "head_vertices": made.sizes["head"][0],
        "left_out_mm": round(made.left_out, 4),
    }
    return Avatar(files, figures, warnings)


def skin_colour(template: Template, neutral: Neutral, points: Cloud) -> np.ndarray | None:
    """(3,) sRGB in 0..1: the median colour of the cloud on the face without lips, lids and brows; None: too little."""
    regions = template.regions
    features = regions["lips"] | regions["lids"] | regions["brows"] | regions["sockets"] | regions["mouth"]
    face = neutral.vertices[regions["face"] & ~features]
    place = neutral.head_from_cloud
    cloud = points.points.astype(np.float64) @ place[:3, :3].T + place[:3, 3]
    distance, nearest = cKDTree(cloud).query(face, distance_upper_bound=NEAR)
    seen = nearest[np.isfinite(distance)]
    if len(seen) < LEAST_COLOURS:
        return None
    return np.median(points.colours[seen], axis=0) / 255


def provenance(
    template: Template,
    capture: Capture,
    cameras: Cameras,
    blendshapes: Blendshapes,
    made: avatar_glb.Made,
    stages: dict[str, Any],
) -> dict[str, Any]:
    """What avatar.json says; docs/schemas/avatar.schema.json. No dates and no seconds: equal runs, equal bytes."""
    anywhere = [
        name for name in template.expression_names if all(name in still for still in made.without_effect.values())
    ]
    largest = [round(float(np.linalg.norm(delta, axis=1).max()), 3) for delta in blendshapes.deltas]
    frontal = capture.photos.files[capture.frontal] if capture.frontal >= 0 else None
    return {
        "version": AVATAR_VERSION,
        "versions": {
            "avatarbuild": __version__,
            "template": {"name": template.name, "version": template.version},
        },
        "capture": {
            "digest": getattr(capture, "digest", "") or None,
            "photos": capture.photos.files,
            "video": None if capture.clip is None else capture.clip.file,
            "frontal": frontal,
            "settings": plain(capture.settings),
        },
        "scale": plain(cameras.scale),
        "shapes": {name: {"largest_mm": size} for name, size in zip(template.expression_names, largest, strict=True)},
        "no_effect": {"anywhere": anywhere, "meshes": made.without_effect},
        "meshes": {name: {"vertices": v, "triangles": m} for name, (v, m) in made.sizes.items()},
        "files": {"avatar.glb": {"bytes": len(made.glb), "sha256": hashlib.sha256(made.glb).hexdigest()}},
        "figures": {name: plain(artefact.figures) for name, artefact in stages.items()},
        "warnings": {name: list(artefact.warnings) for name, artefact in stages.items()},
    }


def plain(value: Any) -> Any:
    """The value as JSON has it: Python's numbers, lists for arrays, null where there is no finite number."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
