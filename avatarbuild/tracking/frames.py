"""Frames of a video as the tracker sees them: the logarithm of grey about the face, in a pyramid."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from avatarbuild.tracking import body, neck
from avatarbuild.tracking.lids import eye_shown
from avatarbuild.tracking.markers import SKIN, Clicks
from avatarbuild.tracking.samples import log_grey

LEVELS = 4  # of the pyramid, each half the size of the one before
_ROOM = 0.2  # of the face's size, kept about it on all sides
_BLUR = 0.6  # pixels: takes off the noise and the block borders that single pixels have


@dataclass(frozen=True)
class Frame:
    """
    number among the decoded frames, time s; marks (478, 3) pixels of the detector and its presence, NaN where it found
    nothing; scores (a,) its opinion of the shapes' weights, NaN where it has none; low, high (a,) the weights' bounds;
    corner (2,) pixels of the crop and its pyramid, finest first; clicks: points that the user has set;
    shown (2,) how much of the left and the right eye shows (`lids.eye_shown`), and shut (2,) how far they are shut;
    whole (h, w) the picture in which the body is looked for (`body.whole`), and moved what it did there, None unknown.
    """

    number: int
    time: float
    marks: np.ndarray
    presence: float
    scores: np.ndarray
    low: np.ndarray
    high: np.ndarray
    corner: np.ndarray
    pyramid: list[np.ndarray]
    clicks: Clicks | None = None
    shown: np.ndarray = field(default_factory=lambda: np.full(2, np.nan))
    shut: np.ndarray = field(default_factory=lambda: np.zeros(2))
    whole: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    moved: body.Motion | None = None


@dataclass(frozen=True)
class ScoreLevel:
    """The detector's expression scores of one face: rest (a,) what they are at rest, alive (a,) bool."""

    rest: np.ndarray
    alive: np.ndarray

    def of(self, scores: np.ndarray) -> np.ndarray:
        """(a,) what scores (a,) say beyond rest; NaN where a channel is dead."""
        return np.where(self.alive & np.isfinite(scores), np.clip(np.nan_to_num(scores) - self.rest, 0, 1), np.nan)


def frame(
    number: int,
    time: float,
    rgb: np.ndarray,
    marks: np.ndarray,
    presence: float,
    scores: np.ndarray,
    clicks: Clicks | None = None,
) -> Frame:
    """The frame cropped to the detector's points, marks (478, 3); scores (a,). The weights' bounds are 0 and 1."""
    h, w = rgb.shape[:2]
    first, last = marks[:SKIN, :2].min(axis=0), marks[:SKIN, :2].max(axis=0)
    room = _ROOM * float((last - first).max())
    unit = 1 << (LEVELS - 1)
    low = np.clip(np.floor((first - room) / unit) * unit, 0, [max(w - 2 * unit, 0), max(h - 2 * unit, 0)]).astype(int)
    high = np.clip(np.ceil((last + room) / unit) * unit, low + 2 * unit, [w, h]).astype(int)
    grey = log_grey(np.ascontiguousarray(rgb[low[1] : high[1], low[0] : high[0]]))
    pyramid = []
    for level in range(LEVELS):
        if level:
            grey = grey[: grey.shape[0] // 2 * 2, : grey.shape[1] // 2 * 2]
            grey = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        pyramid.append(cv2.GaussianBlur(grey, (0, 0), _BLUR))
    return Frame(
        *(number, time, marks, presence, neck.padded(scores, np.nan), *neck.bounds(), low.astype(np.float64)),
        *(pyramid, clicks),
        shown=eye_shown(rgb, marks),
        whole=body.whole(rgb),
    )
