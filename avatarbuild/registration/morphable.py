"""The morphable model fitted to landmarks and cloud: x_v = s R (mean_v + sum_k a_k U_kv) + t.

min over s, R, t, a of  w_lm sum rho(reprojection / s_l) + w_pts mean_v rho(n_v^T (x_v - p_v))^2 + w_prior |a|^2

by Gauss-Newton with analytic Jacobians and reweighting; a in standard deviations. Source: method, section 2 (a).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.energies.reprojection import residual
from avatarbuild.geometry import meshes
from avatarbuild.geometry.similarity import similarity
from avatarbuild.registration.counterparts import Target, counterparts
from avatarbuild.registration.sightings import Sightings
from avatarbuild.template import Template

# landmarks 234 to 454 of the oval lie on the jaw; the others, on the forehead, on no edge that a photo shows
JAW = (234, 93, 132, 58, 172, 136, 150, 149, 176, 148, 152, 377, 400, 378, 379, 365, 397, 288, 361, 323, 454)
_PIXEL_ROBUST = 2.5  # of a landmark's standard deviation: Cauchy's scale
_RIM = 0.25  # cosine to the view below which a vertex lies on the silhouette
_RIM_REACH = 15.0  # mm from a jaw landmark to the silhouette that it may lie on


Told = Callable[[], object]


@dataclass(frozen=True)
class Step:
    """One Gauss-Newton step: how much the cloud, the landmarks and the prior weigh, and how far the cloud reaches."""

    cloud: float
    landmarks: float
    prior: float
    reach: float


@dataclass(frozen=True)
class Placement:
    """The model in the cloud's frame: scale, rotation (3, 3), translation (3,), coefficients (p,)."""

    scale: float
    rotation: np.ndarray
    translation: np.ndarray
    coefficients: np.ndarray

    def place(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) points of the model, in the cloud's frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def head(self, template: Template) -> np.ndarray:
        """(n, 3) all vertices, in the cloud's frame."""
        return self.place(template.neutral(self.coefficients))


def start(template: Template, seen: Sightings) -> Placement:
    """The mean head laid onto the triangulated landmarks by a similarity."""
    own = template.landmarks(template.mean)
    use = np.isfinite(seen.points).all(axis=1) & ~template.landmark_sliding
    use[468:] = False
    scale, rotation, translation = similarity(own[use], seen.points[use])
    for _ in range(5):
        off = np.linalg.norm(scale * own @ rotation.T + translation - seen.points, axis=1)
        weight = 1 / (1 + (off[use] / 4.0) ** 2)
        scale, rotation, translation = similarity(own[use], seen.points[use], weight)
    return Placement(scale, rotation, translation, np.zeros(len(template.identity)))


def fit(
    template: Template,
    seen: Sightings,
    target: Target | None,
    trust: np.ndarray,
    spread: np.ndarray,
    steps: list[Step],
    begin: Placement,
    told: Told = lambda: None,
) -> Placement:
    """
    The model after `steps`.

    trust (n,) in [0, 1]: how far a vertex may listen to the cloud; spread (478,) mm: standard deviation of each
    landmark's place on the model. `told` is called after every step.
    """
    now = begin
    skin = template.triangles[template.parts["skin"].triangles]
    listening = np.flatnonzero(trust > 0)
    corners = template.triangles[template.landmark_triangles]
    bary = template.landmark_barycentric
    basis_l = np.einsum("lc,klcx->klx", bary, template.identity[:, corners])
    basis_v = template.identity[:, listening]
    area = meshes.vertex_areas(template.mean, template.triangles)[listening] * trust[listening]
    area /= area.sum()
    sliding = template.landmark_sliding
    fixed = np.flatnonzero(~sliding)
    for step in steps:
        head = template.neutral(now.coefficients)
        world = now.place(head)
        marks = template.landmarks(world)
        p = len(now.coefficients)
        A, b = np.zeros((7 + p, 7 + p)), np.zeros(7 + p)
        if step.landmarks > 0:
            H, g = _landmark_terms(marks[fixed], seen, fixed, spread[fixed])
            J = _jacobian(now, marks[fixed], basis_l[:, fixed])
            A += step.landmarks * np.einsum("lia,lij,ljb->ab", J, H, J, optimize=True)
            b -= step.landmarks * np.einsum("lia,li->a", J, g)
            normals = meshes.vertex_normals(world, skin)
            vertex, direction, offset, weight = _jaw_terms(template, world, normals, seen)
            if len(vertex):
                J = _jacobian(now, world[vertex], template.identity[:, vertex])
                J = np.einsum("ni,nia->na", direction, J)
                A += step.landmarks * (J * weight[:, None]).T @ J
                b -= step.landmarks * J.T @ (weight * offset)
        if step.cloud > 0 and target is not None:
            normals = meshes.vertex_normals(world, skin)[listening]
            found = counterparts(world[listening], normals, target, step.reach)
            d = np.einsum("ni,ni->n", found.normal, world[listening] - found.place)
            weight = step.cloud * area * found.weight
            use = weight > 0
            J = np.einsum("ni,nia->na", found.normal[use], _jacobian(now, world[listening][use], basis_v[:, use]))
            A += (J * weight[use, None]).T @ J
            b -= J.T @ (weight[use] * d[use])
        A[np.arange(7, 7 + p), np.arange(7, 7 + p)] += step.prior
        b[7:] -= step.prior * now.coefficients
        now = _moved(now, np.linalg.solve(A + 1e-9 * np.eye(7 + p), b))
        told()
    return now


