"""A take: the performance in all of a clip's frames, put together from those that were tracked."""

from __future__ import annotations

import cv2
import numpy as np

from avatarbuild.artefacts import Blendshapes, Clip, Performance
from avatarbuild.rigging import limits_of
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.tracking import gaze
from avatarbuild.tracking.alternation import BLINKS
from avatarbuild.tracking.full_rate import Found, smoothed
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.neck import SHAPES

_MUCH_LOST = 0.1  # of the frames


def performance(
    template: Template,
    clip: Clip,
    lens: Lens,
    rig: Blendshapes,
    heights: np.ndarray,
    whole: list[Found],
    processed: np.ndarray,
    modelled: np.ndarray,
    evidence: np.ndarray,
) -> Performance:
    """
    Every decoded frame of a clip, smoothed without lag; lost ones between their neighbours. processed (j,) frames were
    tracked in full, modelled (j,) bool taught the `rig`; heights (2,) mm between which the neck bends.
    """
    f = len(clip.times)
    quality, angles = np.zeros(f), np.full((f, 2, 2), np.nan)
    weights, pose, torso = np.zeros((f, len(ARKIT_NAMES))), np.zeros((f, 6)), np.zeros((f, 6))
    for one in whole:
        i = one.number
        quality[i], angles[i] = one.quality, one.gaze
        weights[i, :SHAPES] = one.state.weights[:SHAPES]
        pose[i] = np.r_[cv2.Rodrigues(one.state.R)[0].ravel(), one.state.t]
        torso[i] = np.r_[cv2.Rodrigues(one.torso[0])[0].ravel(), one.torso[1]]
    good = quality > 0
    at = np.arange(f)
    if good.any():
        for path in (pose, torso):
            path[:, :3] = _continuous(path[:, :3], good)
            for k in range(6):
                path[:, k] = np.interp(at, at[good], path[good, k])
        last = np.maximum.accumulate(np.where(good, at, -1))
        weights = weights[np.where(last >= 0, last, int(np.argmax(good)))]
    looking = gaze.held(angles, good[:, None] & (weights[:, BLINKS] < 0.5))
    for row in np.flatnonzero(good):
        fixed = gaze.look_weights(template, looking[row])
        for name in template.eye_rotations:
            weights[row, template.expression_index[name]] = fixed[template.expression_index[name]]
    weights = np.clip(smoothed(weights, quality, clip.fps), 0, 1)
    for i, j in limits_of(template).items():
        weights[:, i] = np.minimum(weights[:, i], weights[:, j])
    pose, torso = (smoothed(path, quality, clip.fps) for path in (pose, torso))
    return Performance(
        video=clip.file,
        size=clip.size,
        fps=float(clip.fps),
        focal=float(lens.focal),
        k1=float(lens.k1),
        times=clip.times,
        weights=weights,
        rotation=np.stack([cv2.Rodrigues(row[:3])[0] for row in pose]),
        translation=pose[:, 3:],
        torso_rotation=np.stack([cv2.Rodrigues(row[:3])[0] for row in torso]),
        torso_translation=torso[:, 3:],
        neck=heights,
        quality=quality,
        gaze=looking,
        processed=processed,
        modelled=modelled,
        neutral=rig.neutral,
        deltas=rig.deltas.astype(np.float32),
        depth=np.zeros(rig.deltas.shape, np.float32),
        eye_centres=rig.eye_centres,
        evidence=evidence,
    )


def warnings_of(made: Performance) -> list[str]:
    """What the user should know of a take."""
    lost = 1 - float((made.quality > 0).mean())
    if lost <= _MUCH_LOST:
        return []
    return [f"the face is lost in {100 * lost:.0f} % of the video's frames: keep it in the picture"]


def _continuous(turns: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Rotation vectors (f, 3) without jumps by a whole turn between the good frames, in which the face is upright."""
    out = turns.copy()
    before = None
    for i in np.flatnonzero(good):
        angle = np.linalg.norm(out[i])
        if before is not None and angle > 0:
            other = out[i] * (1 - 2 * np.pi / angle)
            if np.linalg.norm(other - before) < np.linalg.norm(out[i] - before):
                out[i] = other
        before = out[i]
    return out
