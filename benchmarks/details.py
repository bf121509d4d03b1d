"""Every figure of the details: synthesis of detail maps, occlusion of wrinkles.

    python benchmarks/details.py [synthesis] [occlusion] [speed] [pictures] [--people 3] [--out docs/images]

synthesis  maps of simulated people with wrinkles, with the errors that maps from video have; every third frame is left
           out of training; errors of the normals against the truth beside those of the frame's own map
occlusion  equation (15) against rays, on simulated heads with wrinkles
speed      seconds of training and of one evaluation at 1024 x 1024 (on an idle machine)
pictures   of both, for docs/details.md; not among those that run unnamed
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from avatarbuild.details.ambient_occlusion import ambient_occlusion, surface_normals
from avatarbuild.details.synthesis import Synthesis, train
from avatarbuild.formats.images import encode_png
from avatarbuild.simulation import wrinkles
from avatarbuild.simulation.chart import Chart, chart_of
from avatarbuild.simulation.noise import fractal
from avatarbuild.simulation.performance import perform
from avatarbuild.simulation.subject import Subject, random_subject
from avatarbuild.template import ARKIT_NAMES, Template, expression_weights
from avatarbuild.texture.chart import draw_chart
from avatarbuild.texture.occlusion import ambient as by_embree

FIRST = 2000  # seed of the first person
SIDE = 1024
CLIP, RATE = 45.0, 2.0  # seconds, frames a second


class Clip:
    """A person's frames: weights (f, 52), vertices (f, n, 3) as tracked, true maps and those that video would give."""

    def __init__(self, t: Template, chart: Chart, seed: int, noise: float, share: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.seed, self.noise, self.share, self.chart = seed, noise, share, chart
        self.subject: Subject = random_subject(t, self.rng)
        self.folds = wrinkles.folds(chart, seed)
        self.weights = perform(self.rng, CLIP, RATE, (540, 960)).weights
        self.true_vertices = np.stack([self.subject.posed(w) for w in self.weights])
        self.vertices = self.true_vertices + np.stack([self._wobble(t, i) for i in range(len(self.weights))])
        skin = chart.part == 0
        self.face = (chart.field(t.regions["face"].astype(np.float32)) > 0.5) & skin
        aside = np.abs(chart.position[..., 0]) / 70
        self.seen = np.where(self.face, np.clip(1.3 - aside, 0, 1), 0).astype(np.float32)

    def _wobble(self, t: Template, i: int) -> np.ndarray:
        """(n, 3) mm: what tracking gets wrong, smooth, 0.3 mm."""
        waves = [fractal(t.mean, 40.0, 1, self.seed * 1000 + 10 * i + c) for c in range(3)]
        return 0.3 * np.stack(waves, axis=1)

    def truth(self, i: int) -> np.ndarray:
        named = dict(zip(ARKIT_NAMES, self.weights[i], strict=True))
        return layers(self.folds.detail(wrinkles.gains(named)))

    def own(self, i: int) -> np.ndarray:
        """The map of a frame: wrinkles at `share` of their depth, under noise of `noise` degrees."""
        named = dict(zip(ARKIT_NAMES, self.weights[i], strict=True))
        detail = self.share * self.folds.detail(wrinkles.gains(named))
        rng = np.random.default_rng([self.seed, i])
        for width, part in ((2.0, 0.5), (8.0, 0.86)):
            for c in range(2):
                field = cv2.GaussianBlur(rng.standard_normal((SIDE, SIDE)).astype(np.float32), (0, 0), width)
                detail[..., c] += part * np.radians(self.noise) / 1.25 * field / field.std()
        return layers(detail)


def layers(detail: np.ndarray) -> np.ndarray:
    """(s, s, 4) normal and occlusion of slopes and darkening (s, s, 3)."""
    normal = np.stack([-detail[..., 0], -detail[..., 1], np.ones_like(detail[..., 0])], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.concatenate([normal, 1 - 0.6 * detail[..., 2:]], axis=-1).astype(np.float32)


def degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(s, s) between the normals of two maps."""
    return np.degrees(np.arccos(np.clip((a[..., :3] * b[..., :3]).sum(axis=-1), -1, 1)))


def trained(clip: Clip, t: Template, **options: float) -> tuple[Synthesis, np.ndarray]:
    """The synthesis of two thirds of the frames, and the rows left out."""
    out = np.arange(2, len(clip.weights), 3)
    kept = np.setdiff1d(np.arange(len(clip.weights)), out)
    vertices = clip.vertices[kept]
    own, sure = (lambda i: clip.own(kept[i])), (lambda _: clip.seen)
    return train(own, sure, vertices, clip.subject.neutral, t, **options), out


def synthesis(t: Template, people: int, **options: float) -> None:
    """Mean degrees to the truth of held-out frames: over the face, and where wrinkles tilt the skin by 5 degrees."""
    chart = chart_of(t, SIDE)
    flat = layers(np.zeros((SIDE, SIDE, 3), np.float32))
    for noise, share in ((2.0, 1.0), (4.0, 0.7)):
        rows = []
        for person in range(people):
            clip = Clip(t, chart, FIRST + person, noise, share)
            made, held = trained(clip, t, **options)
            for i in held:
                true = clip.truth(i)
                maps = {"own": clip.own(i), "made": made.evaluate(made.strain_of(clip.vertices[i])), "flat": flat}
                area = clip.seen > 0
                folded = area & (degrees(true, flat) > 5)
                found = {k: degrees(m, true) for k, m in maps.items()}
                rows.append([float(found[k][area].mean()) for k in maps])
                rows[-1] += [float(found[k][folded].mean()) if folded.sum() > 500 else np.nan for k in maps]
        own, mine, none, own_fold, mine_fold, none_fold = np.nanmean(rows, axis=0)
        print(
            f"synthesis: own maps with {noise:.0f} degrees of noise, {100 * share:.0f} % deep, {people} people, "
            f"{len(rows)} left out: face {mine:.2f} against own {own:.2f} (x {mine / own:.2f}; flat {none:.2f}), "
            f"wrinkles {mine_fold:.2f} against {own_fold:.2f} (x {mine_fold / own_fold:.2f}; flat {none_fold:.2f})"
        )


def speed(t: Template, people: int) -> None:
    clip = Clip(t, chart_of(t, SIDE), FIRST, 3.0, 1.0)
    kept = np.arange(48)
    maps = [clip.own(i) for i in kept]
    sure = [clip.seen] * len(kept)
    train(maps[:7], sure[:7], clip.vertices[:7], clip.subject.neutral, t)  # compiles
    start = time.perf_counter()
    made = train(maps, sure, clip.vertices[kept], clip.subject.neutral, t)
    taken = time.perf_counter() - start
    strain = made.strain_of(clip.vertices[50])
    made.evaluate(strain)
    start = time.perf_counter()
    for _ in range(10):
        made.evaluate(strain)
    each = (time.perf_counter() - start) / 10
    print(
        f"speed: training {len(made.edges)} edges, {len(kept)} frames, {made.keys.count} keyframes, {len(made.texels)} "
        f"texels: {taken:.1f} s; one evaluation at {SIDE}: {1000 * each:.0f} ms"
    )


FOLDED = (
    {"browInnerUp": 0.9, "browOuterUp": 0.8, "eyeSquint": 0.6, "mouthSmile": 0.8, "noseSneer": 0.5},
    {"browDown": 0.9, "noseSneer": 0.8, "cheekSquint": 0.8, "mouthPucker": 0.6, "mouthShrugLower": 0.8},
    {"browInnerUp": 0.8, "cheekSquint": 0.9, "mouthSmile": 0.9, "jawOpen": 0.3},
)


class Folded(NamedTuple):
    """A head with its wrinkles: positions (s, s, 3) mm, normals, mask, face (s, s) bool, height (s, s) mm of them."""

    positions: np.ndarray
    normals: np.ndarray
    mask: np.ndarray
    face: np.ndarray
    height: np.ndarray


def folded(t: Template, person: int) -> Folded:
    """A simulated head in an expression, displaced by its wrinkles."""
    seed = FIRST + 1000 + person
    refined, chart = t.subdivide(1), chart_of(t, SIDE)
    flat = draw_chart(t, refined.uv, refined.uv_triangles, SIDE)
    mask = flat.part == 1
    weights = expression_weights(**FOLDED[person % 3])
    vertices = refined.matrix @ random_subject(t, np.random.default_rng(seed)).posed(weights)
    positions = flat.field(vertices, refined.triangles)
    height = np.zeros((SIDE, SIDE), np.float32)
    rng, at = np.random.default_rng(seed), t.landmarks(t.mean)
    gains = wrinkles.gains(dict(zip(ARKIT_NAMES, weights, strict=True)))
    for name, lines in wrinkles._lines(at, rng).items():
        relief = wrinkles._relief(chart, lines, rng)
        if name == "chin":
            relief = relief + wrinkles._dimples(chart, at[175] * 0.5 + at[200] * 0.5, int(rng.integers(1 << 20)))
        height += gains[name] * relief
    positions = positions + height[..., None] * surface_normals(positions, mask)
    face = (flat.field(refined.matrix @ t.regions["face"].astype(float), refined.triangles) > 0.5) & mask
    return Folded(positions, surface_normals(positions, mask), mask, face, height)


def by_rays(head: Folded, texels: np.ndarray, rays: int = 200) -> np.ndarray:
    """(k,) openness of flat texels by rays through the surface that joins neighbouring texels."""
    number = np.full(head.mask.shape, -1)
    number[head.mask] = np.arange(head.mask.sum())
    square = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    square = square[(square >= 0).all(axis=1)]
    triangles = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]])
    at, normals = (x.reshape(-1, 3)[texels].astype(float) for x in (head.positions, head.normals))
    return by_embree(head.positions[head.mask].astype(float), triangles, at, normals, rays, 0.02)[0]


def occlusion(t: Template, people: int) -> None:
    """Mean error over 4000 texels of the face and 2000 of its wrinkles (deeper or higher than 0.05 mm)."""
    for person in range(people):
        head, rng = folded(t, person), np.random.default_rng(1)
        found = ambient_occlusion(head.positions, head.normals, head.mask).reshape(-1)
        start = time.perf_counter()
        ambient_occlusion(head.positions, head.normals, head.mask)
        taken = time.perf_counter() - start
        line = f"occlusion: head {person}, {taken:.1f} s"
        for name, area, count in (("face", head.face, 4000), ("wrinkles", head.face & (abs(head.height) > 0.05), 2000)):
            texels = rng.choice(np.flatnonzero(area), count, replace=False)
            true = by_rays(head, texels)
            error, constant = np.abs(found[texels] - true).mean(), np.abs(true - np.median(true)).mean()
            line += f"; {name} {error:.4f} (best constant {constant:.4f})"
        print(line)


def pictures(t: Template, out: Path) -> None:
    """Occlusion of a folded face beside that by rays; a left-out frame with raised brows: own map, made one, truth."""
    head = folded(t, 0)
    window = (slice(330, 700), slice(300, 724))
    inside = np.zeros(head.mask.shape, bool)
    inside[window] = True
    texels = np.flatnonzero(inside & head.mask)
    rays = np.ones(head.mask.size)
    rays[texels] = by_rays(head, texels, 60)
    mine = ambient_occlusion(head.positions, head.normals, head.mask)
    pair = np.concatenate([mine[window], rays.reshape(mine.shape)[window]], axis=1)
    write(out / "details-occlusion.png", np.round(255 * pair).astype(np.uint8))
    clip = Clip(t, chart_of(t, SIDE), FIRST, 4.0, 0.7)
    made, held = trained(clip, t)
    i = held[int(clip.weights[held, ARKIT_NAMES.index("browInnerUp")].argmax())]
    maps = [clip.own(i), made.evaluate(made.strain_of(clip.vertices[i])), clip.truth(i)]
    row = np.concatenate([m[230:560, 330:694, :3] for m in maps], axis=1)
    write(out / "details-synthesis.png", np.round(row * 127.5 + 127.5).astype(np.uint8))


def write(place: Path, picture: np.ndarray) -> None:
    place.write_bytes(encode_png(picture))
    print(f"pictures: {place}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["synthesis", "occlusion", "speed"])
    parser.add_argument("--people", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    chosen = parser.parse_args()
    t = Template.load()
    for what in chosen.what:
        if what == "pictures":
            pictures(t, chosen.out)
        else:
            {"synthesis": synthesis, "occlusion": occlusion, "speed": speed}[what](t, chosen.people)


if __name__ == "__main__":
    main()
