"""
How the neck pulls at the skin below the mouth: where the head moves on a still body, the skin beneath the chin stays
behind. No shape does that, and shapes that follow it move jaw and lips where nobody moved them. Fields of displacement
stand after the rig's shapes: those by which a still torso moves past the head, fading out towards the mouth. Learning
fits them to the person like shapes, and they stay out of the avatar. Their weights are the head's pose alone: fields
that were free in every frame took up what jaws and chins do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.template import ARKIT_NAMES, Template

SHAPES = len(ARKIT_NAMES) - 1  # tongueOut, the last, moves no skin
PULLS = 6  # across the head, up and forward; turned about these
UNIT, TURN = 5.0, 0.1  # mm, and radians about the chin's lower edge, at weight 1
FARTHEST = 3.0  # of UNIT

_LIP, _CHIN = 57, 8  # of the 68 landmarks: the lower lip's lower border, the chin's lower edge
_BEGIN = 0.2  # of the way from that lip to that edge: above, the skin is the face's
_SEEN = 2  # the first pulls, which a frontal video shows: free until the torso is known
_MOST = 0.6  # of the torso's motion at the chin's edge
_KNOWN = 10.0  # mm^2 of motion that the share's prior, 0, is worth
_AT_REST = 0.01  # of the frames that the offset's prior, 0, is worth
_NEAR = 0.5  # mm by which a chin errs before it counts less
_ROUNDS = 20


@dataclass(frozen=True)
class Torso:
    """
    Still while the head moves: R (3, 3) and t (3,) mm, in the camera's frame, the head's usual pose; chin (3,) mm, the
    chin's lower edge in the head frame; share of the torso's motion past the head that the skin there makes, and
    offset (2,) mm of it, across and up, in the usual pose.
    """

    R: np.ndarray
    t: np.ndarray
    chin: np.ndarray
    share: float
    offset: np.ndarray

    def weights(self, R: np.ndarray, t: np.ndarray) -> np.ndarray:
        """(PULLS,) of a frame whose head's pose is R (3, 3), t (3,)."""
        moved = self.share * _passing(self, R, t)
        moved[:_SEEN] += self.offset
        turned = self.share * cv2.Rodrigues(R.T @ self.R)[0].ravel()
        return np.concatenate([moved / UNIT, turned / TURN])


def pulls(template: Template, neutral: np.ndarray) -> np.ndarray:
    """
    (PULLS, n, 3) mm: s(y) UNIT e_k and s(y) TURN e_k x (x - c) for the axes k, c the chin's edge, with
    s = ((h_0 - y) / (h_0 - h_1))^2 below the height h_0, h_1 that of c.

    neutral (n, 3) mm in the head frame, y up.
    """
    lip, chin = template.landmarks(neutral)[template.landmarks68][[_LIP, _CHIN]]
    begin = lip[1] + _BEGIN * (chin[1] - lip[1])
    share = np.clip((begin - neutral[:, 1]) / (begin - chin[1]), 0, 1.5)[:, None] ** 2
    axes = np.eye(3)
    return np.array([share * UNIT * e for e in axes] + [share * TURN * np.cross(e, neutral - chin) for e in axes])


def torso(
    template: Template, neutral: np.ndarray, poses: Sequence[tuple[np.ndarray, np.ndarray]], seen: np.ndarray
) -> Torso:
    """
    min over share, offset of  sum_f rho(|UNIT seen_f - share u_f - offset|) + priors, u_f the torso's motion past the
    chin's edge: the Torso of frames whose heads' poses are (R, t) and whose pulls, free, came out as seen (F, PULLS).
    """
    chin = template.landmarks(neutral)[template.landmarks68][_CHIN]
    mean = sum(R for R, _ in poses)
    u, _, v = np.linalg.svd(mean)
    usual = Torso(u @ v, np.median([t for _, t in poses], axis=0), chin, 0.0, np.zeros(_SEEN))
    moved = np.array([_passing(usual, R, t)[:_SEEN] for R, t in poses])
    A = np.concatenate([moved[:, :, None], np.broadcast_to(np.eye(_SEEN), (len(poses), _SEEN, _SEEN))], axis=2)
    A, b = A.reshape(-1, 1 + _SEEN), UNIT * seen[:, :_SEEN].ravel()
    prior = np.diag([_KNOWN / _NEAR, *[_AT_REST * len(poses) / _NEAR] * _SEEN])
    worth = np.full(len(b), 1 / _NEAR)
    x = np.zeros(1 + _SEEN)
    for _ in range(_ROUNDS):
        x = np.linalg.solve(A.T @ (A * worth[:, None]) + prior, A.T @ (worth * b))
        worth = 1 / np.maximum(np.abs(b - A @ x), _NEAR)
    return Torso(usual.R, usual.t, chin, float(np.clip(x[0], 0, _MOST)), x[1:])


def _passing(torso: Torso, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(3,) mm by which the torso moves past the chin's edge, in the head frame of the pose R, t."""
    return R.T @ (torso.R @ torso.chin + torso.t - t) - torso.chin


def bounds() -> tuple[np.ndarray, np.ndarray]:
    """low, high (SHAPES + PULLS,) of the weights while the torso is unknown: 0 and 1 for shapes."""
    free = np.r_[np.full(_SEEN, FARTHEST), np.zeros(PULLS - _SEEN)]
    return np.r_[np.zeros(SHAPES), -free], np.r_[np.ones(SHAPES), free]


def padded(values: np.ndarray, with_: float) -> np.ndarray:
    """(SHAPES + PULLS,) values of the shapes, SHAPES or more of them, then `with_` for the pulls."""
    return np.r_[values[:SHAPES], np.full(PULLS, with_)]
