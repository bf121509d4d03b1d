"""
Stage tracking: pose and weights of the person in every frame of the video, and the person's own shapes.

Source: method, section 5 [Ichim et al. 2015].
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from avatarbuild.artefacts import GOOD, Albedo, Blendshapes, Cameras, Capture, Neutral, Performance
from avatarbuild.errors import InputError
from avatarbuild.formats import video
from avatarbuild.formats.corrections import Corrections
from avatarbuild.options import TrackingOptions
from avatarbuild.progress import Progress
from avatarbuild.rigging import kept
from avatarbuild.shading.clip import LEAST_FRAMES as LEAST_GOOD
from avatarbuild.shading.clip import good_frames
from avatarbuild.shading.depth import told
from avatarbuild.shading.registration import FREEDOM
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.tracking import alternation, full_rate
from avatarbuild.tracking.alternation import Tracked
from avatarbuild.tracking.corrections import propagated
from avatarbuild.tracking.fit import Face, Weights, wearing
from avatarbuild.tracking.full_rate import Found, Sightings
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.markers import Clicks
from avatarbuild.tracking.modelling import Freedom
from avatarbuild.tracking.neck import SHAPES, UNBENT
from avatarbuild.tracking.rig import Rig
from avatarbuild.tracking.subject import kept_frames, said, score_level, subject
from avatarbuild.tracking.take import performance, warnings_of

log = logging.getLogger(__name__)

LEAST_FRAMES = 3
_PIXEL = 1.0  # mm of the face to a pixel of the depth maps


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
    corrections: Corrections | None = None,
) -> Performance:
    """
    The performance in the capture's video, `source` the capture's folder and `corrections` what the user has set by
    hand; without a video, or without a face in it, the transferred shapes as they are.

    Raises InputError where the video is gone.
    """
    clip = capture.clip
    if clip is None:
        return without(blendshapes, "no video: the shapes are the transferred ones, and there is no performance")
    if int(np.isfinite(clip.frames.presence).sum()) < LEAST_FRAMES:
        return without(
            blendshapes, f"{clip.file} shows the subject's face in fewer than {LEAST_FRAMES} frames: it is not used"
        )
    lens = Lens(clip.focal, 0.0, clip.size)
    face, skin, eyes = subject(capture, cameras, neutral, albedo, blendshapes, template, lens, clip.frames)
    level = score_level(said(clip.frames), said(clip.frames))
    path = source / clip.file
    if not path.is_file():
        raise InputError(f"the video {path} is gone: put it back, or take it out of the capture and run again")
    clicks: dict[int, Clicks] = {}
    if corrections is not None and corrections.video:
        seen = np.flatnonzero(np.isfinite(clip.frames.presence))
        sightings = Sightings(clip.processed[seen], clip.frames.landmarks[seen])
        clicks = propagated(
            *(corrections.video, template.landmarks68, clip.times, sightings.expected),
            lambda frames: video.decode_frames(path, frames),
        )
    frames = kept_frames(clip, level, face.markers, clicks)
    transferred = face.rig
    teaching = np.ones(len(frames), bool)
    if options.leave_out > 1:
        teaching[options.leave_out - 1 :: options.leave_out] = False
    weights, freedom = Weights(), Freedom()
    with progress.task("Finding the head in the frames", 1) as task:
        face, eyes, tracked = alternation.begin(template, face, skin, frames, eyes, weights)
        task.advance()

    def rounds(
        schedule: tuple[tuple[int, ...], ...], count: int, title: str
    ) -> tuple[Face, list[Tracked], list[dict[str, float]]]:
        with progress.task(title, 1.0) as task:
            return alternation.alternate(
                *(template, face, skin, tracked, teaching, weights, freedom),
                *(schedule, count, options.settled, task.advance),
            )

    def worn(rig: Rig) -> Face:
        deltas = np.concatenate([rig.deltas[:SHAPES], face.rig.deltas[SHAPES:]])
        return wearing(face, replace(rig, deltas=deltas))

    def made(rig: Rig, whole: list[Found], depth: np.ndarray) -> Performance:
        own = replace(blendshapes, neutral=rig.neutral, deltas=rig.deltas)
        heights = UNBENT if face.torso is None else face.torso.heights
        take = performance(template, clip, face.lens, own, heights, whole, numbers, teaching, evidence)
        return replace(take, depth=depth.astype(np.float32))

    numbers = np.array([one.number for one in frames])
    face, tracked, history = rounds(alternation.FROM_AFAR, options.rounds, "Tracking and modelling")
    rig, evidence, contacts = learnt(template, blendshapes, face, tracked, teaching, transferred)
    depth = np.zeros_like(rig.deltas)
    so_far = made(rig, [full_rate.found(face, one) for one in tracked if one.quality > 0], depth)
    good = good_frames(so_far)
    if options.lit_rounds and len(good) >= LEAST_GOOD:
        lit = told(capture, albedo, blendshapes, so_far, good, template, _PIXEL, FREEDOM.worth, progress)
        depth = lit.deltas - rig.deltas
        face = worn(Rig(lit.neutral, lit.deltas, rig.triangles))
        face, tracked, further = rounds(alternation.FROM_NEAR, options.lit_rounds, "Tracking, modelling, depth known")
        history += further
        rig, evidence, contacts = learnt(template, blendshapes, face, tracked, teaching, transferred)
        depth[:SHAPES] *= alternation.learnt_share(evidence[:SHAPES])[:, None, None]
    face = worn(rig)
    tracked = alternation.again(template, face, skin, tracked, eyes, weights)
    with progress.task("Every frame", len(clip.times)) as task:
        sightings = Sightings.of([one.frame for one in tracked if one.quality > 0])
        whole = full_rate.follow(
            *(face, skin, template, eyes, sightings, tracked, level),
            *(video.decode_frames(path, range(len(clip.times))), weights, task.advance, clicks),
        )
    take = made(rig, whole, depth)
    quality = np.array([one.quality for one in tracked])
    figures = {
        "frames": len(clip.times),
        "processed": len(frames),
        "good": int((quality >= GOOD).sum()),
        "rounds": len(history),
        "moved_mm": history[-1]["moved_mm"] if history else 0.0,
        "focal": round(face.lens.focal, 1),
        "corrected": len(corrections.video) if corrections is not None else 0,
        "shapes_learnt": int((evidence >= 0.5).sum()),
        **contacts,
    }
    log.info("tracking: %s", figures)
    return replace(take, figures=figures, warnings=warnings_of(take))


def learnt(
    template: Template,
    blendshapes: Blendshapes,
    face: Face,
    tracked: list[Tracked],
    teaching: np.ndarray,
    transferred: Rig,
) -> tuple[Rig, np.ndarray, dict[str, float]]:
    """The face's 52 shapes as far as the frames show them, their evidence (52,), and what contacts say of them."""
    evidence = np.zeros(len(ARKIT_NAMES))
    evidence[:SHAPES] = alternation.evidence(tracked, teaching, transferred)[:SHAPES]
    rig, contacts = kept(template, blendshapes, alternation.as_shown(face.rig, transferred, evidence[:SHAPES]))
    return rig, evidence, contacts


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
        torso_rotation=np.zeros((0, 3, 3)),
        torso_translation=np.zeros((0, 3)),
        neck=UNBENT,
        quality=none,
        gaze=np.zeros((0, 2, 2)),
        processed=np.zeros(0, int),
        modelled=np.zeros(0, bool),
        neutral=blendshapes.neutral,
        deltas=blendshapes.deltas,
        depth=np.zeros_like(blendshapes.deltas),
        eye_centres=blendshapes.eye_centres,
        evidence=np.zeros(len(ARKIT_NAMES)),
        figures={"frames": 0},
        warnings=[warning],
    )
