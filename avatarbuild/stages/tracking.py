"""
Stage tracking: pose and weights of the person in every frame of the video, and the person's own shapes.

Source: method, section 5 [Ichim et al. 2015].
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from avatarbuild.artefacts import Albedo, Blendshapes, Cameras, Capture, Clip, Neutral, Performance
from avatarbuild.errors import InputError
from avatarbuild.formats import video
from avatarbuild.geometry.head_pose import head_pose
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.landmarks import canonical_face
from avatarbuild.options import TrackingOptions
from avatarbuild.parallel import in_order
from avatarbuild.progress import Progress
from avatarbuild.rigging import in_template_s_frame, keep, limits_of
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.texture.photos import placed_in_head
from avatarbuild.tracking import alternation, full_rate, gaze, samples
from avatarbuild.tracking.alternation import Eyes, Skin, Tracked
from avatarbuild.tracking.fit import Face, Weights, face_of, wearing
from avatarbuild.tracking.frames import LEVELS, Frame, ScoreLevel, frame
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.markers import Markers, markers
from avatarbuild.tracking.modelling import Freedom
from avatarbuild.tracking.rig import Rig

log = logging.getLogger(__name__)

SHAPES = len(ARKIT_NAMES) - 1  # tongueOut, the last, moves no skin
SAMPLES = (6000, 4000, 2000, 800)  # of the skin, for each level of the pyramid, finest first
LEAST_SCORE = 0.15  # a channel of the detector that never says more is dead
LEAST_FRAMES = 3


def run(
    capture: Capture,
    cameras: Cameras,
    neutral: Neutral,
    albedo: Albedo,
    blendshapes: Blendshapes,
    options: TrackingOptions,
    progress: Progress,
    template: Template,
    source: Path,
) -> Performance:
    """
    The performance in the capture's video, `source` the capture's folder; without a video, or without a face in it, the
    transferred shapes as they are.

    Raises InputError where the video is gone.
    """
    clip = capture.clip
    if clip is None:
        return without(blendshapes, "no video: the shapes are the transferred ones, and there is no performance")
    if int(np.isfinite(clip.frames.presence).sum()) < LEAST_FRAMES:
        return without(
            blendshapes, f"{clip.file} shows the subject's face in fewer than {LEAST_FRAMES} frames: it is not used"
        )
    eyes = Eyes(neutral.eye_centres, neutral.eye_radius, np.zeros((2, 2)))
    photos = placed_in_head(
        capture.photos,
        placed_photos(cameras.model, [f"{name}.jpg" for name in capture.photos.names]),
        neutral.head_from_cloud,
    )
    points = markers(template, blendshapes.neutral, photos, capture.photos, capture.neutral)
    lens = Lens(clip.focal, 0.0, clip.size)
    level = clip_scores(clip)
    frames = processed_frames(clip, level)
    face, skin = prepared(template, blendshapes, albedo, points, lens, frames)
    transferred = face.rig
    teaching = np.ones(len(frames), bool)
    if options.leave_out > 1:
        teaching[options.leave_out - 1 :: options.leave_out] = False
    weights, freedom = Weights(), Freedom()
    with progress.task("Tracking and modelling", 1.0) as task:
        face, eyes, tracked, history = alternation.alternate(
            *(template, face, skin, frames, eyes, teaching, weights, freedom),
            *(options.rounds, options.settled, task.advance),
        )
    evidence = np.zeros(len(ARKIT_NAMES))
    evidence[:SHAPES] = alternation.evidence(tracked, teaching, transferred)
    rig, contacts = kept(template, blendshapes, face.rig)
    face = wearing(face, replace(rig, deltas=rig.deltas[:SHAPES]))
    with progress.task("Every frame", len(clip.times)) as task:
        path = source / clip.file
        if not path.is_file():
            raise InputError(f"the video {path} is gone: put it back, or take it out of the capture and run again")
        whole = full_rate.follow(
            face, skin, template, eyes, tracked, level, video.decode_frames(path), weights, task.advance
        )
    made = performance(template, clip, face.lens, rig, blendshapes.eye_centres, whole, frames, teaching, evidence)
    quality = np.array([one.quality for one in tracked])
    figures = {
        "frames": len(clip.times),
        "processed": len(frames),
        "good": int((quality >= 0.5).sum()),
        "rounds": len(history),
        "moved_mm": history[-1]["moved_mm"] if history else 0.0,
        "focal": round(face.lens.focal, 1),
        "shapes_learnt": int((evidence >= 0.5).sum()),
        **contacts,
    }
    log.info("tracking: %s", figures)
    warnings = []
    lost = 1 - float((made.quality > 0).mean())
    if lost > 0.1:
        warnings.append(f"the face is lost in {100 * lost:.0f} % of the video's frames: keep it in the picture")
    return replace(made, figures=figures, warnings=warnings)


def without(blendshapes: Blendshapes, warning: str) -> Performance:
    """No performance; the shapes as they were transferred."""
    none = np.zeros(0)
    return Performance(
        video="",
        size=(0, 0),
        fps=0.0,
        focal=0.0,
        k1=0.0,
        times=none,
        weights=np.zeros((0, len(ARKIT_NAMES))),
        rotation=np.zeros((0, 3, 3)),
        translation=np.zeros((0, 3)),
        quality=none,
        gaze=np.zeros((0, 2, 2)),
        processed=np.zeros(0, int),
        modelled=np.zeros(0, bool),
        neutral=blendshapes.neutral,
        deltas=blendshapes.deltas,
        eye_centres=blendshapes.eye_centres,
        evidence=np.zeros(len(ARKIT_NAMES)),
        figures={"frames": 0},
        warnings=[warning],
    )


def processed_frames(clip: Clip, level: ScoreLevel) -> list[Frame]:
    """The frames that the capture kept, those without a face left out."""
    views = clip.frames
    seen = np.flatnonzero(np.isfinite(views.presence))

    def one(i: int) -> Frame:
        number = int(clip.processed[i])
        scores = level.of(views.scores[i, :SHAPES])
        rgb, presence = views.images[i].rgb(), float(views.presence[i])
        return frame(number, float(clip.times[number]), rgb, views.landmarks[i], presence, scores)

    return list(in_order(one, [int(i) for i in seen]))


def clip_scores(clip: Clip) -> ScoreLevel:
    """What the detector's channels say of this face at rest (their lowest tenth), and which of them are alive."""
    scores = np.nan_to_num(clip.frames.scores[np.isfinite(clip.frames.presence), :SHAPES])
    return ScoreLevel(np.quantile(scores, 0.1, axis=0), scores.max(axis=0) > LEAST_SCORE)