def _jacobian(now: Placement, world: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """(n, 3, 7 + p): of places (n, 3) by a turn about the translation, a shift, log s and a; basis (p, n, 3)."""
    n = len(world)
    offset = world - now.translation
    J = np.zeros((n, 3, 7 + len(basis)))
    x, y, z = offset.T
    J[:, 0, 1], J[:, 0, 2] = z, -y
    J[:, 1, 0], J[:, 1, 2] = -z, x
    J[:, 2, 0], J[:, 2, 1] = y, -x
    J[:, :, 3:6] = np.eye(3)
    J[:, :, 6] = offset
    J[:, :, 7:] = np.moveaxis(now.scale * basis @ now.rotation.T, 0, 2)
    return J


def _moved(now: Placement, step: np.ndarray) -> Placement:
    turn = cv2.Rodrigues(step[:3])[0]
    return Placement(
        now.scale * float(np.exp(step[6])),
        turn @ now.rotation,
        now.translation + step[3:6],
        now.coefficients + step[7:],
    )


def _landmark_terms(
    marks: np.ndarray, seen: Sightings, index: np.ndarray, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean over photos of the squared reprojection in standard deviations: Hessian (l, 3, 3) and gradient (l, 3)."""
    r, J = residual(marks, seen.rotation, seen.translation, seen.focal, seen.pictures[:, index])
    depth = np.einsum("kj,lj->kl", seen.rotation[:, 2], marks) + seen.translation[:, 2:]
    sigma = spread * seen.focal[:, None] / depth  # pixels
    weight = 1 / (1 + (np.linalg.norm(r, axis=2) / (_PIXEL_ROBUST * sigma)) ** 2) / sigma**2 / len(seen.focal)
    H = np.einsum("kl,klai,klaj->lij", weight, J, J)
    g = np.einsum("kl,klai,kla->li", weight, J, r)
    return H, g


def _jaw_terms(
    template: Template, world: np.ndarray, normals: np.ndarray, seen: Sightings
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Jaw landmarks against the silhouette: they slide along it, only their distance across it counts.

    Returns vertices (c,), directions in space (c, 3), offsets along them (c,) mm, weights (c,).
    """
    regions = template.regions
    may = np.zeros(len(world), bool)
    may[template.parts["skin"].vertices] = True
    may &= ~(regions["mouth"] | regions["sockets"] | regions["ears"] | regions["scalp"] | regions["lips"])
    may &= template.mean[:, 1] < 0
    candidates = np.flatnonzero(may)
    found: list[tuple[int, np.ndarray, float]] = []
    for k, centre in enumerate(seen.centres):
        ray = world[candidates] - centre
        depth = np.linalg.norm(ray, axis=1)
        ray /= depth[:, None]
        facing = np.einsum("ni,ni->n", normals[candidates], ray)
        rim = candidates[np.abs(facing) < _RIM]
        if not len(rim):
            continue
        camera = world[rim] @ seen.rotation[k].T + seen.translation[k]
        flat = camera[:, :2] / camera[:, 2:]
        for number in JAW:
            gap = np.linalg.norm(flat - seen.pictures[k, number], axis=1) * camera[:, 2]
            best = int(gap.argmin())
            if gap[best] > _RIM_REACH:
                continue
            v = int(rim[best])
            n = normals[v] - normals[v] @ (world[v] - centre) * (world[v] - centre) / ((world[v] - centre) ** 2).sum()
            n /= max(np.linalg.norm(n), 1e-9)
            at = np.append(seen.pictures[k, number], 1.0) * camera[best, 2]
            found.append((v, n, float(n @ (world[v] - seen.rotation[k].T @ (at - seen.translation[k])))))
    if not found:
        return np.zeros(0, int), np.zeros((0, 3)), np.zeros(0), np.zeros(0)
    offset = np.array([f[2] for f in found])
    sigma = 4.0
    weight = 1 / (1 + (offset / (2 * sigma)) ** 2) / sigma**2 / len(seen.centres)
    return np.array([f[0] for f in found]), np.array([f[1] for f in found]), offset, weight
