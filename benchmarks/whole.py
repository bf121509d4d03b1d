"""
The whole program on one capture: what every stage costs, and how good the avatar is where the truth is known.

python benchmarks/whole.py --capture CAPTURE [--truth TRUTH --scorer SCORE.py] [--set stage.option=value]
                           [--project PROJECT] [--quality standard] [--no-append]

AVATARBUILD_BENCHMARK=FOLDER stands for FOLDER/capture_b, FOLDER/truth_b and FOLDER/score.py. Each stage is a run of its
own (`run --until`), so that its processor seconds and its memory can be told: about 3 core-seconds of each are the
program's start, and its seconds are those of its stamp. The scorer is called as `SCORE.py --gt TRUTH --glb … --track …
--albedo … --normals … --json …`; normals are those of the frames for which TRUTH has some. A section is appended to
docs/performance.md unless --no-append says otherwise.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from processes import CLI, Cost, run
from scoring import benchmark
from stages import stage_seconds

from avatarbuild.pipeline import NAMES

PAPER = {
    "cameras": "30–40 min with points",
    "neutral": "about 10 s for the thin shell",
    "albedo": "about 5 min for the light alone",
    "tracking": "60 s a processed frame",
    "refinement": "5 s a frame, then 60 s",
    "details": "30 s a frame",
}
WHOLE = "5–6 hours"  # the paper's, all in
# scores that are asked for: name in the scorer's answer -> what it is, the bar
WANTED = {
    "neutral_mm.median": "0.30",
    "neutral_mm.mean": "0.40",
    "neutral_mm.p90": "0.90",
    "expression_mm_rigid_per_frame.mean": "0.50",
    "expression_mm_rigid_per_frame.p90": "1.0",
    "posed_mm_one_similarity_per_sequence.mean": "1.0",
    "corresponding_points_mm.tracked": "0.95",
    "landmark_reprojection_px.mean": "2.5",
    "weights.median_corr": "at least 0.75",
    "albedo.rel_err_mean": "0.12",
    "albedo.baked_shading_std_log": "0.06",
    "albedo.detail_corr": "at least 0.70",
    "normals_deg.mean": "6.0",
    "normals_deg.wrinkle": "11",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=benchmark("capture_b"))
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--scorer", type=Path, default=benchmark("score.py"))
    parser.add_argument("--project", type=Path, help="kept; by default a temporary folder")
    parser.add_argument("--quality", default="standard")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--until", choices=NAMES, default=NAMES[-1])
    parser.add_argument("--no-append", action="store_true")
    a = parser.parse_args()
    if a.capture is None:
        parser.error("give --capture, or set AVATARBUILD_BENCHMARK")
    if a.truth is None and a.capture == benchmark("capture_b"):
        a.truth = benchmark("truth_b")
    with tempfile.TemporaryDirectory() as folder:
        project = a.project or Path(folder) / "whole.avatar"
        words = ["-o", project, "--quality", a.quality, *(word for pair in a.set for word in ("--set", pair))]
        frames = sorted(int(path.stem.split("_")[1]) for path in a.truth.glob("normals_*.npz")) if a.truth else []
        if frames and a.until == NAMES[-1]:
            words += ["--set", f"details.save_frames={','.join(map(str, frames))}"]
        lines = costs(a.capture, project, words, a.until)
        if a.truth and a.scorer and a.until == NAMES[-1]:
            lines += scores(project, a.truth, a.scorer, bool(frames), Path(folder) / "scores.json")
    command = " ".join(["python benchmarks/whole.py", f"--capture {a.capture.name}", f"--quality {a.quality}"])
    text = "\n".join([f"## A whole run: {a.capture.name}", "", f"`{command}`, {os.cpu_count()} cores.", "", *lines, ""])
    print(text)
    if not a.no_append:
        with (CLI.parent / "docs" / "performance.md").open("a", encoding="utf-8") as file:
            file.write("\n" + text)


def costs(capture: Path, project: Path, words: list, until: str) -> list[str]:
    """A row for every stage and one for the whole."""
    lines = ["| stage | seconds | core-seconds | peak GB | the paper |", "|---|---|---|---|---|"]
    all_: list[Cost] = []
    total = 0.0
    for stage in NAMES[: NAMES.index(until) + 1]:
        cost = run(["run", capture, "--until", stage, *words])
        if cost.code:
            sys.exit(cost.code)
        all_.append(cost)
        seconds = stage_seconds(project, stage)
        total += seconds
        lines.append(
            f"| {stage} | {seconds:.0f} | {cost.core_seconds:.0f} | {cost.peak:.1f} | {PAPER.get(stage, '')} |"
        )
        print(lines[-1], file=sys.stderr, flush=True)
    used, peak = sum(cost.core_seconds for cost in all_), max(cost.peak for cost in all_)
    lines.append(f"| all | {total:.0f} | {used:.0f} | {peak:.1f} | {WHOLE} |")
    return lines


def scores(project: Path, truth: Path, scorer: Path, normals: bool, answer: Path) -> list[str]:
    """The scorer's numbers; those that are asked for with their bars. The paper states none in millimetres."""
    avatar = project / "avatar"
    words = ["--gt", truth, "--glb", avatar / "avatar.glb", "--albedo", avatar / "albedo.png", "--json", answer]
    words += ["--track", avatar / "track.json"] if (avatar / "track.json").is_file() else []
    words += ["--normals", project / "09-details" / "frames"] if normals else []
    done = subprocess.run([sys.executable, str(scorer), *map(str, words)], capture_output=True, text=True)
    if not answer.is_file():
        return ["", f"The scorer failed: {done.stderr.strip().splitlines()[-1:]}"]
    lines = ["", "| score | measured | wanted |", "|---|---|---|"]
    for name, value in leaves(json.loads(answer.read_text())):
        lines.append(f"| {name} | {value:.4g} | {WANTED.get(name, '')} |")
    return lines


def leaves(value: Any, name: str = "") -> list[tuple[str, float]]:
    """(dotted name, number) of nested answers; names that begin with _ are details."""
    if isinstance(value, dict):
        inner = [(f"{name}.{key}" if name else key, one) for key, one in value.items() if not key.startswith("_")]
        return [leaf for key, one in inner for leaf in leaves(one, key)]
    return [(name, float(value))] if isinstance(value, int | float) and not isinstance(value, bool) else []


if __name__ == "__main__":
    main()
