"""What no photo saw, completed: the template's gradients, the person's colours, the person's own pores.

In the logarithm of the albedo, r = log albedo where it was seen, t = log of the template's texture,

    min_u  sum_p w_p (u_p - (r_p - t_p))^2 + |G u|^2 + |u - u_0|^2 / reach^2,    completed = w r + (1 - w) (t + u + h)

u is smooth and found on a coarse grid, with ties across the seams; w in [0, 1] how far a texel was seen; u_0 the
median difference in colour; h the fine part of the person's own skin, cut from where it was seen best and laid out in
overlapping pieces whose weights keep its variance, and so do those of its mirror image from across a seam.

Sources: Perez, Gangnet, Blake, Poisson image editing, 2003; Heitz, Neyret, High-performance by-example noise using a
histogram-preserving blending operator, 2018 (variance-preserving blending).
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.solvers.sparse import Factor
from avatarbuild.template import EYE_PARTS, Template
from avatarbuild.texture.chart import Chart, continued, draw_chart, seam_ties, texels_per_mm

_COARSE = 256  # texels of u's grid
_SEEN_LOW, _SEEN_HIGH = 0.25, 0.5  # of `seen`: nothing below, all above
_SOFT = 5.0  # mm over which what was seen passes into what was not, inside what was seen
_SOFT_LIDS, _SOFT_LIPS = 0.8, 4.0  # mm there: lashes and the lips' red end at the rim of eye and mouth
_SPECK = 0.6  # mm: lids and lips are believed across unseen specks narrower than this
_RIM = 0.4  # mm over which lids and lips pass into sockets and mouth
_REACH = 90.0  # mm beyond which the colour goes back to the person's typical one
_HELD = 30.0  # weight of a texel of u's grid that was seen
_STRANGE = 0.003  # of that weight have brows, lids and lips
_CONTRAST = 1.2  # log: the offset differs from its typical value by no more
_FINE = 1.6  # mm: standard deviation of the blur that what is finer is cut off by
_PIECE = 22.0  # mm: side of the pieces of skin that are laid out
_ACROSS = 2.0  # mm on both sides of a seam in which their fine parts mix
_SEED = 17
_LEAST = 0.004  # linear: colours are bounded from below before their logarithm is taken


def complete(
    albedo: np.ndarray,
    seen: np.ndarray,
    template: Template,
    skin_texture: np.ndarray,
    eye_texture: np.ndarray | None = None,
    dark: np.ndarray | None = None,
) -> np.ndarray:
    """
    (s, s, 3) float32 linear: albedo (s, s, 3) where `seen` (s, s) in [0, 1] says that photos saw the skin, bit for bit
    where they saw it well and away from the border, else completed from skin_texture (s, s, 3), linear. The other
    parts have the texture's colours, the eyes `eye_texture` (e, e, 3), linear, each stretched over its chart. Nothing
    is left empty: texels off the charts bear a colour nearby. dark (n,) bool: vertices where no light tells of the
    skin's colour, which stays the texture's as in mouth and sockets.
    """
    size = albedo.shape[0]
    chart = draw_chart(template, template.uv, template.uv_triangles, size)
    skin = chart.part == 1
    scale = texels_per_mm(template, template.mean, size)
    inside = template.regions["mouth"] | template.regions["sockets"]
    inside = inside if dark is None else inside | dark
    hidden = chart.field(inside.astype(np.float32), template.triangles)
    soft = _soft(template, chart)
    albedo, seen = _across_specks(albedo, seen * skin, skin & (soft < _SOFT), scale)
    weight = _weight(seen, skin, hidden > 0.5, soft, scale)
    out = skin_texture.astype(np.float32, copy=True)
    if (weight > 0.5).any():
        u = _offset(albedo, weight, skin_texture, template, scale)
        rows, columns = np.nonzero(skin & (weight < 1))
        at = (rows, columns)
        fine = _laid_out(albedo, weight, skin, hidden, scale)
        _mix_across(fine, seam_ties(template, chart), skin, _ACROSS * scale)
        w = weight[at][:, None]
        # mouth, sockets and nostrils keep the template's own contrast: no pores there
        rough = fine[at][:, None] * (1 - np.clip(2 * hidden[at], 0, 1))[:, None]
        new = np.log(np.maximum(skin_texture[at], _LEAST)) + u[at] + rough
        own = np.log(np.maximum(albedo[at], _LEAST))
        out[skin] = albedo[skin]
        out[at] = np.exp(w * own + (1 - w) * new)
    if eye_texture is not None:
        _lay_eyes(out, eye_texture, template, chart.part)
    return continued(np.clip(out, 0.0, 1.0), chart.part > 0, round(max(8, size / 128)))


def _soft(template: Template, chart: Chart) -> np.ndarray:
    """(s, s) float32 mm over which what was seen passes into what was not."""
    length = np.full(len(template.mean), _SOFT)
    length[template.regions["lips"]] = _SOFT_LIPS
    length[template.regions["lids"]] = _SOFT_LIDS
    return np.maximum(chart.field(length, template.triangles), _SOFT_LIDS)


def _across_specks(
    albedo: np.ndarray, seen: np.ndarray, where: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """albedo (s, s, 3) and seen (s, s) with what is narrow and unseen among `where` (s, s) filled from beside it."""
    good = (seen > (_SEEN_LOW + _SEEN_HIGH) / 2).astype(np.uint8)
    wide = 2 * round(_SPECK * scale / 2) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    specks = (cv2.morphologyEx(good, cv2.MORPH_CLOSE, disc) > good) & where
    rows, columns = np.nonzero(specks)
    if not len(rows):
        return albedo, seen
    box = np.s_[max(rows.min() - wide, 0) : rows.max() + wide, max(columns.min() - wide, 0) : columns.max() + wide]
    albedo, seen = albedo.copy(), seen.copy()
    near = continued(albedo[box], good[box] > 0, wide)
    albedo[box][specks[box]] = near[specks[box]]
    seen[specks] = 1
    return albedo, seen


def _weight(seen: np.ndarray, skin: np.ndarray, hidden: np.ndarray, soft: np.ndarray, scale: float) -> np.ndarray:
    """
    w (s, s) float32: 1 well inside what was seen, falling to 0 within `soft` (s, s) mm of what was not; 0 in mouth and
    sockets, `hidden` (s, s), whose rims are no borders of what was seen: lids and lips go on up to them.
    """
    good = (seen > (_SEEN_LOW + _SEEN_HIGH) / 2).astype(np.uint8)
    # a gap of a few texels on the chart's rim is the rim's own
    good = np.maximum(good, (~skin | hidden).astype(np.uint8))
    inside = cv2.distanceTransform(good, cv2.DIST_L2, 5) / scale
    t = np.clip((inside - np.minimum(0.5, 0.25 * soft)) / soft, 0, 1)
    fade = smooth_step(t)
    sure = np.clip((seen - _SEEN_LOW) / (_SEEN_HIGH - _SEEN_LOW), 0, 1)
    from_rim = cv2.distanceTransform((~hidden).astype(np.uint8), cv2.DIST_L2, 5) / scale
    weight = np.minimum(np.minimum(fade, np.maximum(sure, t > 0.999)), np.clip(from_rim / _RIM, 0, 1))
    return np.where(skin & ~hidden, weight, 0).astype(np.float32)


def _offset(
    albedo: np.ndarray, weight: np.ndarray, texture: np.ndarray, template: Template, scale: float
) -> np.ndarray:
    """u (s, s, 3) float32 of the module's docstring."""
    size = albedo.shape[0]
    g = min(_COARSE, size)
    small = draw_chart(template, template.uv, template.uv_triangles, g)
    mask = small.part == 1
    held = cv2.resize(weight, (g, g), interpolation=cv2.INTER_AREA) * mask
    # lashes, brows and lips say little of the colour of the skin beside them
    other = np.zeros(len(template.mean), np.float32)
    for name in ("lids", "brows", "lips", "mouth", "sockets"):
        other[template.regions[name]] = 1
    trust = 1 - (1 - _STRANGE) * np.clip(1.5 * small.field(other, template.triangles), 0, 1)
    difference = np.empty((g, g, 3))
    for c in range(3):
        log = np.log(np.maximum(albedo[..., c], _LEAST)) - np.log(np.maximum(texture[..., c], _LEAST))
        mean = cv2.resize((log * weight).astype(np.float32), (g, g), interpolation=cv2.INTER_AREA)
        difference[..., c] = mean / np.maximum(held, 1e-6)
    plain = (held > 0.5) & (trust > 0.5)
    typical = np.median(difference[plain], axis=0) if plain.any() else np.zeros(3)
    n = int(mask.sum())
    number = np.full((g, g), -1)
    number[mask] = np.arange(n)
    pairs = [
        np.stack([number[:, :-1][mask[:, :-1] & mask[:, 1:]], number[:, 1:][mask[:, :-1] & mask[:, 1:]]], axis=1),
        np.stack([number[:-1][mask[:-1] & mask[1:]], number[1:][mask[:-1] & mask[1:]]], axis=1),
        number.reshape(-1)[seam_ties(template, small)],
    ]
    i, j = np.concatenate(pairs).T
    one = np.ones(len(i))
    graph = sp.coo_matrix(
        (np.concatenate([one, one]), (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(n, n)
    ).tocsr()
    laplacian = sp.diags(np.asarray(graph.sum(axis=1)).ravel()) - graph
    pull = 1 / (_REACH * scale * g / size) ** 2
    difference = np.clip(difference, typical - _CONTRAST, typical + _CONTRAST)
    w = (_HELD * held * trust)[mask]
    matrix = (laplacian + sp.diags(w + pull)).tocsc()
    right = w[:, None] * np.where(held[mask][:, None] > 0, difference[mask], 0) + pull * typical
    u = np.zeros((g, g, 3), np.float32)
    u[mask] = Factor(matrix).solve(right)
    return cv2.resize(continued(u, mask, g), (size, size), interpolation=cv2.INTER_LINEAR)


def _laid_out(albedo: np.ndarray, weight: np.ndarray, skin: np.ndarray, hidden: np.ndarray, scale: float) -> np.ndarray:
    """h (s, s) float32: the fine part of log luminance, cut from what was seen and laid over what was not."""
    size = albedo.shape[0]
    log = np.log(np.maximum(albedo.mean(axis=-1), _LEAST)).astype(np.float32)
    sigma = _FINE * scale
    area = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)
    fine = (log - cv2.GaussianBlur(log * weight, (0, 0), sigma) / area) * (weight > 0.99)
    side = max(int(_PIECE * scale) // 2 * 2, 8)
    source = _best_square(fine, weight, hidden, side)
    out = np.zeros((size, size), np.float32)
    if source is None:
        return out
    spread = 3.5 * float(np.std(source)) + 1e-6
    source = np.clip(source - source.mean(), -spread, spread)
    ramp = np.sin(np.pi * (np.arange(side) + 0.5) / side).astype(np.float32)
    window = np.outer(ramp, ramp)
    rng = np.random.default_rng(_SEED)
    power = np.zeros((size, size), np.float32)
    wanted = skin & (weight < 1)
    half = side // 2
    room = source.shape[0] - side + 1
    for top in range(-half, size, half):
        for left in range(-half, size, half):
            i, j, turn = int(rng.integers(room)), int(rng.integers(room)), int(rng.integers(8))
            r0, r1, c0, c1 = max(top, 0), min(top + side, size), max(left, 0), min(left + side, size)
            if not wanted[r0:r1, c0:c1].any():
                continue
            piece = np.rot90(source[i : i + side, j : j + side], turn % 4)
            piece = piece[:, ::-1] if turn > 3 else piece
            cut = np.s_[r0 - top : r1 - top, c0 - left : c1 - left]
            out[r0:r1, c0:c1] += (window * piece)[cut]
            power[r0:r1, c0:c1] += (window * window)[cut]
    return out / np.sqrt(np.maximum(power, 1e-6))


def _mix_across(fine: np.ndarray, ties: np.ndarray, skin: np.ndarray, reach: float) -> None:
    """
    fine (s, s), in place, without a step across the seams between the texels ties (l, 2), flat, of skin (s, s) bool:
    h'(d) = cos(a) h(d) + sin(a) h_other(d), a = pi/4 (1 - d / reach), with h_other as far inside on the other side.
    """
    if not len(ties):
        return
    size = fine.shape[0]
    row, column = np.divmod(np.concatenate([ties[:, 0], ties[:, 1]]), size)
    other_row, other_column = np.divmod(np.concatenate([ties[:, 1], ties[:, 0]]), size)
    rim = np.ones((size, size), np.uint8)
    rim[row, column] = 0
    distance, label = cv2.distanceTransformWithLabels(rim, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    tie_of = np.zeros(int(label.max()) + 1, np.int64)
    tie_of[label[row, column]] = np.arange(len(row))
    at = np.nonzero(skin & (distance < reach))
    tie, d = tie_of[label[at]], distance[at]
    inside = cv2.GaussianBlur(cv2.distanceTransform(skin.astype(np.uint8), cv2.DIST_L2, 5), (0, 0), 2.0)
    ways = [cv2.Sobel(inside, cv2.CV_32F, *way)[other_row, other_column] for way in ((1, 0), (0, 1))]
    inwards = np.stack(ways, axis=1) / np.maximum(np.hypot(*ways), 1e-9)[:, None]
    place = np.stack([other_column, other_row], axis=1)[tie] + d[:, None] * inwards[tie]
    place = np.clip(np.rint(place), 0, size - 1).astype(np.int64)
    angle = np.pi / 4 * (1 - d / reach)
    fine[at] = np.cos(angle) * fine[at] + np.sin(angle) * fine[place[:, 1], place[:, 0]]


def _best_square(fine: np.ndarray, weight: np.ndarray, hidden: np.ndarray, side: int) -> np.ndarray | None:
    """The square of 1.5 sides, all of it seen, whose fine part is the most even; smaller ones where there is none."""
    usable = ((weight > 0.99) & (hidden < 0.01)).astype(np.float32)
    for width in (int(1.5 * side), int(1.1 * side), side):
        if width >= fine.shape[0]:
            continue
        box = (width, width)
        full = cv2.boxFilter(usable, -1, box, borderType=cv2.BORDER_CONSTANT) > 0.9999
        # even skin: a small fourth moment beside the second, so neither brows nor moles
        fourth = cv2.boxFilter(np.minimum(fine**4, 1.0), -1, box, borderType=cv2.BORDER_CONSTANT)
        second = cv2.boxFilter(fine**2, -1, box, borderType=cv2.BORDER_CONSTANT)
        if not full.any():
            continue
        typical = np.median(second[full])
        cost = fourth / np.maximum(second, 1e-12) ** 2 + np.abs(np.log(np.maximum(second, 1e-12) / typical))
        row, column = np.unravel_index(int(np.argmin(np.where(full, cost, np.inf))), cost.shape)
        top, left = int(row) - width // 2, int(column) - width // 2
        square = fine[top : top + width, left : left + width]
        if square.shape == (width, width):
            return square.copy()
    return None


def _lay_eyes(out: np.ndarray, eye: np.ndarray, template: Template, part: np.ndarray) -> None:
    """The eye's texture in the charts of both eyeballs, in place."""
    size = out.shape[0]
    for k, name in enumerate(template.parts):
        if name not in EYE_PARTS:
            continue
        used = template.uv[np.unique(template.uv_triangles[template.parts[name].triangles])]
        low, high = used.min(axis=0), used.max(axis=0)
        # the box of the chart in texels, and a margin for the padding
        left, right = np.floor(low[0] * size).astype(int), np.ceil(high[0] * size).astype(int)
        top, bottom = np.floor((1 - high[1]) * size).astype(int), np.ceil((1 - low[1]) * size).astype(int)
        e = eye.shape[0]
        x = ((np.arange(left, right) + 0.5) / size - low[0]) / (high[0] - low[0]) * e - 0.5
        y = (1 - (1 - (np.arange(top, bottom) + 0.5) / size - low[1]) / (high[1] - low[1])) * e - 0.5
        source: np.ndarray = eye.astype(np.float32)
        step = e / max(right - left, 1)
        if step > 1.5:
            source = cv2.GaussianBlur(source, (0, 0), 0.4 * step)
        columns, rows = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        image = cv2.remap(source, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        on = part[top:bottom, left:right] == k + 1
        out[top:bottom, left:right][on] = image[on]
