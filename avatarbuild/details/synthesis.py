"""
Detail maps of any expression from those of a few keyframes: radial basis functions of the strain of feature edges.

l(f) = l_0 + sum_k eta_k |D_k^(1/2) (f - f_k)|   (16), with a constant term, f held within the range that training saw

for every texel and each of four layers: the normal in tangent space x, y, z (normalised after the sum) and occlusion,
1 open. phi_k = |D_k^(1/2) (f - f_k)| is found at the template's vertices and linear over its triangles; alpha, which
fills D, is never stored per texel. Letters: s texels along a side, t of them in use, k keyframes, e edges, n vertices,
u texture coordinates, f frames.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from avatarbuild.details import layered
from avatarbuild.details.choice import choose
from avatarbuild.details.distances import BETA, distances, positions_at, shares
from avatarbuild.details.edges import feature_edges, lengths, strain
from avatarbuild.geometry.meshes import vertex_of_uv
from avatarbuild.template import Template
from avatarbuild.texture.chart import continued, draw_chart

log = logging.getLogger(__name__)

KEYFRAMES = 6
POSITION_SIDE = 256  # texels of the keyframes' position maps
_CHOOSE_SIDE = 256  # texels of the maps that keyframes are chosen at
_SAMPLES = 3000  # of them
_STILL = 0.03  # spread of strain below which an edge counts for less: it may be the tracking's noise
_TILE = 400_000  # texels that are fitted at a time
_LEAST = 1e-3  # confidence of all frames together below which a texel stays flat

Layers = Sequence[np.ndarray] | Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Keyframes:
    """
    rows (k,) int of the training frames; strain (k, e); ends (k, e, 2, 3) mm of the edges; positions
    (k, p, p, 3) float32 mm: the posed skin in the chart, continued beyond it.
    """

    rows: np.ndarray
    strain: np.ndarray
    ends: np.ndarray
    positions: np.ndarray

    @property
    def count(self) -> int:
        """k"""
        return len(self.rows)


@dataclass(frozen=True)
class Grid:
    """The texels in use: flat (t,) int32 indices, corners (t, 3) int32 into the u, barycentric (t, 3) float32."""

    flat: np.ndarray
    corners: np.ndarray
    barycentric: np.ndarray

    def part(self, texels: slice | np.ndarray) -> Grid:
        """Some of the texels."""
        return Grid(self.flat[texels], self.corners[texels], self.barycentric[texels])


@dataclass(frozen=True)
class Synthesis:
    """
    edges (e, 2) of the template, rest (e,) mm, low and high (e,) the range of strain in training, spread (e,) what
    counts as much strain of an edge; texels (t,) int32 of a map of side x side, row 0 on top; weights
    (t, k + 1, 4) float32: l_0, then eta_k, of the four layers; beta 1/mm.
    """

    template: Template
    side: int
    edges: np.ndarray
    rest: np.ndarray
    low: np.ndarray
    high: np.ndarray
    spread: np.ndarray
    beta: float
    keys: Keyframes
    texels: np.ndarray
    weights: np.ndarray

    @cached_property
    def shares(self) -> np.ndarray:
        """alpha (k, u, e) of (17)."""
        return _shares(self.keys, self.template.uv, self.beta)

    @cached_property
    def grid(self) -> Grid:
        """Where the texels in use lie on the mesh."""
        return grid(self.template, self.side, self.texels)

    def strain_of(self, vertices: np.ndarray) -> np.ndarray:
        """(…, e) of heads (…, n, 3) mm in the topology of the template."""
        return strain(vertices, self.rest, self.edges)

    def distances(self, strain_: np.ndarray) -> np.ndarray:
        """phi (u, k) float32 of strain (e,), held within the range of training."""
        held = np.clip(strain_, self.low, self.high)
        return distances(self.shares, held / self.spread, self.keys.strain / self.spread)

    def evaluate(self, strain_: np.ndarray, side: int | None = None) -> np.ndarray:
        """
        (side, side, 4) float32 detail map of strain (e,): normal, occlusion in [0, 1]; flat and open where no frame
        showed the skin. Other sides than that of training by averages or bilinear.
        """
        out = flat_layers(self.side)
        g = self.grid
        layered.evaluate(g.flat, g.corners, g.barycentric, self.distances(strain_), self.weights, out.reshape(-1, 4))
        if side is not None and side != self.side:
            out = cv2.resize(out, (side, side), interpolation=cv2.INTER_AREA if side < self.side else cv2.INTER_LINEAR)

            size = np.linalg.norm(out[..., :3], axis=-1, keepdims=True)
            out[..., :3] = out[..., :3] / np.maximum(size, 1e-6)
        return out


def flat_layers(side: int) -> np.ndarray:
    """(side, side, 4) float32: a skin without details."""
    return np.tile(np.array([0, 0, 1, 1], np.float32), (side, side, 1))


def grid(template: Template, side: int, texels: np.ndarray | None = None) -> Grid:
    """The skin's texels of a chart of side x side, or those named by flat indices."""
    chart = draw_chart(template, template.uv, template.uv_triangles, side)
    flat = np.flatnonzero(chart.part == 1) if texels is None else texels
    triangle = chart.triangle.reshape(-1)[flat]
    corners = template.uv_triangles[triangle].astype(np.int32)
    return Grid(flat.astype(np.int32), corners, np.ascontiguousarray(chart.barycentric.reshape(-1, 3)[flat]))


