"""
Runs the program on a capture with ground truth and prints what the scorers say.

python benchmarks/accuracy.py --capture capture_b --truth truth_b --scorer FOLDER [--project P] [--set KEY=VALUE]
FOLDER holds score_cameras.py and score_cloud.py. AVATARBUILD_BENCHMARK=FOLDER stands for FOLDER/capture_b,
FOLDER/truth_b and the scorers in FOLDER.

Also printed: the iris diameter against --iris PIXELS (photo:side:diameter, outlined by hand; several), and the metric
scale with a known length taken from the truth (two points of the true mesh, marked in three photos).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scoring import benchmark

from avatarbuild.artefacts import Cameras, Capture
from avatarbuild.geometry.similarity import similarity
from avatarbuild.sfm import metric

ROOT = Path(__file__).parent.parent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=benchmark("capture_b"))
    parser.add_argument("--truth", type=Path, default=benchmark("truth_b"))
    parser.add_argument("--scorer", type=Path, default=benchmark())
    parser.add_argument("--project", type=Path)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--iris", action="append", default=[], help="PHOTO:right|left:PIXELS")
    a = parser.parse_args()
    if None in (a.capture, a.truth, a.scorer):
        parser.error("give --capture, --truth and --scorer, or set AVATARBUILD_BENCHMARK")
    project = a.project or Path(tempfile.mkdtemp()) / "project"
    words = [word for pair in a.set for word in ("--set", pair)]
    code = subprocess.run([sys.executable, ROOT / "cli.py", "run", a.capture, "-o", project, *words]).returncode
    print(f"run: exit code {code}")
    cameras_truth = a.truth / "cameras.json" if a.truth.is_dir() else a.truth
    score = [sys.executable, a.scorer / "score_cameras.py", "--truth", cameras_truth]
    subprocess.run([*score, "--model", project / "02-cameras" / "sparse"])
    if not a.truth.is_dir() or not (a.truth / "mesh.npz").exists():
        return
    cloud = project / "03-points" / "points.ply"
    subprocess.run([sys.executable, a.scorer / "score_cloud.py", "--gt", a.truth, "--cloud", cloud])
    capture, cameras = Capture.load(project / "01-capture"), Cameras.load(project / "02-cameras")
    print_iris(cameras, a.iris)
    print_known_length(a.truth, capture, cameras)


def print_iris(cameras: Cameras, outlined: list[str]) -> None:
    """The measured iris diameters against outlined ones."""
    found = {(name, side): pixels for name, side, pixels in cameras.scale.get("iris_pixels", [])}
    ratios = []
    for text in outlined:
        name, side, pixels = text.split(":")
        if (name, side) in found:
            ratios.append(found[name, side] / float(pixels))
            print(f"iris {name} {side}: {found[name, side]:.1f} px, outlined {float(pixels):.1f} px")
    if ratios:
        print(f"iris diameter: {100 * (np.mean(ratios) - 1):+.1f} % of {len(ratios)} outlined ones on average")
    print("scale:", json.dumps({k: v for k, v in cameras.scale.items() if k != "iris_pixels"}))


def print_known_length(truth: Path, capture: Capture, cameras: Cameras, noise: float = 0.5) -> None:
    """The scale that a known length would give: the outer eye corners, marked in photos `noise` pixels off."""
    mesh = np.load(truth / "mesh.npz")
    corners = mesh["neutral"][mesh["lm68"][[36, 45]]].astype(float)
    photos = json.loads((truth / "cameras.json").read_text())["photos"]
    by_stem = {Path(p["file"]).stem.lower(): p for p in photos}
    names = [f"{name}.jpg" for name in capture.photos.names]
    placed = metric.placed_photos(cameras.model, names)
    true = [by_stem[capture.photos.names[i].lower()] for i in placed.index]
    centres = np.array([-np.array(p["R"]).T @ np.array(p["t"]) for p in true])
    exact = similarity(placed.centres, centres)[0]
    rng = np.random.default_rng(0)
    frontal = [p for p in range(len(true)) if abs(true[p]["yaw"]) < 30]
    errors = []
    for _ in range(100):
        ends = []
        for p in rng.choice(frontal, 3, replace=False):
            pixels = project(corners, true[p]) + 0.5 + rng.normal(size=(2, 2)) * noise
            ends.append((int(placed.index[p]), pixels[0], pixels[1]))
        found = metric.known_length(placed, ends)
        if found is not None:
            errors.append(np.linalg.norm(corners[0] - corners[1]) / found[0] / exact - 1)
    print(f"scale by a known length ({noise} px of error, 3 photos): RMS error {100 * np.std(errors):.2f} %")
    print(f"scale as built: {100 * (1 / exact - 1):+.2f} % against the truth")


def project(points: np.ndarray, photo: dict) -> np.ndarray:
    """OpenCV's projection of points (n, 3) into a photo of cameras.json."""
    x = points @ np.array(photo["R"]).T + np.array(photo["t"])
    u, v = (x[:, :2] / x[:, 2:]).T
    k1, k2, p1, p2, k3 = photo["dist"]
    r = u**2 + v**2
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    k = np.array(photo["K"])
    u, v = (
        u * radial + 2 * p1 * u * v + p2 * (r + 2 * u**2),
        v * radial + p1 * (r + 2 * v**2) + 2 * p2 * u * v,
    )
    return np.stack([k[0, 0] * u + k[0, 2], k[1, 1] * v + k[1, 2]], axis=1)


if __name__ == "__main__":
    main()
