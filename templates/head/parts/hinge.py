"""The lower jaw as a rigid body: its opening about the temporomandibular joints, and the motion that skin implies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .part import Floats

# Middle between the condyles in the mouth frame, mm: Bonwill's triangle of 100 mm sides puts it 86.6 mm from the
# incisors, Balkwill's angle of 24 degrees tilts it against the occlusal plane.
AXIS = (0.0, 35.0, -79.0)
GLIDE = (0.0, -4.0, 8.0)  # mm, path of the condyles down the articular eminence at 40 mm of opening
OPENING = 40.0  # mm between the incisors, jawOpen = 1


@dataclass(frozen=True)
class Rigid:
    """x -> rotation (3, 3) x + translation (3,), mm."""

    rotation: Floats
    translation: Floats

    def apply(self, points: Floats) -> Floats:
        """Moved points (..., 3)."""
        return np.asarray(points @ self.rotation.T + self.translation)

    def displacement(self, points: Floats) -> Floats:
        """Displacements (..., 3): the linear shape that reaches the moved points at weight 1."""
        return self.apply(points) - points


def jaw_opening(opening: float = OPENING, axis: tuple[float, float, float] = AXIS) -> Rigid:
    """The jaw's motion that brings the lower incisors' edge `opening` mm away from its closed place.

    R(angle) about the lateral axis through `axis` plus opening / 40 * GLIDE, with the angle such that
    |R(angle) (0 - axis) + axis + glide| = opening, by bisection.
    """
    hinge = np.array(axis)
    glide = np.array(GLIDE) * opening / OPENING
    low, high = 0.0, np.radians(60.0)
    for _ in range(60):
        angle = 0.5 * (low + high)
        moved = _about_x(angle) @ -hinge + hinge + glide
        low, high = (angle, high) if np.linalg.norm(moved) < opening else (low, angle)
    rotation = _about_x(0.5 * (low + high))
    return Rigid(rotation, hinge - rotation @ hinge + glide)


def fit_rigid(points: Floats, moved: Floats, weights: Floats | None = None) -> Rigid:
    """argmin over rotations R and translations t of sum_i w_i |R p_i + t - q_i|^2.

    points p, moved q (k, 3) mm; weights (k,) >= 0, all 1 when left out. Source: Kabsch 1976, with the sign of the
    determinant kept. Points that mirror each other give a motion within the middle plane.
    """
    w = np.ones(len(points)) if weights is None else np.asarray(weights, float)
    w = w / w.sum()
    centre, target = w @ points, w @ moved
    u, _, vt = np.linalg.svd((points - centre).T @ (w[:, None] * (moved - target)))
    sign = np.sign(np.linalg.det(vt.T @ u.T))
    rotation = vt.T @ np.diag([1.0, 1.0, sign]) @ u.T
    return Rigid(rotation, target - rotation @ centre)


def _about_x(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
