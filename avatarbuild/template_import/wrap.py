"""The shipped skin laid onto another head's mean: a similarity, then a smooth displacement to the closest points."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import NamedTuple

import igl
import numpy as np
import scipy.sparse as sp
from cholespy import CholeskySolverD, MatrixType
from scipy.spatial import cKDTree

from avatarbuild.errors import InputError
from avatarbuild.geometry import meshes
from avatarbuild.geometry.similarity import similarity
from avatarbuild.template import Template
from avatarbuild.template_import.foreign import ForeignHead
from avatarbuild.template_import.sighting import sight

log = logging.getLogger(__name__)

# stiffness, reach in mm, weight of a landmark; each step is solved `ROUNDS` times
SCHEDULE = (
    (1000.0, 30.0, 5.0),
    (200.0, 15.0, 5.0),
    (40.0, 10.0, 5.0),
    (8.0, 6.0, 3.0),
    (4.0, 4.0, 1.0),
    (2.0, 3.0, 0.5),
)
ROUNDS = 2
UNFOLDING = 4  # times that vertices of folded triangles are let go of
FINISH = 2.0  # stiffness of the last fit, which evens out how closest points crowd in folds
EXTENSION = 0.05  # stiffness where displacements are carried over to vertices without a counterpart
MEMBRANE = 0.02  # share of first differences, which keeps carried displacements from growing
HOLD = 0.5  # weight of a landmark in the last fit: the detector sees lids that have no counterpart
FIRMNESS = 2.0  # that share while fitting, where it keeps triangles from folding
SPRING = 10.0  # holds the lips together
LEAST_AGREEMENT = 0.5  # cosine of the normals of corresponding points
LEAST_UPRIGHT = 0.35  # cosine of a triangle's turn beyond which it counts as folded
OUTLIER = 3.0
LEAST_LANDMARKS = 60
_COLUMNS = 128  # that the solver takes at once
WORST_FIT = 2.0  # mm, mean over the face
LEAST_COVER = 0.6  # of the face


class Wrap(NamedTuple):
    """
    skin      (n, 3) mm: the shipped skin on the foreign mean, in the foreign head's scale and the shipped one's axes
    rows      (n, v) csr: barycentric weights of each skin vertex's counterpart
    known     (n,) bool: vertices that have a counterpart
    scale     of the similarity from the shipped head to the foreign one
    rotation  (3, 3): x = rotation^T (x_foreign - shift) brings the foreign head to the shipped one's axes
    """

    skin: np.ndarray
    rows: sp.csr_matrix
    known: np.ndarray
    scale: float
    rotation: np.ndarray


class Extension(NamedTuple):
    """Carries values from some vertices to all: `edges` (k, 2) of the mesh, `springs` (j, 2) pairs that move alike."""

    edges: np.ndarray
    springs: np.ndarray

    def factor(
        self, weights: np.ndarray, stiffness: float, membrane: float = MEMBRANE, extra: sp.spmatrix | None = None
    ) -> Callable:
        """
        Solver d(values) of argmin_d sum_i w_i |d_i - v_i|^2 + stiffness (|L d|^2 + mu |G d|^2) + s sum |d_i - d_j|^2,

        given W v (n, k): L the random walk's Laplacian, G differences along edges, the last sum over springs;
        `extra` (n, n) is added to the normal matrix, as of landmarks.
        """
        n = len(weights)
        pairs = np.concatenate([self.edges, self.edges[:, ::-1]])
        near = sp.csr_matrix((np.ones(len(pairs)), pairs.T), shape=(n, n))
        degree = np.maximum(np.asarray(near.sum(axis=1)).ravel(), 1)
        laplacian = sp.identity(n) - sp.diags(1 / degree) @ near
        matrix = stiffness * (laplacian.T @ laplacian + membrane * (sp.diags(degree) - near)) + sp.diags(weights)
        if len(self.springs):
            matrix = matrix + SPRING * _differences(self.springs, n)
        if extra is not None:
            matrix = matrix + extra
        # a tie far below every weight, so that a mesh without any known vertex stays put
        matrix = (matrix + 1e-10 * sp.identity(n)).tocoo()
        solver = CholeskySolverD(n, matrix.row, matrix.col, matrix.data, MatrixType.COO)

        def solve(right: np.ndarray) -> np.ndarray:
            out = np.empty(right.shape)
            for k in range(0, right.shape[1], _COLUMNS):
                part = np.ascontiguousarray(right[:, k : k + _COLUMNS], np.float64)
                block = np.empty_like(part)
                solver.solve(part, block)
                out[:, k : k + _COLUMNS] = block
            return out

        return solve


def extension(template: Template) -> Extension:
    """Of a template's skin; the springs join the inner rims of the lips."""
    skin = template.parts["skin"]
    edges = np.unique(np.sort(template.triangles[skin.triangles][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    upper, lower = (template.contours[f"lips_inner_{side}"] for side in ("upper", "lower"))
    nearest = cKDTree(template.mean[lower][:, :1]).query(template.mean[upper][:, :1])[1]
    springs = np.stack([upper, lower[nearest]], axis=1)
    return Extension(edges.astype(np.int64), springs[springs[:, 0] != springs[:, 1]].astype(np.int64))


def wrap(template: Template, head: ForeignHead) -> Wrap:
    """The shipped skin on a foreign mean.

    Source: Amberg, Romdhani, Vetter 2007, with one displacement a vertex in place of an affine map.

    Raises:
        InputError: the head is no upright face, or the fit misses it.
    """
    skin = template.parts["skin"]
    rest, triangles = template.mean[skin.vertices], template.triangles[skin.triangles]
    face = template.regions["face"][skin.vertices]
    hidden = np.zeros(len(rest), bool)
    for region in ("mouth", "sockets", "ears"):  # hidden, or too folded for closest points
        hidden |= template.regions[region][skin.vertices]
    outer = head.triangles[head.skin].astype(np.int64)
    # the meshes' own landmarks come from different hands; the detector sees both alike
    target = sight(head.mean, head.triangles, head.skin)
    own = sight(template.mean, template.triangles, np.arange(len(template.triangles)) < len(triangles))
    common = target.seen & own.seen & ~template.landmark_sliding & (np.arange(len(own.seen)) < 468)
    common = _agreeing(own.points, target.points, common)
    scale, rotation, shift = _place(rest, face & ~hidden, own.points, target.points, common, head.mean, outer)
    mean = (head.mean - shift) @ rotation
    start = scale * rest
    marks, _, _ = attach(own.points[common], rest, triangles.astype(np.int64))
    goal = (target.points[common] - shift) @ rotation - marks @ start

    weights = np.where(hidden, 0.0, 1.0)
    d = np.zeros_like(start)
    rows, known = sp.csr_matrix((len(rest), len(mean))), np.zeros(len(rest), bool)
    carry = extension(template)
    outward = _outward(start, triangles, mean, outer)
    border = meshes.border(len(mean), outer)
    for stiffness, reach, trust in SCHEDULE:
        for _ in range(ROUNDS):
            rows, known = _counterparts(start + d, triangles, mean, outer, outward, border, reach)
            known &= weights > 0
            solve = carry.factor(weights * known, stiffness, FIRMNESS, trust * (marks.T @ marks))
            d = solve(known[:, None] * (rows @ mean - start) + trust * (marks.T @ goal))
    rows, known = _counterparts(start + d, triangles, mean, outer, outward, border, SCHEDULE[-1][1])
    known &= weights > 0
    pull, drawn = HOLD * (marks.T @ marks), HOLD * (marks.T @ goal)
    for k in range(UNFOLDING + 1):
        solve = carry.factor(known.astype(float), FINISH, FIRMNESS, pull)
        d = solve(known[:, None] * (rows @ mean - start) + drawn)
        folded = _folded(start, start + d, triangles)
        if k == UNFOLDING or not folded.any():
            break
        for _ in range(2):
            folded[carry.edges[folded[carry.edges].any(axis=1)]] = True
        known &= ~folded
    apart = np.linalg.norm(rows @ mean - start - d, axis=1)
    visible = face & ~hidden
    cover, misfit = float(known[visible].mean()), float(apart[visible & known].mean()) if known.any() else np.inf
    log.info("wrap: %d landmarks, %.0f %% of the face met, %.2f mm apart", common.sum(), 100 * cover, misfit)
    if cover < LEAST_COVER or misfit > WORST_FIT:
        raise InputError(
            f"{head.name}: the head template meets {100 * cover:.0f} % of the face at {misfit:.1f} mm; "
            f"{100 * LEAST_COVER:.0f} % and {WORST_FIT:.0f} mm are needed: a face upright along y that looks along +z"
        )
    return Wrap(start + d, rows, known, scale, rotation)


def attach(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray) -> tuple[sp.csr_matrix, ...]:
    """Closest surface points as rows (k, v) of barycentric weights; their triangles (k,); the distances (k,)."""
    squared, face, closest = igl.point_mesh_squared_distance(np.ascontiguousarray(points), vertices, triangles)[:3]
    corners = triangles[face]
    b = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(vertices[corners[:, k]]) for k in range(3)))
    b = np.clip(np.nan_to_num(b, nan=1 / 3), 0, 1)
    b /= b.sum(axis=1, keepdims=True)
    index = np.repeat(np.arange(len(points)), 3)
    rows = sp.csr_matrix((b.ravel(), (index, corners.ravel())), shape=(len(points), len(vertices)))
    return rows, face, np.sqrt(squared)


def _place(rest, chosen, own, target, common, mean, outer) -> tuple[float, np.ndarray, np.ndarray]:
    """Similarity of the shipped head onto the foreign one: from landmarks, else from nose tips and closest points."""
    if common.sum() >= LEAST_LANDMARKS:
        return similarity(own[common], target[common])
    log.info("wrap: no face was seen on the head; it is placed by its shape alone")
    front = mean[np.unique(outer)]
    scale, rotation, shift = 1.0, np.eye(3), front[front[:, 2].argmax()] - rest[rest[:, 2].argmax()]
    points = rest[chosen]
    for k in range(30):
        moved = scale * points @ rotation.T + shift
        rows, _, apart = attach(moved, mean, outer)
        near = apart <= max(np.quantile(apart, 0.8), 1e-3)
        if k == 0 and apart[near].mean() > 60:
            break
        scale, rotation, shift = similarity(points[near], (rows @ mean)[near])
    return scale, rotation, shift


def _agreeing(own: np.ndarray, target: np.ndarray, common: np.ndarray) -> np.ndarray:
    """(478,) bool: landmarks that a similarity carries to within OUTLIER times the median; others miss the surface."""
    for _ in range(5):
        if common.sum() < LEAST_LANDMARKS:
            break
        scale, rotation, shift = similarity(own[common], target[common])
        apart = np.linalg.norm(scale * own @ rotation.T + shift - target, axis=1)
        common = common & (apart <= OUTLIER * np.median(apart[common]))
    return common


def _counterparts(moved, triangles, mean, outer, outward, border, reach) -> tuple[sp.csr_matrix, np.ndarray]:
    """Rows (n, v) of the closest points, and (n,) bool: within reach, facing alike, not on the foreign border."""
    rows, face, apart = attach(moved, mean, outer)
    alike = np.einsum("ij,ij->i", meshes.vertex_normals(moved, triangles), outward[face])
    at_border = rows @ border > 0.02
    return rows, (apart < reach) & (alike > LEAST_AGREEMENT) & ~at_border


def _outward(start, triangles, mean, outer) -> np.ndarray:
    """(m, 3) unit normals of the foreign skin, turned as a whole to agree with the shipped head's."""
    normals = meshes.face_normals(mean, outer)
    _, face, apart = attach(start, mean, outer)
    agree = np.einsum("ij,ij->i", meshes.vertex_normals(start, triangles), normals[face])
    return normals if np.median(agree[apart <= np.median(apart)]) >= 0 else -normals


def _folded(rest: np.ndarray, moved: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) bool: corners of triangles that turned by more than about 70 degrees."""
    normals = [meshes.face_normals(vertices, triangles) for vertices in (rest, moved)]
    folded = np.zeros(len(rest), bool)
    folded[triangles[np.einsum("ij,ij->i", *normals) < LEAST_UPRIGHT]] = True
    return folded


def _differences(pairs: np.ndarray, n: int) -> sp.csr_matrix:
    """D^T D of the differences d_i - d_j over `pairs` (k, 2)."""
    index = np.repeat(np.arange(len(pairs)), 2)
    d = sp.csr_matrix((np.tile([1.0, -1.0], len(pairs)), (index, pairs.ravel())), shape=(len(pairs), n))
    return d.T @ d
