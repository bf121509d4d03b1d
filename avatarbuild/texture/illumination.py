"""Equation (3): the light that the photos' fused texture still bears, and the skin's albedo without it.

    c_ij = r_ij o s_ij,   s_ij = a_ij o y^T phi(b_ij) + d_ij                                                   (1)

a is the share of light that reaches the point past the rest of the head, b the mean direction that is open, both by
rays; the paper has a = 1 and b = n. First y with d = 0 and r the skin's constant colour, then d with y fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from avatarbuild.artefacts import Neutral
from avatarbuild.energies import harmonics
from avatarbuild.formats.colour import LUMINANCE
from avatarbuild.geometry.meshes import vertex_areas, vertex_normals
from avatarbuild.registration.eye_painting import WHITE
from avatarbuild.solvers import smooth_field
from avatarbuild.template import Template
from avatarbuild.texture import occlusion, skin_tone
from avatarbuild.texture.chart import Chart, continued, draw_chart, texels_per_mm
from avatarbuild.texture.fused import Fused

_GRID = 1024  # texels of the light's own map at most; what it holds is smooth
_FIELD = 512  # of the corrective field's
_LEAST = 0.15  # of the mean light, the least that reaches any place of the skin
_DOUBTFUL = 0.5  # weight in the second stage of a texel of the face whose colour is not the skin's
_DIM = 0.3  # of the mean light: below this, errors count absolutely again
_TINY = 1e-6
_BESIDE = (36.0, 42.0, 48.0)  # degrees from the gaze: where the white shows beside the iris
_COLLAR = 6.0  # mm from what no photo saw, within which a speck on neck, scalp or ears is no mole
_FINE, _AROUND = 3.0, 5.0  # mm: blurs of what is fine in the light, and of where it is judged together
_SURE = 0.1  # log: fine light weaker than this is believed whatever the photos show
_BEST = 3  # places of a white, the best-lit ones, that are compared with its bright pixels


@dataclass(frozen=True)
class LightWeights:
    """
    The weights of equation (3) in our units: residuals are divided by the skin's colour, so that they are shares of the
    mean light; lengths are millimetres on the face.

    ridge            of the five second-order coefficients of y, per unit of area
    huber            shares of the light beyond which a residual counts linearly
    symmetry         how much more skin differs from the mean colour than from its other side (ratio of standard
                     deviations): differences between the sides are light's
    field            whether there is a corrective field at all
    field_length     mm: d follows half of what has this wavelength (l3), where the sides differ
    field_small      l1 where the sides differ
    even_length      mm: the same for the half of d that is equal on both sides, which may as well be skin
    even_small       l1 there
    outlier          log ratio below the expected colour beyond which a texel is no plain skin (beard, brow, fold)
    brightest        times the skin's mean brightness that its brightest places may have; the rest is light
    """

    ridge: float = 1e-3
    huber: float = 0.06
    symmetry: float = 3.0
    field: bool = True
    field_length: float = 25.0
    field_small: float = 0.05
    even_length: float = 25.0
    even_small: float = 0.3
    outlier: float = 0.45
    brightest: float = 1.4


@dataclass(frozen=True)
class Light:
    """
    albedo, shading (s, s, 3) float32 linear: albedo * shading = the fused colour without its highlights; harmonics y
    (9, 3) in the head frame; skin_colour r (3,); field (g, g, 3) d on its own grid, or None; open (n,) and bent (n, 3)
    of the vertices; mask (g, g) the texels that the light was found from; skin (s, s) float32 in [0, 1]: 0 where scalp,
    neck or ears are not of the skin's colour, so that cloth, hair or what stands behind was seen there.
    """

    albedo: np.ndarray
    shading: np.ndarray
    harmonics: np.ndarray
    skin_colour: np.ndarray
    field: np.ndarray | None
    open: np.ndarray
    bent: np.ndarray
    mask: np.ndarray
    skin: np.ndarray


class Hidden(NamedTuple):
    """What the head hides of the light: openness (n,), normals and mean open directions (n, 3) of the vertices."""

    open: np.ndarray
    normal: np.ndarray
    bent: np.ndarray

    def direction(self) -> np.ndarray:
        """b (n, 3): half way from the normal to the mean open direction, since harmonics are smooth themselves."""
        b = self.normal + self.bent
        return b / np.maximum(np.linalg.norm(b, axis=1, keepdims=True), 1e-9)


class Card(NamedTuple):
    """The white of an eye as a grey card: colour (3,) as the fused texture would show it, openness (k,) and mean open
    directions (k, 3) of places on it."""

    colour: np.ndarray
    open: np.ndarray
    bent: np.ndarray


def factor(
    fused: Fused,
    template: Template,
    neutral: Neutral,
    options: LightWeights | None = None,
    whites: Sequence[tuple[int, np.ndarray]] = (),
) -> Light:
    """
    The light and the albedo of a fused texture: equations (1)–(3) above.

    The mean light on the skin seen is that of `skin_tone.divide`. whites: eye (0 left, 1 right) and colour (3,) of its
    white, with the photo's gain; they tell how bright the light is. What they leave open between a brighter light and
    a brighter skin is not decidable.
    """
    o = LightWeights() if options is None else options
    size = fused.colour.shape[0]
    grid = min(size, _GRID)
    chart = draw_chart(template, template.uv, template.uv_triangles, grid)
    matt, seen = _matt(fused, grid)
    normals = vertex_normals(neutral.vertices, template.triangles)
    open_, towards = occlusion.of_vertices(neutral.vertices, template.triangles, template.parts["skin"].vertices)
    hidden = Hidden(open_, normals, towards)
    cards = _cards(template, neutral, whites)
    plain = _plain_skin(template, chart) * seen
    mean = _mean(matt, plain)
    lit = np.ones_like(matt)
    for _ in range(2):
        # whether a texel has the skin's colour shows once its light is known
        own = plain * _alike(matt / lit, plain, template, chart)
        y, r, a, bent = _harmonics(template, neutral, chart, matt, own, hidden, mean, cards, o)
        lit = _shading_map(template, chart, a, bent, y)
        # nine numbers undershoot where little light arrives; no place of a room is black
        lit = np.maximum(lit, _LEAST * lit[own > 0].mean(axis=0) if (own > 0).any() else _TINY)
    lit = _as_seen(lit, matt, seen, texels_per_mm(template, neutral.vertices, grid))
    # on the face itself a strange colour is more often strange light, which the field is there for
    face = chart.field(template.regions["face"].astype(np.float32), template.triangles)
    plain = np.maximum(own, _DOUBTFUL * plain * (face > 0.5))
    field = None
    if o.field:
        field = _field(matt, lit, plain, r, texels_per_mm(template, neutral.vertices, 1), o)
        lit = lit + _resized(field, grid)
    lit = np.maximum(lit, _LEAST * lit[plain > 0].mean(axis=0) if (plain > 0).any() else _TINY)
    lit = _at_least(lit, matt, seen, r, o.brightest)
    skin = _resized(_skin(matt / lit, r, template, chart)[..., None], size)
    inside = chart.part == 1
    lit = continued(lit.astype(np.float32), inside)
    shading = _resized(lit, size)
    albedo = _without_highlights(fused, matt, seen, size)
    np.divide(albedo, np.maximum(shading, _TINY), out=albedo)
    np.clip(albedo, 0, 1, out=albedo)
    albedo[~fused.chart] = 0
    return Light(albedo, shading, y, r, field, open_, bent, plain, skin.reshape(size, size))


def _matt(fused: Fused, grid: int) -> tuple[np.ndarray, np.ndarray]:
    """(g, g, 3) the colours less the smooth part of the highlights, and (g, g) in [0, 1] how well they were seen."""
    seen = (fused.seen > 0) & fused.chart
    weight = cv2.resize(seen.astype(np.float32), (grid, grid), interpolation=cv2.INTER_AREA)
    divisor = np.maximum(weight, _TINY)[..., None]
    masked = fused.colour * seen[..., None]
    colour = cv2.resize(masked, (grid, grid), interpolation=cv2.INTER_AREA) / divisor
    quality = cv2.resize(fused.seen * seen, (grid, grid), interpolation=cv2.INTER_AREA)
    if fused.low is not None:
        low = cv2.resize(fused.low * seen[..., None], (grid, grid), interpolation=cv2.INTER_AREA) / divisor
        colour = colour - _highlights(colour, low, weight)
    return colour * (weight > 0.5)[..., None], np.where(weight > 0.5, quality, 0)


def _highlights(colour: np.ndarray, low: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(g, g, 3) the smooth excess of the chosen views over the lower envelope of all of them, never negative."""
    sigma = 4.0 * colour.shape[0] / 1024 * 2.6
    area = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), _TINY)[..., None]
    excess = cv2.GaussianBlur((colour - low) * weight[..., None], (0, 0), sigma) / area
    return np.clip(excess, 0, 0.4 * colour)


