"""The deliverables: avatar.glb, which any viewer opens, track.json, and avatar.json, which says where they are from."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from avatarbuild import __version__
from avatarbuild.artefacts import (
    Albedo,
    Avatar,
    Blendshapes,
    Cameras,
    Capture,
    Cloud,
    Details,
    Neutral,
    Performance,
    Refinement,
)
from avatarbuild.formats import avatar_glb
from avatarbuild.formats.details import JSON_FILE
from avatarbuild.formats.images import encode_jpeg, encode_png
from avatarbuild.formats.track import track_csv, track_json
from avatarbuild.options import AvatarOptions
from avatarbuild.parallel import in_order
from avatarbuild.progress import Progress
from avatarbuild.report.page import page
from avatarbuild.template import Template

AVATAR_VERSION = 1
_SHOWN = 0.02  # weights below it are not told of a state of wrinkles


def run(
    capture: Capture,
    cameras: Cameras,
    points: Cloud,
    neutral: Neutral,
    albedo: Albedo,
    blendshapes: Blendshapes,
    performance: Performance,
    refinement: Refinement,
    details: Details,
    options: AvatarOptions,
    progress: Progress,
    template: Template,
    stamps: Sequence[dict[str, Any]] = (),
) -> Avatar:
    """The files of the avatar folder; each is complete on its own. `stamps`: what the stages before left behind."""
    performance = replace(performance, neutral=refinement.neutral, deltas=refinement.deltas)
    rig = avatar_glb.Rig(
        performance.neutral, performance.deltas, performance.eye_centres, options.least_motion, options.least_turn
    )
    with progress.task("avatar.glb", 1) as task:
        pngs = (albedo.albedo, albedo.coverage, neutral.eye_texture, albedo.normal, albedo.occlusion)
        albedo_png, coverage_png, eye, normal, occlusion = in_order(encode_png, pngs)
        jpeg = encode_jpeg(albedo.albedo, options.albedo_quality)
        pictures = avatar_glb.Pictures(eye=eye, albedo=jpeg, normal=normal, occlusion=occlusion)
        scale = {key: value for key, value in plain(cameras.scale).items() if not isinstance(value, list | dict)}
        extras: dict[str, Any] = {"scale": scale, "evidence": evidence(template, performance)}
        if states := wrinkle_states(template, details, performance):
            extras["wrinkles"] = states
        made = avatar_glb.write(template, rig, pictures, extras, performance)
        task.advance()
    stages = {
        "capture": capture,
        "cameras": cameras,
        "points": points,
        "neutral": neutral,
        "albedo": albedo,
        "blendshapes": blendshapes,
        "tracking": performance,
        "refinement": refinement,
        "details": details,
    }
    files = {
        "avatar.glb": made.glb,
        "albedo.png": albedo_png,
        "coverage.png": coverage_png,
    }
    if len(performance.times):
        files |= {"track.json": track_json(performance), "track.csv": track_csv(performance)}
    files |= {f"details/{name}": data for name, data in details.files.items() if not name.startswith("frames/")}
    about = provenance(template, capture, cameras, performance, made, stages, files)
    files |= {
        "avatar.json": (json.dumps(about, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode(),
    }
    with progress.task("report.html", 1) as task:
        seen = (capture, cameras, points, neutral, albedo, blendshapes, performance, details)
        files["report.html"] = page(*seen, template, list(stamps))
        task.advance()
    figures = {
        "glb_mb": round(len(made.glb) / 1e6, 2),
        "shapes": len(template.expression_names) - len(about["no_effect"]["anywhere"]),
        "head_vertices": made.sizes["head"][0],
        "left_out_mm": round(made.left_out, 4),
    }
    return Avatar(files, figures)


def provenance(
    template: Template,
    capture: Capture,
    cameras: Cameras,
    performance: Performance,
    made: avatar_glb.Made,
    stages: dict[str, Any],
    files: dict[str, bytes],
) -> dict[str, Any]:
    """What avatar.json says; docs/schemas/avatar.schema.json. No dates and no seconds: equal runs, equal bytes."""
    anywhere = [
        name for name in template.expression_names if all(name in still for still in made.without_effect.values())
    ]
    largest = [round(float(np.linalg.norm(delta, axis=1).max()), 3) for delta in performance.deltas]
    known = evidence(template, performance)
    frontal = capture.photos.files[capture.frontal] if capture.frontal >= 0 else None
    return {
        "version": AVATAR_VERSION,
        "versions": {
            "avatarbuild": __version__,
            "template": {"name": template.name, "version": template.version},
        },
        "capture": {
            "digest": capture.digest or None,
            "photos": capture.photos.files,
            "video": None if capture.clip is None else capture.clip.file,
            "frontal": frontal,
            "settings": plain(capture.settings),
        },
        "scale": plain(cameras.scale),
        "clip": clip(performance),
        "shapes": {
            name: {"largest_mm": size, "evidence": known[name]}
            for name, size in zip(template.expression_names, largest, strict=True)
        },
        "no_effect": {"anywhere": anywhere, "meshes": made.without_effect},
        "meshes": {name: {"vertices": v, "triangles": m} for name, (v, m) in made.sizes.items()},
        "files": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in files.items()
        },
        "figures": {name: plain(artefact.figures) for name, artefact in stages.items()},
        "warnings": {name: list(artefact.warnings) for name, artefact in stages.items()},
    }


def wrinkle_states(template: Template, details: Details, performance: Performance) -> list[dict[str, Any]]:
    """
    The keyframes' maps for viewers without the shader: which weights each belongs to, and its pictures beside the file.
    """
    if not details.files:
        return []
    states = []
    for key in json.loads(details.files[JSON_FILE])["keyframes"]:
        weights = zip(template.expression_names, performance.weights[key["frame"]], strict=True)
        shown = {name: round(float(value), 3) for name, value in weights if value >= _SHOWN}
        pictures = {name: f"details/{key[name]}" for name in ("normal", "occlusion")}
        states.append({"frame": key["frame"], "weights": shown, **pictures})
    return states


def evidence(template: Template, performance: Performance) -> dict[str, float]:
    """Shape -> how far the video, and not the transfer, decided it."""
    return dict(zip(template.expression_names, np.round(performance.evidence, 3).tolist(), strict=True))


def clip(performance: Performance) -> dict[str, Any] | None:
    """The video that was tracked and its lens, for avatar.json; None without frames."""
    if not len(performance.times):
        return None
    return {
        "file": performance.video,
        "image_size": [int(side) for side in performance.size],
        "fps": round(performance.fps, 6),
        "seconds": round(float(performance.times[-1]), 4),
        "focal_px": round(performance.focal, 3),
        "k1": round(performance.k1, 6),
        "frames": {
            "decoded": len(performance.times),
            "processed": len(performance.processed),
            "modelled": int(np.count_nonzero(performance.modelled)),
            "lost": int(np.count_nonzero(performance.quality <= 0)),
        },
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