def keyframes(
    template: Template, edges: np.ndarray, rest: np.ndarray, vertices: np.ndarray, rows: list[int]
) -> Keyframes:
    """The keyframes that are rows of heads (f, n, 3) mm."""
    chart = draw_chart(template, template.uv, template.uv_triangles, POSITION_SIDE)
    posed = vertices[rows]
    maps = [continued(chart.field(x, template.triangles), chart.part == 1) for x in posed]
    positions = np.stack(maps) if maps else np.zeros((0, POSITION_SIDE, POSITION_SIDE, 3), np.float32)
    return Keyframes(np.array(rows, np.int64), strain(posed, rest, edges), posed[:, edges], positions)


def train(
    layers: Layers,
    confidence: Layers,
    vertices: np.ndarray,
    neutral: np.ndarray,
    template: Template,
    *,
    count: int = KEYFRAMES,
    beta: float = BETA,
    ridge: float = 0.03,
) -> Synthesis:
    """
    argmin over l_0, eta of  sum_f c_f |l_f - l_0 - sum_k eta_k phi_k(f)|^2 + rho sum_k mean(phi_k^2) |eta_k|^2

    per texel, for four layers at once: normal equations of k + 1 unknowns, gathered frame by frame in tiles of texels,
    so that memory does not grow with the frames. layers (f) of (s, s, 4), confidence (f) of (s, s) in [0, 1]: sequences
    or functions of the frame's row; vertices (f, n, 3) and neutral (n, 3) mm. Keyframes by `choose`, at 256^2.

    Source: method, section 7 [Ichim et al. 2015, section 6; Bickel et al. 2008].
    """
    edges = feature_edges(template)
    rest = lengths(neutral, edges)
    strains = strain(vertices, rest, edges)
    spread = np.sqrt(strains.var(axis=0) + _STILL**2)
    fit = _Fit(template, strains, spread, beta, ridge)
    small, total = _reduced(layers, confidence, len(vertices))
    rows = _chosen(template, small, vertices, edges, strains / spread, count, beta, ridge)
    keys = keyframes(template, edges, rest, vertices, rows)
    side = total.shape[0]
    skin = grid(template, side)
    used = np.flatnonzero(total.reshape(-1)[skin.flat] > _LEAST)
    seen = skin.part(used)
    weights = np.empty((len(used), keys.count + 1, 4), np.float32)
    phi = fit.phi(keys)
    for first in range(0, len(used), _TILE):
        tile = slice(first, first + _TILE)
        weights[tile] = fit.solve(seen.part(tile), phi, lambda i: (_row(layers, i), _row(confidence, i)))
    low, high = strains.min(axis=0), strains.max(axis=0)
    return Synthesis(template, side, edges, rest, low, high, spread, beta, keys, seen.flat, weights)


