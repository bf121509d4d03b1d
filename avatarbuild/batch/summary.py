"""What became of every subject of a batch: summary.csv and index.html, the worst first."""

from __future__ import annotations

import base64
import csv
import io
import re
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2

from avatarbuild.batch.jobs import Job, Outcome
from avatarbuild.capture_folder import natural
from avatarbuild.errors import InputError
from avatarbuild.formats.images import decode_jpeg
from avatarbuild.pipeline import NAMES
from avatarbuild.project import Project, stage_folder_name
from avatarbuild.report.html import duration, picture, style

_THUMB = 200  # pixels wide


class Column(NamedTuple):
    """A figure of a stage's stamp, over another one's value where `of` names it; better: +1 more is, -1 less is."""

    name: str
    stage: str
    figure: str
    better: int
    of: str = ""


COLUMNS = (
    Column("photos", "capture", "photos", 1),
    Column("pixels_per_mm", "capture", "face_pixels_per_mm", 1),
    Column("placed", "cameras", "placed", 1, "photos"),
    Column("reprojection_px", "cameras", "reprojection_px", -1),
    Column("face_to_cloud_p90_mm", "neutral", "face_to_cloud_mm_p90", -1),
    Column("face_seen", "neutral", "face_seen", 1),
    Column("skin_seen", "albedo", "skin_seen", 1),
    Column("good_frames", "tracking", "good", 1, "processed"),
    Column("shapes_learnt", "tracking", "shapes_learnt", 1),
    Column("wrinkles_misfit_degrees", "details", "misfit_degrees", -1),
)


@dataclass(frozen=True)
class Row:
    """
    A subject: state 'done', 'failed' or 'unfinished' (not begun, or stopped); the last stage that is there; figures by
    COLUMNS' names, None where unknown; warnings (stage, sentence); seconds of all stages that are there.
    """

    subject: str
    state: str
    reason: str
    message: str
    stage: str
    figures: dict[str, float | None]
    warnings: list[tuple[str, str]]
    seconds: float
    report: str


def rows(jobs: list[Job], outcomes: dict[str, Outcome], until: str | None) -> list[Row]:
    """Every subject of a batch, the worst first: failed, unfinished, then by warnings, then by figures."""
    made = [_row(job, outcomes.get(job.subject), until) for job in jobs]
    states = ("failed", "unfinished", "done")
    bad = _badness(made)
    return sorted(
        made,
        key=lambda row: (states.index(row.state), -len(row.warnings), -bad[row.subject], natural(row.subject)),
    )


def _row(job: Job, outcome: Outcome | None, until: str | None) -> Row:
    project = Project(job.project)
    stamps = {}
    for name in NAMES[: NAMES.index(until) + 1] if until else NAMES:
        stamp = project.stamp(name)
        if stamp is not None:
            stamps[name] = stamp
    figures = {column.name: _figure(stamps, column) for column in COLUMNS}
    warnings = [(name, str(text)) for name, stamp in stamps.items() for text in stamp["warnings"]]
    state, reason, message = "unfinished", "", ""
    if outcome is not None and outcome.reason != "stopped":
        state, reason, message = "failed" if outcome.reason else "done", outcome.reason, outcome.message
    report = f"{job.project.name}/{stage_folder_name('avatar')}/report.html"
    return Row(
        *(job.subject, state, reason, message, max(stamps, key=NAMES.index, default=""), figures, warnings),
        seconds=sum(stamp["timing"]["seconds"] for stamp in stamps.values()),
        report=report if (job.project.parent / report).is_file() else "",
    )


def _figure(stamps: dict[str, dict[str, Any]], column: Column) -> float | None:
    known = stamps.get(column.stage, {}).get("figures", {})
    value, whole = known.get(column.figure), known.get(column.of) if column.of else 1
    if not isinstance(value, int | float) or not isinstance(whole, int | float) or not whole:
        return None
    return value if whole == 1 else round(value / whole, 3)


