"""
Seconds of every stage, and how they grow with photos, frames, texture size or an option.

python benchmarks/stages.py --capture CAPTURE [--until STAGE] [--set stage.option=value]
python benchmarks/stages.py --capture CAPTURE --photos 13,26,52
python benchmarks/stages.py --capture CAPTURE --frames 20,40,80
python benchmarks/stages.py --capture CAPTURE --texels 1024,2048,4096
python benchmarks/stages.py --capture CAPTURE --photos 26 --grow cameras.max_image_size=1200,1800,2400

AVATARBUILD_BENCHMARK=FOLDER stands for FOLDER/capture_b. --photos thins the capture evenly; --frames sets the rate at
which the video is processed, the whole program running for each; --texels is --grow albedo.size. --grow: everything
before the option's stage runs once; then, for each value, a row of that stage and those up to --until (by default that
stage alone). `whole.py` measures one run stage by stage, and scores it.

core-s are processor seconds of the row's run, 3 or so of starting the program included; on a machine that does other
work too they tell more than seconds. Growth is their exponent: log of their ratio over log of the values' ratio.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
from processes import Cost, run
from scoring import benchmark

from avatarbuild.capture_folder import CaptureFolder, open_capture
from avatarbuild.formats.video import open_video
from avatarbuild.pipeline import NAMES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=benchmark("capture_b"))
    parser.add_argument("--photos", default="")
    parser.add_argument("--frames", default="")
    parser.add_argument("--texels", default="")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--grow", default="", metavar="STAGE.OPTION=VALUE,VALUE")
    parser.add_argument("--until", choices=NAMES)
    a = parser.parse_args()
    if a.capture is None:
        parser.error("give --capture, or set AVATARBUILD_BENCHMARK")
    if sum(bool(way) for way in (a.frames, a.texels, a.grow)) > 1:
        parser.error("one of --frames, --texels and --grow at a time")
    found = open_capture(a.capture)
    counts = numbers(a.photos) or [len(found.photos)]
    words = [word for pair in a.set for word in ("--set", pair)]
    option, _, values = (f"albedo.size={a.texels}" if a.texels else a.grow).partition("=")
    grown = option.split(".")[0]
    if grown and grown not in NAMES[1:]:
        parser.error(f"--grow {a.grow}: {grown} is no stage that others come before")
    until = a.until or grown or NAMES[-1]
    heading = "  ".join(f"{stage:>11s}" for stage in NAMES)
    print(f"photos  value   check  {heading}   core-s  growth  peak GB")
    before: tuple[float, float] | None = None
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            capture = thinned(found, count, Path(folder) / "capture")
            before = before if len(counts) > 1 else None
            if grown:
                run(["run", capture, "--until", NAMES[NAMES.index(grown) - 1], *words])
                for value in values.split(","):
                    cost = run(["run", capture, "--until", until, *words, "--set", f"{option}={value}"])
                    before = row(count, value, float("nan"), capture, cost, float(value), before)
            elif a.frames:
                seconds = open_video(found.root / found.videos[0]).duration
                for frames in numbers(a.frames):
                    rate = ["--set", f"capture.frame_rate={frames / seconds:.4f}"]
                    cost = run(["run", capture, "--until", until, *words, *rate])
                    before = row(count, str(frames), float("nan"), capture, cost, frames, before)
            else:
                check = run(["check", capture]).seconds
                cost = run(["run", capture, "--until", until, *words])
                before = row(count, "", check, capture, cost, count, before)


def numbers(text: str) -> list[int]:
    return [int(number) for number in text.split(",")] if text else []


def thinned(found: CaptureFolder, count: int, folder: Path) -> Path:
    """A copy of a capture with fewer photos; neighbours alone would lose the overlap, so they are thinned evenly."""
    chosen = [found.photos[i] for i in np.linspace(0, len(found.photos) - 1, count).round().astype(int)]
    for name in [*chosen, *found.videos]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(found.root / name, folder / name)
    return folder


def row(
    count: int, value: str, check: float, capture: Path, cost: Cost, size: float, before: tuple[float, float] | None
) -> tuple[float, float]:
    """Prints one line of the table; (size, core-seconds) for the next one's growth."""
    growth = np.log(cost.core_seconds / before[1]) / np.log(size / before[0]) if before else float("nan")
    listed = "  ".join(f"{stage_seconds(Path(f'{capture}.avatar'), stage):11.1f}" for stage in NAMES)
    used = f"{cost.core_seconds:7.0f}  {growth:6.2f}  {cost.peak:7.2f}"
    print(f"{count:6d}  {value:>5s}  {check:6.1f}  {listed}  {used}", flush=True)
    return size, cost.core_seconds


def stage_seconds(project: Path, stage: str) -> float:
    stamps = list(project.glob(f"*{stage}/stamp.json"))
    return float(json.loads(stamps[0].read_text())["timing"]["seconds"]) if stamps else float("nan")


if __name__ == "__main__":
    main()
