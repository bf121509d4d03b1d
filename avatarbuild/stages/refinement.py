"""Stage refinement: depth maps of the tracked frames by shape from shading, and all shapes refined against them.

Source: method, section 6 [Ichim et al. 2015, section 5.1].
"""

from __future__ import annotations

import logging

import numpy as np

from avatarbuild.artefacts import Albedo, Blendshapes, Capture, Performance, Refinement
from avatarbuild.options import RefinementOptions
from avatarbuild.progress import Progress
from avatarbuild.shading.clip import LEAST_FRAMES, good_frames
from avatarbuild.shading.depth import told
from avatarbuild.template import Template

log = logging.getLogger(__name__)


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
    found = told(
        *(capture, albedo, blendshapes, performance, rows, template),
        *(options.pixel, options.worth, progress),
    )
    moved = np.linalg.norm(found.deltas - performance.deltas, axis=2).max(axis=1)
    figures = {
        "frames": len(rows),
        "pixel_frame_px": found.watched.frames[0].drawn.factor,
        "offset_mm": round(found.offset, 3),
        "moved_mm": round(float(moved.max()), 3),
        "neutral_moved_mm": round(float(np.linalg.norm(found.neutral - performance.neutral, axis=1).max()), 3),
        **found.contacts,
    }
    log.info("refinement: %s", figures)
    light = found.watched.light
    return Refinement(found.neutral, found.deltas.astype(np.float32), light.harmonics(), light.gains, moved, figures)


def untouched(performance: Performance, warnings: list[str]) -> Refinement:
    """The shapes as they came."""
    none = np.zeros(len(performance.deltas))
    return Refinement(performance.neutral, performance.deltas, np.zeros(9), np.zeros(0), none, {"frames": 0}, warnings)
