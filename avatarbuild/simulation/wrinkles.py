"""Relief that comes and goes with expressions: creases of forehead, brows, eyes, cheeks, nose and chin in the chart.

Each group is a relief h (mm) of a few crease lines over the mean head; in a frame its gain is a function of the
expression weights, and the slopes and darkening of all groups add up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.simulation.chart import Chart, slopes
from avatarbuild.simulation.noise import fractal

# group -> the shapes that fold it, each with its share
GROUPS: dict[str, dict[str, float]] = {
    "forehead": {"browInnerUp": 0.7, "browOuterUpLeft": 0.35, "browOuterUpRight": 0.35},
    "glabella": {"browDownLeft": 0.6, "browDownRight": 0.6},
    "crow_left": {"eyeSquintLeft": 0.6, "cheekSquintLeft": 0.6, "mouthSmileLeft": 0.4, "eyeBlinkLeft": 0.15},
    "crow_right": {"eyeSquintRight": 0.6, "cheekSquintRight": 0.6, "mouthSmileRight": 0.4, "eyeBlinkRight": 0.15},
    "fold_left": {"mouthSmileLeft": 0.9, "noseSneerLeft": 0.4, "mouthUpperUpLeft": 0.4, "mouthDimpleLeft": 0.3},
    "fold_right": {"mouthSmileRight": 0.9, "noseSneerRight": 0.4, "mouthUpperUpRight": 0.4, "mouthDimpleRight": 0.3},
    "bunny": {"noseSneerLeft": 0.6, "noseSneerRight": 0.6},
    "chin": {"mouthShrugLower": 0.9, "mouthPucker": 0.3, "mouthPressLeft": 0.2, "mouthPressRight": 0.2},
}


@dataclass(frozen=True)
class Wrinkles:
    """
    Groups of relief in a chart of t x t texels.

    windows: group -> (rows, columns) of the texels that it touches; layers: group -> (a, b, 3) float32: dh/du, dh/dv
    and darkening at gain 1.
    """

    size: int
    windows: dict[str, tuple[slice, slice]]
    layers: dict[str, np.ndarray]

    def detail(self, gains: dict[str, float]) -> np.ndarray:
        """(t, t, 3): what `rendering.Skin.detail` holds."""
        out = np.zeros((self.size, self.size, 3), np.float32)
        for name, gain in gains.items():
            if gain > 1e-3:
                out[self.windows[name]] += gain * self.layers[name]
        return out


def gains(weights: dict[str, float]) -> dict[str, float]:
    """Group -> gain 0 … about 1.2, smooth in the weights and nil at rest."""
    found = {}
    for group, shapes in GROUPS.items():
        total = sum(share * max(weights.get(shape, 0.0), 0.0) for shape, share in shapes.items())
        found[group] = 1.2 * float(smooth_step(np.array(total), 0.05, 1.1))
    return found


def folds(chart: Chart, seed: int) -> Wrinkles:
    """The groups of one person: line positions, depths and widths vary with `seed`."""
    rng = np.random.default_rng(seed)
    at = chart.template.landmarks(chart.template.mean)
    windows, layers = {}, {}
    for name, lines in _lines(at, rng).items():
        height = _relief(chart, lines, rng)
        if name == "chin":
            height = height + _dimples(chart, at[175] * 0.5 + at[200] * 0.5, int(rng.integers(1 << 20)))
        touched = np.abs(height) > 1e-4
        if not touched.any():
            window = (slice(0, 1), slice(0, 1))
        else:
            i, j = np.nonzero(touched)
            window = (
                slice(max(int(i.min()) - 2, 0), int(i.max()) + 3),
                slice(max(int(j.min()) - 2, 0), int(j.max()) + 3),
            )
        dark = np.clip(-height / 0.45, 0, 1) * 0.32
        layers[name] = np.concatenate([slopes(height, chart.scale), dark[..., None]], axis=-1)[window].astype(
            np.float32
        )
        windows[name] = window
    return Wrinkles(chart.size, windows, layers)


def _lines(at: np.ndarray, rng: np.random.Generator) -> dict[str, list[tuple[np.ndarray, float, float]]]:
    """Group -> crease lines as (points (k, 3), depth mm, half width mm), from the 478 landmarks of the mean head."""
    found: dict[str, list[tuple[np.ndarray, float, float]]] = {name: [] for name in GROUPS}
    top, brow = at[10], at[9]
    half = 0.62 * abs(at[300][0] - at[70][0])
    for share in np.linspace(0.22, 0.78, 4) + 0.03 * rng.standard_normal(4):
        middle = brow + share * (top - brow)
        x = np.linspace(-half, half, 40) * rng.uniform(0.7, 1)
        y = middle[1] + 3.0 * np.cos(np.linspace(-2, 2, 40)) + 1.2 * rng.standard_normal() * np.linspace(-1, 1, 40)
        z = middle[2] - 0.0045 * x**2
        found["forehead"].append((np.stack([x, y, z], 1), rng.uniform(0.28, 0.45), rng.uniform(0.9, 1.3)))
    for aside in (-rng.uniform(5, 8), rng.uniform(5, 8)):
        s = np.linspace(-1, 1, 20)
        line = np.stack([aside * (1 + 0.15 * s), at[9][1] + 9 * s, np.full(20, at[9][2])], 1)
        found["glabella"].append((line, rng.uniform(0.3, 0.5), rng.uniform(0.9, 1.3)))
    for side, corner, sign in (("left", 263, 1.0), ("right", 33, -1.0)):
        for angle in (0.55, 0.12, -0.35):
            s = np.linspace(0, 1, 20)
            x = at[corner][0] + sign * (6 + 17 * s * np.cos(angle))
            y = at[corner][1] + 17 * s * np.sin(angle) + 3 * s * s * np.sign(angle)
            line = np.stack([x, y, at[corner][2] - 14 * s - 3], 1)
            found[f"crow_{side}"].append((line, rng.uniform(0.2, 0.35), rng.uniform(0.7, 1.0)))
    for side, path in (("left", (358, 423, 426, 436, 432)), ("right", (129, 203, 206, 216, 212))):
        corners = at[list(path)]
        s = np.linspace(0, len(path) - 1, 50)
        line = np.stack([np.interp(s, np.arange(len(path)), corners[:, c]) for c in range(3)], 1)
        found[f"fold_{side}"].append((line, rng.uniform(0.45, 0.7), rng.uniform(1.3, 1.8)))
    for inner, outer in ((197, 343), (197, 114)):
        for shift in (-4.0, 0.5, 5.0):
            s = np.linspace(0.25, 0.95, 16)[:, None]
            line = at[inner] * (1 - s) + at[outer] * s + [0, shift, 0]
            found["bunny"].append((line, rng.uniform(0.2, 0.32), rng.uniform(0.7, 1.0)))
    s = np.linspace(-1, 1, 30)
    middle = 0.45 * at[17] + 0.55 * at[199]
    line = np.stack([17 * s, middle[1] - 3.5 * s * s, middle[2] - 4 * s * s], 1)
    found["chin"].append((line, 0.4, 1.5))
    return found


def _relief(chart: Chart, lines: list[tuple[np.ndarray, float, float]], rng: np.random.Generator) -> np.ndarray:
    """(t, t) mm: sum over lines of -depth exp(-(d/w)^2) with bulges on both sides, fading towards the ends."""
    height = np.zeros((chart.size, chart.size), np.float32)
    skin = chart.part == 0
    for points, depth, width in lines:
        wander = np.cumsum(rng.normal(0, 0.16, len(points)))
        points = points + np.stack([0 * wander, wander - wander.mean(), 0 * wander], 1)
        dense = np.stack(
            [np.interp(np.linspace(0, 1, 160), np.linspace(0, 1, len(points)), points[:, c]) for c in range(3)], 1
        )
        # The drawn line need not lie on the skin: distances count across the face only.
        reach = np.array([8.0, 8.0, 30.0])
        low, high = dense.min(0) - reach, dense.max(0) + reach
        near = skin & ((chart.position > low) & (chart.position < high)).all(-1)
        rows, columns = np.nonzero(near)
        flat = np.array([1.0, 1.0, 0.35])
        d, k = cKDTree(dense * flat).query(chart.position[rows, columns] * flat)
        fade = np.sin(np.pi * np.clip(k / 159, 0.001, 0.999)) ** 0.6
        uneven = 0.8 + 0.25 * fractal(chart.position[rows, columns], 6.0, 2, int(rng.integers(1 << 20)))
        valley = -np.exp(-((d / width) ** 2)) + 0.38 * np.exp(-(((d - 2.1 * width) / (1.1 * width)) ** 2))
        height[rows, columns] += depth * fade * uneven * valley
    return height


def _dimples(chart: Chart, centre: np.ndarray, seed: int) -> np.ndarray:
    reach = np.exp(-((chart.position - centre) ** 2).sum(-1) / 13.0**2) * (chart.part == 0)
    rows, columns = np.nonzero(reach > 0.02)
    height = np.zeros((chart.size, chart.size), np.float32)
    height[rows, columns] = 0.13 * fractal(chart.position[rows, columns], 3.5, 2, seed) * reach[rows, columns]
    return height
