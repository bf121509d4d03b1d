"""The capture doctor: in seconds, what a capture lacks, before hours of work are spent on it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.markup import escape
from rich.table import Table

from avatarbuild import coverage
from avatarbuild.capture_folder import CaptureFolder, open_capture
from avatarbuild.faces import Look, look
from avatarbuild.formats import video
from avatarbuild.judgement import GOOD, MIN_PHOTOS, RESHOOT, USABLE, Finding, has_face, judge
from avatarbuild.options import CaptureOptions
from avatarbuild.parallel import in_order
from avatarbuild.progress import Progress
from avatarbuild.survey import FURTHER, Survey, choose_video, read_photos, survey_frames, survey_photos

_PHOTO_PIXELS = 3.2e6  # photos are looked at in this size, half of 12 megapixels; blur of 0.1 mm still shows
_KEY_GAP = 1.5  # s: keyframes nearer than this sample a video well, and cost least
_SAMPLES = 120  # frames of the video that are looked at, at most
_RATE = 2.0  # Hz, where keyframes are too rare

_COLOURS = {GOOD: "green", USABLE: "yellow", RESHOOT: "red"}


@dataclass(frozen=True)
class Checkup:
    """
    findings  the check's lines, in order
    verdict   the worst that stands in the way of a run: 're-shoot' if it would refuse or make no avatar
    picture   PNG: yaw and pitch of the photos that show a face, and where views are lacking
    """

    source: Path
    findings: list[Finding]
    verdict: str
    picture: bytes

    def as_json(self) -> dict[str, Any]:
        """docs/schemas/check.schema.json."""
        lines = [
            {"name": f.name, "found": f.found, "verdict": f.verdict, "advice": f.advice, "values": f.values}
            for f in self.findings
        ]
        return {"version": 1, "capture": str(self.source), "verdict": self.verdict, "lines": lines}


def examine(source: Path, progress: Progress) -> Checkup:
    """
    Checks a capture folder.

    Raises InputError if it is no readable folder or capture.toml is faulty; all else is a finding.
    """
    options = CaptureOptions()
    folder = open_capture(source)
    with progress.task("photos", len(folder.photos)) as task:
        shots, faults = read_photos(folder, _PHOTO_PIXELS, options.presence, None, task)
    findings = _files(folder, faults)
    if not shots:
        findings.append(
            Finding("photos", "none", RESHOOT, "take 50 to 80 in a slow sweep about the head", {"count": 0})
        )
        return Checkup(source, findings, RESHOOT, coverage.draw(None, options.max_yaw))
    photos = survey_photos(shots, options.presence, folder.settings)
    frames, seconds, warnings = _sampled(folder, photos, options, progress)
    findings += judge(photos, frames, seconds, folder, options.presence, options.max_yaw)
    if warnings:
        findings.append(Finding("videos", "; ".join(warnings), USABLE, "name the video in capture.toml", {}))
    stops = len(shots) < MIN_PHOTOS or not has_face(photos, options.presence, options.max_yaw) or bool(folder.subjects)
    worst = RESHOOT if stops else max((f.verdict for f in findings), key=[GOOD, USABLE, RESHOOT].index)
    return Checkup(source, findings, worst, coverage.draw(photos, options.max_yaw))


def table(checkup: Checkup) -> Table:
    """The findings for a terminal."""
    shown = Table(title=escape(f"{checkup.source}: {checkup.verdict}"), title_justify="left", show_lines=False)
    for name in ("what", "found", "verdict", "what to do"):
        shown.add_column(name, overflow="fold")
    for f in checkup.findings:
        shown.add_row(f.name, escape(f.found), f"[{_COLOURS[f.verdict]}]{f.verdict}[/]", escape(f.advice))
    return shown


def _files(folder: CaptureFolder, faults: list[tuple[Path, str]]) -> list[Finding]:
    """Findings about the folder itself."""
    findings = []
    if folder.subjects:
        found = f"{len(folder.subjects)} captures: {', '.join(folder.subjects)}"
        values = {"subjects": folder.subjects}
        findings.append(Finding("subjects", found, RESHOOT, "check and run each of these folders by itself", values))
    troubles = [*(why for _, why in faults), *folder.warnings]
    if troubles:
        more = f" and {len(troubles) - 3} more" if len(troubles) > 3 else ""
        values = {"files": [file.as_posix() for file, _ in faults]}
        advice = "copy them from the phone again, or remove them"
        findings.append(Finding("unreadable", "; ".join(troubles[:3]) + more, USABLE, advice, values))
    return findings


def _sampled(
    folder: CaptureFolder, photos: Survey, options: CaptureOptions, progress: Progress
) -> tuple[Survey | None, float, list[str]]:
    """A survey of some frames of the video, its length in seconds, and warnings."""
    chosen, warnings = choose_video(folder, options.presence, photos.identity)
    if chosen is None:
        return None, 0.0, warnings
    times = video.frame_times(chosen.path)
    indices = _samples(chosen.path, times)
    looks, kept = [], []
    with progress.task("video", len(indices)) as task:
        frames = enumerate((i, rgb) for i, _, rgb in video.decode_frames(chosen.path, indices))

        def glance(item: tuple[int, tuple[int, np.ndarray]]) -> tuple[int, Look]:
            number, (index, rgb) = item
            return index, look(_smaller(rgb), options.presence, careful=False, further=number % FURTHER == 0)

        for index, seen in in_order(glance, frames):
            task.advance()
            kept.append(index)
            looks.append(seen)
    file = chosen.path.relative_to(folder.root)
    known = photos.identity
    survey = survey_frames(file, kept, times[kept], looks, [b""] * len(kept), known, np.nan, options.presence)
    return survey, float(times[-1]), warnings


def _samples(path: Path, times: np.ndarray) -> list[int]:
    """Keyframes where there are enough, else frames at 2 Hz; at most 120, evenly."""
    keys = video.keyframes(path)
    gaps = np.diff(np.r_[times[keys], times[-1]])
    if len(keys) < 2 or gaps.max() > _KEY_GAP:
        keys = np.unique(np.searchsorted(times, np.arange(0.0, times[-1] + 1e-9, 1.0 / _RATE)).clip(0, len(times) - 1))
    if len(keys) > _SAMPLES:
        keys = keys[np.linspace(0, len(keys) - 1, _SAMPLES).round().astype(int)]
    return [int(i) for i in keys]


def _smaller(rgb: np.ndarray) -> np.ndarray:
    scale = float(np.sqrt(_PHOTO_PIXELS / (rgb.shape[0] * rgb.shape[1])))
    return rgb if scale >= 1 else cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
