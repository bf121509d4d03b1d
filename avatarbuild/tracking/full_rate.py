"""Every decoded frame: pose and weights with the shapes fixed, then smoothed without lag."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import scipy.linalg

from avatarbuild.landmarks import region_about, trace
from avatarbuild.parallel import each_alone
from avatarbuild.template import Template
from avatarbuild.tracking.alternation import Eyes, Skin, Tracked, aim, seek, settle
from avatarbuild.tracking.fit import Face, State, Weights
from avatarbuild.tracking.frames import Frame, ScoreLevel, frame

DENSE_LEVEL = 2  # of the pyramid for dense flow: a quarter of the work, and the shapes are known by now
FLOW_LEVEL = 1  # for equation (6)
CUT_OFF = 7.0  # Hz: motion that is faster than a blink's lids is noise
LEAST_PRESENCE = 0.5


def follow(
    face: Face,
    skin: Skin,
    template: Template,
    eyes: Eyes,
    processed: list[Tracked],
    level: ScoreLevel,
    decoded: Iterator[tuple[int, float, np.ndarray]],
    w: Weights,
    advance: Callable[[float], None],
) -> list[Tracked]:
    """
    All decoded frames (number, time, rgb) in order, without their pyramids. A processed one stays as it is; each of the
    others stands alone: the detector looks in the square where the processed neighbours' face lies, dense flow and
    equation (6) do the rest.
    """
    known = {one.frame.number: one for one in processed if one.quality > 0}
    numbers = np.array(sorted(known))
    a = len(face.rig.deltas)

    def look(item: tuple[int, float, np.ndarray]) -> Tracked:
        number, time, rgb = item
        if number in known:
            return known[number]
        marks = _expected(known, numbers, number)
        if marks is None:
            return _lost(number, time, a)
        seen = trace(rgb, region_about(marks), careful=False)
        if seen.presence < LEAST_PRESENCE:
            return _lost(number, time, a)
        here = frame(number, time, rgb, seen.points, seen.presence, level.of(seen.scores[:a]))
        begun = settle(face, aim(face, here, eyes, w), template, eyes, w)
        return seek(face, skin, begun, w, (FLOW_LEVEL,), DENSE_LEVEL)

    out = []
    for one in each_alone(look, decoded):
        advance(1)
        out.append(replace(one, pinned=[], frame=replace(one.frame, pyramid=[])))
    return out


def _expected(known: dict[int, Tracked], numbers: np.ndarray, number: int) -> np.ndarray | None:
    """(478, 3) where the detector should find its points, between the processed frames on both sides."""
    if not len(numbers):
        return None
    i = int(np.searchsorted(numbers, number))
    before, after = known[numbers[max(i - 1, 0)]].frame, known[numbers[min(i, len(numbers) - 1)]].frame
    share = np.clip((number - before.number) / max(after.number - before.number, 1), 0, 1)
    return (1 - share) * before.marks + share * after.marks


def _lost(number: int, time: float, a: int) -> Tracked:
    nothing = Frame(number, time, np.zeros((478, 3)), np.nan, np.full(a, np.nan), *(np.zeros(a),) * 2, np.zeros(2), [])
    state = State(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 500.0]), np.zeros(a))
    return Tracked(nothing, state, [], 0.0, np.full((2, 2), np.nan))


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