def prepared(
    template: Template, blendshapes: Blendshapes, albedo: Albedo, points: Markers, lens: Lens, frames: list[Frame]
) -> tuple[Face, Skin]:
    """The face as it is tracked at first, with the transferred shapes, and its skin as it is drawn."""
    rig = Rig(blendshapes.neutral, blendshapes.deltas[:SHAPES].astype(np.float64), template.triangles)
    mean = canonical_face()
    scale = float(np.median([head_pose(mean.points, mean.rigidity, f.marks[: len(mean.points)]).scale for f in frames]))
    grey = samples.grey_chart(albedo.albedo)
    levels = samples.levels_of_samples(
        template,
        blendshapes.neutral,
        grey,
        albedo.coverage,
        [(1 << level) / scale for level in range(LEVELS)],
        list(SAMPLES),
    )
    part = template.parts["skin"].triangles
    limits = tuple(limits_of(template).items())
    skin = Skin(
        samples.flow_region(template)[part],
        (build_mipmap(grey[..., None]), template.uv, template.uv_triangles[part]),
    )
    return face_of(rig, lens, points, levels, template.triangles[part], limits), skin


def kept(template: Template, blendshapes: Blendshapes, learnt: Rig) -> tuple[Rig, dict[str, float]]:
    """The learnt shapes, all 52, with lids, lips, teeth and jaw as they must be; and what is left of the contacts."""
    person, size, turn = in_template_s_frame(template, learnt.neutral, blendshapes.eye_centres)
    deltas = blendshapes.deltas.astype(np.float64)
    deltas[:SHAPES] = learnt.deltas
    moved, figures = keep(template, person, deltas @ turn / size)
    figures = {key: round(size * value, 3) for key, value in figures.items()}
    return Rig(learnt.neutral, size * moved @ turn.T, learnt.triangles), figures


def performance(
    template: Template,
    clip: Clip,
    lens: Lens,
    rig: Rig,
    eye_centres: np.ndarray,
    whole: list[Tracked],
    frames: list[Frame],
    teaching: np.ndarray,
    evidence: np.ndarray,
) -> Performance:
    """Every decoded frame, smoothed without lag; lost ones between their neighbours."""
    f = len(clip.times)
    quality, angles = np.zeros(f), np.full((f, 2, 2), np.nan)
    weights, pose = np.zeros((f, len(ARKIT_NAMES))), np.zeros((f, 6))
    blink = [ARKIT_NAMES.index(name) for name in ("eyeBlinkLeft", "eyeBlinkRight")]
    for one in whole:
        i = one.frame.number
        quality[i], angles[i] = one.quality, one.gaze
        weights[i, :SHAPES] = one.state.weights
        pose[i] = np.r_[cv2.Rodrigues(one.state.R)[0].ravel(), one.state.t]
    good = quality > 0
    at = np.arange(f)
    if good.any():
        pose[:, :3] = _continuous(pose[:, :3], good)
        for k in range(6):
            pose[:, k] = np.interp(at, at[good], pose[good, k])
        last = np.maximum.accumulate(np.where(good, at, -1))
        weights = weights[np.where(last >= 0, last, int(np.argmax(good)))]
    looking = gaze.held(angles, good[:, None] & (weights[:, blink] < 0.6))
    for row in np.flatnonzero(good):
        fixed = gaze.look_weights(template, looking[row])
        for name in template.eye_rotations:
            weights[row, template.expression_index[name]] = fixed[template.expression_index[name]]
    weights = np.clip(full_rate.smoothed(weights, quality, clip.fps), 0, 1)
    for i, j in limits_of(template).items():
        weights[:, i] = np.minimum(weights[:, i], weights[:, j])
    pose = full_rate.smoothed(pose, quality, clip.fps)
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
        quality=quality,
        gaze=looking,
        processed=np.array([one.number for one in frames]),
        modelled=teaching,
        neutral=rig.neutral,
        deltas=rig.deltas.astype(np.float32),
        eye_centres=eye_centres,
        evidence=evidence,
    )


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
