"""Skin of our own making: albedo, gloss and fine relief in the template's chart, different for every seed.

The logarithm of the albedo is that of a skin tone, less melanin and blood times their absorption: two pigments vary,
and everything that is painted is an amount of one of them. Noise is solid noise on the mean head, so it has no seams.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.simulation.chart import Chart, filled, slopes
from avatarbuild.simulation.noise import cells, fractal

_MELANIN = np.array([0.36, 0.62, 0.85], np.float32)
_BLOOD = np.array([0.04, 0.46, 0.42], np.float32)
_TONES = np.array([[238, 203, 182], [222, 176, 148], [198, 148, 116], [150, 103, 76], [98, 66, 50]]) / 255
# landmarks: cheeks, tip of the nose, chin, between the brows, under the eyes
_CHEEKS, _NOSE, _CHIN, _UNDER_EYES = (50, 280), (4,), (152, 175), (119, 348)


@dataclass(frozen=True)
class Person:
    """
    What makes a skin: tone 0 (light) … 1 (dark), freckles and stubble 0 … 1, redness about 1, hair and iris (3,)
    linear colours, and the seed of everything else.
    """

    tone: float
    freckles: float
    stubble: float
    redness: float
    hair: np.ndarray
    iris: np.ndarray
    seed: int


@dataclass(frozen=True)
class Surface:
    """albedo (t, t, 3) linear, gloss (t, t), relief (t, t) mm, slopes (t, t, 2): float32, continued off-chart."""

    albedo: np.ndarray
    gloss: np.ndarray
    relief: np.ndarray
    slopes: np.ndarray

    def channels(self) -> np.ndarray:
        """(t, t, 6): what `rendering.Skin.surface` holds."""
        return np.concatenate([self.albedo, self.gloss[..., None], self.slopes], axis=-1)


def random_person(rng: np.random.Generator) -> Person:
    """A person's colours, drawn at random."""
    tone = rng.random()
    hair = np.array([0.05, 0.032, 0.02]) * np.exp(rng.normal(0, 0.6)) * (1.6 - 1.3 * tone)
    irises = np.array(
        [[0.10, 0.05, 0.02], [0.16, 0.10, 0.04], [0.10, 0.15, 0.07], [0.12, 0.20, 0.30], [0.2, 0.25, 0.28]]
    )
    iris = irises[int(rng.integers(2 if tone > 0.55 else 5))] * np.exp(0.15 * rng.standard_normal(3))
    return Person(
        tone=float(tone),
        freckles=float(max(rng.normal(0.1, 0.35), 0) * (1 - tone)),
        stubble=float(rng.choice([0.0, 0.0, 0.5, 1.0]) * rng.uniform(0.5, 1)),
        redness=float(rng.uniform(0.7, 1.4)),
        hair=hair,
        iris=iris,
        seed=int(rng.integers(1 << 20)),
    )