def _chosen(
    template: Template,
    small: list[tuple[np.ndarray, np.ndarray]],
    vertices: np.ndarray,
    edges: np.ndarray,
    strains: np.ndarray,
    count: int,
    beta: float,
    ridge: float,
) -> list[int]:
    """Rows of the keyframes, by a few thousand texels spread evenly over those in use."""
    skin = grid(template, small[0][1].shape[0])
    total = np.sum([sure for _, sure in small], axis=0).reshape(-1)[skin.flat]
    used = np.flatnonzero(total > _LEAST)
    at = skin.part(used[:: max(len(used) // _SAMPLES, 1)])
    flats = [_flat(*frame) for frame in small]
    corner = vertex_of_uv(template.triangles, template.uv_triangles, len(template.uv))[at.corners]
    points = np.einsum("tc,ftcx->ftx", at.barycentric, vertices[:, corner])
    maps, sure = (np.stack([part[at.flat] for part in parts]).astype(np.float64) for parts in zip(*flats))
    return choose(maps, sure, points, vertices[:, edges], strains, count, beta, ridge)


@dataclass(frozen=True)
class _Fit:
    template: Template
    strains: np.ndarray
    spread: np.ndarray
    beta: float
    ridge: float

    def phi(self, keys: Keyframes) -> np.ndarray:
        """(f, u, k) float32"""
        alpha = _shares(keys, self.template.uv, self.beta)
        if not len(alpha):
            return np.zeros((len(self.strains), len(self.template.uv), 0), np.float32)
        return np.stack([distances(alpha, one / self.spread, keys.strain / self.spread) for one in self.strains])

    def solve(self, texels: Grid, phi: np.ndarray, frame: Callable[[int], tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """(t, k + 1, 4) float32 weights of some texels; frame(i) gives layers (s, s, 4) and confidence (s, s)."""
        t, terms = len(texels.flat), phi.shape[2] + 1
        left, right = np.zeros((t, terms * (terms + 1) // 2)), np.zeros((t, terms, 4))
        for i in range(len(phi)):
            maps, sure = _flat(*frame(i))
            layered.gather(texels.flat, texels.corners, texels.barycentric, phi[i], maps, sure, left, right)
        prior = self.ridge * np.append(1.0, np.mean(phi.astype(np.float64) ** 2, axis=(0, 1)))
        weights = np.empty((t, terms, 4), np.float32)
        layered.solve(left, right, prior, weights)
        return weights


def _shares(keys: Keyframes, uv: np.ndarray, beta: float) -> np.ndarray:
    points = positions_at(keys.positions, uv)
    found = [shares(p, ends[:, 0], ends[:, 1], beta) for p, ends in zip(points, keys.ends, strict=True)]
    return np.stack(found) if found else np.zeros((0, len(uv), keys.strain.shape[1]), np.float32)


def _row(frames: Layers, i: int) -> np.ndarray:
    return frames(i) if callable(frames) else frames[i]


def _flat(maps: np.ndarray, sure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The texels of a map (s, s, 4) and its confidence (s, s) one after the other, float32."""
    return np.asarray(maps, np.float32).reshape(-1, 4), np.asarray(sure, np.float32).reshape(-1)


def _reduced(layers: Layers, confidence: Layers, f: int) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Every frame at the size that keyframes are chosen at, means weighted by confidence; and the confidence's sum."""
    small, total = [], np.zeros(0)
    for i in range(f):
        maps, sure = np.asarray(_row(layers, i), np.float32), np.asarray(_row(confidence, i), np.float32)
        total = sure + total if total.size else sure.astype(np.float64)
        side = min(_CHOOSE_SIDE, len(sure))
        less = cv2.resize(sure, (side, side), interpolation=cv2.INTER_AREA)
        mean = cv2.resize(maps * sure[..., None], (side, side), interpolation=cv2.INTER_AREA)
        small.append((mean / np.maximum(less, 1e-6)[..., None], less))
    return small, total
