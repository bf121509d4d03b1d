"""
The person's own shapes from all frames together, tracking fixed: equations (8) to (10) [Ichim et al. 2015].

  min_c  sum_f E_feature + E_flow  +  sum_j || y_j ||_K^2,        c_j = s_j y_j

c_0 corrects the neutral and c_j the j-th shape's displacement; x_f = b_0 + c_0 + sum_j w_fj (B_j + c_j). s_j (n,) mm
says how far a shape may stray at each vertex: in proportion to how far it moves there, so that what several shapes
could explain is shared in proportion to their motion, and a shape keeps its place on the face. K makes y a smooth
random field of unit variance and correlation length l (Matern; Lindgren et al. 2011): with M the vertex areas and L
the Laplacian,

  K = (kappa^2 M - L) M^-1 (kappa^2 M - L) / (4 pi kappa^2),   kappa = sqrt(2) / l,

which is closeness (9) and smoothness (10) with g4 : g5 : g6 = kappa^4 : 2 kappa^2 : 1. Matrix-free conjugate gradients,
preconditioned shape by shape: K and what the data say of that shape alone, lumped at the vertices. n free vertices, a
shapes, F frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatarbuild.energies import texture_flow
from avatarbuild.geometry import meshes
from avatarbuild.parallel import each_alone
from avatarbuild.solvers.sparse import Factor, conjugate_gradients
from avatarbuild.template import Template
from avatarbuild.tracking import fit
from avatarbuild.tracking.fit import Face, Pinned, State, Weights
from avatarbuild.tracking.frames import Frame
from avatarbuild.tracking.rig import Places, Rig
from avatarbuild.tracking.samples import face_skin

_MUCH = 16.0  # kappa^2, a vertex' mean of the data's Hessian: below, K alone serves nearly as well


@dataclass(frozen=True)
class Freedom:
    """
    How far shapes may stray: `share` of their own motion, spread over `reach` mm, plus `least` mm where they move;
    `neutral` mm for the face at rest; `depth` of that along the line of sight, where a frontal video shows nothing;
    `length` mm over which deviations agree; `worth` of the data beside tracking's. Conjugate gradients end after
    `steps` or at `tolerance`; a round begins where the last one ended.
    """

    share: float = 0.3
    least: float = 0.15
    reach: float = 12.0
    depth: float = 0.15
    neutral: float = 0.01
    length: float = 40.0
    worth: float = 0.3
    steps: int = 20
    tolerance: float = 1e-4


class Space:
    """The free vertices of a head, their prior K and how far each of a shapes may stray: `stray` (1 + a, n)."""

    def __init__(self, template: Template, rig: Rig, axis: np.ndarray, freedom: Freedom) -> None:
        skin = template.parts["skin"]
        self.free = np.flatnonzero(face_skin(template))
        count = skin.vertices.stop
        triangles = template.triangles[skin.triangles].astype(np.int64)
        rest = rig.neutral[:count]
        mass, L = meshes.vertex_areas(rest, triangles), meshes.laplacian(rest, triangles)
        kappa2 = 2 / freedom.length**2
        root = (sp.diags(kappa2 * mass) - L)[:, self.free]
        K = root.T @ sp.diags(1 / np.maximum(mass, 1e-6)) @ root / (4 * np.pi * kappa2)
        self.prior = sp.csr_matrix(K)
        self.factor = Factor(self.prior)
        # motions spread by one implicit step of the heat equation
        heat = Factor(sp.csc_matrix(sp.diags(np.maximum(mass, 1e-6)) - freedom.reach**2 / 2 * L))
        size = np.linalg.norm(rig.deltas[:, :count], axis=2)
        spread = np.maximum(heat.solve((size * np.maximum(mass, 1e-6)).T), 0).T[:, self.free]
        least = freedom.least * np.minimum(spread / 0.5, 1)
        along = np.outer(axis, axis)
        self.axes = np.linalg.svd(along)[0][:, [1, 2, 0]]  # two across the line of sight, and it
        self.depth = freedom.depth
        self.turn = np.eye(3) - (1 - freedom.depth) * along
        self.back = np.eye(3) - (1 - 1 / freedom.depth) * along
        self.stray = np.concatenate([np.full((1, len(self.free)), freedom.neutral), freedom.share * spread + least])
        self.much = _MUCH * kappa2
        self._alone: list[tuple[int, slice, Factor]] | None = None

    def alone(self, weights: np.ndarray, diagonal: np.ndarray) -> list[tuple[int, slice, Factor]]:
        """
        Shape j, its `axes` across or along the line of sight, and the factor of K + s_j^2 sum_f w_fj^2 h_f there, where
        the data say much beside K: weights (F, 1 + a); diagonal h (F, n, 3) of the data's Hessian, by vertex and axis
        of the head. Made once: they only speed conjugate gradients up, and later rounds differ little.
        """
        if self._alone is None:
            share = self.axes[:, 2] ** 2
            across, along = diagonal @ (1 - share) / 2, self.depth**2 * (diagonal @ share)
            self._alone = []
            for j, (s, w) in enumerate(zip(self.stray**2, weights.T**2, strict=True)):
                for axes, h in ((slice(0, 2), across), (slice(2, 3), along)):
                    says = s * (w @ h)
                    if says.mean() > self.much:
                        self._alone.append((j, axes, Factor(self.prior + sp.diags(says))))
        return self._alone


def data_rows(
    face: Face,
    frame: Frame,
    pinned: list[Pinned],
    state: State,
    levels: tuple[int, ...],
    w: Weights,
    worth: float,
    column: np.ndarray,
) -> tuple[sp.csr_matrix, np.ndarray]:
    """
    G (q, 3 n) and r (q,), scaled: the frame's residuals are r + G d, where d (n, 3) mm displaces the free vertices.

    column (N,): a vertex's place among the free ones, -1 for others.
    """
    triangles = face.rig.triangles
    blocks, residuals = [], []
    for points in pinned:
        r, J, each = points.rows(face, state)
        scale = np.sqrt(worth * each)
        at = points.markers.places
        twice = Places(np.repeat(at.triangle, 2), np.repeat(at.barycentric, 2, axis=0))
        slope = J[:, 3:6] @ state.R  # a point's own motion in the head frame does what a shift of the head does
        blocks.append(_spread_rows(np.arange(len(r)), twice, slope * scale[:, None], triangles, column, len(r)))
        residuals.append(r * scale)
    for level in levels:
        seen = fit.seen_samples(face, level, state)
        sight = fit.flow(face, frame, level, state, seen)
        r, known = texture_flow.residuals(face.samples[level].rho, sight)
        scale = np.sqrt(worth / len(levels) * fit.flow_worth(r, known, w))
        q = 2 * len(r)
        places = face.samples[level].places
        triangle = places.triangle.reshape(-1, 3)
        barycentric = places.barycentric.reshape(-1, 3, 3)
        block = sp.csr_matrix((q, 3 * int(column.max() + 1)))
        for k in (1, 2):
            row = 2 * np.arange(len(r)) + k - 1
            for end, sign in ((0, 1.0), (k, -1.0)):
                slope = sign * sight.slope[:, end] * scale[:, k - 1, None]
                block = block + _spread_rows(
                    row, Places(triangle[:, end], barycentric[:, end]), slope, triangles, column, q
                )
        keep = np.flatnonzero(scale.ravel())
        blocks.append(block[keep])
        residuals.append((r * scale).ravel()[keep])
    return sp.csr_matrix(sp.vstack(blocks)), np.concatenate(residuals)


def _spread_rows(
    row: np.ndarray, places: Places, slope: np.ndarray, triangles: np.ndarray, column: np.ndarray, q: int
) -> sp.csr_matrix:
    """(q, 3 n): slope (p, 3) of rows (p,) by points, handed on to the corners of their triangles."""
    corners = column[triangles[places.triangle]]
    values = places.barycentric[:, :, None] * slope[:, None, :]
    columns = 3 * corners[:, :, None] + np.arange(3)
    good = np.broadcast_to((corners >= 0)[:, :, None], values.shape)
    rows = np.broadcast_to(row[:, None, None], values.shape)
    return sp.csr_matrix((values[good], (rows[good], columns[good])), shape=(q, 3 * int(column.max() + 1)))


def gauge(rig: Rig, base: Rig, states: list[State]) -> tuple[Rig, list[State]]:
    """
    The same poses with shapes whose projection on the transferred ones is 1: B_j / s_j and w_j s_j, s_j = <B_j, B*_j> /
    <B*_j, B*_j>, as far as no weight exceeds 1. Without it the l1 term shrinks weights and modelling blows up shapes,
    round by round.
    """
    s = np.einsum("jnc,jnc->j", rig.deltas, base.deltas) / np.maximum(
        np.einsum("jnc,jnc->j", base.deltas, base.deltas), 1e-12
    )
    s = np.clip(s, 0.5, 2)
    most = np.max([state.weights for state in states], axis=0)
    s = np.minimum(s, np.maximum(1 / np.maximum(most, 1e-9), 1))
    scaled = Rig(rig.neutral, rig.deltas / s[:, None, None], rig.triangles)
    return scaled, [State(state.R, state.t, state.weights * s) for state in states]


def learn(
    space: Space,
    face: Face,
    base: Rig,
    frames: list[Frame],
    pinned: list[list[Pinned]],
    states: list[State],
    levels: tuple[int, ...],
    w: Weights,
    freedom: Freedom,
) -> Rig:
    """
    The rig that explains the frames best near `base`, the transferred one; `face.rig` is the one the frames were
    tracked with and linearised at.
    """
    n, a = len(space.free), len(base.deltas)
    column = np.full(len(base.neutral), -1)
    column[space.free] = np.arange(n)
    weights = with_rest(states)
    present = np.concatenate(
        [(face.rig.neutral - base.neutral)[None, space.free], (face.rig.deltas - base.deltas)[:, space.free]]
    )
    y0 = (present @ space.back) / space.stray[:, :, None]
    G, target = [], np.zeros((len(states), 3 * n))
    here = (weights @ present.reshape(1 + a, -1)).reshape(len(states), -1)
    seen = zip(frames, pinned, states, strict=True)
    found = each_alone(lambda one: data_rows(face, *one, levels, w, freedom.worth, column), seen)
    for i, (rows, r) in enumerate(found):
        G.append(rows)
        target[i] = rows.T @ (rows @ here[i] - r)

    def pulled(moved: np.ndarray) -> np.ndarray:
        return np.stack(list(each_alone(lambda i: G[i].T @ (G[i] @ moved[i]), range(len(G)))))

    diagonal = np.stack([np.asarray(g.multiply(g).sum(axis=0)).reshape(n, 3) for g in G])
    return nearest(space, base, weights, pulled, diagonal, target, y0, freedom)


def with_rest(states: list[State]) -> np.ndarray:
    """(F, 1 + a) what the neutral and each shape weigh in every frame."""
    return np.concatenate([np.ones((len(states), 1)), [s.weights for s in states]], axis=1)


def nearest(
    space: Space,
    base: Rig,
    weights: np.ndarray,
    pulled: Callable[[np.ndarray], np.ndarray],
    diagonal: np.ndarray,
    target: np.ndarray,
    y0: np.ndarray,
    freedom: Freedom,
) -> Rig:
    """
    The rig near `base` that solves  sum_f W_f^T H_f W_f y + K y = sum_f W_f^T b_f  for the strayings y (1 + a, n, 3),
    from y0: weights (F, 1 + a); pulled, H_f d_f of what all frames' free vertices moved by, (F, 3 n) to (F, 3 n);
    diagonal (F, n, 3) of H; target b (F, 3 n).
    """
    n, a = len(space.free), len(base.deltas)

    def strayed(y: np.ndarray) -> np.ndarray:
        return space.stray[:, :, None] * (y @ space.turn)

    def spread(frames: np.ndarray) -> np.ndarray:
        return strayed((weights.T @ frames).reshape(1 + a, n, 3))

    def columns(y: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(y.transpose(1, 0, 2).reshape(n, -1))

    def back(y: np.ndarray) -> np.ndarray:
        return y.reshape(n, 1 + a, 3).transpose(1, 0, 2)

    alone = space.alone(weights, diagonal)
    usual = np.ones((1 + a, 3), bool)
    for j, axes, _ in alone:
        usual[j, axes] = False

    def eased(r: np.ndarray) -> np.ndarray:
        split = r @ space.axes
        z = np.empty((n, 1 + a, 3))
        z[:, usual] = space.factor.solve(split.transpose(1, 0, 2)[:, usual])
        for j, axes, factor in alone:
            z[:, j, axes] = factor.solve(split[j, :, axes])
        return np.asarray(z.transpose(1, 0, 2) @ space.axes.T)

    y = conjugate_gradients(
        lambda y: spread(pulled(weights @ strayed(y).reshape(1 + a, -1))) + back(space.prior @ columns(y)),
        spread(target),
        y0,
        eased,
        freedom.steps,
        freedom.tolerance,
    )
    change = strayed(y)
    neutral, deltas = base.neutral.copy(), base.deltas.copy()
    neutral[space.free] += change[0]
    deltas[:, space.free] += change[1:]
    return Rig(neutral, deltas, base.triangles)
