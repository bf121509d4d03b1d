"""
What contours drawn by hand are worth: the truth's points of lids and lips drawn on the frontal photo, stage neutral run
without and with them, and how far from the truth's points the head's contours then lie in that photo.

python benchmarks/contours.py PROJECT --truth TRUTH --scorer score.py
AVATARBUILD_BENCHMARK=FOLDER stands for --truth FOLDER/truth_b --scorer FOLDER/score.py. Stage points must have run;
nothing is written. Lids have four points each in the truth, lips five to seven.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
from scoring import arguments, load_scorer, scored

from avatarbuild.artefacts import Cameras, Capture, Cloud, Neutral
from avatarbuild.formats.corrections import Corrections
from avatarbuild.options import NeutralOptions
from avatarbuild.progress import Silent
from avatarbuild.registration.drawn import RIMS
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.stages import neutral
from avatarbuild.template import Template
from avatarbuild.texture.photos import Photo, placed_in_head

LINES = {  # of the 68 points
    "lidUpperRight": (36, 37, 38, 39),
    "lidLowerRight": (36, 41, 40, 39),
    "lidUpperLeft": (42, 43, 44, 45),
    "lidLowerLeft": (42, 47, 46, 45),
    "lipsOuterUpper": (48, 49, 50, 51, 52, 53, 54),
    "lipsOuterLower": (48, 59, 58, 57, 56, 55, 54),
    "lipsInnerUpper": (60, 61, 62, 63, 64),
    "lipsInnerLower": (60, 67, 66, 65, 64),
}


def main() -> None:
    a = scored(arguments(__doc__))
    truth, template = load_scorer(a.scorer).GT(str(a.truth)), Template.load()
    capture, cameras = Capture.load(a.project / "01-capture"), Cameras.load(a.project / "02-cameras")
    cloud = Cloud.load(a.project / "03-points")
    name = capture.photos.names[capture.frontal]
    marks, mm = seen(a.truth, name, truth.V[truth.lm])
    told = Corrections(photo={name: {contour: marks[list(line)] for contour, line in LINES.items()}})
    for label, corrections in (("as detected", None), ("drawn", told)):
        made = neutral.run(capture, cameras, cloud, NeutralOptions(), Silent(), template, corrections)
        off = errors(made, capture, cameras, template, marks)
        told_ = ", ".join(f"{contour} {mm * e:.2f}" for contour, e in off.items())
        print(f"{label}: {mm * np.mean(list(off.values())):.2f} mm; {told_}")


def seen(truth: Path, name: str, points: np.ndarray) -> tuple[np.ndarray, float]:
    """Pixels (n, 2) of points (n, 3) in a photo by the true camera, first centre at 0.5, and mm a pixel."""
    camera = next(c for c in json.loads((truth / "cameras.json").read_text())["photos"] if Path(c["file"]).stem == name)
    R, t, K = (np.array(camera[key], float) for key in ("R", "t", "K"))
    pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, K, np.array(camera["dist"]))
    return pixels[:, 0] + 0.5, float((points @ R.T + t)[:, 2].mean() / K[0, 0])


def errors(
    made: Neutral, capture: Capture, cameras: Cameras, template: Template, marks: np.ndarray
) -> dict[str, float]:
    """Pixels: the true points' mean distance from the head's contour in the frontal photo."""
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in capture.photos.names])
    views = placed_in_head(capture.photos, placed, made.head_from_cloud)
    photo: Photo = next(view for view in views if view.photo == capture.frontal)
    out = {}
    for contour, line in LINES.items():
        x = made.vertices[template.contours[RIMS[contour][0]]]
        pixels, _ = cv2.projectPoints(x, cv2.Rodrigues(photo.R)[0], photo.t, photo.K, photo.dist)
        out[contour] = float(to_line(marks[list(line)], pixels[:, 0]).mean())
    return out


def to_line(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """(p,) distances of points (p, 2) from a polyline (q, 2)."""
    start, step = line[:-1], np.diff(line, axis=0)
    share = ((points[:, None] - start) * step).sum(axis=2) / np.maximum((step**2).sum(axis=1), 1e-12)
    at = start + np.clip(share, 0, 1)[..., None] * step
    return np.linalg.norm(points[:, None] - at, axis=2).min(axis=1)


if __name__ == "__main__":
    main()
