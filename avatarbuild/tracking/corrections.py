"""
Points that the user has set in some frames, as strong features of those and of the frames about them.

Dense optical flow carries them from frame to frame, forward from one corrected frame and backward from the next; what
comes both ways is blended by c / (1 - c), c its confidence, which fades by exp(-time / FADES), and where flow there and
back differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.formats.corrections import COUNT
from avatarbuild.geometry.head_pose import head_pose
from avatarbuild.landmarks import canonical_face
from avatarbuild.tracking.dense import flow
from avatarbuild.tracking.markers import SKIN, Clicks, Markers

FADES = 2.0  # s
REACH = 4.0  # s from a corrected frame
LEAST = 0.05  # confidence below which a point is let go
_SIDE = 320  # pixels: the longer side of the face's window that the flow is computed in
_KEPT = 2  # of the window's pixels that one kept sample of the flow stands for
_ROOM = 0.25  # of the face's size about it
_AGREE = 1.0  # pixels of that window: flow there and back
_NEAR = 12.0  # mm on the face over which neighbouring points share a correction
_LEAST_DOUBT = 1e-3  # of a point that was set in this very frame
_FAR = 0.2  # beyond, they keep what the detector says

Clicked = dict[int, dict[int, np.ndarray]]
"""Decoded frame -> {one of the 68 points: (2,) pixels}."""
Expected = Callable[[int], np.ndarray]
"""Decoded frame -> (478, 3) pixels, about where the face is."""
Decode = Callable[[list[int]], Iterator[tuple[int, float, np.ndarray]]]
"""Frames, rising -> number, time and picture of those that can be decoded."""


@dataclass(frozen=True)
class Step:
    """
    Flow between two decoded frames that follow each other, in a window about the face: corner (2,) pixels, scale the
    window's pixels a pixel, size its width and height; there and back (h, w, 2) float16, the window's pixels, sampled
    at every _KEPT-th of them.
    """

    first: int
    then: int
    corner: np.ndarray
    scale: float
    size: tuple[int, int]
    there: np.ndarray
    back: np.ndarray

    def carry(self, pixels: np.ndarray, backward: bool) -> tuple[np.ndarray, np.ndarray]:
        """Points (q, 2) one frame farther, and by how much (q,) flow there and back lets them be trusted, 0 outside."""
        ways = (self.back, self.there) if backward else (self.there, self.back)
        at = (pixels - self.corner) * self.scale
        landed = at + self._sampled(ways[0], at)
        apart = np.linalg.norm(landed - at + self._sampled(ways[1], landed), axis=1)
        inside = ((landed > 0.5) & (landed < np.array(self.size) - 0.5)).all(axis=1)
        return landed / self.scale + self.corner, inside / (1 + (apart / _AGREE) ** 2)

    def _sampled(self, field: np.ndarray, at: np.ndarray) -> np.ndarray:
        """(q, 2) bilinear of a field at points (q, 2) of the window, held at its borders."""
        h, w = field.shape[:2]
        limit = np.array([w - 1, h - 1])
        samples = np.clip(at * (np.array([w, h]) / self.size) - 0.5, 0, limit)
        low = np.minimum(samples.astype(int), np.maximum(limit - 1, 0))
        x, y = (samples - low).T[..., None]
        j, i = low.T
        above, below = ((1 - x) * field[r, j] + x * field[r, j + 1] for r in (i, i + 1))
        return (1 - y) * above + y * below


def propagated(
    clicked: Clicked, landmarks68: np.ndarray, times: np.ndarray, expected: Expected, decode: Decode
) -> dict[int, Clicks]:
    """
    What the user's points say of every frame within REACH of a corrected one.

    landmarks68 (68,): the detector's points that they are; times (f,) s of the clip's frames.
    """
    out: dict[int, Clicks] = {}
    for frames in stretches(clicked, times):
        own = {i: clicked[i] for i in frames if i in clicked}
        for i, (pixels, sure) in spread(own, steps(frames, expected, decode), times).items():
            known = np.flatnonzero(sure)
            if len(known):
                out[i] = Clicks(landmarks68[known], pixels[known], sure[known])
    return out


def stretches(clicked: Iterable[int], times: np.ndarray) -> list[list[int]]:
    """Runs of frames within REACH of a corrected one."""
    corrected = np.array(sorted(frame for frame in clicked if frame < len(times)), int)
    if not len(corrected):
        return []
    near = np.abs(times[:, None] - times[corrected]).min(axis=1) <= REACH
    numbers = np.flatnonzero(near)
    return [run.tolist() for run in np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)]


def steps(frames: list[int], expected: Expected, decode: Decode) -> Iterator[Step]:
    """The flow from each of these frames (rising) to the next that can be decoded, and back."""
    first, before = -1, None
    for then, _, rgb in decode(frames):
        now = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
        if before is not None:
            yield _step(first, then, before, now, np.concatenate([expected(i)[:SKIN, :2] for i in (first, then)]))
        first, before = then, now


def _step(first: int, then: int, before: np.ndarray, now: np.ndarray, marks: np.ndarray) -> Step:
    """before, now (h, w) uint8 whole frames; marks (q, 2) pixels of the face in both."""
    room = _ROOM * float(np.ptp(marks, axis=0).max())
    limit = np.array(before.shape[::-1]) - 32
    x0, y0 = np.clip(np.floor(marks.min(axis=0) - room), 0, np.maximum(limit, 0)).astype(int)
    x1, y1 = np.maximum(np.ceil(marks.max(axis=0) + room).astype(int), [x0 + 32, y0 + 32])
    cut = [picture[y0:y1, x0:x1] for picture in (before, now)]
    scale = min(1.0, _SIDE / max(cut[0].shape))
    w, h = (max(16, round(side * scale)) for side in cut[0].shape[::-1])
    a, b = (cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA) for picture in cut)
    small = (max(8, w // _KEPT), max(8, h // _KEPT))
    there, back = (
        cv2.resize(field, small, interpolation=cv2.INTER_AREA).astype(np.float16) for field in (flow(a, b), flow(b, a))
    )
    return Step(first, then, np.array([x0, y0], float), w / cut[0].shape[1], (w, h), there, back)


def spread(clicked: Clicked, known: Iterable[Step], times: np.ndarray) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """
    Of each frame that is corrected or that a chain of `known` steps reaches from a corrected one: pixels (68, 2) and
    confidence (68,) of the points, 0 where nothing is known of one.
    """
    chain = sorted(known, key=lambda step: step.first)
    ways = [_carried(clicked, chain, times, backward) for backward in (False, True)]
    out = {}
    for i in sorted(ways[0].keys() | ways[1].keys()):
        sides = [way.get(i, _nothing()) for way in ways]
        c = np.stack([side[1] for side in sides])
        worth = c / (1 - c + _LEAST_DOUBT)
        pixels = np.einsum("sk,ski->ki", worth, np.stack([side[0] for side in sides]))
        sure = np.where(c.max(axis=0) > LEAST, 1 - (1 - c).prod(axis=0), 0.0)
        if sure.any():
            out[i] = pixels / np.maximum(worth.sum(axis=0), 1e-12)[:, None], sure
    return out


def _carried(
    clicked: Clicked, chain: list[Step], times: np.ndarray, backward: bool
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Step by step, one way: of each frame pixels and confidence of the points."""
    out = {i: _with(_nothing(), points) for i, points in clicked.items()}
    here = -1
    for step in reversed(chain) if backward else chain:
        a, b = (step.then, step.first) if backward else (step.first, step.then)
        pixels, sure = out.get(a, _nothing()) if a == here or a in clicked else _nothing()
        here = b
        held = np.flatnonzero(sure)
        pixels, left = pixels.copy(), np.zeros(COUNT)
        if len(held):
            pixels[held], trust = step.carry(pixels[held], backward)
            left[held] = sure[held] * trust * np.exp(-abs(times[b] - times[a]) / FADES)
        left[left <= LEAST] = 0.0
        out[b] = _with((pixels, left), clicked.get(b, {}))
    return out


