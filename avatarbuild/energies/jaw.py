"""
What is in the mouth: pieces that move with the jaw as one, and what they do besides.

The source's lower teeth move by a rigid motion x -> Q x + t. The skin about the jaw follows it but for an offset
o(x) = E(x) - (Q x + t - x); on the target the teeth move by the rigid motion (Q', t') that leaves the skin the same
offset:

  argmin_{Q', t'} sum_v w_v || x_v + D_v - o_v - (Q' x_v + t') ||^2,   w_v = exp(-|o_v|^2 / NEAR^2),

D the target's displacement of the skin. A piece with its own motion besides (a tongue) has it mapped by the affine map
that takes the source's piece to the target's. Where target and source are equal nothing changes. Millimetres.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatarbuild.geometry.similarity import similarity

NEAR = 4.0  # mm between the jaw's motion and the skin's, of skin that tells where the jaw is
STILL = 1e-7  # mm


class Rigid(NamedTuple):
    """x -> rotation x + shift."""

    rotation: np.ndarray
    shift: np.ndarray

    def displacement(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) of points (n, 3)."""
        return points @ self.rotation.T + self.shift - points


def rigid(a: np.ndarray, b: np.ndarray, weights: np.ndarray | None = None) -> Rigid:
    """argmin_{Q, t} sum_i w_i || Q a_i + t - b_i ||^2; a, b (n, 3), weights (n,)."""
    _, rotation, _ = similarity(a, b, weights)
    w = np.full(len(a), 1 / len(a)) if weights is None else weights / weights.sum()
    return Rigid(rotation, w @ b - rotation @ (w @ a))


def jaw_motion(
    teeth: np.ndarray,
    teeth_delta: np.ndarray,
    skin: np.ndarray,
    delta: np.ndarray,
    target: np.ndarray,
    moved: np.ndarray,
) -> tuple[Rigid, Rigid]:
    """
    The jaw's motion in the source and in the target, in one shape.

    teeth (k, 3), teeth_delta (k, 3) the source's lower teeth; skin (n, 3), delta (n, 3) its skin; target (n, 3), moved
    (n, 3) the target's skin at rest and its displacement.
    """
    source = rigid(teeth, teeth + teeth_delta)
    offset = delta - source.displacement(skin)
    size = np.linalg.norm(offset, axis=1)
    weights = np.where(np.linalg.norm(delta, axis=1) > STILL, np.exp(-((size / NEAR) ** 2)), 0)
    return source, rigid(target, target + moved - offset, weights)


def carried(
    piece: np.ndarray, delta: np.ndarray, target: np.ndarray, source_jaw: Rigid, target_jaw: Rigid
) -> np.ndarray:
    """(k, 3) displacement of the target's piece (k, 3): with the jaw, and the source's own motion besides."""
    own = delta - source_jaw.displacement(piece)
    return target_jaw.displacement(target) + own @ affine(piece, target).T


def affine(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3, 3) argmin_M sum_i || M (a_i - mean a) - (b_i - mean b) ||^2, a light pull to I where a is flat."""
    x, y = a - a.mean(axis=0), b - b.mean(axis=0)
    pull = 1e-9 * np.trace(x.T @ x) * np.eye(3)
    return np.linalg.solve(x.T @ x + pull, x.T @ y + pull).T
