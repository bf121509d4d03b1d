"""What the factorisation of the light does: on simulated skin under three lights, and on a project, as pictures.

python benchmarks/illumination.py lights --seed 101
python benchmarks/illumination.py rooms PROJECT TRUTH CAPTURE.avatar [CAPTURE.avatar ...]
python benchmarks/illumination.py pictures PROJECT docs/images

rooms: the person of a simulated PROJECT (stage neutral has run) photographed in other lights, `simulate --seed N --set
light=1` and so on, each CAPTURE run until stage capture and its truth in CAPTURE.truth. The head is PROJECT's, the
cameras are the true ones; fusion, gains, whites of the eyes, gloss, noise and exposure are those of a whole run. Then
each room's textures are laid on the head in the other rooms' photos, the light refitted (`relighting.py`).
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import relighting

from avatarbuild.artefacts import Cameras, Capture, Neutral, Views
from avatarbuild.energies.harmonics import basis
from avatarbuild.formats.colour import encode_srgb
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.geometry.similarity import similarity
from avatarbuild.options import AlbedoOptions
from avatarbuild.registration.eye_white import eye_whites
from avatarbuild.sfm.metric import Placed, placed_photos
from avatarbuild.simulation import chart as simulated_chart
from avatarbuild.simulation.light import occlusion, room_light
from avatarbuild.simulation.skin import paint, random_person
from avatarbuild.simulation.subject import random_subject
from avatarbuild.template import Template
from avatarbuild.texture import completion, illumination
from avatarbuild.texture.chart import Chart, draw_chart, texels_per_mm
from avatarbuild.texture.fused import Fused
from avatarbuild.texture.fusion import fuse
from avatarbuild.texture.photos import Photo, linear_picture, placed_in_head
from avatarbuild.texture.template_skin import skin_texture

SIZE = 512
OTHERS = 5  # photos of every room, the most frontal ones
HIDDEN = ("lids", "mouth", "sockets")


def face_of(template: Template, chart: Chart) -> np.ndarray:
    """(s, s) bool: the face without lids, mouth and sockets."""
    aside = np.zeros(len(template.mean))
    for name in HIDDEN:
        aside[template.regions[name]] = 1
    face = chart.field(template.regions["face"].astype(float), template.triangles) > 0.99
    return face & (chart.field(aside, template.triangles) == 0)


def simulated(seed: int, lights: int) -> tuple[np.ndarray, list[Fused], SimpleNamespace, Chart]:
    """
    True albedo (s, s, 3), the head as fused under `lights` lights of rooms, its neutral, and the chart.

    The light is the simulator's: its occlusion, its colours of hollows and its bent normals are not those of
    `texture.illumination`. No gloss and no noise: what remains is the factorisation's own error.
    """
    template = Template.load()
    rng = np.random.default_rng([seed, 1])
    subject = random_subject(template, rng)
    albedo = paint(simulated_chart.chart_of(template, SIZE), random_person(rng)).albedo
    chart = draw_chart(template, template.uv, template.uv_triangles, SIZE)
    vertices = subject.neutral
    normals = vertex_normals(vertices, template.triangles)
    open_, bent = occlusion(vertices, template.triangles, vertices, normals)
    lean = normals + 0.55 * (1 - open_)[:, None] * (bent - normals)
    lean /= np.linalg.norm(lean, axis=1, keepdims=True)
    position = chart.field(vertices, template.triangles)
    normal = chart.field(normals, template.triangles)
    seen = ((chart.part == 1) & (position[..., 2] > -75)).astype(np.float32)
    fused = []
    for k in range(lights):
        other = np.random.default_rng([k, 9])
        light = room_light(other, np.array([other.choice([-1, 1]) * other.uniform(0.3, 1.0), 0.2, 0.5]))
        hollow = np.maximum(open_, 1e-3)[:, None] ** (0.75 + 0.18 * np.arange(3))
        lit = np.maximum(basis(lean) @ light.harmonics, 0) * hollow
        lit = chart.field(lit / np.median(lit), template.triangles)
        label = np.where(seen > 0, 0, -1).astype(np.int16)
        colour = (albedo * lit * seen[..., None]).astype(np.float32)
        fused.append(Fused(colour, seen, label, position, normal, chart.part > 0, chart.part))
    return albedo, fused, SimpleNamespace(vertices=vertices), chart


def apart(images: list[np.ndarray], on: np.ndarray) -> float:
    """Mean over the pairs of sum |a - b| / sum b in percent, after one scale a channel; NaN of a single image."""
    found = []
    for i, first in enumerate(images):
        for second in images[i + 1 :]:
            a, b = first[on], second[on]
            a = a * np.exp(np.median(np.log(b + 1e-3) - np.log(a + 1e-3), axis=0))
            found.append(np.abs(a - b).sum() / b.sum())
    return 100 * float(np.mean(found)) if found else float("nan")


def lights(seed: int) -> None:
    """The table of one simulated head under three lights."""
    albedo, fused, neutral, chart = simulated(seed, 3)
    template = Template.load()
    on = face_of(template, chart) & (fused[0].seen > 0)
    rows = {"fused": [f.colour for f in fused]}
    for name, weights in (("harmonics", {"field": False}), ("harmonics + field", {})):
        o = illumination.LightWeights(**weights)  # type: ignore[arg-type]
        rows[name] = [illumination.factor(f, template, neutral, o).albedo for f in fused]  # type: ignore[arg-type]
    print(f"seed {seed}, face, percent: difference of the three | error against the truth")
    for name, images in rows.items():
        errors = [apart([image, albedo], on) for image in images]
        print(f"  {name:20s} {apart(images, on):6.2f} | " + "  ".join(f"{e:.2f}" for e in errors))


def rooms(project: Path, truth: Path, captures: list[Path], size: int) -> None:
    """The table of one person under the lights of several captures."""
    template, neutral = Template.load(), Neutral.load(project / "04-neutral")
    with np.load(truth / "mesh.npz") as mesh:
        known = np.empty(mesh["neutral"].shape)
        known[mesh["template_vertex"]] = mesh["neutral"]
    placing = similarity(known, neutral.vertices)
    neutral = replace(neutral, head_from_cloud=np.eye(4))
    chart = draw_chart(template, template.uv, template.uv_triangles, size)
    bytes_ = cv2.cvtColor(cv2.imread(str(truth / "albedo_face.png")), cv2.COLOR_BGR2RGB)
    true = cv2.resize(linear_picture(bytes_), (size, size), interpolation=cv2.INTER_AREA)
    on = face_of(template, chart)
    rows: dict[str, list[np.ndarray]] = {"fused": [], "without whites": [], "albedo": []}
    seen, taken = [], []
    for folder in captures:
        views = Capture.load(folder / "01-capture").photos
        placed, photos = truly_placed(views, folder.with_suffix(".truth"), placing)
        eyes = (neutral.eye_centres, neutral.eye_radius)
        still = np.ones(len(photos), bool)
        blend = AlbedoOptions().blend
        fused, choice, _ = fuse(
            template, neutral.vertices, neutral.seen, photos, still, size, blend, eyes, lambda _: None
        )
        cards = eye_whites(views, placed, neutral, template)
        whites = [(card.eye, card.colour * choice.gains[card.placed]) for card in cards]
        rows["fused"].append(fused.colour)
        rows["without whites"].append(illumination.factor(fused, template, neutral).albedo)
        rows["albedo"].append(illumination.factor(fused, template, neutral, whites=whites).albedo)
        on &= fused.seen > 0.3
        seen.append(fused.seen)
        taken.append([photos[i] for i in np.argsort([abs(photo.yaw) for photo in photos])[:OTHERS]])
    print("face, percent: difference between the lights | error against the truth | brightness over the truth's")
    for name, images in rows.items():
        errors = "  ".join(f"{apart([image, true], on):.1f}" for image in images)
        bright = "  ".join(f"{np.median(image[on]) / np.median(true[on]):.2f}" for image in images)
        print(f"  {name:15s} {apart(images, on):6.2f} | {errors} | {bright}")
    head = relighting.head_of(template, neutral.vertices)
    print("PSNR on the face in photos of the other rooms, light refitted: harmonics, with the field")
    for name in ("fused", "albedo"):
        values = [
            value
            for i, texture in enumerate(rows[name])
            for j, others in enumerate(taken)
            if i != j
            for value in in_photos(head, texture, seen[i], others)
        ]
        plain, full = np.mean(values, axis=0)
        print(f"  {name:15s} {plain:5.1f}, {full:5.1f} dB ({len(values)} pictures)")


def in_photos(
    head: relighting.Head, texture: np.ndarray, seen: np.ndarray, photos: list[Photo]
) -> list[tuple[float, float]]:
    """dB by harmonics and with the field, of a texture (s, s, 3) in photos, where `seen` (s, s) says it is known."""
    levels = build_mipmap(texture.astype(np.float32))
    known = build_mipmap(np.repeat((seen > 0.3)[..., None], 3, axis=2).astype(np.float32))
    values = []
    for photo in photos:
        shot = relighting.Shot(photo.K, photo.dist, photo.R, photo.t, photo.size)
        drawn = relighting.rendered(head, levels, shot)
        real = linear_picture(photo.image.rgb())
        use = drawn.face & (drawn.cosine > 0.3) & (real.max(axis=2) < 0.95)
        use &= relighting.rendered(head, known, shot).picture[..., 0] > 0.99
        lit = relighting.relit(drawn, real, use, photo.K[0, 0] / float(np.linalg.norm(photo.centre)))
        values.append((relighting.psnr(lit[0], real, use), relighting.psnr(lit[1], real, use)))
    return values


def truly_placed(
    views: Views, truth: Path, placing: tuple[float, np.ndarray, np.ndarray]
) -> tuple[Placed, list[Photo]]:
    """The photos with the truth's cameras, in the frame that `placing` (scale, rotation, translation) leads to."""
    s, turn, shift = placing
    told = {Path(p["file"]).stem: p for p in json.loads((truth / "cameras.json").read_text())["photos"]}
    photos, cameras = [], []
    for i, file in enumerate(views.files):
        p = told[Path(file).stem]
        K = np.array(p["K"]) + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        R = np.array(p["R"]) @ turn.T
        t = s * np.array(p["t"]) - R @ shift
        size = (int(views.size[i, 0]), int(views.size[i, 1]))
        photos.append(Photo(views.names[i], i, i, views.images[i], size, K, np.array(p["dist"]), R, t))
        k1, k2, p1, p2, k3 = p["dist"]
        lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], k1, k2, p1, p2, k3, 0, 0, 0]
        cameras.append(pycolmap.Camera(model="FULL_OPENCV", width=size[0], height=size[1], params=lens))
    rotation, translation = (np.stack([getattr(photo, name) for photo in photos]) for name in ("R", "t"))
    return Placed(np.arange(len(photos)), cameras, rotation, translation), photos


