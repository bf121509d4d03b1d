"""Shape from shading on simulated faces whose relief is known.

    python benchmarks/relief.py [moles] [norms] [--people 2] [--frames 16] [--out docs/images]

moles   a face without relief, with painted moles and stubble, under soft light from the front and under a room's: how
        far the displacement under them stands out, with what all frames share told from the frame's own, and without
norms   wrinkles under the same lights: the error of the normals with squares and with l1 in equation (13); a picture
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from avatarbuild.formats.clip import encode_clip
from avatarbuild.formats.colour import encode_srgb
from avatarbuild.formats.images import encode_png
from avatarbuild.formats.video import decode_frames
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.geometry.raster import rasterise
from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.shading.observation import Seen, View, Watched, watch
from avatarbuild.shading.relief import FINE, Relief, ReliefWeights, light_seen, relief
from avatarbuild.shading.surface import fine_skin
from avatarbuild.simulation import truth
from avatarbuild.simulation.light import Light, room_light
from avatarbuild.simulation.noise import fractal
from avatarbuild.simulation.performance import perform
from avatarbuild.simulation.photographs import Shot, develop
from avatarbuild.simulation.rendering import Camera, Skin, draw
from avatarbuild.simulation.skin import paint, random_person
from avatarbuild.simulation.studio import Head, build_head, posed_head
from avatarbuild.simulation.subject import random_subject
from avatarbuild.simulation.wrinkles import gains
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.tracking.lens import Lens

FIRST = 3000  # seed of the first person
SIZE = (540, 960)
TEXTURE = 2048
PIXEL = 1  # frame pixels of one of the relief's: 0.7 mm, as in stage details
BLACK = 0.02  # of the face's median
BESIDE = 14  # pixels from a mole to the plain skin that is measured like it
SHARP = 0.1  # slope of the l1
SCATTER = 0.8  # mm: how far light goes in the skin
MISPLACED, WOBBLE = 0.3, 0.3  # mm: the albedo against the skin, the tracked mesh against the face


def soft_light() -> Light:
    """A bright wall behind the phone."""
    lobes = np.array([[0, 0.2, 1.0], [0, -1, 0]])
    shining = Light(lobes, np.array([1.2, 0.5]), np.array([[1.4] * 3, [0.25] * 3]), np.zeros((9, 3)))
    return shining.turned(np.eye(3))  # which works its harmonics out


class Face:
    """One person filmed: `frames` of a clip as decoded, the skin as photos know it, and the true heads."""

    def __init__(self, t: Template, seed: int, frames: int, light: Light | None, *, flat: bool) -> None:
        rng = np.random.default_rng([seed, 1])
        self.t, self.seed = t, seed
        subject = random_subject(t, rng)
        head = build_head(subject, rng, TEXTURE, shirt=None)
        self.marks = np.zeros((TEXTURE, TEXTURE), np.int32)
        if flat:
            self.marks, head = painted(head, seed)
        self.head = head
        lit = light if light is not None else room_light(np.random.default_rng([seed, 2]), np.array([-0.6, 0.4, 0.7]))
        skin = posed_head(head, np.zeros(len(t.expression_names)))
        focal = 1.373 * SIZE[0]
        K = np.array([[focal, 0, SIZE[0] / 2 - 0.5], [0, focal, SIZE[1] / 2 - 0.5], [0, 0, 1.0]])
        self.camera = Camera(K, np.zeros(5), np.diag([1.0, -1, -1]), np.array([0, -32.0, 415]), SIZE)
        first = draw(self.camera, [], [skin], lit, 1).mean(axis=-1)
        lit = lit.scaled(0.42 / float(np.quantile(first[first > 0], 0.85)))
        self.lens = Lens(focal, 0.0, SIZE)
        self.played = perform(np.random.default_rng([seed, 5]), 34.0, 6.0, SIZE)
        self.rows = self._wrinkled(frames)
        self.skins = [self._skin(i, flat) for i in self.rows]
        noise = np.random.default_rng([seed, 7])
        shot = Shot(self.camera, 0, 0, 1.0, np.ones(3), np.zeros(2), 1)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "clip.mp4"
            pictures = (develop(self._scattered(s, lit), shot, noise, noise=1.0) for s in self.skins)
            encode_clip(path, pictures, 10.0, quality=19)
            self.rgb = [rgb for _, _, rgb in decode_frames(path, list(range(frames)))]
        self.watched = self._watch()

    def _wrinkled(self, count: int) -> np.ndarray:
        """
        Frames evenly over the clip, and of every second part the one with the deepest wrinkles: in a clip most frames
        are without a given wrinkle, else it would be skin that all frames share.
        """
        named = [dict(zip(ARKIT_NAMES, w.tolist(), strict=True)) for w in self.played.weights]
        depth = np.array([sum(gains(one).values()) for one in named])
        parts = np.array_split(np.arange(len(depth)), count)
        return np.array([part[depth[part].argmax() if k % 2 else 0] for k, part in enumerate(parts)])

    def _skin(self, i: int, flat: bool) -> Skin:
        skin = posed_head(self.head, self.played.weights[i], self.played.head_pose[i])
        return replace(skin, detail=None) if flat else skin

    def _scattered(self, skin: Skin, light: Light) -> np.ndarray:
        """(h, w, 3): the picture, its light blurred by the way through the skin, which the renderer does not know."""
        white = self.head.surface.channels()
        white[..., :3], white[..., 3] = 1, 0
        shone = draw(self.camera, [], [replace(skin, surface=build_mipmap(white))], light, 2)
        on = (shone.sum(axis=-1) > 0).astype(np.float32)
        width = SCATTER * self.camera.K[0, 0] / 415
        part = cv2.GaussianBlur(on, (0, 0), width)[..., None]
        soft = cv2.GaussianBlur(shone * on[..., None], (0, 0), width) / np.maximum(part, 1e-3)
        return draw(self.camera, [], [skin], light, 2) * soft / np.maximum(shone, 1e-3)

    def _watch(self) -> Watched:
        t, subject = self.t, self.head.subject
        texel = 0.2  # mm, of the chart
        x, y = (MISPLACED / texel * _field(TEXTURE, self.seed + k) for k in range(2))
        rows, columns = np.mgrid[0:TEXTURE, 0:TEXTURE].astype(np.float32)
        albedo = cv2.remap(self.head.surface.albedo, columns + x, rows + y, cv2.INTER_LINEAR)
        known = encode_srgb(albedo)
        skin = fine_skin(t, known)
        R, shift = self.camera.R, self.camera.t
        views = []
        for k, i in enumerate(self.rows):
            pose = self.played.head_pose[i]
            wobble = [fractal(t.mean, 40.0, 1, self.seed * 1000 + 10 * k + c) for c in range(3)]
            head = subject.posed(self.played.weights[i]) + WOBBLE * np.stack(wobble, axis=1)
            views.append(View(k, head, R @ pose[:3, :3], R @ pose[:3, 3] + shift))
        self.skin, self.views = skin, views
        return watch(skin, views, lambda k: self.rgb[k], self.lens, PIXEL)

    def relief(self, one: Seen, w: ReliefWeights, *, shared: bool = True) -> Relief:
        more = self.watched.more(one.drawn) if shared else np.zeros_like(one.grey)
        seen = light_seen(one.drawn, one.grey, float(self.watched.light.gains[one.row]), more)
        return relief(one.drawn, seen, self.watched.light, self.lens, w)


def _field(side: int, seed: int) -> np.ndarray:
    """(side, side) float32 smooth, of unit standard deviation."""
    rng = np.random.default_rng(seed)
    small = cv2.GaussianBlur(rng.standard_normal((64, 64)).astype(np.float32), (0, 0), 2.0)
    return np.asarray(cv2.resize(small / small.std(), (side, side), interpolation=cv2.INTER_CUBIC))


def painted(head: Head, seed: int) -> tuple[np.ndarray, Head]:
    """A smooth head with moles and stubble that are colour alone; marks (t, t): 0, -1 stubble, k the k-th mole."""
    chart = head.chart
    rng = np.random.default_rng([seed, 9])
    person = replace(random_person(rng), tone=0.2, freckles=0.0)
    plain, beard = (paint(chart, replace(person, stubble=s)) for s in (0.0, 1.0))
    albedo = beard.albedo.copy()
    darker = (beard.albedo.mean(axis=-1) < 0.93 * plain.albedo.mean(axis=-1)).astype(np.float32)
    marks = -(cv2.GaussianBlur(darker, (0, 0), 3) > 0.15).astype(np.int32)
    t = chart.template
    face = (chart.field(t.regions["face"].astype(np.float32)) > 0.9) & (chart.part == 0)
    away = np.zeros(len(t.mean), np.float32)
    for name in ("lips", "lids", "brows"):
        away = np.maximum(away, t.regions[name].astype(np.float32))
    face &= (chart.field(away) < 0.05) & (marks == 0) & (np.abs(chart.position[..., 0]) < 50)
    rows, columns = np.nonzero(face)
    for k in range(1, 25):
        j = int(rng.integers(len(rows)))
        centre, radius = chart.position[rows[j], columns[j]], rng.uniform(0.8, 2.5)
        distance = np.linalg.norm(chart.position - centre, axis=-1)
        spot = smooth_step(distance, radius * 1.15, radius * 0.8) * (chart.part == 0)
        albedo *= 1 - spot[..., None] * np.array([0.5, 0.62, 0.7], np.float32)
        marks[(distance < radius) & (chart.part == 0)] = k
    surface = replace(beard, albedo=albedo, relief=np.zeros_like(beard.relief), slopes=np.zeros_like(beard.slopes))
    return marks, replace(head, surface=surface, drawn=build_mipmap(surface.channels()))


def moles(t: Template, people: int, frames: int) -> None:
    for name, light in (("soft light from the front", soft_light()), ("a room's light", None)):
        bumps, rough, without, beside = [], [], [], []
        for person in range(people):
            face = Face(t, FIRST + person, frames, light, flat=True)
            marks = _nearest(face.marks)
            for one in face.watched.frames:
                label = np.where(_whole(one), marks(one), 0)
                found = face.relief(one, FINE)
                told, smooth = _stand_out(found.d, label, one.drawn.on)
                bumps += told
                rough.append(smooth)
                moved = np.roll(np.maximum(label, 0), BESIDE, axis=1)
                moved = np.where((label == 0) & one.drawn.on, moved, -1)
                beside += _stand_out(found.d, moved, one.drawn.on)[0]
                without += _stand_out(face.relief(one, FINE, shared=False).d, label, one.drawn.on)[0]
        b, w, plain = np.abs(bumps), np.abs(without), np.abs(beside)
        stubble, skin = np.mean(rough, axis=0)
        print(
            f"moles: {name}, {people} people, {len(b)} moles in frames: mean, 95 %, most "
            f"{b.mean():.3f}, {np.quantile(b, 0.95):.3f}, {b.max():.3f} mm (without what frames share "
            f"{w.mean():.3f}, {np.quantile(w, 0.95):.3f}, {w.max():.3f}; on plain skin beside them "
            f"{plain.mean():.3f}, {np.quantile(plain, 0.95):.3f}, {plain.max():.3f}); "
            f"roughness under stubble {stubble:.3f} mm, on smooth skin {skin:.3f}"
        )


def _whole(one: Seen) -> np.ndarray:
    """(h, w) bool: BESIDE pixels or more from where the picture is black, an eyeball rendered through the skin."""
    black = (one.drawn.on & (one.grey < BLACK * np.median(one.grey[one.drawn.on]))).astype(np.uint8)
    return cv2.dilate(black, np.ones((2 * BESIDE + 1,) * 2, np.uint8)) == 0


def _nearest(marks: np.ndarray) -> Callable[[Seen], np.ndarray]:
    def at(one: Seen) -> np.ndarray:
        side = marks.shape[0]
        column, row = np.clip(one.drawn.uv * [side, -side] + [0, side], 0, side - 1).astype(int).transpose(2, 0, 1)
        return np.where(one.drawn.on, marks[row, column], 0)

    return at


def _stand_out(d: np.ndarray, label: np.ndarray, on: np.ndarray) -> tuple[list[float], tuple[float, float]]:
    """mm that each mole stands over a ring about it; the displacement's roughness under stubble and elsewhere."""
    told = []
    for k in range(1, int(label.max()) + 1):
        mole = (label == k).astype(np.uint8)
        if mole.sum() < 3:
            continue
        near = cv2.dilate(mole, np.ones((9, 9), np.uint8)) - cv2.dilate(mole, np.ones((3, 3), np.uint8))
        ring = (near > 0) & on & (label == 0)
        if ring.sum() > 20:
            told.append(float(d[mole > 0].mean() - d[ring].mean()))
    high = d - cv2.GaussianBlur(d, (0, 0), 3.0)
    inner = cv2.erode(on.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    return told, (float(high[inner & (label < 0)].std()), float(high[inner & (label == 0)].std()))


def norms(t: Template, people: int, frames: int, out: Path | None) -> None:
    """Degrees to the true normals where wrinkles tilt the skin, and on the face."""
    for name, light in (("soft light from the front", soft_light()), ("a room's light", None)):
        rows = []
        for person in range(people):
            face = Face(t, FIRST + person, frames, light, flat=False)
            most, deepest = 0, []
            for one, skin in zip(face.watched.frames, face.skins, strict=True):
                true, folded = true_normals(face, skin, one)
                area = one.drawn.on & (np.abs(true).sum(axis=-1) > 0)
                wrinkles = area & (folded > 5)
                made = {w: face.relief(one, replace(FINE, sharp=w)).normal for w in (0.0, SHARP)}
                shown = [one.drawn.normal, *made.values()]
                angles = [_degrees(n, true) for n in shown]
                rows.append([float(a[area].mean()) for a in angles])
                rows[-1] += [float(a[wrinkles].mean()) if wrinkles.sum() > 300 else np.nan for a in angles]
                if int(wrinkles.sum()) > most:
                    most, deepest = int(wrinkles.sum()), [true, *shown]
            if out is not None and person == 0 and light is None and deepest:
                picture = np.concatenate([(127 + 127 * n * [1, -1, -1]) for n in deepest], axis=1)
                (out / "relief-norms.png").write_bytes(encode_png(np.clip(picture, 0, 255).astype(np.uint8)))
        face_, wrinkle = np.nanmean(rows, axis=0).reshape(2, 3)
        print(
            f"norms: {name}, {people} people, {len(rows)} frames: face: mesh {face_[0]:.2f}, squares {face_[1]:.2f}, "
            f"l1 {face_[2]:.2f} degrees; wrinkles: {wrinkle[0]:.2f}, {wrinkle[1]:.2f}, {wrinkle[2]:.2f}"
        )


def true_normals(face: Face, skin: Skin, one: Seen) -> tuple[np.ndarray, np.ndarray]:
    """(h, w, 3) in camera axes at a drawing's pixels, without still relief; (h, w) degrees by which wrinkles tilt."""
    calm = replace(skin, surface=build_mipmap(np.zeros((8, 8, 6), np.float32)))
    pixels, depth = face.camera.project(skin.vertices)
    raster = rasterise(pixels, depth, skin.triangles, SIZE, near=40)
    both = [truth.relief_normals(s, raster, pixels, depth) for s in (calm, replace(calm, detail=None))]
    (w, h), (x, y) = one.drawn.size, one.drawn.corner.astype(int)
    on = (raster.triangle >= 0)[..., None]
    turned, smooth = (
        cv2.resize(
            (n @ face.camera.R.T.astype(np.float32) * on)[y : y + h * PIXEL, x : x + w * PIXEL],
            (w, h),
            interpolation=cv2.INTER_AREA,
        )
        for n in both
    )
    length = np.linalg.norm(turned, axis=-1, keepdims=True)
    true = np.where(length > 0.7, turned / np.maximum(length, 1e-9), 0)
    return true, _degrees(true, smooth / np.maximum(np.linalg.norm(smooth, axis=-1, keepdims=True), 1e-9))


def _degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["moles", "norms"])
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--out", type=Path)
    o = parser.parse_args()
    t = Template.load()
    for part in o.parts:
        {"moles": lambda: moles(t, o.people, o.frames), "norms": lambda: norms(t, o.people, o.frames, o.out)}[part]()


if __name__ == "__main__":
    main()
