"""A finished project for the viewer, made without any stage: a random head, wrinkles that follow a frown, a clip."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import performances
import synthetic

from avatarbuild.artefacts import Albedo, Blendshapes
from avatarbuild.details.synthesis import train
from avatarbuild.formats import avatar_glb
from avatarbuild.formats.clip import encode_clip
from avatarbuild.formats.details import details_files
from avatarbuild.formats.images import encode_jpeg, encode_png
from avatarbuild.formats.track import track_csv, track_json
from avatarbuild.project import Project
from avatarbuild.simulation.subject import random_subject
from avatarbuild.template import Template, expression_weights

SIDE = 256
STAMP = {"timing": {"seconds": 1.0}}
FROWN = {"browDownLeft": 1.0, "browDownRight": 1.0, "mouthFrownLeft": 0.6, "mouthFrownRight": 0.6}
_TAUGHT: tuple[dict[str, float], ...] = (
    {},
    FROWN,
    {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0},
    {"jawOpen": 0.8},
    {"browInnerUp": 1.0, "browOuterUpLeft": 1.0, "browOuterUpRight": 1.0},
    {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    {"browDownLeft": 0.5, "browDownRight": 0.5},
)


def shapes() -> Blendshapes:
    subject = random_subject(synthetic.template(), np.random.default_rng(5))
    return Blendshapes(subject.neutral, subject.expressions.astype(np.float32), subject.eye_centres)


def albedo() -> Albedo:
    """Blotched skin with bumps."""
    rng = np.random.default_rng(2)
    blotches = cv2.resize(rng.normal(0, 12, (32, 32, 1)), (SIDE, SIDE))[..., None]
    colour = np.clip(np.array([205, 160, 140]) + blotches, 0, 255).astype(np.uint8)
    normal = _encoded(cv2.resize(0.12 * rng.standard_normal((64, 64, 2)), (SIDE, SIDE)))
    open_ = np.clip(235 + blotches[..., 0], 0, 255).astype(np.uint8)
    light = np.zeros((9, 3))
    light[0], light[2], light[3] = 0.6, 0.1, 0.25
    seen = np.full((SIDE, SIDE), 200, np.uint8)
    return Albedo(colour, colour, colour, seen, normal, open_, light, np.full(3, 0.4), np.ones((1, 3)))


def files(template: Template, rig: Blendshapes, *, details: bool = True, tracked: bool = True) -> dict[str, bytes]:
    """What the folder `avatar` holds that the viewer reads."""
    skin = albedo()
    eye = np.full((64, 64, 3), 235, np.uint8)
    cv2.circle(eye, (32, 32), 9, (70, 110, 60), -1)
    cv2.circle(eye, (32, 32), 4, (10, 10, 10), -1)
    pictures = avatar_glb.Pictures(
        encode_png(eye), encode_jpeg(skin.albedo, 90), encode_png(skin.normal), encode_png(skin.occlusion)
    )
    shown = performances.performance(rig, size=(96, 128))
    shapes_ = avatar_glb.Rig(shown.neutral, shown.deltas, shown.eye_centres, 0.004, 0.2)
    made = {"avatar.glb": avatar_glb.write(template, shapes_, pictures, {}, shown if tracked else None).glb}
    if tracked:
        made |= {"track.json": track_json(shown), "track.csv": track_csv(shown)}
    if details:
        made |= {f"details/{name}": data for name, data in wrinkles(template, rig).items()}
    return made


def wrinkles(template: Template, rig: Blendshapes) -> dict[str, bytes]:
    """Details in their written form: ridges all over the face, as deep as the brows are down."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    heads, maps = [], []
    for named in _TAUGHT:
        w = template.allowed(expression_weights(**named))
        heads.append(rig.neutral + np.einsum("e,enc->nc", w, rig.deltas))
        depth = 0.5 * named.get("browDownLeft", 0.0)
        slopes = np.stack([depth * np.sin(0.5 * columns), 0.3 * depth * np.sin(0.5 * rows)], axis=-1)
        map_ = np.concatenate([slopes, np.ones((SIDE, SIDE, 2))], axis=-1)
        map_[..., :3] /= np.linalg.norm(map_[..., :3], axis=-1, keepdims=True)
        map_[..., 3] -= 0.4 * depth
        maps.append(map_.astype(np.float32))
    sure = np.ones((SIDE, SIDE), np.float32)
    return details_files(train(maps, [sure] * len(maps), np.stack(heads), rig.neutral, template))


def project(folder: Path, *, details: bool = True, tracked: bool = True) -> Project:
    """Writes capture and project below a folder."""
    template, rig = synthetic.template(), shapes()
    made = Project(folder / "anna.avatar")
    (folder / "capture" / "video").mkdir(parents=True)
    (folder / "anna.avatar" / "avatar" / "details").mkdir(parents=True)
    (made.root / "project.toml").write_text('capture = "../capture"\ntemplate = "head"\n')
    for name, data in files(template, rig, details=details, tracked=tracked).items():
        (made.folder("avatar") / name).write_bytes(data)
    made.save("albedo", albedo(), STAMP)
    made.save("blendshapes", rig, STAMP)
    if tracked:
        made.save("tracking", performances.performance(rig, size=(96, 128)), STAMP)
        grey = (np.full((128, 96, 3), 20 * i, np.uint8) for i in range(12))
        encode_clip(folder / "capture" / "video" / "MOV_0001.mp4", grey, 30.0)
    return made


def _encoded(slopes: np.ndarray) -> np.ndarray:
    normal = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.round(normal * 127.5 + 127.5).astype(np.uint8)
