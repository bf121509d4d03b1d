"""
How the neck pulls at the skin below the mouth: where the head moves on its body, the skin beneath the chin stays
behind. No shape does that, and shapes that follow it move jaw and lips where nobody moved them. Fields of displacement
stand after the rig's shapes: those by which the torso moves past the head, fading out towards the mouth. Learning
fits them to the person like shapes, and they stay out of the avatar. Their weights are where the head's pose and the
body in the picture are: fields that were free in every frame took up what jaws and chins do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.tracking.body import STILL, Motion, Patch

SHAPES = len(ARKIT_NAMES) - 1  # tongueOut, the last, moves no skin
PULLS = 6  # across the head, up and forward; turned about these
UNIT, TURN = 5.0, 0.1  # mm, and radians about the chin's lower edge, at weight 1
FARTHEST = 3.0  # of UNIT

UNBENT = np.array([0.0, -1e6])  # mm: `heights` of a neck that stays the head's

_LIP, _CHIN = 57, 8  # of the 68 landmarks: the lower lip's lower border, the chin's lower edge
_BEGIN = 0.2  # of the way from that lip to that edge: above, the skin is the face's
_SEEN = 2  # the first pulls, which a frontal video shows: free until the torso is known
_MOST = 0.6  # of the torso's motion at the chin's edge
_KNOWN = 10.0  # mm^2 of motion that the share's prior, 0, is worth
_AT_REST = 0.01  # of the frames that the offset's prior, 0, is worth
_NEAR = 0.5  # mm by which a chin errs before it counts less
_ROUNDS = 20
_LEAST_WAY = 0.02  # from `begin` to where the neck is the torso's: necks end before


@dataclass(frozen=True)
class Torso:
    """
    What the head moves on: R (3, 3) and t (3,) mm, in the camera's frame, the head's usual pose in the frame of the
    body's patch, None where no body is seen; begin mm, the height in the head frame below which skin is pulled, and
    chin (3,) mm, the chin's lower edge; share of the torso's motion past the head that the skin there makes, and offset
    (2,) mm of it, across and up, in the usual pose.
    """

    R: np.ndarray
    t: np.ndarray
    patch: Patch | None
    begin: float
    chin: np.ndarray
    share: float
    offset: np.ndarray

    def at(self, moved: Motion | None) -> tuple[np.ndarray, np.ndarray]:
        """R (3, 3), t (3,) of a head that has not moved on its body, in a frame to which the body moved."""
        return (moved or STILL).of(self.R, self.t)

    def weights(self, R: np.ndarray, t: np.ndarray, moved: Motion | None) -> np.ndarray:
        """(PULLS,) of a frame whose head's pose is R (3, 3), t (3,) and to which the body moved."""
        still = self.at(moved)
        past = self.share * _passing(self.chin, *still, R, t)
        past[:_SEEN] += self.offset
        turned = self.share * cv2.Rodrigues(R.T @ still[0])[0].ravel()
        return np.concatenate([past / UNIT, turned / TURN])

    @property
    def heights(self) -> np.ndarray:
        """(2,) mm: `begin`, and where `bent` has to end for the chin's edge to make its share of the torso's motion."""
        way = 0.5 - np.sin(np.arcsin(1 - 2 * self.share) / 3)  # the inverse of 3 x^2 - 2 x^3
        return np.array([self.begin, self.begin - (self.begin - self.chin[1]) / max(way, _LEAST_WAY)])


def pulls(template: Template, neutral: np.ndarray) -> np.ndarray:
    """
    (PULLS, n, 3) mm: s(y) UNIT e_k and s(y) TURN e_k x (x - c) for the axes k, c the chin's edge, with
    s = ((h_0 - y) / (h_0 - h_1))^2 below the height h_0, h_1 that of c.

    neutral (n, 3) mm in the head frame, y up.
    """
    begin, chin = _edge(template, neutral)
    share = np.clip((begin - neutral[:, 1]) / (begin - chin[1]), 0, 1.5)[:, None] ** 2
    axes = np.eye(3)
    return np.array([share * UNIT * e for e in axes] + [share * TURN * np.cross(e, neutral - chin) for e in axes])


