"""The table of contents of the program: its stages, their order, and the runner that keeps them fresh."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import threadpoolctl

from avatarbuild import __version__, artefacts, options
from avatarbuild.errors import InputError
from avatarbuild.formats.corrections import Corrections
from avatarbuild.progress import Progress
from avatarbuild.project import Project
from avatarbuild.template_files import TemplateFile

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Stage:
    """
    A row: `avatarbuild.stages.<name>.run(*needs, options, progress)` makes the artefact. HEAD_STAGES are given the
    project's head template as well, as `template`; a stage that `reports`, the stamps of the others, as `stamps`; one
    that `watches` the video itself, the capture's folder as `source`; one that is `corrected`, by a section of the
    project's corrections.json, them as `corrections`.
    """

    name: str
    needs: tuple[str, ...]
    makes: type
    options: type
    version: int
    sentence: str
    reports: bool = False
    watches: bool = False
    corrected: str = ""


STAGES = (
    Stage("capture", (), artefacts.Capture, options.CaptureOptions, 1, "upright photos, video frames, landmarks"),
    Stage("cameras", ("capture",), artefacts.Cameras, options.CamerasOptions, 2, "where each photo was taken from"),
    Stage("points", ("capture", "cameras"), artefacts.Cloud, options.PointsOptions, 2, "a dense cloud of the head"),
    Stage(
        "neutral",
        ("capture", "cameras", "points"),
        artefacts.Neutral,
        options.NeutralOptions,
        2,
        "the person's head: model, thin shell, eyes, teeth",
        corrected="photo",
    ),
    Stage(
        "albedo",
        ("capture", "cameras", "points", "neutral"),
        artefacts.Albedo,
        options.AlbedoOptions,
        7,
        "the skin's colour without the light",
    ),
    Stage(
        "blendshapes",
        ("neutral",),
        artefacts.Blendshapes,
        options.BlendshapesOptions,
        2,
        "the 52 expressions on this head",
    ),
    Stage(
        "tracking",
        ("capture", "cameras", "neutral", "albedo", "blendshapes"),
        artefacts.Performance,
        options.TrackingOptions,
        13,
        "the performance in the video, and the person's own expressions",
        watches=True,
        corrected="video",
    ),
    Stage(
        "refinement",
        ("capture", "albedo", "blendshapes", "tracking"),
        artefacts.Refinement,
        options.RefinementOptions,
        7,
        "the expressions refined by the light on the skin",
    ),
    Stage(
        "details",
        ("capture", "albedo", "tracking", "refinement"),
        artefacts.Details,
        options.DetailsOptions,
        4,
        "wrinkles that follow the expression",
        watches=True,
    ),
    Stage(
        "avatar",
        ("capture", "cameras", "points", "neutral", "albedo", "blendshapes", "tracking", "refinement", "details"),
        artefacts.Avatar,
        options.AvatarOptions,
        2,
        "avatar.glb, avatar.json, report.html",
        reports=True,
    ),
)
# those that work on the template: no face, no sense
HEAD_STAGES = ("neutral", "albedo", "blendshapes", "tracking", "refinement", "details", "avatar")
NAMES = [stage.name for stage in STAGES]


@dataclass(frozen=True)
class StageState:
    """One line of `status`: state is 'fresh', 'stale' or 'missing'."""

    name: str
    state: str
    seconds: float | None
    figures: dict[str, Any]
    warnings: list[str]


@dataclass(frozen=True)
class Plan:
    """Which stages a run may touch, and which of them run although they are fresh."""

    selected: list[str]
    forced: list[str]
    only: bool


def plan(first: str | None, until: str | None, only: str | None, force: bool) -> Plan:
    """
    The stages named by --from, --until, --only and --force.

    Raises InputError for unknown names (with the nearest real one) and contradictions.
    """
    for name in (first, until, only):
        if name is not None and name not in NAMES:
            raise InputError(f"no stage '{name}', {options.nearest(name, NAMES)}")
    if only is not None:
        if first is not None or until is not None:
            raise InputError("--only was given with --from or --until: give --only alone, or the other two")
        return Plan([only], [only] if force else [], True)
    last = NAMES.index(until) if until is not None else len(NAMES) - 1
    start = NAMES.index(first) if first is not None else 0
    if start > last:
        raise InputError(f"--from {first} comes after --until {until}: the order is {', '.join(NAMES)}")
    selected = NAMES[: last + 1]
    forced = selected[start:] if first is not None else selected if force else []
    return Plan(selected, forced, False)


def keys(
    capture_digest: str,
    template_digest: str,
    chosen: dict[str, Any],
    corrections: Corrections | None = None,
    capture_key: str = "",
) -> dict[str, str]:
    """
    What each stage's artefact is made of, as a hash: the stage's version, its options, the keys of the stages that it
    needs, for the capture the bytes of its files, for the stages that use the head template its bytes, and what the
    user has set by hand for a stage. Where the capture is gone, `capture_key` stands for stage capture's.
    """
    made: dict[str, str] = {}
    for stage in STAGES:
        recipe = {
            "stage": stage.name,
            "version": stage.version,
            "options": dataclasses.asdict(chosen[stage.name]),
            "needs": [made[name] for name in stage.needs] or [capture_digest],
        }
        if stage.name in HEAD_STAGES:
            recipe["template"] = template_digest
        if stage.corrected and corrections is not None and (digest := corrections.digest(stage.corrected)):
            recipe["corrections"] = digest
        made[stage.name] = hashlib.sha256(json.dumps(recipe, sort_keys=True).encode()).hexdigest()
        if not stage.needs and capture_key:
            made[stage.name] = capture_key
    return made


def states(project: Project, made_of: dict[str, str]) -> list[StageState]:
    """The state of every stage of a project."""
    lines = []
    for stage in STAGES:
        stamp = project.stamp(stage.name)
        if stamp is None:
            lines.append(StageState(stage.name, "missing", None, {}, []))
            continue
        state = "fresh" if stamp["key"] == made_of[stage.name] else "stale"
        seconds = stamp["timing"]["seconds"]
        lines.append(StageState(stage.name, state, seconds, stamp["figures"], stamp["warnings"]))
    return lines


def run(
    project: Project,
    source: Path,
    capture_digest: str,
    template: TemplateFile,
    chosen: dict[str, Any],
    what: Plan,
    progress: Progress,
    tell: Callable[[StageState, bool], None],
) -> None:
    """
    Brings the planned stages of a locked project up to date; `tell` hears of each one (and whether it ran now).

    Raises InputError where the input or the template cannot serve, where --only finds its inputs stale and, after the
    last stage, where the photos show no face: cameras and points are then in COLMAP's own scale.
    """
    corrections = project.corrections()
    made_of = keys(capture_digest, template.digest, chosen, corrections)
    before = {line.name: line for line in states(project, made_of)}
    loaded: dict[str, Any] = {}
    head = None
    wanted = [line for line in before.values() if line.name in HEAD_STAGES and line.name in what.selected]
    if any(what.only or line.name in what.forced or line.state != "fresh" for line in wanted):
        head = template.load()  # one that cannot serve is refused before the stages that need none take their minutes

    def load(name: str) -> Any:
        if name not in loaded:
            loaded[name] = load_artefact(project, name, capture_digest)
        return loaded[name]

    for stage in STAGES:
        if stage.name not in what.selected:
            continue
        if stage.name == HEAD_STAGES[0] and not load("capture").face:
            break
        line = before[stage.name]
        if line.state == "fresh" and stage.name not in what.forced and not what.only:
            tell(line, False)
            continue
        if what.only:
            stale = [name for name in stage.needs if before[name].state != "fresh"]
            if stale:
                states_ = ", ".join(f"{name} is {before[name].state}" for name in stale)
                raise InputError(f"--only {stage.name} needs fresh inputs, but {states_}: run without --only")
        more: dict[str, Any] = {"template": head or template.load()} if stage.name in HEAD_STAGES else {}
        if stage.reports:
            stamps = [project.stamp(row.name) for row in STAGES if row.name != stage.name]
            more["stamps"] = [stamp for stamp in stamps if stamp]
        if stage.watches:
            more["source"] = source
        if stage.corrected:
            more["corrections"] = corrections
        line = _run_stage(project, stage, source, made_of[stage.name], chosen[stage.name], load, progress, more)
        loaded.pop(stage.name, None)
        tell(line, True)
    if "points" in what.selected and not load("capture").face:
        raise InputError(
            "no face was found in enough photos: the run ends after stage points, and cameras and points are in "
            "COLMAP's own scale; for an avatar, photograph a face (see `avatarbuild check`)"
        )


def load_artefact(project: Project, name: str, capture_digest: str = "") -> Any:
    """What a stage made, with the figures and warnings of its stamp."""
    made: Any = project.read(name, STAGES[NAMES.index(name)].makes)
    stamp = project.stamp(name) or {}
    known = {"figures": stamp.get("figures", {}), "warnings": stamp.get("warnings", [])}
    if name == "capture":
        known["digest"] = capture_digest
    return dataclasses.replace(made, **known)


def _run_stage(
    project: Project,
    stage: Stage,
    source: Path,
    key: str,
    chosen: Any,
    load: Callable[[str], Any],
    progress: Progress,
    more: dict[str, Any],
) -> StageState:
    log.info("stage %s begins", stage.name)
    started, clock = datetime.now(UTC), time.perf_counter()
    function = importlib.import_module(f"avatarbuild.stages.{stage.name}").run
    inputs = [load(name) for name in stage.needs] or [source]
    # sums of products come out otherwise on another number of threads; what is worth them is shared out by items
    with threadpoolctl.threadpool_limits(1, "blas"):
        artefact = function(*inputs, chosen, progress, **more)
    seconds = time.perf_counter() - clock
    stamp = {
        "stage": stage.name,
        "key": key,
        "versions": {"avatarbuild": __version__, "stage": stage.version},
        "options": dataclasses.asdict(chosen),
        "figures": artefact.figures,
        "warnings": artefact.warnings,
        **getattr(artefact, "stamped", {}),
        "timing": {"started": started.isoformat(timespec="seconds"), "seconds": round(seconds, 2)},
    }
    project.save(stage.name, artefact, stamp)
    log.info("stage %s: %s", stage.name, ", ".join(f"{name} {value}" for name, value in artefact.figures.items()))
    for warning in artefact.warnings:
        log.warning("stage %s: %s", stage.name, warning)
    return StageState(stage.name, "fresh", seconds, artefact.figures, artefact.warnings)
