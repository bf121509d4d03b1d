"""The clip's focal length and distortion, from frames whose face is near to rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatarbuild.geometry.rotations import rotation
from avatarbuild.tracking.fit import Face, Pinned, State
from avatarbuild.tracking.lens import Lens

_FOCAL_SD = 0.05  # of the logarithm: what the metadata, or the photos' lens and the usual crop, leave open
_K1_SD = 0.03
_STEPS = 6


def refined(face: Face, states: list[State], pinned: list[list[Pinned]], weight: float) -> tuple[Lens, list[State]]:
    """
    min over log f, k1 and all poses of sum r^2 + (log f / f0)^2 / sd^2 + k1^2 / sd^2, shapes and weights fixed.

    A clip from the front tells focal length from depth by the perspective of one known face alone: hence a prior and
    many frames at once. `weight`: of a point's square beside the prior, since neighbouring points err alike. The poses
    are eliminated frame by frame (Schur complement).
    """
    lens, first = face.lens, face.lens.focal
    for _ in range(_STEPS):
        at = replace(face, lens=lens)
        A = np.diag([1 / _FOCAL_SD**2, 1 / _K1_SD**2])
        b = np.array([-np.log(lens.focal / first) / _FOCAL_SD**2, -lens.k1 / _K1_SD**2])
        kept = []
        for state, points in zip(states, pinned, strict=True):
            H, C, g = np.eye(6) * 1e-9, np.zeros((6, 2)), np.zeros(6)
            for one in points:
                r, J, worth = one.rows(at, state)
                worth, J = worth * weight, J[:, :6]
                x = (one.rider.at(state.weights) + one.markers.offset) @ state.R.T + state.t
                p = x[:, :2] / x[:, 2:]
                r2 = (p * p).sum(axis=1, keepdims=True)
                by_focal = (1 + lens.k1 * r2) * p * x[:, 2:]  # du / d(log f), in mm at the face
                by_k1 = r2 * p * x[:, 2:]
                G = np.stack([by_focal.ravel(), by_k1.ravel()], axis=1)
                H += J.T @ (worth[:, None] * J)
                C += J.T @ (worth[:, None] * G)
                g -= J.T @ (worth * r)
                A += G.T @ (worth[:, None] * G)
                b -= G.T @ (worth * r)
            inverse = np.linalg.inv(H)
            A -= C.T @ inverse @ C
            b -= C.T @ inverse @ g
            kept.append((inverse, C, g))
        change = np.linalg.solve(A, b)
        lens = Lens(float(lens.focal * np.exp(change[0])), float(lens.k1 + change[1]), lens.size)
        moved = []
        for state, (inverse, C, g) in zip(states, kept, strict=True):
            pose = inverse @ (g - C @ change)
            moved.append(State(rotation(pose[:3]) @ state.R, state.t + pose[3:], state.weights))
        states = moved
    return lens, states
