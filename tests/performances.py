"""A short tracked clip, made up: a head that turns, opens its mouth, smiles, looks about and is lost for a moment."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from avatarbuild.artefacts import Blendshapes, Performance
from avatarbuild.template import ARKIT_NAMES, expression_weights
from avatarbuild.tracking.neck import UNBENT

FLIP = np.diag([1.0, -1.0, -1.0])  # a head that looks into the camera


def performance(
    shapes: Blendshapes,
    count: int = 12,
    size: tuple[int, int] = (100, 200),
    focal: float = 150.0,
    distance: float = 450.0,
) -> Performance:
    """The rig is `shapes`' with a jaw of its own; the first frame is lost; every third frame was tracked in full."""
    s = np.linspace(0, 1, count)
    open_, smile, look = np.sin(np.pi * s), s**2, 0.8 * s
    weights = np.stack(
        [
            expression_weights(jawOpen=a, mouthSmile=b, eyeLookUp=c, eyeLookInLeft=c, eyeLookOutRight=c)
            for a, b, c in zip(open_, smile, look, strict=True)
        ]
    )
    turn = Rotation.from_euler("YXZ", np.column_stack([60 * s - 30, 10 * s, 5 * s]), degrees=True).as_matrix()
    deltas = shapes.deltas.copy()
    jaw = ARKIT_NAMES.index("jawOpen")
    deltas[jaw] *= 1.1
    evidence = np.zeros(52)
    evidence[jaw] = 0.85
    processed = np.arange(0, count, 3)
    return Performance(
        video="video/MOV_0001.mp4",
        size=size,
        fps=30.0,
        focal=focal,
        k1=0.02,
        times=np.arange(count) / 30,
        weights=weights,
        rotation=FLIP @ turn,
        translation=np.column_stack([20 * s, 10 * s - 5, distance + 0 * s]),
        torso_rotation=FLIP @ turn,
        torso_translation=np.column_stack([20 * s, 10 * s - 5, distance + 0 * s]),
        neck=UNBENT,
        quality=np.where(np.arange(count) == 0, 0.0, 0.9),
        gaze=np.stack([np.column_stack([0.3 * s, -0.2 * s]), np.column_stack([0.3 * s, -0.2 * s])], axis=1),
        processed=processed,
        modelled=processed > 0,
        neutral=shapes.neutral,
        deltas=deltas,
        depth=np.zeros_like(deltas),
        eye_centres=shapes.eye_centres,
        evidence=evidence,
        figures={"frames": count},
    )


def nothing(shapes: Blendshapes) -> Performance:
    """Without a video: no frames, the transferred rig."""
    none = np.zeros(0)
    return Performance(
        *("", (0, 0), 0.0, 0.0, 0.0, none, np.zeros((0, 52)), np.zeros((0, 3, 3)), np.zeros((0, 3))),
        *(np.zeros((0, 3, 3)), np.zeros((0, 3)), UNBENT, none, np.zeros((0, 2, 2))),
        *(np.zeros(0, int), np.zeros(0, bool)),
        *(shapes.neutral, shapes.deltas, np.zeros_like(shapes.deltas), shapes.eye_centres, np.zeros(52)),
    )
