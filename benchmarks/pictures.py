"""
The documentation's pictures of a person: what the program makes (README) and how to record (capture guide).

python benchmarks/pictures.py PROJECT [--folder docs/images]

PROJECT is a finished one, of the repository's example capture for the pictures that are shipped. What the guide shows
is the avatar, drawn as photos would show it: from each side of the sweep, and as photos should not be.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from avatarbuild import artefacts
from avatarbuild.animation import clip, picture
from avatarbuild.animation.picture import exposed, frame, model
from avatarbuild.formats.images import decode_jpeg, encode_jpeg
from avatarbuild.project import Project
from avatarbuild.report import heads
from avatarbuild.report.rendering import View, draw
from avatarbuild.report.shading import Light
from avatarbuild.template import expression_weights

SIZE = (300, 380)
SMILE = {
    "mouthSmileLeft": 0.8,
    "mouthSmileRight": 0.8,
    "cheekSquintLeft": 0.5,
    "cheekSquintRight": 0.5,
    "jawOpen": 0.12,
}
FROWN = {"browDownLeft": 1.0, "browDownRight": 1.0, "mouthFrownLeft": 0.5, "mouthFrownRight": 0.5, "noseSneerLeft": 0.3}
KISS = {"mouthPucker": 0.8, "browInnerUp": 0.9, "browOuterUpLeft": 0.8, "browOuterUpRight": 0.8}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("project", type=Path)
    parser.add_argument("--folder", type=Path, default=Path(__file__).parent.parent / "docs" / "images")
    a = parser.parse_args()
    project = Project(a.project)
    template = project.template().load()
    albedo = project.read("albedo", artefacts.Albedo)
    rig = clip.rig_of(project)
    figure = heads.figure(rig, albedo.albedo, template, 1)
    write(
        a.folder / "avatar.jpg",
        made(project, model(template, rig, albedo, clip.own_details(project, template)), albedo),
    )
    write(a.folder / "guide-sweep.jpg", sweep(figure))
    write(a.folder / "guide-faults.jpg", faults(figure))


def made(project: Project, drawn: picture.Model, albedo: artefacts.Albedo) -> np.ndarray:
    """A photo of the capture, and the avatar: from the left, smiling, frowning, with pursed lips."""
    capture = project.read("capture", artefacts.Capture)
    name = capture.photos.names[capture.frontal]
    photo = decode_jpeg((project.folder("capture") / "photos" / f"{name}.jpg").read_bytes())
    views = [({}, 38.0), (SMILE, -18.0), (FROWN, 0.0), (KISS, 20.0)]
    light = exposed(albedo.harmonics)
    panels = [filled(photo, SIZE)]
    for weights, yaw in views:
        view = View(size=SIZE, height=300.0, centre=(0.0, -15.0, -20.0), yaw=yaw)
        panels.append(frame(drawn, expression_weights(**weights), np.eye(3), view, light))
    return np.concatenate(panels, axis=1)


def sweep(figure: heads.Figure) -> np.ndarray:
    """From ear to ear in the middle row, fewer from above and from below."""
    small = (150, 190)

    def row(pitch: float, yaws: range) -> list[np.ndarray]:
        shown = {yaw: View(yaw=-yaw, pitch=pitch, size=small, height=330.0, centre=(0.0, -15.0, -30.0)) for yaw in yaws}
        return [figure.picture({}, view) for view in shown.values()]

    empty = [np.full((small[1], small[0], 3), 255, np.uint8)]
    rows = (
        [*2 * empty, *row(22, range(-60, 61, 30)), *2 * empty],
        row(0, range(-88, 89, 22)),
        [*3 * empty, *row(-18, range(-40, 41, 40)), *3 * empty],
    )
    return np.concatenate([np.concatenate(one, axis=1) for one in rows])


def faults(figure: heads.Figure) -> np.ndarray:
    """Right; too far; cut off; from one side only; blurred; another expression."""
    right = View(size=SIZE, height=420.0, centre=(0.0, -15.0, -20.0))
    plain = figure.picture({}, right)
    side = Light(direction=(-1.0, -0.1, -0.15), lamp=1.5, above=0.05, below=0.03, wrap=0.0)
    kernel = np.zeros((25, 25), np.float32)
    cv2.line(kernel, (2, 16), (22, 8), 1.0, 1, cv2.LINE_AA)
    panels = [
        plain,
        figure.picture({}, right._replace(height=1250.0)),
        figure.picture({}, right._replace(height=150.0, centre=(40.0, 20.0, -20.0))),
        draw(figure.posed({}), figure.triangles, figure.paint, right, light=side),
        cv2.filter2D(plain, -1, kernel / kernel.sum()),
        figure.picture(SMILE | {"jawOpen": 0.4}, right),
    ]
    marks = ["", *5 * ["x"]]
    return np.concatenate([marked(panel, bool(mark)) for panel, mark in zip(panels, marks)], axis=1)


def marked(panel: np.ndarray, wrong: bool) -> np.ndarray:
    """A green tick or a red cross in the corner."""
    out = panel.copy()
    colour = (200, 50, 40) if wrong else (40, 140, 70)
    lines = [((20, 20), (50, 50)), ((50, 20), (20, 50))] if wrong else [((18, 36), (30, 50)), ((30, 50), (54, 20))]
    for a, b in lines:
        cv2.line(out, a, b, colour, 7, cv2.LINE_AA)
    return out


def filled(photo: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The middle of a photo in the shape that is asked for."""
    h, w = photo.shape[:2]
    width = min(w, round(h * size[0] / size[1]))
    height = round(width * size[1] / size[0])
    x, y = (w - width) // 2, (h - height) // 2
    return cv2.resize(photo[y : y + height, x : x + width], size, interpolation=cv2.INTER_AREA)


def write(path: Path, rgb: np.ndarray) -> None:
    path.write_bytes(encode_jpeg(np.ascontiguousarray(rgb), 86))


if __name__ == "__main__":
    main()
