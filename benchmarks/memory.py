"""
The largest memory of every stage on a large simulated capture: 80 photos of 8 megapixels, 180 frames of 1080p.

python benchmarks/memory.py [--folder FOLDER] [--photos 80] [--width 2448] [--frames 180] [--video-width 1080]
                            [--until STAGE] [--set stage.option=value]

The capture is rendered into FOLDER, where it is not there yet, at three frames a second, without supersampling (about
7 core-minutes), and its project is kept there: a second call goes on where the first was stopped.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from processes import run
from whole import costs

from avatarbuild.pipeline import NAMES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--photos", type=int, default=80)
    parser.add_argument("--width", type=int, default=2448)
    parser.add_argument("--frames", type=int, default=180)
    parser.add_argument("--video-width", type=int, default=1080)
    parser.add_argument("--until", choices=NAMES, default=NAMES[-1])
    parser.add_argument("--set", action="append", default=[])
    a = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = a.folder or Path(temporary)
        capture = folder / "large"
        if not capture.is_dir():
            size = {"photos": a.photos, "photo_width": a.width, "video_width": a.video_width, "supersampling": 1}
            size |= {"video_fps": 3, "video_seconds": a.frames / 3}
            words = [word for name, value in size.items() for word in ("--set", f"{name}={value}")]
            cost = run(["simulate", "-o", capture, "--seed", "9", *words])
            print(f"rendered in {cost.seconds:.0f} s")
        options = [word for pair in a.set for word in ("--set", pair)]
        print("\n".join(costs(capture, folder / "large.avatar", ["-o", folder / "large.avatar", *options], a.until)))


if __name__ == "__main__":
    main()