def bent(
    vertices: np.ndarray,
    rest: np.ndarray,
    heights: np.ndarray,
    head: tuple[np.ndarray, np.ndarray],
    torso: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """
    (n, 3) mm, head frame: x + b(y) (R^T (R' x + t' - t) - x), b = 3 s^2 - 2 s^3 with s from 0 to 1 between the heights
    (2,) at rest (n, 3): vertices of a posed head whose neck goes from the head's pose R, t to the torso's R', t'.
    """
    b = smooth_step(rest[:, 1], heights[0], heights[1])[:, None]
    (R, t), (R_torso, t_torso) = head, torso
    return np.asarray((1 - b) * vertices + b * ((vertices @ R_torso.T + t_torso - t) @ R))


def torso(
    template: Template,
    neutral: np.ndarray,
    poses: Sequence[tuple[np.ndarray, np.ndarray]],
    moved: Sequence[Motion | None],
    patch: Patch | None,
    seen: np.ndarray,
) -> Torso:
    """
    min over share, offset of  sum_f rho(|UNIT seen_f - share u_f - offset|) + priors, u_f the torso's motion past the
    chin's edge: the Torso of frames whose heads' poses are (R, t), whose bodies moved from the patch's frame as said,
    and whose pulls, free, came out as seen (F, PULLS).
    """
    begin, chin = _edge(template, neutral)
    back = [(m or STILL).undone(*pose) for m, pose in zip(moved, poses, strict=True)]
    u, _, v = np.linalg.svd(sum(R for R, _ in back))
    usual = Torso(u @ v, np.median([t for _, t in back], axis=0), patch, begin, chin, 0.0, np.zeros(_SEEN))
    past = np.array([_passing(chin, *usual.at(m), *pose)[:_SEEN] for m, pose in zip(moved, poses, strict=True)])
    A = np.concatenate([past[:, :, None], np.broadcast_to(np.eye(_SEEN), (len(poses), _SEEN, _SEEN))], axis=2)
    A, b = A.reshape(-1, 1 + _SEEN), UNIT * seen[:, :_SEEN].ravel()
    prior = np.diag([_KNOWN / _NEAR, *[_AT_REST * len(poses) / _NEAR] * _SEEN])
    worth = np.full(len(b), 1 / _NEAR)
    x = np.zeros(1 + _SEEN)
    for _ in range(_ROUNDS):
        x = np.linalg.solve(A.T @ (A * worth[:, None]) + prior, A.T @ (worth * b))
        worth = 1 / np.maximum(np.abs(b - A @ x), _NEAR)
    return replace(usual, share=float(np.clip(x[0], 0, _MOST)), offset=x[1:])


def _edge(template: Template, neutral: np.ndarray) -> tuple[float, np.ndarray]:
    """mm: the height below which skin is pulled, and (3,) the chin's lower edge."""
    lip, chin = template.landmarks(neutral)[template.landmarks68][[_LIP, _CHIN]]
    return float(lip[1] + _BEGIN * (chin[1] - lip[1])), chin


def _passing(chin: np.ndarray, R_torso: np.ndarray, t_torso: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(3,) mm by which the torso moves past the chin's edge, in the head frame of the pose R, t."""
    return np.asarray(R.T @ (R_torso @ chin + t_torso - t) - chin)


def bounds() -> tuple[np.ndarray, np.ndarray]:
    """low, high (SHAPES + PULLS,) of the weights while the torso is unknown: 0 and 1 for shapes."""
    free = np.r_[np.full(_SEEN, FARTHEST), np.zeros(PULLS - _SEEN)]
    return np.r_[np.zeros(SHAPES), -free], np.r_[np.ones(SHAPES), free]


def padded(values: np.ndarray, with_: float) -> np.ndarray:
    """(SHAPES + PULLS,) values of the shapes, SHAPES or more of them, then `with_` for the pulls."""
    return np.r_[values[:SHAPES], np.full(PULLS, with_)]
