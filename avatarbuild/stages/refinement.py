"""Stage refinement: depth maps of the tracked frames by shape from shading, and all shapes refined against them.

Source: method, section 6 [Ichim et al. 2015, section 5.1].
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from avatarbuild.artefacts import Albedo, Blendshapes, Capture, Performance, Refinement
from avatarbuild.options import RefinementOptions
from avatarbuild.parallel import each_alone
from avatarbuild.progress import Progress
from avatarbuild.rigging import kept
from avatarbuild.shading import registration
from avatarbuild.shading.observation import View, Watched, watch
from avatarbuild.shading.relief import MEDIUM, light_seen, relief
from avatarbuild.shading.surface import FineSkin, factor_for, fine_skin
from avatarbuild.template import Template
from avatarbuild.texture import occlusion
from avatarbuild.tracking.alternation import as_shown
from avatarbuild.tracking.fit import State
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.neck import bent
from avatarbuild.tracking.rig import Rig

log = logging.getLogger(__name__)

GOOD = 0.35  # quality from which a frame counts
LEAST_FRAMES = 5
ROUNDS = 2  # of depth maps and shapes in turn: better shapes are better lit, drawn and aligned


def run(
    capture: Capture,
    albedo: Albedo,
    blendshapes: Blendshapes,
    performance: Performance,
    options: RefinementOptions,
    progress: Progress,
    template: Template,
) -> Refinement:
    """The performance's shapes, refined; as they are where the video has too few good frames."""
    rows = good_frames(performance)
    if capture.clip is None or len(rows) < LEAST_FRAMES:
        warnings = []
        if len(performance.times):
            warnings.append(f"{len(rows)} good frames: {LEAST_FRAMES} are needed to refine the shapes by shading")
        return untouched(performance, warnings)
    shapes = len(performance.deltas) - 1
    lens = Lens(performance.focal, performance.k1, performance.size)
    states = [state_of(performance, int(performance.processed[row]), shapes) for row in rows]
    sight = -np.mean([s.R.T @ s.t / np.linalg.norm(s.t) for s in states], axis=0)
    axis, freedom = sight / np.linalg.norm(sight), replace(registration.FREEDOM, worth=options.worth)
    skin = fine_skin_of(albedo, performance, template)
    now = performance
    tracked = rig = Rig(performance.neutral, performance.deltas[:shapes].astype(np.float64), template.triangles)
    for number in range(ROUNDS):
        turn = f", {number + 1} of {ROUNDS}"
        watched = watched_clip(
            capture, now, rows, template, skin, options.pixel, progress, f"The light on the face{turn}"
        )

        def asked(k: int, now: Performance = now, watched: Watched = watched) -> registration.Planes:
            one = watched.frames[k]
            seen = light_seen(one.drawn, one.grey, float(watched.light.gains[k]), watched.more(one.drawn))
            found = relief(one.drawn, seen, watched.light, lens, MEDIUM)
            head = posed(now, int(now.processed[rows[k]]), int(rows[k]))
            return registration.planes(template, head, lens, one.drawn, found)

        planes = []
        with progress.task(f"Depth maps{turn}", len(rows)) as task:
            for one in each_alone(asked, range(len(rows))):
                planes.append(one)
                task.advance()
        with progress.task(f"Refining all shapes{turn}", 1) as task:
            refined = registration.refine(template, tracked, rig, states, planes, axis, freedom)
            shown = as_shown(refined, tracked, performance.evidence[:shapes])
            made, contacts = kept(template, blendshapes, shown)
            task.advance()
        rig = Rig(made.neutral, made.deltas[:shapes], template.triangles)
        now = replace(performance, neutral=made.neutral, deltas=made.deltas)
    moved = np.linalg.norm(made.deltas - performance.deltas, axis=2).max(axis=1)
    figures = {
        "frames": len(rows),
        "pixel_frame_px": watched.frames[0].drawn.factor,
        "offset_mm": round(float(np.mean([np.average(np.abs(p.offset), weights=p.sure + 1e-9) for p in planes])), 3),
        "moved_mm": round(float(moved.max()), 3),
        "neutral_moved_mm": round(float(np.linalg.norm(made.neutral - performance.neutral, axis=1).max()), 3),
        **contacts,
    }
    log.info("refinement: %s", figures)
    exposure = watched.light.gains
    return Refinement(made.neutral, made.deltas.astype(np.float32), watched.light.y, exposure, moved, figures)


def untouched(performance: Performance, warnings: list[str]) -> Refinement:
    """The shapes as they came."""
    none = np.zeros(len(performance.deltas))
    return Refinement(performance.neutral, performance.deltas, np.zeros(9), np.zeros(0), none, {"frames": 0}, warnings)


def good_frames(performance: Performance) -> np.ndarray:
    """(g,) rows of the processed frames that may teach, and were tracked well."""
    return np.flatnonzero(performance.modelled & (performance.quality[performance.processed] >= GOOD))


def state_of(performance: Performance, frame: int, shapes: int) -> State:
    """Pose and weights (of the first `shapes`) of a decoded frame."""
    return State(performance.rotation[frame], performance.translation[frame], performance.weights[frame][:shapes])


def fine_skin_of(albedo: Albedo, performance: Performance, template: Template) -> FineSkin:
    """The skin to draw, with the openness of the head at rest."""
    open_, _ = occlusion.of_vertices(performance.neutral, template.triangles, template.parts["skin"].vertices)
    return fine_skin(template, albedo.albedo, open_)


def watched_clip(
    capture: Capture,
    performance: Performance,
    rows: np.ndarray,
    template: Template,
    skin: FineSkin,
    pixel: float,
    progress: Progress,
    title: str,
) -> Watched:
    """The processed frames `rows` on the posed head, with `pixel` mm of the face to a pixel."""
    assert capture.clip is not None
    images = capture.clip.frames.images
    lens = Lens(performance.focal, performance.k1, performance.size)
    views = [posed(performance, int(performance.processed[row]), int(row)) for row in rows]
    first = views[0]
    factor = factor_for(template, first.vertices, lens, first.R, first.t, pixel)
    with progress.task(title, len(views)) as task:
        return watch(skin, views, lambda row: images[row].rgb(), lens, factor, task.advance)


def posed(performance: Performance, frame: int, row: int) -> View:
    """A decoded frame's head and camera, the neck bent as it was."""
    vertices = performance.neutral + np.tensordot(performance.weights[frame], performance.deltas.astype(np.float64), 1)
    R, t = performance.rotation[frame], performance.translation[frame]
    torso = performance.torso_rotation[frame], performance.torso_translation[frame]
    return View(row, bent(vertices, performance.neutral, performance.neck, (R, t), torso), R, t)
