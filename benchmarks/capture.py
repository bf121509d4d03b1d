"""
Landmarks, head pose and the capture doctor against the truth of a rendered capture.

AVATARBUILD_BENCHMARK=FOLDER python benchmarks/capture.py [landmarks] [frames] [time] [silent]

FOLDER holds capture_b (photos, video) and truth_b (cameras.json, video.npz). Without a word: all four.
landmarks  found and trusted photos by yaw; yaw, pitch and roll against the cameras; the iris in millimetres
frames     68 landmarks of video frames against the truth, after each point's constant offset
time       seconds of `check` and of stage capture, and what `check` says
silent     expression scores that no arrangement of the points raises
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from scoring import benchmark

from avatarbuild import doctor, landmarks
from avatarbuild.faces import look
from avatarbuild.formats.images import read_photo
from avatarbuild.formats.video import decode_frames
from avatarbuild.geometry.head_pose import head_angles
from avatarbuild.options import CaptureOptions
from avatarbuild.progress import Silent
from avatarbuild.stages import capture
from avatarbuild.template import ARKIT_NAMES

# the 51 inner points of the usual 68 among the 478
INNER = [
    *(70, 63, 105, 66, 107, 336, 296, 334, 293, 300, 168, 197, 5, 4, 75, 97, 2, 326, 305, 33, 160, 158, 133, 153),
    *(144, 362, 385, 387, 263, 373, 380, 61, 39, 37, 0, 267, 269, 291, 405, 314, 17, 84, 181, 78, 82, 13, 312, 308),
    *(317, 14, 87),
]


def main() -> None:
    root = benchmark()
    if root is None:
        sys.exit("set AVATARBUILD_BENCHMARK")
    asked = sys.argv[1:] or ["landmarks", "frames", "time", "silent"]
    for name in asked:
        print(f"== {name}")
        {"landmarks": photos, "frames": frames, "time": times, "silent": silent}[name](root)


def photos(root: Path) -> None:
    """Yaw here is the truth's, in the head's own axes, so that a constant offset of pitch is a matter of definition."""
    rows, iris = [], []
    for view in json.loads((root / "truth_b" / "cameras.json").read_text())["photos"]:
        rgb = read_photo(root / "capture_b" / "photos" / view["file"]).rgb
        rotation, shift = np.array(view["R"]), np.array(view["t"])
        true = head_angles(rotation, shift)
        found = look(rgb, 0.9).faces
        seen = found[0] if found else None
        pose = np.full(3, np.nan) if seen is None else seen.pose
        rows.append(np.r_[true, pose, np.nan if seen is None else seen.face.presence])
        if seen is not None and seen.face.presence > 0.9 and abs(true[0]) < 40:
            for part, x in ((landmarks.IRIS_LEFT, 31.0), (landmarks.IRIS_RIGHT, -31.0)):
                rim = seen.face.points[part, :2]
                depth = (rotation @ (x, 0.0, 10.0) + shift)[2]  # an iris lies about there in every adult's head
                across = np.linalg.norm(rim[1] - rim[3])
                iris.append(across * depth / view["K"][0][0])
    values = np.array(rows)
    off = values[:, 3:6] - values[:, :3]
    pitch_offset = np.nanmedian(off[(np.abs(values[:, 0]) < 60) & (values[:, 6] > 0.9), 1])
    off[:, 1] -= pitch_offset
    print(f"pitch offset {pitch_offset:.1f} degrees")
    print("yaw        photos  found  presence > 0.9  RMS error of yaw  pitch  roll (degrees)")
    for low, high in ((0, 30), (30, 45), (45, 60), (60, 75), (75, 95)):
        here = (np.abs(values[:, 0]) >= low) & (np.abs(values[:, 0]) < high)
        sure = here & (values[:, 6] > 0.9)
        rms = np.sqrt(np.mean(off[sure] ** 2, axis=0)) if sure.any() else np.full(3, np.nan)
        found_here = int(np.isfinite(values[here, 6]).sum())
        print(
            f"{low:2d}-{high:2d}      {here.sum():6d} {found_here:6d} {sure.sum():15d} "
            f"{rms[0]:17.1f} {rms[1]:6.1f} {rms[2]:5.1f}"
        )
    width = np.array(iris)
    print(f"iris {np.median(width):.2f} mm, standard deviation {width.std():.2f} over {len(width)} eyes (yaw under 40)")


def frames(root: Path) -> None:
    with np.load(root / "truth_b" / "video.npz") as truth:
        true = truth["landmarks68"][:, 17:] + 0.5
        visible = truth["landmarks68_visible"][:, 17:]
    (film,) = sorted((root / "capture_b" / "video").iterdir())
    chosen = list(range(0, len(true), 10))
    off = np.full((len(chosen), len(INNER), 2), np.nan)
    for i, (index, _, rgb) in enumerate(decode_frames(film, chosen)):
        found = look(rgb, 0.9).faces
        if found:
            eyes = np.linalg.norm(true[index, 19] - true[index, 28])
            off[i] = 100 * (found[0].face.points[INNER, :2] - true[index]) / eyes
    missed = int(np.isnan(off[:, 0, 0]).sum())
    offset = np.nanmedian(off, axis=0)
    left = np.linalg.norm(off - offset, axis=2)[visible[chosen]]
    raw = np.linalg.norm(off, axis=2)[visible[chosen]]
    print(f"{len(chosen) - missed} of {len(chosen)} frames found")
    print(f"per cent of the outer eye corners' distance, as defined: median {np.nanmedian(raw):.2f}")
    print(f"after each point's constant offset: median {np.nanmedian(left):.2f}, p90 {np.nanpercentile(left, 90):.2f}")


def times(root: Path) -> None:
    source = root / "capture_b"
    start, busy = time.perf_counter(), time.process_time()
    checkup = doctor.examine(source, Silent())
    print(f"check: {time.perf_counter() - start:.1f} s, processor {time.process_time() - busy:.1f} s")
    Console(width=160).print(doctor.table(checkup))
    start, busy = time.perf_counter(), time.process_time()
    made = capture.run(source, CaptureOptions(), Silent())
    print(f"stage capture: {time.perf_counter() - start:.1f} s, processor {time.process_time() - busy:.1f} s")
    print(made.figures)
    for warning in made.warnings:
        print("-", warning)


def silent(root: Path) -> None:
    """Scores of real points, exaggerated, mixed and bent by smooth random fields: what never rises is silent."""
    (film,) = sorted((root / "capture_b" / "video").iterdir())
    real = []
    for _, _, rgb in decode_frames(film, range(0, 390, 30)):
        points = look(rgb, 0.9).faces[0].face.points
        region = landmarks.region_about(points)
        real.append((points[:, :2] - region.centre) / region.side)
    shapes = np.array(real)
    mean = shapes.mean(0)
    random = np.random.default_rng(0)
    most = np.zeros(len(ARKIT_NAMES))
    for _ in range(4000):
        i, j = random.integers(0, len(shapes), 2)
        bent = mean + random.uniform(0, 3) * (shapes[i] - mean) + random.uniform(0, 2) * (shapes[j] - mean)
        centres = random.uniform(-0.35, 0.35, (6, 2))
        bumps = np.exp(-((bent[:, None] - centres) ** 2).sum(2) / (2 * 0.08**2))
        bent = bent + bumps @ random.normal(0, 0.03, (6, 2))
        most = np.fmax(most, landmarks._scores(np.c_[bent * 500, np.zeros(len(bent))]))
    for k in np.argsort(most)[:12]:
        print(f"{ARKIT_NAMES[k]:20s} at most {most[k]:.3f}")


if __name__ == "__main__":
    main()