def fused_of(project: Path, size: int) -> tuple[Fused, Neutral]:
    """A project's fused texture, found again."""
    template = Template.load()
    capture, cameras = Capture.load(project / "01-capture"), Cameras.load(project / "02-cameras")
    neutral = Neutral.load(project / "04-neutral")
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in capture.photos.names])
    photos = placed_in_head(capture.photos, placed, neutral.head_from_cloud)
    still = capture.neutral[[photo.photo for photo in photos]]
    eyes = (neutral.eye_centres, neutral.eye_radius)
    fused, _, _ = fuse(
        *(template, neutral.vertices, neutral.seen, photos, still, size, AlbedoOptions().blend, eyes, lambda *a: None)
    )
    return fused, neutral


def pictures(project: Path, folder: Path, size: int) -> None:
    """The pictures of docs/illumination.md."""
    template = Template.load()
    fused, neutral = fused_of(project, size)
    cut = np.s_[int(0.12 * size) : int(0.86 * size), int(0.12 * size) : int(0.88 * size)]

    def tile(image: np.ndarray, gain: float = 1.0) -> np.ndarray:
        small = cv2.resize(image[cut].astype(np.float32) * gain, (420, 410), interpolation=cv2.INTER_AREA)
        return encode_srgb(small)[..., ::-1]

    start = time.perf_counter()
    both = illumination.factor(fused, template, neutral)
    print(f"{size}^2: {time.perf_counter() - start:.1f} s")
    alone = illumination.factor(fused, template, neutral, illumination.LightWeights(field=False))
    row = [tile(fused.colour), tile(alone.shading, 0.5), tile(alone.albedo)]
    row += [tile(both.shading, 0.5), tile(both.albedo)]
    _write(folder / "illumination-stages.jpg", np.hstack(row))
    row = []
    for length in (6.0, 12.0, 25.0, 50.0, 100.0):
        o = illumination.LightWeights(field_length=length, even_length=length)
        row.append(tile(illumination.factor(fused, template, neutral, o).albedo))
    _write(folder / "illumination-smoothness.jpg", np.hstack(row))
    _cheek(fused, both, template, folder, tile)