def _without_highlights(fused: Fused, matt: np.ndarray, seen: np.ndarray, size: int) -> np.ndarray:
    """(s, s, 3) float32: the fused colours less what `_matt` took away, at full size."""
    if fused.low is None:
        return fused.colour.astype(np.float32, copy=True)
    grid = matt.shape[0]
    low_size = cv2.resize(fused.colour, (grid, grid), interpolation=cv2.INTER_AREA)
    excess: np.ndarray = np.where((seen > 0)[..., None], np.maximum(low_size - matt, 0), 0).astype(np.float32)
    excess = cv2.GaussianBlur(continued(excess, seen > 0), (0, 0), 2.0 * grid / 1024)
    return np.maximum(fused.colour - _resized(excess, size), 0.3 * fused.colour)


def _plain_skin(template: Template, chart: Chart) -> np.ndarray:
    """(g, g) in [0, 1]: skin of the face's own colour: no lips, lids, brows, sockets, mouth or ears, nothing dark."""
    r = template.regions
    other = np.zeros(len(template.mean))
    for name in ("lips", "lids", "brows", "sockets", "mouth", "ears"):
        other[r[name]] = 1
    weight = np.where(r["face"], 1.0, np.where(r["neck"] | r["scalp"], 0.15, 0.5)) * (1 - other)
    return np.where(chart.part == 1, chart.field(weight, template.triangles) > 0.1, 0) * chart.field(
        weight, template.triangles
    )


