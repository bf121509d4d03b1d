"""The photos' colours on the template's chart: one photo for each texel, gains, gradients composited, Poisson.

With c the gain-corrected colour of the chosen photo, B that photo's and q all photos' common colour over a millimetre
(a few where lids, lips, brows and ears would ghost), the texture is f = c' + x, c' = c + q - B, where x solves the
screened Poisson equation

    min_x  sum_pq (x_q - x_p - g_pq)^2 + screen sum_p x_p^2

over neighbouring texels pq, those across the chart's seams among them; g_pq = 0 within a patch, so that its gradients
are the photo's own; where the photos i and j meet, g_pq = ((c'_i - c'_j)(p) + (c'_i - c'_j)(q)) / 2, so that the
gradient across is the mean of the two photos' own.

Source: method, section 3 (a).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from avatarbuild.geometry.meshes import adjacency, vertex_areas
from avatarbuild.geometry.meshes import edges as mesh_edges
from avatarbuild.solvers.poisson import Grid, divergence
from avatarbuild.template import Template
from avatarbuild.texture.borders import border_pairs, correct, texel_labels
from avatarbuild.texture.chart import Chart, draw_chart, seam_ties, texels_per_mm
from avatarbuild.texture.consensus import averaged, trimmed
from avatarbuild.texture.fused import Fused
from avatarbuild.texture.gains import photo_gains
from avatarbuild.texture.observations import Nodes, Observations, nodes_of, observe
from avatarbuild.texture.photos import Photo
from avatarbuild.texture.sampling import sample
from avatarbuild.texture.selection import choose, few, photo_sharpness, scores

MOST_PHOTOS = 24  # in the texture
_LEAST_GAIN = 0.01  # of the mean -log(score) that a further photo must bring
BORDER = 3.0  # per mm of border between patches, beside -log(score) per mm^2
_ROUNDS_NEAR_WIDE = (2, 10)  # steps of averaging: a photo's colour over a millimetre, and over a few
_COMMON = (0.15, 0.75)  # quantiles between which the photos' colours make their common one
_LOW = (0.1, 0.3)  # and the one that stands for skin without highlights
_ROUNDS = 30
_BY_CHOICE = 0.6  # how far a slanting view of what is taken from the front is forgiven
_DOUBTED = 0.25  # share of strange colours from which a place is no skin
_LEAST_PIECE = 400.0  # mm^2
_CHIN = -70.0  # mm below the eyes from which what is not face may be cloth
_LEAST_SPREAD, _FAR = 0.06, 3.5  # of the face's log chroma; how many spreads off a colour is no longer skin


@dataclass(frozen=True)
class Choice:
    """
    What the photos say at the nodes. gains (p, 3); label (n,) int16; seen (n,) in [0, 1], how well the chosen photo
    sees each node; offset (p, n, 3) q - B_i; low (n, 3); disagreement: rms of log colour that gains leave.
    """

    gains: np.ndarray
    label: np.ndarray
    seen: np.ndarray
    offset: np.ndarray
    low: np.ndarray
    sharpness: np.ndarray
    disagreement: float


def choice(nodes: Nodes, seen: Observations, photos: list[Photo], still: np.ndarray) -> Choice:
    """Gains, the common colour, and the photo for each node; still (p,) bool: photos with the common expression."""
    weight = seen.cosine * (seen.clipped < 0.02) * (seen.cosine > 0.35)
    gains, disagreement = photo_gains(seen.colour, weight)
    colour = seen.colour * gains[:, None, :].astype(np.float32)
    sharpness = photo_sharpness(seen.detail, weight)

    usable = seen.cosine**2 * np.clip(1 - 4 * seen.clipped, 0.02, 1)
    near, wide = averaged(colour, usable.astype(np.float32), nodes.triangles, _ROUNDS_NEAR_WIDE)
    fine = trimmed(*near, *_COMMON) - near[0]
    local, local_weight = wide
    common = trimmed(*wide, *_COMMON)
    low = trimmed(*wide, *_LOW)
    shown = local_weight > 1e-6
    share = nodes.relief[:, None].astype(np.float32)
    offset = np.where((near[1] > 1e-6)[..., None], (1 - share) * fine + share * (common - local), 0)
    offset = np.where(shown[..., None], offset, 0).astype(np.float32)

    grey = lambda c: np.log(np.maximum(c.mean(axis=-1), 1e-3))  # noqa: E731
    excess = np.where(shown, grey(local) - grey(common), 0)
    score = scores(seen, photos, nodes, excess, sharpness, still)
    score *= like_skin(*near, common, nodes) * like_skin(*wide, common, nodes)
    area = vertex_areas(nodes.position, nodes.triangles)
    pairs, _ = mesh_edges(nodes.triangles)
    span = np.linalg.norm(nodes.position[pairs[:, 0]] - nodes.position[pairs[:, 1]], axis=1)
    # costs are per mm^2 and per mm; dividing both by the nodes' area keeps the scores' own scale
    length = BORDER * span / np.maximum(area[pairs].mean(axis=1), 1e-3) * 0.6
    length *= 1 + 3 * nodes.front[pairs].min(axis=1)
    use = few(score, area, MOST_PHOTOS, _LEAST_GAIN)
    label = choose(score[use], pairs, length, _ROUNDS)
    label = np.where((label >= 0) & held_together(label >= 0, pairs, area, nodes), use[label], -1).astype(np.int16)
    at = np.maximum(label, 0), np.arange(len(label))
    # lids, lips and brows are taken from the front by choice: aslant does not mean badly seen there
    slant = seen.cosine[at] ** (1 - _BY_CHOICE * nodes.front)
    quality = np.where(label >= 0, slant * np.minimum(sharpness[at[0]], 1), 0)
    return Choice(gains, label, quality, offset, low, sharpness, disagreement)


def held_together(labelled: np.ndarray, pairs: np.ndarray, area: np.ndarray, nodes: Nodes) -> np.ndarray:
    """(n,) bool: pieces of the labelled surface that hold some of the face or are no smaller than an ear."""
    one = pairs[labelled[pairs].all(axis=1)]
    n = len(labelled)
    count, piece = connected_components(sp.coo_matrix((np.ones(len(one)), one.T), shape=(n, n)), directed=False)
    size = np.bincount(piece, area, count)
    size += np.where(np.bincount(piece, nodes.face & labelled, count) > 0, np.inf, 0)
    return size[piece] >= _LEAST_PIECE


def like_skin(local: np.ndarray, weight: np.ndarray, common: np.ndarray, nodes: Nodes) -> np.ndarray:
    """
    (p, n) float32, 1 where a photo's colour may be this person's skin, 0 where it is cloth: judged below the chin.

    log(R / G) and log(B / G) of the face are linear in its log brightness (what lies in the shade is redder); far off
    that line, in the face's own spreads, nothing is skin.
    """
    below = ~nodes.face & (nodes.position[:, 1] < _CHIN)
    face = nodes.face & (common.min(axis=1) > 0)
    if face.sum() < 100:
        return np.ones(local.shape[:2], np.float32)
    chroma = lambda c: np.log(np.maximum(c[..., [0, 2]], 2e-3) / np.maximum(c[..., 1:2], 2e-3))  # noqa: E731
    light = lambda c: np.stack([np.ones(c.shape[:-1]), np.log(np.maximum(c.mean(axis=-1), 2e-3))], axis=-1)  # noqa: E731
    usual, shade = chroma(common[face]), light(common[face])
    line = np.linalg.lstsq(shade, usual, rcond=None)[0]
    off = usual - shade @ line
    off = off[np.linalg.norm(off, axis=1) <= np.quantile(np.linalg.norm(off, axis=1), 0.8)]
    scatter = np.linalg.inv(off.T @ off / len(off) + _LEAST_SPREAD**2 * np.eye(2))
    judged = local[:, below]
    off = chroma(judged) - light(judged) @ line
    far = np.sqrt(np.einsum("pni,ij,pnj->pn", off, scatter, off))
    cloth = np.zeros(local.shape[:2], np.float32)
    strange = far >= _FAR
    share = (weight[:, below] * strange).sum(axis=0) / np.maximum(weight[:, below].sum(axis=0), 1e-9)
    cloth[:, below] = strange | (share > _DOUBTED)
    ring = adjacency(len(nodes.position), nodes.triangles)
    return (ring @ (ring @ cloth.T) + cloth.T == 0).T.astype(np.float32)


def fuse(
    template: Template,
    vertices: np.ndarray,
    measured: np.ndarray,
    photos: list[Photo],
    still: np.ndarray,
    size: int,
    screen: float,
    eyes: tuple[np.ndarray, np.ndarray] | None,
    tell: Callable[[float], None],
) -> tuple[Fused, Choice, dict[str, Any]]:
    """
    The fused texture at size x size texels, the choice at the nodes, and figures.

    vertices (n, 3) mm in the head frame, measured (n,) how far a cloud decided where they lie; still (p,) bool;
    `screen`: mm over which a step between patches fades; eyes as in `nodes_of`; `tell` hears which share of the work is
    done.
    """
    nodes = nodes_of(template, vertices, measured, eyes)
    seen = observe(photos, nodes, vertices, template.triangles, lambda: tell(0.35 / len(photos)))
    chosen = choice(nodes, seen, photos, still)
    tell(0.2)
    chart = draw_chart(template, nodes.uv, nodes.uv_triangles, size)
    position = chart.field(nodes.position, nodes.triangles)
    label = np.empty((size, size), np.int16)
    texel_labels(chart.triangle, chart.barycentric, nodes.triangles, chosen.label, label)
    label[chart.part != 1] = -1
    texels = texels_per_mm(template, vertices, size)
    flat = position.reshape(-1, 3)
    colour = corrected(photos, chosen, nodes, chart, label.reshape(-1), None, flat, texels)
    tell(0.2)

    pairs = np.concatenate([border_pairs(label), split_ties(seam := seam_ties(template, chart), label)])
    steps = border_steps(photos, chosen, nodes, chart, label, pairs, flat, texels, colour)
    grid = Grid(label >= 0, (1 / (screen * texels)) ** 2, seam[(label.reshape(-1)[seam] >= 0).all(axis=1)])
    taken = []
    for channel in range(3):
        x, count = grid.solve(divergence(pairs, steps[:, channel], (size, size)))
        colour[:, channel] = np.maximum(colour[:, channel] + x.reshape(-1), 0)
        taken.append(count)
        tell(0.25 / 3)
    normal = chart.field(nodes.normal, nodes.triangles)
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-6)
    fused = Fused(
        colour.reshape(size, size, 3),
        np.where(label >= 0, chart.field(chosen.seen, nodes.triangles), 0).astype(np.float32),
        label,
        position,
        normal,
        chart.part > 0,
        chart.part,
        chart.field(chosen.low, nodes.triangles),
    )
    skin = chart.part == 1
    figures = {
        "photos_used": len(np.unique(chosen.label[chosen.label >= 0])),
        "skin_seen": round(float((label[skin] >= 0).mean()), 3),
        "gains_disagree": round(chosen.disagreement, 4),
        "border_step_rms": round(float(np.sqrt((steps**2).mean())), 5) if len(steps) else 0.0,
        "poisson_steps": max(taken),
    }
    return fused, chosen, figures


def corrected(
    photos: list[Photo],
    chosen: Choice,
    nodes: Nodes,
    chart: Chart,
    label: np.ndarray,
    texel: np.ndarray | None,
    position: np.ndarray,
    texels: float,
) -> np.ndarray:
    """(n, 3) c' at texels (n,) flat indices (None: all of them) in the photos label (n,), 0 where label < 0."""
    places = position if texel is None else position[texel]
    colour = sample(photos, label, places, texels)
    triangle, barycentric = chart.triangle.reshape(-1), chart.barycentric.reshape(-1, 3)
    which = np.arange(len(label)) if texel is None else texel
    gains = chosen.gains.astype(np.float32)
    correct(colour, label, which, triangle, barycentric, nodes.triangles, gains, chosen.offset)
    return colour


def border_steps(
    photos: list[Photo],
    chosen: Choice,
    nodes: Nodes,
    chart: Chart,
    label: np.ndarray,
    pairs: np.ndarray,
    position: np.ndarray,
    texels: float,
    colour: np.ndarray,
) -> np.ndarray:
    """(l, 3) g_pq of pairs (l, 2) whose labels differ; the mean of the photos' steps at both texels."""
    flat = label.reshape(-1)
    p, q = pairs.T
    other = lambda at, by: corrected(  # noqa: E731
        photos, chosen, nodes, chart, flat[by], at, position, texels
    )
    return 0.5 * (colour[p] - other(p, q)) + 0.5 * (other(q, p) - colour[q])


def split_ties(ties: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Those ties (l, 2) whose two texels show different photos."""
    found = label.reshape(-1)[ties]
    return ties[(found >= 0).all(axis=1) & (found[:, 0] != found[:, 1])]