def paint(chart: Chart, person: Person) -> Surface:
    """The surface of the whole head: skin, eyes, teeth, gums and tongue."""
    template = chart.template
    rng = np.random.default_rng(person.seed)
    seeds = iter(rng.integers(1 << 20, size=40).tolist())
    # All that is skin is painted texel by texel, in lists of the chart's skin texels.
    at = np.nonzero(chart.part == 0)
    q = chart.position[at]
    melanin, blood, relief = (np.zeros(len(q), np.float32) for _ in range(3))

    lips, lids, nose, ears, scalp, mouth = (
        chart.region(name, blur)[at]
        for name, blur in (("lips", 1), ("lids", 2), ("nose", 3), ("ears", 3), ("scalp", 5), ("mouth", 1))
    )
    landmarks = template.landmarks(template.mean)
    cheeks = _blobs(q, landmarks[list(_CHEEKS)], 17)
    tip = _blobs(q, landmarks[list(_NOSE)], 11)
    under = _blobs(q, landmarks[list(_UNDER_EYES)], 9)
    chin = _blobs(q, landmarks[list(_CHIN)], 12)

    # Blotches: long waves come from the vertices, short ones from the texels.
    for wavelength, m, b in ((45.0, 0.10, 0.10), (16.0, 0.09, 0.16)):
        at_vertices = np.stack([fractal(template.mean, wavelength, 3, next(seeds)) for _ in range(2)], 1)
        both = chart.field(at_vertices)[at]
        melanin += m * both[:, 0]
        blood += b * both[:, 1]
    middle, fine = fractal(q, 4.5, 2, next(seeds)), fractal(q, 1.5, 2, next(seeds))
    melanin += 0.10 * middle + 0.11 * fine
    blood += 0.11 * fractal(q, 3.2, 2, next(seeds)) - 0.05 * fine
    relief += 0.012 * fine

    # Pores: about 1.2 mm apart, wider on nose and cheeks.
    distance, label = cells(q, 1.25, next(seeds))
    open_ = 0.35 + 0.75 * np.clip(nose + cheeks + 0.6 * chin, 0, 1)
    pore = np.exp(-((distance / (0.17 + 0.10 * open_)) ** 2)) * open_ * (0.4 + 0.9 * label)
    pore *= 1 - np.clip(lips + 0.7 * lids, 0, 1)
    melanin += 0.30 * pore
    relief -= 0.055 * pore

    # Freckles thin out away from cheeks and nose; moles are few and raised.
    distance, label = cells(q, 3.2, next(seeds))
    likely = (0.12 + np.clip(1.3 * cheeks + tip + nose, 0, 1)) * min(person.freckles, 1)
    freckle = (label < 0.5 * likely) * smooth_step(distance, 1.15, 0.35)
    melanin += 0.75 * freckle * (0.5 + label)
    for k in rng.integers(0, len(q), int(rng.integers(10, 22))):
        radius = rng.uniform(0.5, 1.7)
        near, away = _around(q, q[k], radius * 1.25)
        spot = smooth_step(away, radius * 1.25, radius * 0.65)
        melanin[near] += rng.uniform(0.7, 2.0) * spot
        relief[near] += 0.12 * radius * spot
    for k in rng.integers(0, len(q), 10):
        radius = rng.uniform(1.0, 2.6)
        near, away = _around(q, q[k], 4 * radius)
        blood[near] += rng.uniform(0.2, 0.6) * np.exp(-((away / radius) ** 2))

    blood += person.redness * (0.34 * cheeks + 0.45 * tip + 0.30 * ears + 0.12 * lids + 0.15 * chin + 0.12 * under)
    melanin += 0.16 * under + 0.08 * lids

    # Lips: red with fine upright lines.
    lines = fractal(q * [1.0, 0.22, 0.22], 1.1, 2, next(seeds))
    ragged = smooth_step(lips + 0.10 * middle, 0.32, 0.62)
    blood += ragged * (1.25 + 0.22 * lines)
    melanin += ragged * (0.22 + 0.06 * lines)
    relief += ragged * 0.05 * lines
    rim = _near_contours(chart, ("lips_inner_upper", "lips_inner_lower"), 1.2)[at]
    blood += 0.7 * rim
    melanin += 0.35 * rim

    # Hair under the skin: the shaven scalp and the beard's shade.
    distance, label = cells(q, 0.75, next(seeds))
    dots = np.exp(-((distance / 0.2) ** 2)) * (0.3 + label)
    scalp_share = smooth_step(scalp + 0.12 * fractal(q, 9.0, 3, next(seeds)), 0.35, 0.75)
    beard = person.stubble * _beard(q, landmarks) * (1 - np.clip(2 * lips, 0, 1))
    hairy = np.clip(scalp_share + beard, 0, 1)
    grey = 0.25 * hairy + 1.1 * dots * hairy

    tone = np.array([np.interp(person.tone * 4, range(5), _TONES[:, c]) for c in range(3)]) ** 2.2
    log_albedo = np.log(tone).astype(np.float32) - melanin[:, None] * _MELANIN - blood[:, None] * _BLOOD
    colour = np.exp(log_albedo - grey[:, None] * np.array([0.62, 0.55, 0.46], np.float32))
    shine = 0.75 + 0.45 * np.clip(tip + nose * 0.6 + 0.5 * cheeks, 0, 1) + 0.7 * ragged - 0.2 * scalp_share
    shine *= 1 + 0.12 * fine

    hairs = _brow_hairs(chart, rng)[at]
    colour = colour * (1 - hairs[:, None]) + np.asarray(person.hair, np.float32) * hairs[:, None]
    lashes = _near_contours(chart, ("lid_upper_left", "lid_upper_right"), 0.75)
    lashes = np.maximum(lashes, 0.55 * _near_contours(chart, ("lid_lower_left", "lid_lower_right"), 0.45))[at]
    lashes = np.clip(lashes * (0.9 + 0.5 * fractal(q * [1.0, 0.1, 0.1], 0.7, 1, next(seeds))), 0, 0.96)
    colour = colour * (1 - lashes[:, None]) + 0.3 * np.asarray(person.hair, np.float32) * lashes[:, None]
    deep = np.clip(mouth * 1.4 - ragged, 0, 1)[:, None]
    colour = colour * (1 - deep) + np.array([0.22, 0.045, 0.04], np.float32) * deep
    shine = shine * (1 - np.maximum(hairs, lashes) * 0.7)

    painted = np.zeros((chart.size, chart.size, 5), np.float32)
    painted[at] = np.concatenate([colour, shine[:, None], relief[:, None]], axis=1)
    _paint_parts(chart, person, painted[..., :3], painted[..., 3], painted[..., 4], next(seeds))
    inside = chart.part >= 0
    painted = filled(painted, inside)
    slope = slopes(painted[..., 4], chart.scale)
    # Where the chart ends a difference of neighbours means nothing.
    slope[cv2.erode(inside.astype(np.uint8), np.ones((3, 3))) == 0] = 0
    return Surface(np.clip(painted[..., :3], 0.002, 0.92), painted[..., 3], painted[..., 4], slope)


