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

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from avatarbuild.details.synthesis import Synthesis, train
from avatarbuild.simulation import wrinkles
from avatarbuild.simulation.chart import Chart, chart_of
from avatarbuild.simulation.noise import fractal
from avatarbuild.simulation.performance import perform
from avatarbuild.simulation.subject import Subject, random_subject
from avatarbuild.template import ARKIT_NAMES, Template

FIRST = 2000  # seed of the first person
SIDE = 1024
CLIP, RATE = 30.0, 2.0  # seconds, frames a second


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

    def confidence(self, i: int) -> np.ndarray:
        return self.seen


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
    own, sure = (lambda i: clip.own(kept[i])), (lambda i: clip.confidence(kept[i]))
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
    sure = [clip.confidence(i) for i in kept]
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


def occlusion(t: Template, people: int) -> None:
    raise NotImplementedError


def pictures(t: Template, out: Path) -> None:
    raise NotImplementedError


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
