"""
Cameras against their truth where the capture misleads: a wrong focal length in EXIF, a head that turns in the room.

python benchmarks/cameras.py CAPTURE TRUTH [--focal 1,0.5,0.25] [--features auto,all]
CAPTURE and TRUTH as `avatarbuild simulate -o CAPTURE` writes them (TRUTH is CAPTURE.truth), or capture_b and truth_b.
--focal multiplies what EXIF says. Prints, for each: photos placed, the focal length against the truth in per cent, the
camera centres' RMSE (mm, after a similarity) as seen from the head, and the warnings of stage cameras.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from avatarbuild.geometry.similarity import similarity
from avatarbuild.options import CamerasOptions, CaptureOptions
from avatarbuild.progress import Silent
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.stages import cameras, capture


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--focal", default="1,0.5")
    parser.add_argument("--features", default="auto")
    a = parser.parse_args()
    told = {Path(p["file"]).stem: p for p in json.loads((a.truth / "cameras.json").read_text())["photos"]}
    taken = capture.run(a.capture, CaptureOptions(), Silent())
    people = [w for w in taken.warnings if w.startswith("other people")]
    print("other people:", people[0] if people else "nobody")
    true_focal = float(np.median([told[name]["K"][0][0] for name in taken.photos.names]))
    print(" focal  features  placed  focal %  centres mm  warnings")
    for factor in (float(v) for v in a.focal.split(",")):
        claimed = replace(taken, photos=replace(taken.photos, focal=taken.photos.focal * factor))
        for features in a.features.split(","):
            found = cameras.run(claimed, CamerasOptions(features=features), Silent())
            placed = placed_photos(found.model, [f"{name}.jpg" for name in taken.photos.names])
            true = [told[taken.photos.names[i]] for i in placed.index]
            centres = np.array([-np.array(p["R"]).T @ p["t"] for p in true])
            s, r, t = similarity(placed.centres, centres)
            rmse = np.sqrt((np.linalg.norm(s * placed.centres @ r.T + t - centres, axis=1) ** 2).mean())
            off = 100 * (found.model.cameras[1].mean_focal_length() / true_focal - 1)
            print(
                f"{factor:6.2f}  {features:8s}  {len(true):6d}  {off:+7.2f}  {rmse:10.2f}  {'; '.join(found.warnings)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
