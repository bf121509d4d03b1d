"""
How the neck pulls at the skin below the mouth: where the head turns on a still body, the skin beneath the chin stays
behind. No shape does that, and shapes that follow it move jaw and lips where nobody moved them. Two fields of
displacement stand after the rig's shapes, across the head and up, each of UNIT mm at the chin's lower edge, with
weights of either sign; learning fits them to the person like shapes, and they stay out of the avatar.
"""

from __future__ import annotations

import numpy as np

from avatarbuild.template import ARKIT_NAMES, Template

SHAPES = len(ARKIT_NAMES) - 1  # tongueOut, the last, moves no skin
PULLS = 2
UNIT = 5.0  # mm
FARTHEST = 3.0  # of UNIT

_LIP, _CHIN = 57, 8  # of the 68 landmarks: the lower lip's lower border, the chin's lower edge
_BEGIN = 0.2  # of the way from that lip to that edge: above, the skin is the face's


def pulls(template: Template, neutral: np.ndarray) -> np.ndarray:
    """
    (PULLS, n, 3) mm: UNIT ((h_0 - y) / (h_0 - h_1))^2 below the height h_0, h_1 that of the chin's edge.

    neutral (n, 3) mm in the head frame, y up.
    """
    heights = template.landmarks(neutral)[template.landmarks68][[_LIP, _CHIN], 1]
    begin = heights[0] + _BEGIN * (heights[1] - heights[0])
    share = np.clip((begin - neutral[:, 1]) / (begin - heights[1]), 0, 1.5) ** 2
    out = np.zeros((PULLS, *neutral.shape))
    for axis in range(PULLS):
        out[axis, :, axis] = UNIT * share
    return out


def bounds() -> tuple[np.ndarray, np.ndarray]:
    """low, high (SHAPES + PULLS,) of the weights: 0 and 1 for shapes."""
    low = np.r_[np.zeros(SHAPES), np.full(PULLS, -FARTHEST)]
    return low, np.r_[np.ones(SHAPES), np.full(PULLS, FARTHEST)]


def padded(values: np.ndarray, with_: float) -> np.ndarray:
    """(SHAPES + PULLS,) values of the shapes, SHAPES or more of them, then `with_` for the pulls."""
    return np.r_[values[:SHAPES], np.full(PULLS, with_)]
