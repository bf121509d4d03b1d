"""
What the light on the skin tells of the shapes: depth maps of all good frames (equations 11 to 13), and the shapes
refined against them (equation 14).

Points and texture of a frontal video tell nothing along the line of sight. Tracking goes through this once and goes on
from what it gave; stage refinement goes through it again, from the better shapes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avatarbuild.artefacts import Albedo, Blendshapes, Capture, Performance
from avatarbuild.parallel import each_alone
from avatarbuild.progress import Progress
from avatarbuild.rigging import kept
from avatarbuild.shading import registration
from avatarbuild.shading.clip import posed, watched_clip
from avatarbuild.shading.observation import Watched
from avatarbuild.shading.relief import MEDIUM, light_seen, relief
from avatarbuild.shading.surface import fine_skin
from avatarbuild.template import Template
from avatarbuild.tracking.alternation import as_shown
from avatarbuild.tracking.fit import State
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.neck import SHAPES
from avatarbuild.tracking.rig import Rig


@dataclass(frozen=True)
class Told:
    """The rig as the light tells it, neutral (n, 3) and all 52 deltas mm; what contacts say of it; the clip as it was
    watched, and how far the depth maps lie from the drawn head, mm in the mean."""

    neutral: np.ndarray
    deltas: np.ndarray
    contacts: dict[str, float]
    watched: Watched
    offset: float


def told(
    capture: Capture,
    albedo: Albedo,
    blendshapes: Blendshapes,
    performance: Performance,
    rows: np.ndarray,
    template: Template,
    pixel: float,
    worth: float,
    progress: Progress,
) -> Told:
    """
    Depth maps, `pixel` mm to a pixel, of the processed frames `rows`, and the shapes near those that points and texture
    alone tell, which meet them: worth 1/mm^2 of the maps beside that closeness. A shape of little evidence stays.
    """
    lens = Lens(performance.focal, performance.k1, performance.size)
    numbers = performance.processed[rows]
    poses = performance.rotation[numbers], performance.translation[numbers]
    states = [State(R, t, w) for R, t, w in zip(*poses, performance.weights[numbers, :SHAPES], strict=True)]
    sight = -np.mean([s.R.T @ s.t / np.linalg.norm(s.t) for s in states], axis=0)
    axis, freedom = sight / np.linalg.norm(sight), replace(registration.FREEDOM, worth=worth)
    skin = fine_skin(template, albedo.albedo)
    watched = watched_clip(capture, performance, rows, template, skin, pixel, progress, "The light on the face")

    def asked(k: int) -> registration.Planes:
        one = watched.frames[k]
        seen = light_seen(one.drawn, one.grey, float(watched.light.gains[k]), watched.more(one.drawn))
        found = relief(one.drawn, seen, watched.light, lens, MEDIUM)
        return registration.planes(template, posed(performance, int(numbers[k]), int(rows[k])), lens, one.drawn, found)

    planes = []
    with progress.task("Depth maps", len(rows)) as task:
        for one in each_alone(asked, range(len(rows))):
            planes.append(one)
            task.advance()
    drawn = Rig(performance.neutral, performance.deltas[:SHAPES].astype(np.float64), template.triangles)
    unlit = replace(drawn, deltas=drawn.deltas - performance.depth[:SHAPES])
    with progress.task("Refining all shapes", 1) as task:
        refined = registration.refine(template, unlit, drawn, states, planes, axis, freedom)
        made, contacts = kept(template, blendshapes, as_shown(refined, unlit, performance.evidence[:SHAPES]))
        task.advance()
    offset = float(np.mean([np.average(np.abs(p.offset), weights=p.sure + 1e-9) for p in planes]))
    return Told(made.neutral, made.deltas, contacts, watched, offset)
