"""
How near the registered head is to the truth, and what robs it of accuracy.

python benchmarks/neutral.py PROJECT --truth TRUTH --scorer score.py [--trials]
AVATARBUILD_BENCHMARK=FOLDER stands for --truth FOLDER/truth_b --scorer FOLDER/score.py. The project's stages up to
neutral must have run. Rows: the head, the morphable model alone, the mean head alone, the cloud alone; with --trials
also the head from a cloud without half of a cheek, and from one with gross outliers and a cap of hair.
"""

from __future__ import annotations

import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from eyes import true_eyes, true_head
from scipy.spatial import cKDTree
from scoring import arguments, load_scorer, scored

from avatarbuild.artefacts import Cameras, Capture, Cloud, Neutral
from avatarbuild.geometry.similarity import similarity
from avatarbuild.options import NeutralOptions
from avatarbuild.progress import Silent
from avatarbuild.registration.pins import LID_RIMS, LIP_BORDERS, SEAM
from avatarbuild.report.overlay import contour_distance
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.stages import neutral as stage
from avatarbuild.template import Template

SEED = 11
PHOTOS = 6  # the most frontal ones, for the overlay of rims
MEGAPIXELS = 2e6  # at which rims are compared


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--trials", action="store_true")
    a = scored(parser)
    scorer = load_scorer(a.scorer)
    template, truth = Template.load(), scorer.GT(str(a.truth))
    capture = Capture.load(a.project / "01-capture")
    cameras = Cameras.load(a.project / "02-cameras")
    cloud = Cloud.load(a.project / "03-points")
    made = Neutral.load(a.project / "04-neutral")

    print(f"{'':24s}  median    mean     p90  at landmarks, mm")
    place = show(scorer, truth, template, "head", made.vertices)
    show(scorer, truth, template, "morphable model alone", made.model)
    show(scorer, truth, template, "mean head alone", template.mean)
    alone(scorer, truth, cloud, made, place)
    known = true_head(a.truth)
    correspondence(truth, template, made, place, None if known is None else known[1])
    eyes(a.truth, template, made, place)
    rims(template, capture, cameras, made, made.vertices)
    if known is not None:
        s, R, t = place
        print("the true head's own rims against the detector:")
        rims(template, capture, cameras, made, (known[0] - t) @ R / s * 1000)
    if a.trials:
        trials(scorer, truth, template, capture, cameras, cloud, made)


def show(
    scorer: ModuleType, truth: Any, template: Template, name: str, vertices: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Prints a row; returns the similarity that takes the head, in metres, onto the truth."""
    skin = template.triangles[template.parts["skin"].triangles].astype(np.int64)
    marks = template.landmarks(vertices / 1000)[template.landmarks68]
    head = {"V": vertices / 1000, "F": skin, "UV": None, "morph": {}}
    place, off, surface = scorer.align_neutral(head, truth, marks)
    s = scorer.stats(off, truth.area)
    at = truth.V[truth.lm[17:]]
    near = np.linalg.norm(surface.closest(at)[0] - at, axis=1).mean()
    print(f"{name:24s}  {s['median']:6.3f}  {s['mean']:6.3f}  {s['p90']:6.3f}  {near:6.3f}", flush=True)
    return place


def alone(scorer: ModuleType, truth: Any, cloud: Cloud, made: Neutral, place: Any) -> None:
    """Truth to the nearest point of the cloud, by the head's alignment."""
    s, R, t = place
    head = cloud.points @ made.head_from_cloud[:3, :3].T + made.head_from_cloud[:3, 3]
    off, _ = cKDTree(s * head / 1000 @ R.T + t).query(truth.V[truth.mask], workers=-1)
    v = scorer.stats(off, truth.area)
    print(f"{'cloud alone':24s}  {v['median']:6.3f}  {v['mean']:6.3f}  {v['p90']:6.3f}")


def correspondence(truth: Any, template: Template, made: Neutral, place: Any, order: np.ndarray | None) -> None:
    """The 68 points of the head against the truth's, mm; the same vertices where `order` (n,) tells the template's."""
    s, R, t = place
    points = template.landmarks(made.vertices)[template.landmarks68]
    if order is not None:
        points = made.vertices[order[truth.lm]]
    own = s * points / 1000 @ R.T + t
    off = np.linalg.norm(own - truth.V[truth.lm], axis=1)
    print(
        f"corresponding points: inner without brows {off[27:].mean():.2f} mm (nose {off[27:36].mean():.2f}, "
        f"eyes {off[36:48].mean():.2f}, lips {off[48:].mean():.2f}), brows {off[17:27].mean():.2f}, "
        f"jaw {off[:17].mean():.2f}"
    )


def eyes(folder: Path, template: Template, made: Neutral, place: Any) -> None:
    """Eyeballs against spheres laid through the truth's eyeballs."""
    s, R, t = place
    centres, radius = true_eyes(folder, template)
    for k, name in enumerate(("left", "right")):
        own = s * made.eye_centres[k] / 1000 @ R.T + t
        x, y, z = own - centres[k]
        ratio = s / 1000 * made.eye_radius[k] / radius
        print(f"eye {name}: off by {x:+.2f} across, {y:+.2f} up, {z:+.2f} out, mm; radius {100 * (ratio - 1):+.1f} %")


def rims(template: Template, capture: Capture, cameras: Cameras, made: Neutral, vertices: np.ndarray) -> None:
    """Detected points of lids and lips against a head's rims in the most frontal photos, pixels at 2 megapixels."""
    photos = capture.photos
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in photos.names])
    back = np.linalg.inv(made.head_from_cloud)
    world = vertices @ back[:3, :3].T + back[:3, 3]
    frontal = np.argsort(np.abs(photos.pose[placed.index, 0]), kind="stable")[:PHOTOS]
    everything = []
    for name, group in (("lids", LID_RIMS), ("lips' border", LIP_BORDERS), ("lips' seam", SEAM)):
        off = []
        for contour, chain in group.items():
            for p in frontal:
                photo = placed.index[p]
                scale = np.sqrt(MEGAPIXELS / np.prod(photos.size[photo]))
                at = world @ placed.rotation[p].T + placed.translation[p]
                pixels = np.asarray(placed.cameras[p].img_from_cam(at)) * scale
                marks = photos.landmarks[photo, list(chain)[1:-1], :2] * scale
                off += contour_distance(marks, pixels, template, (contour,)).tolist()
        everything += off
        print(f"rims of {name:13s} {np.mean(off):.2f} px mean, {np.percentile(off, 90):.2f} px p90")
    print(f"rims of all           {np.mean(everything):.2f} px mean")