def _alike(matt: np.ndarray, plain: np.ndarray, template: Template, chart: Chart) -> np.ndarray:
    """(g, g) in [0, 1]: 1 where the colour (not the brightness) is that of the face's skin: no cloth, hair, beard."""
    face = plain * (chart.field(template.regions["face"].astype(float), template.triangles) > 0.5)
    if not (face > 0).any():
        return np.ones_like(plain)
    log = np.log(np.maximum(matt, 1e-3))
    tint = np.stack([log[..., 0] - log[..., 1], log[..., 2] - log[..., 1]], axis=-1)
    values = tint[face > 0.5] if (face > 0.5).any() else tint[face > 0]
    middle = np.median(values, axis=0)
    spread = np.maximum(1.4826 * np.median(np.abs(values - middle), axis=0), 0.06)
    away = np.sqrt((((tint - middle) / spread) ** 2).sum(axis=-1))
    return np.clip((6.0 - away) / 2.5, 0, 1)


def _skin(albedo: np.ndarray, r: np.ndarray, template: Template, chart: Chart) -> np.ndarray:
    """(g, g) in [0, 1]: `Light.skin`, and 1 all over the face, whose lips, brows and beard are the person's."""
    log = np.log(np.maximum(albedo, 1e-3)) - np.log(r)
    tint = np.stack([log[..., 0] - log[..., 1], log[..., 2] - log[..., 1]], axis=-1)
    away = np.sqrt((tint**2).sum(axis=-1)) / 0.45 + np.maximum(log.mean(axis=-1), 0) / 0.5
    good = (away < 1).astype(np.float32)
    reach = max(round(2 * 2.6 * chart.size / 1024), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    # specks are moles, but at the rim of what was seen the last of a collar; then the rim of what is left goes, where
    # colours of both mix
    unseen = (albedo.max(axis=-1) <= 0).astype(np.uint8)
    pieces, piece = cv2.connectedComponents(((good == 0) & (unseen == 0)).astype(np.uint8), connectivity=8)
    beside = cv2.distanceTransform(1 - unseen, cv2.DIST_L2, 5) < _COLLAR * 2.6 * chart.size / 1024
    collar = np.zeros(pieces, bool)
    collar[piece[beside]] = True
    collar[0] = False
    good = np.where(collar[piece], 0, cv2.morphologyEx(good, cv2.MORPH_CLOSE, disc)).astype(np.float32)
    good = cv2.erode(good, disc)
    face = chart.field(template.regions["face"].astype(np.float32), template.triangles)
    return np.maximum(cv2.GaussianBlur(good, (0, 0), max(reach / 2, 0.5)), np.clip(2 * face, 0, 1))


def _mean(colour: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(3,) weighted median of the colours."""
    on = weight > 0.25 * max(float(weight.max()), _TINY)
    return np.median(colour[on], axis=0) if on.any() else np.full(3, 0.3)


def _harmonics(
    template: Template,
    neutral: Neutral,
    chart: Chart,
    matt: np.ndarray,
    plain: np.ndarray,
    hidden: Hidden,
    mean: np.ndarray,
    cards: list[Card],
    o: LightWeights,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """y (9, 3), r (3,), the light's share a (n, 3) and its direction b (n, 3), by alternation, since a depends on r by
    the light between skin."""
    skin = template.parts["skin"].vertices
    colour, weight = _at_vertices(template, chart, matt, plain)
    weight[skin.stop :] = 0
    weight = weight * vertex_areas(neutral.vertices, template.triangles)
    r, _ = skin_tone.divide(mean)
    bent = hidden.direction()
    if not weight.any():  # no skin was seen: even light
        return np.eye(9)[:, :1] * np.ones(3), r, occlusion.between_skin(hidden.open, r), bent
    relative = np.ones(len(weight))
    for _ in range(3):
        a = occlusion.between_skin(hidden.open, r)
        y = _paired_fit(template, bent, a, colour / r, (weight, relative), o)
        lit = a * harmonics.shading(bent, y)
        share = weight / weight.sum()
        middle = share @ lit
        # the colour of the skin under the mean light decides between skin and light
        new = skin_tone.divide(r * middle, _light_by_whites(cards, y, r, middle))[0]
        y, lit, r = y * (r / new), lit * (r / new), new
        weight = weight * _near(colour, r * lit, o.outlier)
        # albedo is a ratio: errors count as shares of the light that is there
        bright = lit.mean(axis=1)
        relative = 1 / np.maximum(bright / (share @ bright), _DIM)
    return y, r, a, bent


def _cards(template: Template, neutral: Neutral, whites: Sequence[tuple[int, np.ndarray]]) -> list[Card]:
    """The whites of each eye, by the median photo, at places beside the iris."""
    side, up = np.meshgrid(np.radians([*_BESIDE, *(-angle for angle in _BESIDE)]), np.radians([-8.0, 8.0]))
    towards = np.stack([np.sin(side) * np.cos(up), np.sin(up), np.cos(side) * np.cos(up)], axis=-1).reshape(-1, 3)
    cards = []
    for eye in range(2):
        seen = [colour for which, colour in whites if which == eye]
        if seen:
            places = neutral.eye_centres[eye] + neutral.eye_radius[eye] * towards
            cards.append(
                Card(
                    np.median(seen, axis=0),
                    *occlusion.ambient(neutral.vertices, template.triangles, places, towards),
                )
            )
    return cards


def _light_by_whites(cards: list[Card], y: np.ndarray, r: np.ndarray, middle: np.ndarray) -> float | None:
    """Log luminance of the mean light on the skin, by the whites' best-lit places; None where no white was seen."""
    told = []
    for card in cards:
        lit = occlusion.between_skin(card.open, r) * harmonics.shading(card.bent, y)
        best = lit[np.argsort(lit.sum(axis=1), kind="stable")[-_BEST:]].mean(axis=0)
        if (best > 0).all() and (card.colour > 0).all():
            told.append(float(LUMINANCE @ np.log(card.colour * middle / (WHITE * best))))
    return float(np.mean(told)) if told else None


def _near(colour: np.ndarray, expected: np.ndarray, limit: float) -> np.ndarray:
    """(n,) in [0, 1]: 0 where the brightness is `limit` (log) darker or 1.5 times that lighter than expected."""
    ratio = np.log(np.maximum(colour.mean(axis=1), 1e-4) / np.maximum(expected.mean(axis=1), 1e-4))
    return np.clip((limit + ratio) / (0.4 * limit), 0, 1) * np.clip((1.5 * limit - ratio) / (0.6 * limit), 0, 1)


def _at_vertices(
    template: Template, chart: Chart, colour: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Means (n, 3) of the colours within about 1.5 mm of the vertices, and (n,) of the weights."""
    grid = chart.size
    sigma = max(3.0 * grid / 1024, 0.6)
    area = cv2.GaussianBlur(weight.astype(np.float32), (0, 0), sigma)
    blurred = cv2.GaussianBlur((colour * weight[..., None]).astype(np.float32), (0, 0), sigma)
    corner = np.zeros(len(template.mean), np.int64)
    corner[template.triangles.reshape(-1)] = template.uv_triangles.reshape(-1)
    place = np.clip((template.uv[corner] * [grid, -grid] + [0, grid]).astype(np.int64), 0, grid - 1)
    at = (place[:, 1], place[:, 0])
    found = area[at].astype(np.float64)
    return blurred[at] / np.maximum(found, _TINY)[:, None], np.where(found > 0.05, found, 0.0)


def _paired_fit(
    template: Template,
    bent: np.ndarray,
    a: np.ndarray,
    target: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray],
    o: LightWeights,
) -> np.ndarray:
    """
    y (9, 3) = argmin sum over pairs of mirrored vertices of rho(k u) + rho(v),

    u = (e - e') / sqrt 2, v = (e + e') / sqrt 2, e = f (s - t), with weights w (n,) and factors f (n,): what differs
    between the sides counts k = `symmetry` times as much as what both sides share, since skin is alike on both. A
    vertex without its twin counts as v.
    """
    weight, factor = weights
    other = template.symmetry
    phi = harmonics.basis(bent)
    both = np.minimum(weight, weight[other])
    index = np.arange(len(weight))
    paired = (other != index) & (both > 0)
    i = index[paired & (index < other)]
    j, single = other[i], index[(weight > 0) & ~paired]
    k = max(o.symmetry, 1.0)

    def rows_of(values: np.ndarray) -> np.ndarray:
        minus, plus = (values[i] - values[j]) / np.sqrt(2), (values[i] + values[j]) / np.sqrt(2)
        return np.concatenate([k * minus, plus, values[single]])

    base = np.concatenate([both[i], both[i], weight[single]])
    ridge = (o.ridge * k * k * np.array([0, 0, 0, 0, 1.0, 1, 1, 1, 1]) + _TINY) * base.sum()
    y = np.zeros((9, 3))
    for c in range(3):
        typical = float(np.median(np.abs((factor * target[:, c])[weight > 0]))) + _TINY
        rows, goal = rows_of(phi * (factor * a[:, c])[:, None]), rows_of(factor * target[:, c])
        y[:, c] = harmonics.fit(rows, goal, base, ridge, o.huber * typical)
    return y


def _shading_map(template: Template, chart: Chart, a: np.ndarray, bent: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(g, g, 3): a o y^T phi(b) at the vertices, linear between them."""
    return chart.field(a * harmonics.shading(bent, y), template.triangles)


def _field(
    matt: np.ndarray, lit: np.ndarray, plain: np.ndarray, r: np.ndarray, scale: float, o: LightWeights
) -> np.ndarray:
    """d (f, f, 3) of the second stage: residuals c / r - s_sh, as shares of the mean light, zero off the plain skin."""
    size = min(matt.shape[0], _FIELD)
    weight = cv2.resize(plain.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    on = plain[..., None] * np.ones(3, np.float32)
    target, known = (
        cv2.resize(image.astype(np.float32) * on, (size, size), interpolation=cv2.INTER_AREA)
        / np.maximum(weight, _TINY)[..., None]
        for image in (matt / r, lit)
    )
    e = target - known
    level = max(float(np.median(weight[weight > 0])), _TINY) if (weight > 0).any() else 1.0
    # Huber's weights, once; what is far too dark is hair or a fold, what is far too bright can only be light
    m = np.minimum(weight / level, 1) * np.minimum(1, 2 * o.huber / np.maximum(np.abs(e.mean(axis=-1)), _TINY))
    dark = np.log(np.maximum(target.mean(axis=-1), 1e-3) / np.maximum(known.mean(axis=-1), 1e-3)) < -o.outlier
    m = np.where(dark, 0, m)
    texels = scale * size
    weights = smooth_field.Smoothness(
        o.even_small,
        0.0,
        smooth_field.cut_off(o.even_length * texels),
        (o.field_small, 0.0, smooth_field.cut_off(o.field_length * texels)),
    )
    return np.stack([smooth_field.solve(e[..., c], m, weights) for c in range(3)], axis=-1)


def _as_seen(lit: np.ndarray, matt: np.ndarray, seen: np.ndarray, scale: float) -> np.ndarray:
    """
    (g, g, 3): the light, its fine part f (finer than _FINE mm, in logarithms) as strong as the photos show it:

        k = argmin sum w (c - k f)^2 + _SURE^2 (k - 1)^2   in windows of _AROUND mm, 0 <= k <= 1,

    c the fine part of the colours (g, g, 3). Creases of the head's mesh that lie a millimetre beside the person's, or
    that the person lacks, would else turn into bright lines.
    """
    weight = (seen > 0).astype(np.float32)

    def around(image: np.ndarray, sigma: float) -> np.ndarray:
        area = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma * scale), 1e-3)
        return cv2.GaussianBlur(image.astype(np.float32) * weight, (0, 0), sigma * scale) / area

    f, c = (
        np.where(weight > 0, log - around(log, _FINE), 0)
        for log in (np.log(np.maximum(image.mean(axis=-1), 1e-3)) for image in (lit, matt))
    )
    k = (around(f * c, _AROUND) + _SURE**2) / (around(f * f, _AROUND) + _SURE**2)
    return lit * np.exp((np.clip(k, 0, 1) - 1) * f)[..., None]


def _at_least(lit: np.ndarray, matt: np.ndarray, seen: np.ndarray, r: np.ndarray, limit: float) -> np.ndarray:
    """(g, g, 3): the light, raised where the skin would else be over `limit` times as bright as its colour r."""
    sigma = max(3.0 * lit.shape[0] / 1024, 0.6)
    weight = (seen > 0).astype(np.float32)
    area = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)
    smooth = cv2.GaussianBlur(matt.astype(np.float32) * weight[..., None], (0, 0), sigma) / area[..., None]
    bright = smooth.mean(axis=-1) / (limit * r.mean())
    mean = np.maximum(lit.mean(axis=-1), _TINY)
    # what is missing has the mean light's own tint: nine numbers tell little of it in the dark
    tint = lit[seen > 0].mean(axis=0) if (seen > 0).any() else np.ones(3)
    return lit + np.maximum(bright - mean, 0)[..., None] * (tint / tint.mean())


def _resized(image: np.ndarray, size: int) -> np.ndarray:
    """(size, size, c) float32, linear between texel centres."""
    if image.shape[0] == size:
        return image.astype(np.float32)
    return cv2.resize(image.astype(np.float32), (size, size), interpolation=cv2.INTER_LINEAR)