def _badness(made: list[Row]) -> dict[str, float]:
    """Of each subject the mean, over the figures that it has, of the share of subjects that are better."""
    places: dict[str, list[float]] = {row.subject: [] for row in made}
    for column in COLUMNS:
        known = {row.subject: value for row in made if (value := row.figures[column.name]) is not None}
        for subject, value in known.items():
            better = sum(1 for other in known.values() if (other - value) * column.better > 0)
            places[subject].append(better / len(known))
    return {subject: sum(ranks) / len(ranks) if ranks else 0.0 for subject, ranks in places.items()}


def table(made: list[Row]) -> bytes:
    """summary.csv: no dates and no seconds, so that equal captures give equal bytes."""
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    names = [column.name for column in COLUMNS]
    lines.writerow(["subject", "state", "reason", "last_stage", "warnings", *names, "message"])
    for row in made:
        figures = ["" if (value := row.figures[name]) is None else f"{value:g}" for name in names]
        lines.writerow([row.subject, row.state, row.reason, row.stage, len(row.warnings), *figures, row.message])
    return text.getvalue().encode()


def page(made: list[Row], projects: dict[str, Path]) -> bytes:
    """index.html: every subject with its picture, figures, warnings and report; nothing fetched, no script."""
    counts = {state: sum(row.state == state for row in made) for state in ("done", "failed", "unfinished")}
    said = ", ".join(f"{number} {state}" for state, number in counts.items() if number)
    own = files("avatarbuild.batch").joinpath("index.css").read_text(encoding="utf-8")
    body = "".join(_card(row, projects[row.subject]) for row in made)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Avatars</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{style()}{own}</style></head>\n'
        f'<body><header><h1>Avatars</h1><p class="lead">{len(made)} subjects: {said}. The worst first; '
        f'<a href="summary.csv">summary.csv</a> holds the figures.</p></header><main>{body}</main></body></html>\n'
    ).encode()


def _card(row: Row, project: Path) -> str:
    tone = "poor" if row.state == "failed" else "fair" if row.warnings or row.state == "unfinished" else "good"
    name = escape(row.subject)
    title = f'<a href="{escape(quote(row.report))}">{name}</a>' if row.report else name
    state = row.state
    if row.state != "done":
        state += f" after stage {row.stage}" if row.stage else "" if row.state == "failed" else ", not begun"
    if row.seconds:
        state += f" · {duration(row.seconds)} of computation"
    known = {key.replace("_", " "): value for key, value in row.figures.items() if value is not None}
    facts = [f"<div><dt>{escape(key)}</dt><dd>{value:g}</dd></div>" for key, value in known.items()]
    parts = [f'<h2>{title}</h2><p class="state">{escape(state)}</p>']
    if row.message:
        parts.append(f'<p class="message">{escape(row.message)}</p>')
    parts.append(f'<dl class="figures">{"".join(facts)}</dl>')
    if row.warnings:
        lines = "".join(f"<li><b>{escape(stage)}</b> {escape(text)}</li>" for stage, text in row.warnings)
        count = "1 warning" if len(row.warnings) == 1 else f"{len(row.warnings)} warnings"
        parts.append(f"<details><summary>{count}</summary><ul>{lines}</ul></details>")
    return f'<article class="subject {tone}">{_thumbnail(row, project)}<div>{"".join(parts)}</div></article>'


def _thumbnail(row: Row, project: Path) -> str:
    """The avatar from the front, as its report begins, or else the first upright photo."""
    try:
        if row.report:
            report = (project.parent / row.report).read_text(encoding="utf-8")
            found = re.search(r'src="data:image/jpeg;base64,([^"]+)"', report)
            data = base64.b64decode(found[1]) if found else b""
        else:
            photos = sorted((project / stage_folder_name("capture") / "photos").glob("*.jpg"))
            data = photos[len(photos) // 2].read_bytes()
        rgb = decode_jpeg(data)
    except (OSError, ValueError, IndexError, InputError):
        return '<div class="nothing"></div>'
    height = round(rgb.shape[0] * _THUMB / rgb.shape[1])
    return picture(cv2.resize(rgb, (_THUMB, height), interpolation=cv2.INTER_AREA), row.subject, "", lazy=True)
