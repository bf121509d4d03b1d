"""Every decoded frame: pose and weights with the shapes fixed, then smoothed without lag."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from avatarbuild.landmarks import region_about, trace
from avatarbuild.parallel import each_alone
from avatarbuild.template import Template
from avatarbuild.tracking.alternation import Eyes, Skin, Tracked, aim, regard, seek, settle
from avatarbuild.tracking.corrections import shifted
from avatarbuild.tracking.fit import Face, State, Weights
from avatarbuild.tracking.frames import Frame, ScoreLevel, frame
from avatarbuild.tracking.markers import Clicks
from avatarbuild.tracking.neck import SHAPES

SIDES = (256.0, 512.0)  # pixels of the face's crop, whatever the video's size: to find the face, and to measure it
CUT_OFF = 7.0  # Hz: motion that is faster than a blink's lids is noise
LEAST_PRESENCE = 0.5


@dataclass(frozen=True)
class Sightings:
    """Frames that the detector has seen the face in: their numbers (j,), rising, and its points (j, 478, 3)."""

    numbers: np.ndarray
    marks: np.ndarray

    @staticmethod
    def of(frames: list[Frame]) -> Sightings:
        return Sightings(np.array([one.number for one in frames], int), np.array([one.marks for one in frames]))

    def expected(self, number: int) -> np.ndarray:
        """(478, 3) where the detector should find its points in a frame, between the sightings on both sides."""
        i = int(np.searchsorted(self.numbers, number))
        before, after = max(i - 1, 0), min(i, len(self.numbers) - 1)
        share = (number - self.numbers[before]) / max(self.numbers[after] - self.numbers[before], 1)
        return self.marks[before] + np.clip(share, 0, 1) * (self.marks[after] - self.marks[before])


@dataclass(frozen=True)
class Found:
    """
    A decoded frame's number, its state, its quality in 0..1 (0: lost), its gaze (2, 2) radians, NaN unknown, and the
    pose R, t of a head that had not moved on its body.
    """

    number: int
    state: State
    quality: float
    gaze: np.ndarray
    torso: tuple[np.ndarray, np.ndarray]


def follow(
    face: Face,
    skin: Skin,
    template: Template,
    eyes: Eyes,
    sightings: Sightings,
    processed: list[Tracked],
    level: ScoreLevel,
    decoded: Iterator[tuple[int, float, np.ndarray]],
    w: Weights,
    advance: Callable[[float], None],
    clicks: dict[int, Clicks],
) -> list[Found]:
    """
    All decoded frames (number, time, rgb) in order, but the lost ones. A processed one stays as it is; each of the
    others stands alone: the detector looks in the square where the face should be by the sightings before and after,
    dense flow and equation (6) do the rest. `clicks`: what the user's points say of a frame.
    """
    known = {one.frame.number: one for one in processed if one.quality > 0}

    def look(item: tuple[int, float, np.ndarray]) -> Found | None:
        number, time, rgb = item
        if number in known:
            one = known[number]
        else:
            seen = trace(rgb, region_about(sightings.expected(number)), careful=False)
            if seen.presence < LEAST_PRESENCE:
                return None
            scores = level.of(seen.scores[:SHAPES])
            told = clicks.get(number)
            marks = seen.points if told is None else shifted(seen.points, told, face.markers)
            here = frame(number, time, rgb, marks, seen.presence, scores, told)
            begun = settle(face, aim(face, here, w), template, eyes, w)
            coarse, fine = (fitting(here, side) for side in SIDES)
            near = seek(face, skin, begun, w, (), coarse)
            one = seek(face, skin, near, w, (fine,), fine)
            one = regard(face, one, template, eyes)
        return found(face, one)

    out = []
    for one in each_alone(look, decoded if len(sightings.numbers) else ()):
        advance(1)
        if one is not None:
            out.append(one)
    return out


def found(face: Face, one: Tracked) -> Found:
    """A tracked frame as part of the take."""
    unmoved = (one.state.R, one.state.t) if face.torso is None else face.torso.at(one.frame.moved)
    return Found(one.frame.number, one.state, one.quality, one.gaze, unmoved)


def fitting(here: Frame, side: float) -> int:
    """The first level of a frame's pyramid whose longer side is no longer than `side` pixels, else the last."""
    sides = [max(picture.shape) for picture in here.pyramid]
    return next((level for level, length in enumerate(sides) if length <= side), len(sides) - 1)


def smoothed(values: np.ndarray, worth: np.ndarray, fps: float) -> np.ndarray:
    """
    x = argmin sum_f q_f |x_f - v_f|^2 + l sum_f |x_(f+1) - 2 x_f + x_(f-1)|^2, for values (f, k) with worths (f,).

    No lag, since both sides count. l halves what swings at CUT_OFF: l = 1 / (2 - 2 cos(2 pi CUT_OFF / fps))^2; slower
    clips than 3 CUT_OFF keep their frames as they are. Source: Whittaker 1923.
    """
    n = len(values)
    if n < 3 or fps < 3 * CUT_OFF or not worth.any():
        return values
    l = 1 / (2 - 2 * np.cos(2 * np.pi * CUT_OFF / fps)) ** 2
    bands = np.zeros((3, n))
    bands[2] = np.maximum(worth, 1e-6)
    difference = (1.0, -2.0, 1.0)
    for i in range(n - 2):
        for p in range(3):
            for q in range(p, 3):
                bands[2 - (q - p), i + q] += l * difference[p] * difference[q]
    return scipy.linalg.solveh_banded(bands, values * np.maximum(worth, 1e-6)[:, None])