def _around(points: np.ndarray, centre: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Which of the points (n, 3) lie within `reach` of `centre` along x, and their distances (k,) from it."""
    near = np.flatnonzero(np.abs(points[:, 0] - centre[0]) <= reach)
    return near, np.linalg.norm(points[near] - centre, axis=1)


def _blobs(position: np.ndarray, centres: np.ndarray, radius: float) -> np.ndarray:
    """(n,) sum of exp(-(|x - c| / radius)^2) at positions (n, 3), clipped at 1."""
    total = np.zeros(len(position), np.float32)
    for centre in centres.astype(np.float32):
        total += np.exp(-((position - centre) ** 2).sum(-1) / radius**2)
    return np.clip(total, 0, 1)


def _near_contours(chart: Chart, names: tuple[str, ...], reach: float) -> np.ndarray:
    """(t, t) exp(-(d / reach)^2) of the distance d to polylines of the template, drawn in the chart."""
    canvas = np.full((chart.size, chart.size), 255, np.uint8)
    for name in names:
        for line in chart_lines(chart, chart.template.contours[name]):
            cv2.polylines(canvas, [np.round(line * 16).astype(np.int32)], False, 0, 1, cv2.LINE_8, 4)
    distance = cv2.distanceTransform(canvas, cv2.DIST_L2, 5) / chart.scale
    return np.exp(-((distance / reach) ** 2)) * (chart.part == 0)


def chart_lines(chart: Chart, vertices: np.ndarray) -> list[np.ndarray]:
    """Texel coordinates (k, 2), from 0 at the first centre, of a polyline of vertices; one line unless a seam cuts."""
    template = chart.template
    own = np.zeros(len(template.mean), np.int64)
    skin = template.parts["skin"].triangles
    own[template.triangles[skin].reshape(-1)] = template.uv_triangles[skin].reshape(-1)
    points = template.uv[own[vertices]] * [chart.size, -chart.size] + [0, chart.size] - 0.5
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    cuts = np.nonzero(step > 20 * chart.scale)[0] + 1
    return [piece for piece in np.split(points, cuts) if len(piece) > 1]


def _beard(position: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """(n,) at positions (n, 3): 1 on jaw, chin and upper lip, fading into cheeks and neck."""
    nose, corner, chin = landmarks[2], landmarks[61], landmarks[152]
    low = smooth_step(position[..., 1], nose[1] + 6 - 4, nose[1] - 8)
    middle = np.abs(position[..., 0]) / max(abs(corner[0]), 1.0)
    high_cheek = smooth_step(position[..., 1] - 0.35 * (corner[1] - chin[1]) * middle, nose[1] + 22, nose[1] - 14)
    neck = smooth_step(position[..., 1], chin[1] - 45, chin[1] - 10)
    front = smooth_step(position[..., 2], -45, -15)
    return (low * high_cheek * neck * front).astype(np.float32)


def _brow_hairs(chart: Chart, rng: np.random.Generator) -> np.ndarray:
    """(t, t) coverage by some hundred short curved strokes along each brow, steep inside, lying flat outside."""
    t, scale = chart.size, chart.scale
    cover = np.zeros((t, t), np.float32)
    thick, full = rng.uniform(3.4, 5.2), int(rng.uniform(550, 850))
    for name in ("brow_left", "brow_right"):
        line = chart_lines(chart, chart.template.contours[name])[0]
        if np.abs(chart.template.mean[chart.template.contours[name][0], 0]) > np.abs(
            chart.template.mean[chart.template.contours[name][-1], 0]
        ):
            line = line[::-1]
        arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        out = np.sign(line[-1, 0] - line[0, 0])
        for _ in range(full):
            s = rng.random() ** 0.9
            root = np.array([np.interp(s * arc[-1], arc, line[:, c]) for c in range(2)])
            ahead = np.array([np.interp(min(s + 0.05, 1) * arc[-1], arc, line[:, c]) for c in range(2)])
            behind = np.array([np.interp(max(s - 0.05, 0) * arc[-1], arc, line[:, c]) for c in range(2)])
            tangent = (ahead - behind) / (np.linalg.norm(ahead - behind) + 1e-9)
            up = np.array([tangent[1], -tangent[0]]) * out
            half = thick * np.interp(s, [0, 0.15, 0.6, 1], [0.75, 1.0, 0.85, 0.2])
            offset = np.clip(rng.normal(0, 0.5), -1, 1)
            start = root + up * offset * half * scale
            lift = np.interp(s, [0, 0.25, 1], [1.2, 0.65, 0.12]) - 0.45 * (offset > 0.2) + 0.18 * rng.standard_normal()
            length = rng.uniform(3.5, 7.5) * np.interp(s, [0, 0.3, 1], [0.8, 1, 0.8]) * scale
            along = np.cos(lift) * tangent + np.sin(lift) * up
            bend = np.cos(lift * 0.4) * tangent + np.sin(lift * 0.4) * up
            stroke = np.stack([start, start + 0.5 * length * along, start + 0.5 * length * (along + bend)])
            low = np.floor(stroke.min(0)).astype(int) - 2
            high = np.ceil(stroke.max(0)).astype(int) + 3
            if (low < 0).any() or (high > t).any():
                continue
            layer = np.zeros((high[1] - low[1], high[0] - low[0]), np.uint8)
            thickness = 1 if scale < 7 else 2
            cv2.polylines(
                layer, [np.round((stroke - low) * 16).astype(np.int32)], False, 255, thickness, cv2.LINE_AA, 4
            )
            window = cover[low[1] : high[1], low[0] : high[0]]
            window[:] = 1 - (1 - window) * (1 - layer.astype(np.float32) / 255 * rng.uniform(0.35, 0.75))
    return np.minimum(cv2.GaussianBlur(cover, (0, 0), 0.6), 0.93) * (chart.part == 0)


def _paint_parts(
    chart: Chart, person: Person, albedo: np.ndarray, gloss: np.ndarray, relief: np.ndarray, seed: int
) -> None:
    """Eyes, teeth, gums and tongue, in place."""
    names = list(chart.template.parts)
    rng = np.random.default_rng(seed)
    for k, name in enumerate(names):
        at = chart.part == k
        if k == 0 or not at.any():
            continue
        q = chart.position[at]
        grain = fractal(q, 2.0, 3, int(rng.integers(1 << 20)))
        if name.startswith("eye"):
            centre = chart.template.eye_centres[0 if name == "eye_left" else 1]
            albedo[at] = _eye(q - centre, person, seed, grain)
            gloss[at] = 2.0
        elif name.startswith("teeth"):
            albedo[at] = np.array([0.66, 0.60, 0.47]) * np.exp(0.05 * grain)[:, None]
            gloss[at] = 1.2
        else:
            tint = np.array([0.42, 0.13, 0.12]) if name == "gums" else np.array([0.38, 0.12, 0.11])
            albedo[at] = tint * np.exp(0.12 * grain)[:, None]
            gloss[at] = 1.2
        relief[at] = 0


def _eye(offset: np.ndarray, person: Person, seed: int, grain: np.ndarray) -> np.ndarray:
    """Colours (k, 3) of an eyeball from the offsets (k, 3) mm to its centre; the gaze is along +z."""
    radius = np.hypot(offset[:, 0], offset[:, 1])
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    front = offset[:, 2] > 0
    veins = fractal(offset * [1.0, 1.0, 0.4], 3.0, 4, seed + 3)
    white = np.array([0.58, 0.53, 0.49]) * np.exp(0.03 * grain)[:, None]
    away = smooth_step(radius, 6.5, 11.5)[:, None]
    thin = np.exp(-((veins / 0.08) ** 2))[:, None] * away
    white = white * (1 - 0.5 * thin * [0.1, 0.9, 0.9]) * (1 - 0.12 * away * [0.3, 1, 1])
    spokes = fractal(np.stack([np.cos(angle) * 9, np.sin(angle) * 9, radius * 0.22], -1), 1.0, 3, seed + 5)
    iris = 0.6 * person.iris * np.exp(0.45 * spokes)[:, None] * (1 + 0.7 * smooth_step(radius, 3.9, 2.5)[:, None])
    iris = iris * (1 - 0.75 * smooth_step(radius, 5.0, 5.85)[:, None])
    colours = white + (iris - white) * (front * smooth_step(radius, 6.1, 5.65))[:, None]
    pupil = (front * smooth_step(radius, 2.15, 1.9))[:, None]
    return np.clip(colours * (1 - pupil) + 0.004 * pupil, 0.003, 0.9)