def _nothing() -> tuple[np.ndarray, np.ndarray]:
    return np.zeros((COUNT, 2)), np.zeros(COUNT)


def _with(held: tuple[np.ndarray, np.ndarray], points: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The points `held`, those that the user has set in this frame in their place."""
    for k, at in points.items():
        held[0][k], held[1][k] = at, 1.0
    return held


def shifted(marks: np.ndarray, clicks: Clicks, m: Markers) -> np.ndarray:
    """
    The detector's points (478, 3) with those about the user's moved along: e_v = sum_k G_vk c_k e_k / (sum_k G_vk c_k +
    FAR), G a Gaussian of NEAR mm on the mean face, e_k the way from the detector's point to where it should see the
    user's, its own bias included.
    """
    face = canonical_face()
    seen = head_pose(face.points, face.rigidity, marks[: len(face.points)])
    bias = seen.scale * (m.offset[clicks.points] @ seen.rotation.T)[:, :2]
    way = clicks.pixels + bias - marks[clicks.points, :2]
    apart = np.linalg.norm(face.points[:SKIN, None] - face.points[clicks.points], axis=2)
    share = np.exp(-0.5 * (apart / _NEAR) ** 2) * clicks.confidence
    out = marks.copy()
    out[:SKIN, :2] += share @ way / (share.sum(axis=1, keepdims=True) + _FAR)
    return out
