"""
How well eyeballs, lids, teeth and the iris's colour come out, against ground truth.

python benchmarks/eyes.py PROJECT TRUTH [PROJECT TRUTH ...]

PROJECT holds the stages capture, cameras and, if it has been run, neutral; TRUTH the mesh.npz, cameras.json and
albedo_face.png that `avatarbuild simulate` writes. Two lines a project: "true skin": the true neutral with smooth noise
of 0.3 mm in place of a registered one (only where the truth has the template's vertices); "neutral": as the stage left
it. Errors of centres in mm along the head's axes, the scale between capture and truth taken out.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np

from avatarbuild.artefacts import Cameras, Capture, Neutral
from avatarbuild.formats.colour import decode_srgb
from avatarbuild.geometry.similarity import similarity
from avatarbuild.registration.eye_painting import eye_map
from avatarbuild.registration.eyes import eyeballs
from avatarbuild.registration.inner_parts import inner_parts
from avatarbuild.registration.iris_sightings import Photos
from avatarbuild.registration.iris_texture import eye_texture
from avatarbuild.registration.lids import lid_fit, settle_lids
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.simulation.chart import softened
from avatarbuild.template import EYE_PARTS, Template

NOISE = 0.3  # mm
ICT_EYES = ((21451, 23021), (23021, 24591))  # vertices of the eyeballs in ICT-FaceKit's mesh, left and right
IRIS, WHITE = (2.4, 5.0), (7.0, 9.0)  # mm from the gaze's axis, where colours are compared


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", type=Path, nargs="+")
    paths = parser.parse_args().paths
    if len(paths) % 2:
        parser.error("give a TRUTH for every PROJECT")
    template = Template.load()
    for project, truth in zip(paths[::2], paths[1::2]):
        compare(project, truth, template)


def compare(project: Path, truth: Path, template: Template) -> None:
    """The lines of one project."""
    capture, cameras = Capture.load(project / "01-capture"), Cameras.load(project / "02-cameras")
    views = capture.photos
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in views.names])
    told = {Path(p["file"]).stem.lower(): p for p in json.loads((truth / "cameras.json").read_text())["photos"]}
    own = [told[Path(views.files[i]).stem.lower()] for i in placed.index]
    at = np.array([-np.array(p["R"]).T @ np.array(p["t"]) for p in own])
    scale, turn, shift = similarity(at, placed.centres)  # cloud from truth
    centres, radius = true_eyes(truth, template)
    known = true_head(truth)
    head = None if known is None else known[0]
    trusted = views.trusted(0.9, 60)
    photos = Photos(
        placed, views.landmarks, trusted, views.pose[:, 0], views.sharpness, lambda i: views.images[i].rgb()
    )

    def say(name: str, found: np.ndarray, size: float, rest: str) -> None:
        off = (found - shift) @ turn / scale - centres
        print(
            f"{project.name} {name}: radius {100 * (size / scale / radius - 1):+.1f} %, centres left {off[0].round(2)}"
            f" ({np.linalg.norm(off[0]):.2f}), right {off[1].round(2)} ({np.linalg.norm(off[1]):.2f}); {rest}"
        )

    if head is not None:
        rng = np.random.default_rng(0)
        noise = np.stack([softened(template, rng.standard_normal(len(head)), 6) for _ in range(3)], axis=1)
        skin = scale * head @ turn.T + shift + NOISE * noise / noise.std()
        identity = np.load(truth / "mesh.npz")["identity"]
        start = time.perf_counter()
        balls = eyeballs(photos, skin, template, identity)
        assert balls is not None
        before = lid_fit(skin, balls.centres, balls.radius, template, turn[:, 2])
        settled = settle_lids(skin, balls.centres, balls.radius, template, turn[:, 2])
        after = lid_fit(settled, balls.centres, balls.radius, template, turn[:, 2])
        texture = eye_texture(photos, balls, settled, template)
        inner = inner_parts(template, identity, settled, balls.centres, balls.radius, turn)
        seconds = time.perf_counter() - start
        teeth = template.parts["teeth_upper"].vertices
        off = np.linalg.norm((inner.vertices[teeth] - shift) @ turn / scale - head[teeth], axis=1).mean()
        say(
            "true skin",
            balls.centres,
            float(balls.radius.mean()),
            f"lids {max(before.contact, before.rim, before.poke):.2f} -> {max(after.contact, after.rim):.2f}, "
            f"poke {after.poke:.2f}; teeth {off:.2f} off, {inner.lips:.1f} behind the skin, {inner.poke:.2f} in it; "
            f"{colours(truth, texture.texture, template)}; follow {balls.follow:.2f}; {seconds:.1f} s",
        )
    if (project / "04-neutral").is_dir():
        neutral = Neutral.load(project / "04-neutral")
        to_cloud = np.linalg.inv(neutral.head_from_cloud)
        fit = lid_fit(neutral.vertices, neutral.eye_centres, neutral.eye_radius, template)
        say(
            "neutral",
            neutral.eye_centres @ to_cloud[:3, :3].T + to_cloud[:3, 3],
            float(neutral.eye_radius.mean()),
            f"lids {max(fit.contact, fit.rim):.2f}, poke {fit.poke:.2f}; "
            + (colours(truth, neutral.eye_texture, template) if head is not None else "no true colours"),
        )


def true_head(truth: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """The head (n, 3) in the template's order, and the template's vertex at each place; None: another's."""
    with np.load(truth / "mesh.npz") as mesh:
        order, neutral = mesh.get("template_vertex"), mesh["neutral"].astype(float)
    if order is None:
        return None
    head = np.empty_like(neutral)
    head[order] = neutral
    return head, order


