"""A performance's good frames as views to be lit, drawn and read: the posed heads, the skin, the clip's light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avatarbuild.artefacts import Capture, Clip, Performance
from avatarbuild.progress import Progress
from avatarbuild.shading.observation import View, Watched, watch
from avatarbuild.shading.surface import FineSkin, factor_for
from avatarbuild.template import Template
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.neck import bent

LEAST_FRAMES = 5


def good_frames(performance: Performance) -> np.ndarray:
    """
    (g,) rows of the processed frames that may teach, and were tracked well: light knows nothing of blur and hands,
    as the texture's flow does.
    """
    return np.flatnonzero(performance.modelled & performance.good[performance.processed])


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
    rgb = pictures(capture.clip, performance)
    lens = Lens(performance.focal, performance.k1, performance.size)
    views = [posed(performance, int(performance.processed[row]), int(row)) for row in rows]
    first = views[0]
    factor = factor_for(template, first.vertices, lens, first.R, first.t, pixel)
    with progress.task(title, len(views)) as task:
        return watch(skin, views, rgb, lens, factor, task.advance)


def pictures(clip: Clip, performance: Performance) -> Callable[[int], np.ndarray]:
    """row -> (h, w, 3) uint8, the picture of a processed frame; the clip keeps frames without the face, too."""
    kept = np.searchsorted(clip.processed, performance.processed)
    return lambda row: clip.frames.images[kept[row]].rgb()


def posed(performance: Performance, frame: int, row: int) -> View:
    """A decoded frame's head and camera, the neck bent as it was."""
    vertices = performance.neutral + np.tensordot(performance.weights[frame], performance.deltas.astype(np.float64), 1)
    R, t = performance.rotation[frame], performance.translation[frame]
    torso = performance.torso_rotation[frame], performance.torso_translation[frame]
    return View(row, bent(vertices, performance.neutral, performance.neck, (R, t), torso), R, t)
