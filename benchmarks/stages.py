"""
Seconds of every stage, and how they grow with the number of photos.

python benchmarks/stages.py --capture CAPTURE [--photos 13,26,52] [--until STAGE] [--set stage.option=value]
AVATARBUILD_BENCHMARK=FOLDER stands for FOLDER/capture_b. For the growth with resolution, give sizes:
--set cameras.max_image_size=1200 --set points.max_image_size=768.
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

ROOT = Path(__file__).parent.parent
STAGES = ("01-capture", "02-cameras", "03-points", "04-neutral", "06-blendshapes", "avatar")


def main() -> None:
    home = os.environ.get("AVATARBUILD_BENCHMARK")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=Path(home) / "capture_b" if home else None)
    parser.add_argument("--photos", default="")
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--until", default="avatar")
    a = parser.parse_args()
    if a.capture is None:
        parser.error("give --capture, or set AVATARBUILD_BENCHMARK")
    found = open_capture(a.capture)
    counts = [int(n) for n in a.photos.split(",")] if a.photos else [len(found.photos)]
    words = ["--until", a.until, *(word for pair in a.set for word in ("--set", pair))]
    print("photos   check  " + "  ".join(f"{stage.split('-')[-1]:>8s}" for stage in STAGES) + "   core-s  peak GB")
    for count in counts:
        with tempfile.TemporaryDirectory() as folder:
            capture = Path(folder) / "capture"
            # a run of neighbours every other way round would lose the overlap: photos are thinned evenly
            chosen = [found.photos[i] for i in np.linspace(0, len(found.photos) - 1, count).round().astype(int)]
            for name in [*chosen, *found.videos]:
                (capture / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(found.root / name, capture / name)
            check = seconds([sys.executable, ROOT / "cli.py", "check", capture])
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            seconds([sys.executable, ROOT / "cli.py", "run", capture, *words])
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            stamps = [Path(f"{capture}.avatar") / stage / "stamp.json" for stage in STAGES]
            times = [json.loads(s.read_text())["timing"]["seconds"] if s.exists() else float("nan") for s in stamps]
            row = "  ".join(f"{t:8.1f}" for t in times)
            print(f"{count:6d}  {check:6.1f}  {row}  {used:7.0f}  {after.ru_maxrss / 1e6:7.2f}", flush=True)


def seconds(command: list) -> float:
    start = time.perf_counter()
    subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
