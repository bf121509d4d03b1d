"""The performance in new footage of a person whose avatar is built: the tracker with the shapes fixed."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from avatarbuild import faces
from avatarbuild.artefacts import Albedo, Blendshapes, Cameras, Capture, Neutral, Performance, Refinement
from avatarbuild.errors import InputError
from avatarbuild.faces import Identity, Look, candidate
from avatarbuild.footage import read_clip
from avatarbuild.formats import video
from avatarbuild.landmarks import Face as Sighting
from avatarbuild.options import CaptureOptions
from avatarbuild.parallel import in_order
from avatarbuild.portrait import MAX_YAW
from avatarbuild.progress import Progress
from avatarbuild.survey import glance, video_focal
from avatarbuild.template import Template
from avatarbuild.tracking import alternation, full_rate
from avatarbuild.tracking.fit import Weights
from avatarbuild.tracking.full_rate import Sightings
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.neck import SHAPES, UNBENT
from avatarbuild.tracking.subject import kept_frame, said, score_level, subject
from avatarbuild.tracking.take import performance, warnings_of

log = logging.getLogger(__name__)

LEAST_FRAMES = 3
_PORTRAITS = 15  # photos that tell who the person is
_SAME_SHAPE = 0.01  # of the aspect ratio
_TRIED = 40  # frames all over the clip that tell of its lens and of where the eyes usually look


def track(
    capture: Capture,
    cameras: Cameras,
    neutral: Neutral,
    albedo: Albedo,
    blendshapes: Blendshapes,
    tracking: Performance,
    refinement: Refinement,
    options: CaptureOptions,
    progress: Progress,
    template: Template,
    path: Path,
) -> Performance:
    """
    The performance in the video at `path`; `tracking`: what stage tracking made of the capture's video; the rig is that
    of stage refinement. The video is read three times, so that its length takes no memory.

    Raises InputError for what is no video, shows nobody, or another person.
    """
    source = video.open_video(path)
    known = identity(capture, options.presence)
    if glance(source, options.presence, known)[2]:
        raise InputError(f"{path} seems to show another person: the avatar's own face is needed")
    clip, _ = read_clip(
        *(source, Path(path.name), focal(source, capture, tracking), known, options, progress), copies=False
    )
    seen = np.flatnonzero(np.isfinite(clip.frames.presence))
    if len(seen) < LEAST_FRAMES:
        found = "no face" if not len(seen) else f"a face in only {len(seen)} of {len(clip.processed)} frames"
        raise InputError(f"{path} shows {found}: at least {LEAST_FRAMES} frames that show it are needed, name another")
    rig = replace(blendshapes, neutral=refinement.neutral, deltas=refinement.deltas)
    lens = Lens(clip.focal, 0.0, clip.size)
    face, skin, eyes = subject(capture, cameras, neutral, albedo, rig, template, lens, clip.frames)
    level = score_level(_at_rest(capture), said(clip.frames))
    weights = Weights()
    chosen = seen[np.unique(np.linspace(0, len(seen) - 1, _TRIED).round().astype(int))]
    pictures = video.decode_frames(path, clip.processed[chosen].tolist())
    number = {int(clip.processed[i]): int(i) for i in chosen}
    frames = [kept_frame(clip, level, face.markers, {}, number[index], rgb) for index, _, rgb in pictures]
    with progress.task("Lens and gaze", 1.0) as task:
        face, eyes, _ = alternation.begin(template, face, skin, frames, eyes, weights)
        task.advance(1.0)
    with progress.task("Every frame", len(clip.times)) as task:
        sightings = Sightings(clip.processed[seen], clip.frames.landmarks[seen])
        whole = full_rate.follow(
            *(face, skin, template, eyes, sightings, [], level, video.decode_frames(path), weights, task.advance, {})
        )
    none = np.zeros(0)
    heights = UNBENT if face.torso is None else face.torso.heights
    made = performance(
        *(template, clip, face.lens, rig, heights, whole),
        *(none.astype(int), none.astype(bool), tracking.evidence),
    )
    figures = {
        "frames": len(made.times),
        "seconds": round(float(made.times[-1]), 2),
        "good": int(made.good.sum()),
        "lost": int((made.quality == 0).sum()),
        "focal": round(made.focal, 1),
    }
    log.info("%s: %s", path.name, figures)
    return replace(made, figures=figures, warnings=warnings_of(made))


def identity(capture: Capture, presence: float) -> Identity | None:
    """What the most frontal photos' faces have in common, None without any."""
    photos = capture.photos
    usable = np.flatnonzero(photos.trusted(presence, MAX_YAW))
    frontal = usable[np.argsort(np.abs(photos.pose[usable, 0]), kind="stable")][:_PORTRAITS]

    def seen(i: int) -> Look:
        rgb = photos.images[i].rgb()
        shown = Sighting(photos.landmarks[i], float(photos.presence[i]), photos.scores[i])
        return Look((rgb.shape[1], rgb.shape[0]), [candidate(rgb, shown)], None)

    looks = list(in_order(seen, frontal.tolist()))
    return faces.identity(looks, [0] * len(looks), presence)


def focal(source: video.VideoFile, capture: Capture, learnt: Performance) -> float:
    """Pixels, a prior: the tracked clip's lens where the new one has its shape, else what is usual."""
    if learnt.video and abs(np.divide(*learnt.size) / np.divide(*source.size) - 1) < _SAME_SHAPE:
        return learnt.focal * source.size[0] / learnt.size[0]
    return video_focal(source, capture.photos, assumed=False)


def _at_rest(capture: Capture) -> np.ndarray:
    """(k, a) the detector's scores in pictures that show the face at rest often enough."""
    if capture.clip is not None and len(known := said(capture.clip.frames)) >= LEAST_FRAMES:
        return known
    photos = np.nan_to_num(capture.photos.scores[capture.neutral, :SHAPES])
    return photos if len(photos) else np.zeros((1, SHAPES))