def true_eyes(truth: Path, template: Template) -> tuple[np.ndarray, float]:
    """Centres (2, 3) of the left and the right eyeball, and their radius."""
    known = true_head(truth)
    if known is None:
        with np.load(truth / "mesh.npz") as mesh:
            balls = [mesh["neutral"][first:last].astype(float) for first, last in ICT_EYES]
    else:
        balls = [known[0][template.parts[name].vertices] for name in EYE_PARTS]
    fits = [sphere(ball) for ball in balls]
    return np.array([centre for centre, _ in fits]), float(np.mean([radius for _, radius in fits]))


def sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """The sphere on which most of the points lie: the cornea bulges out of it."""
    keep = np.ones(len(points), bool)
    centre, radius = points.mean(axis=0), 0.0
    for _ in range(20):
        A = np.c_[2 * points[keep], np.ones(keep.sum())]
        x = np.linalg.lstsq(A, (points[keep] ** 2).sum(axis=1))[0]
        centre, radius = x[:3], float(np.sqrt(x[3] + x[:3] @ x[:3]))
        distance = np.linalg.norm(points - centre, axis=1)
        keep = np.abs(distance - np.median(distance)) < 0.3
    return centre, radius


def colours(truth: Path, texture: np.ndarray, template: Template) -> str:
    """Distance in Lab between the medians of iris and white, here and in the truth's albedo."""
    albedo = cv2.cvtColor(cv2.imread(str(truth / "albedo_face.png")), cv2.COLOR_BGR2RGB)
    used = template.uv[np.unique(template.uv_triangles[template.parts["eye_left"].triangles])]
    low, high = used.min(axis=0), used.max(axis=0)
    size = texture.shape[0]
    share = (np.arange(size) + 0.5) / size
    x = (low[0] + share * (high[0] - low[0])) * albedo.shape[1] - 0.5
    y = (1 - high[1] + share * (high[1] - low[1])) * albedo.shape[0] - 0.5
    true = cv2.remap(albedo, *(v.astype(np.float32) for v in np.meshgrid(x, y)), cv2.INTER_LINEAR)
    offset = eye_map(template, size)
    radius = np.where(offset[..., 2] > 0, np.hypot(offset[..., 0], offset[..., 1]), np.inf)
    said = []
    for name, (least, most) in (("iris", IRIS), ("white", WHITE)):
        zone = (radius > least) & (radius < most)
        a, b = (np.median(decode_srgb(image[zone]), axis=0) for image in (true, texture))
        signal = (np.stack([a, b])[None] ** (1 / 2.2)).astype(np.float32)
        lab = cv2.cvtColor(signal, cv2.COLOR_RGB2Lab)[0]
        said.append(f"{name} {np.linalg.norm(lab[0] - lab[1]):.1f} off in Lab")
    return ", ".join(said)


if __name__ == "__main__":
    main()
