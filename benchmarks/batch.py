"""
The throughput of a batch: captures a minute by the number of workers, each of one thread.

python benchmarks/batch.py [--captures 8] [--workers 1,2] [--folder FOLDER] [--photos 16] [--width 480]
                           [--seconds 4] [--until STAGE] [--quality draft]

Captures are rendered into FOLDER, where they are not there yet, by `avatarbuild simulate` with seeds from 1; kernels
are compiled by a first run that is not counted. Every number of workers begins with an empty output folder.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from processes import run

from avatarbuild.pipeline import NAMES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=8)
    parser.add_argument("--workers", default="1,2")
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--photos", type=int, default=16)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--until", choices=NAMES, default=NAMES[-1])
    parser.add_argument("--quality", default="draft")
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = a.folder or Path(temporary)
        captures, words = folder / "captures", ["--quality", a.quality, "--until", a.until]
        for seed in range(1, a.captures + 1):
            rendered(captures / f"seed{seed}", seed, a.photos, a.width, a.seconds)
        run(["run", captures / "seed1", "-o", folder / "first.avatar", *words])
        print("workers  seconds  captures/min  core-s  peak GB  times the first", flush=True)
        first = 0.0
        for workers in [int(number) for number in a.workers.split(",")]:
            output = folder / f"out{workers}"
            shutil.rmtree(output, ignore_errors=True)
            means = ["--workers", workers, "--threads", 1, "--memory", 4]
            cost = run(["batch", captures, "-o", output, *means, *words])
            rate = 60 * a.captures / cost.seconds
            first = first or rate
            print(
                f"{workers:7d}  {cost.seconds:7.0f}  {rate:12.2f}  {cost.core_seconds:6.0f}  {cost.peak:7.2f}  "
                f"{rate / first:15.2f}",
                flush=True,
            )


def rendered(place: Path, seed: int, photos: int, width: int, seconds: float) -> None:
    """A simulated capture; its truth goes beside the captures."""
    if place.is_dir():
        return
    size = {"photos": photos, "photo_width": width, "video_seconds": seconds, "video_width": 360, "texture": 1024}
    words = [word for name, value in size.items() for word in ("--set", f"{name}={value}")]
    place.parent.mkdir(parents=True, exist_ok=True)
    partial = place.parent / f".{place.name}"
    shutil.rmtree(partial, ignore_errors=True)
    truth = place.parent.parent / f"{place.name}.truth"
    shutil.rmtree(truth, ignore_errors=True)
    cost = run(["simulate", "-o", partial, "--seed", seed, "--truth", truth, *words])
    if cost.code == 0:
        partial.rename(place)


if __name__ == "__main__":
    main()
