"""
What dense stereo costs: seconds, core-seconds and memory of stage points by number of photos and by resolution.

  python benchmarks/points.py PROJECT [--photos 13 26 52] [--sizes 576 768 1152 1600] [--out FOLDER]

PROJECT has its stages capture and cameras done. Other sizes than the standard one are measured with the largest of the
numbers of photos (without a number: all of them). With --out the clouds are kept as FOLDER/<photos>-<size>/points.ply,
for a scorer. Run it on an idle machine; the first run also compiles the kernels, so a small one goes before.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
import zlib  # noqa: F401 before pycolmap, see avatarbuild/__init__.py
from pathlib import Path

import pycolmap

from avatarbuild.artefacts import Cameras, Capture
from avatarbuild.options import PointsOptions
from avatarbuild.progress import Silent
from avatarbuild.stages import points


def fewer(cameras: Cameras, folder: Path, count: int) -> Cameras:
    """The cameras of `count` photos spread evenly over the placed ones."""
    model = pycolmap.Reconstruction(str(folder / "sparse"))
    names = sorted(model.images[i].name for i in model.reg_image_ids())
    kept = {names[round(i * (len(names) - 1) / max(count - 1, 1))] for i in range(min(count, len(names)))}
    for i in list(model.reg_image_ids()):
        if model.images[i].name not in kept:
            model.deregister_frame(model.images[i].frame_id)
    return Cameras(model, cameras.metric, cameras.scale)


def measure(capture: Capture, cameras: Cameras, size: int, out: Path | None) -> str:
    """One row of the table."""
    wall, cores = time.perf_counter(), time.process_time()
    cloud = points.run(capture, cameras, PointsOptions(max_image_size=size), Silent())
    wall, cores = time.perf_counter() - wall, time.process_time() - cores
    count = cameras.model.num_reg_images()
    if out is not None:
        cloud.save(out / f"{count}-{size}")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return f"{count:6d} {size:6d} {wall:8.1f} {cores:8.1f} {cores / count:10.2f} {len(cloud.points):9d} {peak:8.2f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("--photos", type=int, nargs="*", default=[13, 26, 52])
    parser.add_argument("--sizes", type=int, nargs="*", default=[576, 768, 1152, 1600])
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    capture, folder = Capture.load(given.project / "01-capture"), given.project / "02-cameras"
    cameras = Cameras.load(folder)
    standard = PointsOptions().max_image_size
    points.run(capture, fewer(cameras, folder, 8), PointsOptions(max_image_size=320), Silent())
    print("photos   size  seconds  core-s  core-s/photo    points  peak GiB (of the process so far)")
    for count in given.photos:
        print(measure(capture, fewer(cameras, folder, count), standard, given.out), flush=True)
    most = fewer(cameras, folder, max(given.photos, default=cameras.model.num_reg_images()))
    for size in given.sizes:
        if size != standard:
            print(measure(capture, most, size, given.out), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
