"""Every decoded frame: pose and weights with the shapes fixed, then smoothed without lag."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import scipy.linalg

from avatarbuild.landmarks import region_about, trace
from avatarbuild.parallel import in_order
from avatarbuild.template import Template
from avatarbuild.tracking import fit, gaze
from avatarbuild.tracking.alternation import Eyes, Tracked, first_state
from avatarbuild.tracking.fit import Face, State, Weights
from avatarbuild.tracking.frames import Frame, box_of, frame

LEVEL = 1  # of the pyramid for equation (6)
CUT_OFF = 7.0  # Hz: motion that is faster than a blink's lids is noise
LEAST_PRESENCE = 0.5
_NEAR = 0.5  # quality of the processed frames on both sides from which a face is looked for at the place between


def follow(
    face: Face,
    template: Template,
    eyes: Eyes,
    processed: list[Tracked],
    decoded: Iterator[tuple[int, float, np.ndarray]],
    w: Weights,
    advance: Callable[[float], None],
) -> list[Tracked]:
    """
    All decoded frames (number, time, rgb) in order. A processed one stays as it is; the others start from the one
    before, by the detector's points in the square where the neighbours' face lies, then by the texture.
    """
    known = {one.frame.number: one for one in processed}
    numbers = np.array(sorted(known))
    a = len(face.rig.deltas)

    def look(item: tuple[int, float, np.ndarray]) -> Tracked | Frame:
        number, time, rgb = item
        if number in known:
            return known[number]
        i = int(np.clip(np.searchsorted(numbers, number), 1, max(len(numbers) - 1, 1)))
        pair = [known[n] for n in numbers[max(i - 1, 0) : i + 1]]
        pair = [one for one in pair if one.quality > 0]
        if not pair:
            return Frame(number, time, np.zeros((478, 3)), np.nan, np.full(a, np.nan), *_empty(a))
        marks = pair[0].frame.marks
        if len(pair) == 2:
            gap = pair[1].frame.number - pair[0].frame.number
            share = np.clip((number - pair[0].frame.number) / max(gap, 1), 0, 1)
            marks = (1 - share) * marks + share * pair[1].frame.marks
        seen = trace(rgb, region_about(marks), careful=False)
        presence = seen.presence if seen.presence >= LEAST_PRESENCE else np.nan
        return frame(number, time, rgb, seen.points, presence, np.full(a, np.nan), box_of(seen.points))

    out: list[Tracked] = []
    before: Tracked | None = None
    for found in in_order(look, decoded):
        advance(1)
        if isinstance(found, Tracked):
            out.append(found)
        elif not np.isfinite(found.presence):
            out.append(Tracked(found, first_lost(before, a), [], 0.0, np.full((2, 2), np.nan)))
        else:
            out.append(_one(face, template, eyes, found, before, w))
        before = out[-1] if out[-1].quality > 0 else before
    return [replace(one, frame=replace(one.frame, pyramid=[])) for one in out]


def _empty(a: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
    return np.zeros(a), np.ones(a), np.zeros(2), []


def first_lost(before: Tracked | None, a: int) -> State:
    """Where a lost frame stands until its neighbours are known: with the frame before."""
    return State(np.diag([1.0, -1, -1]), np.array([0, 0, 500.0]), np.zeros(a)) if before is None else before.state


def _one(face: Face, template: Template, eyes: Eyes, here: Frame, before: Tracked | None, w: Weights) -> Tracked:
    a = len(face.rig.deltas)
    pinned = fit.detected(face, here, w)
    near = before is not None and before.quality > 0
    start = before.state if near and before is not None else first_state(here, face.lens, a)
    state = fit.fit_points(face, here, pinned, start, w, rigid=2 if near else 4, steps=0)
    angles = gaze.gaze(here.marks, eyes.centres, eyes.radius, face.lens, state.R, state.t)
    looks = gaze.look_weights(template, angles)[:a]
    fixed = np.array([name in template.eye_rotations for name in template.expression_names])[:a]
    here = replace(here, low=np.where(fixed, looks, 0.0), high=np.where(fixed, looks, here.high))
    state = replace(state, weights=np.clip(state.weights, here.low, here.high))
    state = fit.fit_points(face, here, pinned, state, w, rigid=0, steps=2 if near else 6)
    state = fit.fit(face, here, pinned, state, w, (LEVEL,), 2, before.state.weights if near and before else None)
    r, _, _ = pinned[0].rows(face, state)
    off = float(np.median(np.hypot(r[0::2], r[1::2])))
    return Tracked(here, state, [], float(here.presence) * float(np.clip((8 - off) / 6, 0, 1)), angles)


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
