"""Small colour textures for the parts, painted by formula: no photograph stands behind them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .eyeball import IRIS_UV, LIMBUS_RADIUS, PUPIL_RADIUS
from .part import Floats, Part

Rgb = tuple[float, float, float]
HAZEL: Rgb = (0.42, 0.29, 0.17)
_SEED = 7
_PADDING = 8  # texels that the colours are carried over a chart's border


def colours(part: Part, resolution: int = 512, iris: Rgb = HAZEL) -> NDArray[np.uint8]:
    """Texture (resolution, resolution, 3) in sRGB of `eyeball()`, `teeth()`, `gums()` or `tongue()`; row 0 is v = 1.

    iris: sRGB in 0..1 of the middle of the iris. Every texel outside the charts bears a colour nearby.
    """
    if part.name == "eye":
        return _bytes(_eye(resolution, iris))
    values, covered = paint(part, resolution)
    if part.name.startswith("teeth"):
        image = _enamel(values)
    elif part.name == "gums":
        image = _gum(values)
    else:
        image = _tongue(values)
    return _bytes(_padded(image, covered))


def paint(part: Part, resolution: int) -> tuple[dict[str, Floats], NDArray[np.bool_]]:
    """Interpolated `position` (r, r, 3) mm and fields (r, r) at every texel centre, and which texels a chart covers."""
    names = list(part.fields)
    attributes = np.column_stack([part.vertices, *(part.fields[k] for k in names)])
    image = np.zeros((resolution, resolution, attributes.shape[1]))
    covered = np.zeros((resolution, resolution), bool)
    corners = part.uv * np.array([resolution, -resolution]) + np.array([0.0, resolution])
    for triangle, chart in zip(part.triangles, part.uv_triangles, strict=True):
        a, b, c = corners[chart]
        low = np.maximum(np.floor(np.minimum(np.minimum(a, b), c) - 0.5).astype(int), 0)
        high = np.ceil(np.maximum(np.maximum(a, b), c)).astype(int) + 1
        x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        second = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        third = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        inside = (second >= 0) & (third >= 0) & (second + third <= 1)
        rows, columns = (y[inside]).astype(int), (x[inside]).astype(int)
        weights = np.stack([1 - second - third, second, third], -1)[inside]
        image[rows, columns] = weights @ attributes[triangle]
        covered[rows, columns] = True
    return {"position": image[..., :3], **{k: image[..., 3 + i] for i, k in enumerate(names)}}, covered


def _eye(resolution: int, iris: Rgb) -> Floats:
    """Sclera with veins towards the corners of the eye, iris with fibres, collarette and limbal ring, pupil."""
    axis = (np.arange(resolution) + 0.5) / resolution - 0.5
    x, y = np.meshgrid(axis, -axis)
    radius, turn = np.hypot(x, y), np.arctan2(y, x)
    mm = radius * LIMBUS_RADIUS / IRIS_UV
    outside = np.clip((radius - IRIS_UV) / (0.488 - IRIS_UV), 0, 1)
    white = np.array([0.93, 0.91, 0.885]) - outside[..., None] ** 1.5 * np.array([0.03, 0.12, 0.125])
    rng = np.random.default_rng(_SEED)
    vein = np.zeros_like(radius)
    for _ in range(34):
        start = rng.choice([0.0, np.pi]) + rng.normal(0, 0.45)
        bend, pace, phase, reach = (
            rng.uniform(0.02, 0.09),
            rng.uniform(8, 22),
            rng.uniform(0, 6.3),
            rng.uniform(0.1, 0.5),
        )
        away = turn - start - bend * np.sin(pace * outside + phase) - 0.4 * bend * np.sin(2.7 * pace * outside)
        away = np.abs(np.mod(away + np.pi, 2 * np.pi) - np.pi) * radius
        vein += 0.5 * np.exp(-((away / 0.0022) ** 2)) * np.clip((outside - reach) / 0.4, 0, 1)
    vein = vein * _step(outside, 1.0, 0.8)
    white = white - np.clip(vein, 0, 0.8)[..., None] * np.array([0.10, 0.30, 0.29])

    share = np.clip((mm - PUPIL_RADIUS) / (LIMBUS_RADIUS - PUPIL_RADIUS), 0, 1)
    fibre = np.zeros_like(radius)
    for count in rng.integers(18, 130, 28):
        fibre += np.sin(
            count * turn + rng.uniform(0, 6.3) + rng.uniform(-2, 2) * np.sin(5 * share + rng.uniform(0, 6.3))
        )
    fibre = fibre / np.sqrt(28 / 2)
    collarette = np.exp(-(((share - 0.3 - 0.03 * np.sin(9 * turn + np.sin(4 * turn))) / 0.1) ** 2))
    tone = 1.0 + 0.17 * fibre * np.sin(np.pi * np.clip(share, 0, 1)) ** 0.5 + 0.28 * collarette - 0.15 * (share < 0.25)
    ring = _step(share, 0.72, 1.0)
    colour = np.array(iris) * (tone * (1 - 0.62 * ring))[..., None]
    colour = colour * _step(mm, PUPIL_RADIUS - 0.12, PUPIL_RADIUS + 0.15)[..., None] + 0.015
    return _mix(colour, white, _step(mm, LIMBUS_RADIUS - 0.35, LIMBUS_RADIUS + 0.35))


def _enamel(values: dict[str, Floats]) -> Floats:
    """Yellower at the neck, a little grey and translucent at the edge."""
    height = values["height"]
    image = _mix(np.array([0.86, 0.78, 0.62]), np.array([0.93, 0.90, 0.83]), _step(height, -0.1, 0.6))
    image = _mix(image, np.array([0.86, 0.86, 0.84]), 0.6 * _step(height, 0.82, 1.0))
    back = _step(-values["position"][..., 2], 12.0, 40.0)[..., None]
    return np.asarray(image * (1 + 0.015 * _noise(values["position"], 1.3)[..., None]) * (1 - 0.12 * back))


def _gum(values: dict[str, Floats]) -> Floats:
    """Coral pink at the attached gum, redder towards the vestibule and on the palate, with a paler margin."""
    mucosa = values["mucosa"]
    image = _mix(np.array([0.83, 0.57, 0.54]), np.array([0.72, 0.34, 0.34]), _step(mucosa, 0.1, 0.9))
    image = _mix(np.array([0.80, 0.50, 0.48]), image, _step(mucosa, 0.0, 0.08))
    grain = 0.03 * _noise(values["position"], 0.9) + 0.02 * _noise(values["position"], 3.1)
    return np.asarray(image * (1 + grain)[..., None])


def _tongue(values: dict[str, Floats]) -> Floats:
    """Pink and rough above, paler in the middle, dark red and smooth below."""
    above = _step(values["up"], -0.3, 0.35)
    coat = above * np.exp(-((values["position"][..., 0] / 9.0) ** 2)) * _step(values["along"], 0.15, 0.6)
    image = _mix(np.array([0.66, 0.30, 0.32]), np.array([0.78, 0.44, 0.43]), above)
    image = _mix(image, np.array([0.82, 0.58, 0.55]), 0.55 * coat)
    crease = 0.09 * above * np.exp(-((values["position"][..., 0] / 0.8) ** 2))
    grain = (0.02 + 0.03 * above) * _noise(values["position"], 2.6) - crease
    return np.asarray(image * (1 + grain)[..., None])


def _noise(position: Floats, frequency: float) -> Floats:
    """A smooth function of place (mm), about -1..1, the same at x and -x: sines in fixed random directions."""
    rng = np.random.default_rng(_SEED)
    place = position * np.array([0.0, 1.0, 1.0]) + np.abs(position) * np.array([1.0, 0.0, 0.0])
    waves = rng.normal(0, frequency, (24, 3))
    return np.asarray(np.sin(place @ waves.T + rng.uniform(0, 6.3, 24)).sum(-1) / np.sqrt(24 / 2) / 1.6)


def _padded(image: Floats, covered: NDArray[np.bool_]) -> Floats:
    """The charts' colours carried over their borders, then the mean colour everywhere else."""
    mean = image[covered].mean(0)
    image, known = np.where(covered[..., None], image, 0.0), covered
    for _ in range(_PADDING):
        total, count = np.zeros_like(image), np.zeros(known.shape)
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            total += np.roll(image, step, axis)
            count += np.roll(known, step, axis)
        fresh = ~known & (count > 0)
        image = np.where(fresh[..., None], total / np.maximum(count, 1)[..., None], image)
        known = known | fresh
    return np.where(known[..., None], image, mean)


def _step(value: Floats, low: float, high: float) -> Floats:
    t = np.clip((value - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _mix(first: Floats, second: Floats, share: Floats) -> Floats:
    return np.asarray(first + (second - first) * share[..., None])


def _bytes(image: Floats) -> NDArray[np.uint8]:
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
