"""`avatarbuild animate`: a finished avatar, driven by a table of weights, as a video."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from avatarbuild.animation.picture import Model, exposed, frame, model
from avatarbuild.artefacts import Albedo, Blendshapes, Performance, Refinement
from avatarbuild.details.synthesis import Synthesis
from avatarbuild.errors import InputError
from avatarbuild.formats.clip import encode_clip
from avatarbuild.formats.details import details_in, read_details
from avatarbuild.formats.weights import read_weights
from avatarbuild.progress import Progress
from avatarbuild.project import Project
from avatarbuild.report.rendering import View
from avatarbuild.report.shading import Light
from avatarbuild.template import Template
from avatarbuild.whole_file import whole_file

log = logging.getLogger(__name__)

LAMP, ESTIMATED = "lamp", "estimated"
_SUFFIXES = (".mp4", ".mov")


def animate(
    project: Project,
    table: Path,
    output: Path,
    progress: Progress,
    *,
    fps: float = 30.0,
    light: str = ESTIMATED,
    size: tuple[int, int] = (720, 900),
    still: bool = False,
) -> int:
    """
    Writes the video at `output` and returns its frames. light: 'estimated' (that of the photos, stage albedo), 'lamp',
    or a JSON file with nine rows of three harmonics; `still`: without the details of expressions.

    Raises InputError for tables that cannot be read, projects without rig or albedo, lights that are none of these,
    and outputs that cannot be written.
    """
    if output.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{output}: the video is written as H.264; name a file that ends in .mp4 or .mov")
    if any(side < 64 or side % 2 for side in size) or not 1 <= fps <= 240:
        raise InputError(f"{size[0]} x {size[1]} at {fps:g} fps cannot be written: even sides from 64, 1 to 240 fps")
    if not output.resolve().parent.is_dir():
        raise InputError(f"{output}: its folder does not exist; make it first")
    frames = read_weights(table)
    template = project.template().load()
    albedo = _albedo(project)
    lit = _light(light, albedo)
    details = None if still else own_details(project, template)
    log.info("%d frames, %s", len(frames.weights), "details follow the expression" if details else "still maps only")
    drawn = model(template, rig_of(project), albedo, details)
    view = View(size=size, height=300.0, centre=(0.0, -15.0, -20.0), distance=900.0)
    turns = np.tile(np.eye(3), (len(frames.weights), 1, 1)) if frames.head is None else frames.head
    with whole_file(output) as partial, progress.task(f"{len(turns)} frames", len(turns)) as task:
        encode_clip(partial, _frames(drawn, frames.weights, turns, view, lit, task), fps)
    return len(turns)


def rig_of(project: Project) -> Blendshapes:
    """
    The person's rig as far as the project has come: refined, else learnt from the video, else transferred.

    Raises InputError where there is none.
    """
    if project.stamp("tracking") is not None:
        learnt = project.read("tracking", Performance)
        if project.stamp("refinement") is None:
            return Blendshapes(learnt.neutral, learnt.deltas, learnt.eye_centres)
        made = project.read("refinement", Refinement)
        return Blendshapes(made.neutral, made.deltas, learnt.eye_centres)
    if project.stamp("blendshapes") is None:
        raise InputError(f"{project.root} has no blendshapes yet: finish `avatarbuild run` first")
    return project.read("blendshapes", Blendshapes)


def own_details(project: Project, template: Template) -> Synthesis | None:
    """The details in the project's avatar folder, None without; InputError where they are damaged."""
    files = details_in(project.folder("avatar") / "details")
    return read_details(files, template) if files else None


def _albedo(project: Project) -> Albedo:
    if project.stamp("albedo") is None:
        raise InputError(f"{project.root} has no albedo yet: finish `avatarbuild run` first")
    return project.read("albedo", Albedo)


def _light(named: str, albedo: Albedo) -> np.ndarray | Light:
    if named == LAMP:
        return Light()
    if named == ESTIMATED:
        return exposed(albedo.harmonics)
    try:
        y = np.array(json.loads(Path(named).read_text(encoding="utf-8")), np.float64)
    except (OSError, ValueError, TypeError):
        y = np.zeros(0)
    if y.shape != (9, 3) or not np.isfinite(y).all():
        raise InputError(
            f"--light {named}: neither '{ESTIMATED}' nor '{LAMP}' nor a JSON file of nine rows of red, green, blue"
        )
    return y


def _frames(
    drawn: Model, weights: np.ndarray, turns: np.ndarray, view: View, light: np.ndarray | Light, task: Any
) -> Iterator[np.ndarray]:
    for w, turn in zip(weights, turns, strict=True):
        yield frame(drawn, w, turn, view, light)
        task.advance()