def trials(
    scorer: ModuleType,
    truth: Any,
    template: Template,
    capture: Capture,
    cameras: Cameras,
    cloud: Cloud,
    made: Neutral,
) -> None:
    for name, spoilt in (
        ("without half a cheek", without_half_a_cheek(cloud, made)),
        ("outliers, cap of hair", with_outliers_and_hair(cloud, made)),
    ):
        begun = time.perf_counter()
        head = stage.run(capture, cameras, spoilt, NeutralOptions(), Silent(), template)
        show(scorer, truth, template, name, head.vertices)
        _, R, t = similarity(made.vertices, head.vertices)
        apart = np.linalg.norm(made.vertices @ R.T + t - head.vertices, axis=1)[template.regions["face"]]
        far = np.percentile(apart, 99)
        seconds = time.perf_counter() - begun
        print(f"{'':24s}  from the head of the whole cloud {apart.mean():.3f}, p99 {far:.2f} mm; {seconds:.0f} s")


def without_half_a_cheek(cloud: Cloud, made: Neutral) -> Cloud:
    """The cloud without the points on the outer half of the left cheek."""
    head = cloud.points @ made.head_from_cloud[:3, :3].T + made.head_from_cloud[:3, 3]
    x, y, z = head.T
    gone = (x > 35) & (x < 75) & (y < -15) & (y > -75) & (z > -60)
    return chosen(cloud, ~gone)


def with_outliers_and_hair(cloud: Cloud, made: Neutral) -> Cloud:
    """The cloud with a fifth as many points anywhere, and a cap of tangled points up to 25 mm above the scalp."""
    rng = np.random.default_rng(SEED)
    n = len(cloud.points)
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    stray = rng.uniform(low, high, (n // 5, 3)).astype(np.float32)
    back = np.linalg.inv(made.head_from_cloud)
    template = Template.load()
    triangles = template.triangles[template.parts["skin"].triangles]
    upper = made.vertices[:, 1] > 30
    scalp = triangles[(template.regions["scalp"] & upper)[triangles].all(axis=1)]
    at = scalp[rng.integers(0, len(scalp), 120_000)]
    share = rng.dirichlet(np.ones(3), len(at))
    root = np.einsum("ni,nij->nj", share, made.vertices[at])
    tip = root * (1 + rng.uniform(0, 25, (len(root), 1)) / np.linalg.norm(root, axis=1, keepdims=True))
    hair = (tip @ back[:3, :3].T + back[:3, 3]).astype(np.float32)
    more = np.concatenate([stray, hair])
    turned = rng.standard_normal((len(more), 3))
    normals = (turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32)
    dark = rng.integers(10, 60, (len(hair), 1)) * np.array([[1.0, 0.8, 0.6]])
    colours = np.concatenate([rng.integers(0, 255, (len(stray), 3)), dark]).astype(np.uint8)
    return Cloud(
        np.concatenate([cloud.points, more]),
        np.concatenate([cloud.normals, normals]),
        np.concatenate([cloud.colours, colours]),
        np.concatenate([cloud.views, np.full(len(more), 3, np.uint8)]),
    )


def chosen(cloud: Cloud, keep: np.ndarray) -> Cloud:
    return Cloud(cloud.points[keep], cloud.normals[keep], cloud.colours[keep], cloud.views[keep])


if __name__ == "__main__":
    main()