def _cheek(fused: Fused, light: illumination.Light, template: Template, folder: Path, tile: Callable) -> None:
    """One cheek taken away and completed; and the figure of what stands at its border."""
    size = len(fused.seen)
    centre = fused.position[_texel(template, 280, size)]
    away = np.linalg.norm(fused.position - centre, axis=-1)
    gone = fused.seen * ((away > 28) | (fused.part != 1))
    texture = skin_texture(template, size)
    whole = completion.complete(light.albedo, gone, template, texture)
    truth = completion.complete(light.albedo, fused.seen, template, texture)
    _write(folder / "completion-cheek.jpg", np.hstack([tile(truth), tile(truth * (gone > 0)[..., None]), tile(whole)]))
    on = (fused.part == 1) & (fused.seen > 0.3)
    for name, image in (("photos", truth), ("completed", whole)):
        log = np.log(np.maximum(image.mean(axis=-1), 0.004))
        fine = log - cv2.GaussianBlur(log, (0, 0), 1.6 * texels_per_mm(template, template.mean, size))
        ring = [log[on & (away > a) & (away <= a + 6)].mean() for a in (22, 28, 34)]
        pores = fine[on & (away < 20)].std()
        print(f"  {name:10s} steps across the border {np.diff(ring).round(3)}, pores (log) {pores:.3f}")


def _texel(template: Template, landmark: int, size: int) -> tuple[int, int]:
    triangle = template.uv_triangles[template.landmark_triangles[landmark]]
    u, v = template.landmark_barycentric[landmark] @ template.uv[triangle]
    return int((1 - v) * size), int(u * size)


def _write(path: Path, image: np.ndarray) -> None:
    cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("lights").add_argument("--seed", type=int, default=101)
    drawn = verbs.add_parser("pictures")
    drawn.add_argument("project", type=Path)
    drawn.add_argument("folder", type=Path)
    drawn.add_argument("--size", type=int, default=1024)
    lit = verbs.add_parser("rooms")
    lit.add_argument("project", type=Path)
    lit.add_argument("truth", type=Path)
    lit.add_argument("captures", type=Path, nargs="+")
    lit.add_argument("--size", type=int, default=1024)
    o = parser.parse_args()
    if o.verb == "lights":
        lights(o.seed)
    elif o.verb == "rooms":
        rooms(o.project, o.truth, o.captures, o.size)
    else:
        pictures(o.project, o.folder, o.size)


if __name__ == "__main__":
    main()
