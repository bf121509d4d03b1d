"""
Seconds of every stage, and how they grow with the number of photos and with an option.

python benchmarks/stages.py --capture CAPTURE [--photos 13,26,52] [--until STAGE] [--set stage.option=value]
python benchmarks/stages.py --capture CAPTURE --photos 26 --grow cameras.max_image_size=1200,1800,2400
AVATARBUILD_BENCHMARK=FOLDER stands for FOLDER/capture_b. --grow: everything before the option's stage runs once; then,
for each value, a row of that stage and those up to --until (by default that stage alone).

core-s are processor seconds of the row's run, 3 or so of starting the program included; on a machine that does other
work too they tell more than seconds. Growth is their exponent: log of their ratio over log of the values' ratio.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from avatarbuild.capture_folder import open_capture
from avatarbuild.pipeline import NAMES

ROOT = Path(__file__).parent.parent
CLI = ROOT / "cli.py"


def main() -> None:
    home = os.environ.get("AVATARBUILD_BENCHMARK")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=Path(home) / "capture_b" if home else None)
    parser.add_argument("--photos", default="")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--grow", default="", metavar="STAGE.OPTION=VALUE,VALUE")
    parser.add_argument("--until", choices=NAMES)
    a = parser.parse_args()
    if a.capture is None:
        parser.error("give --capture, or set AVATARBUILD_BENCHMARK")
    found = open_capture(a.capture)
    counts = [int(n) for n in a.photos.split(",")] if a.photos else [len(found.photos)]
    words = [word for pair in a.set for word in ("--set", pair)]
    option, _, values = a.grow.partition("=")
    grown = option.split(".")[0]
    if grown and grown not in NAMES[1:]:
        parser.error(f"--grow {a.grow}: {grown} is no stage that others come before")
    until = a.until or grown or NAMES[-1]
    print("photos  value   check  " + "  ".join(f"{stage:>11s}" for stage in NAMES) + "   core-s  growth  peak GB")
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            capture = Path(folder) / "capture"
            # a run of neighbours every other way round would lose the overlap: photos are thinned evenly
            chosen = [found.photos[i] for i in np.linspace(0, len(found.photos) - 1, count).round().astype(int)]
            for name in [*chosen, *found.videos]:
                (capture / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(found.root / name, capture / name)
            if not grown:
                check = seconds([CLI, "check", capture])
                used = core_seconds([CLI, "run", capture, "--until", until, *words])
                row(count, "", check, capture, used, float("nan"))
                continue
            core_seconds([CLI, "run", capture, "--until", NAMES[NAMES.index(grown) - 1], *words])
            before: tuple[float, float] | None = None
            for value in values.split(","):
                used = core_seconds([CLI, "run", capture, "--until", until, *words, "--set", f"{option}={value}"])
                growth = np.log(used / before[1]) / np.log(float(value) / before[0]) if before else float("nan")
                before = float(value), used
                row(count, value, float("nan"), capture, used, growth)


def row(count: int, value: str, check: float, capture: Path, used: float, growth: float) -> None:
    """One line of the table; peak memory is the largest of all runs so far."""
    times = [stage_seconds(Path(f"{capture}.avatar"), stage) for stage in NAMES]
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e6
    listed = "  ".join(f"{t:11.1f}" for t in times)
    print(f"{count:6d}  {value:>5s}  {check:6.1f}  {listed}  {used:7.0f}  {growth:6.2f}  {peak:7.2f}", flush=True)


def stage_seconds(project: Path, stage: str) -> float:
    stamps = list(project.glob(f"*{stage}/stamp.json"))
    return float(json.loads(stamps[0].read_text())["timing"]["seconds"]) if stamps else float("nan")


def seconds(words: list) -> float:
    start = time.perf_counter()
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True)
    if done.returncode:
        print(f"{words[1]} ended with {done.returncode}: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
    return time.perf_counter() - start


def core_seconds(words: list) -> float:
    """The processor's seconds of a run of the program, its children's included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds(words)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
