"""
Points that the user has set in some frames, as strong features of those and of the frames about them.

Dense optical flow carries them from frame to frame, forward from one corrected frame and backward from the next; what
comes both ways is blended by c / (1 - c), c its confidence, which fades by exp(-time / FADES), and where flow there and
back differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from avatarbuild.geometry.head_pose import head_pose
from avatarbuild.landmarks import canonical_face
from avatarbuild.tracking.dense import flow
from avatarbuild.tracking.markers import SKIN, Clicks, Markers

FADES = 2.0  # s
REACH = 4.0  # s from a corrected frame
LEAST = 0.05  # confidence below which a point is let go
_SIDE = 320  # pixels: the longer side of the face's window that the flow is computed in
_ROOM = 0.25  # of the face's size about it
_AGREE = 1.0  # pixels of that window: flow there and back
_NEAR = 12.0  # mm on the face over which neighbouring points share a correction
_LEAST_DOUBT = 1e-3  # of a point that was set in this very frame
_FAR = 0.2  # beyond, they keep what the detector says


def propagated(
    clicked: dict[int, dict[int, np.ndarray]],
    landmarks68: np.ndarray,
    times: np.ndarray,
    expected: Callable[[int], np.ndarray],
    decode: Callable[[list[int]], Iterator[tuple[int, float, np.ndarray]]],
) -> dict[int, Clicks]:
    """
    What the user's points say of every frame within REACH of a corrected one.

    clicked: frame -> {one of the 68 points: (2,) pixels}; landmarks68 (68,): the detector's points that they are;
    times (f,) s of the clip's frames; expected(frame): (478, 3) pixels, about where the face is; decode(frames): their
    pictures in order.
    """
    corrected = np.array(sorted(frame for frame in clicked if frame < len(times)), int)
    out: dict[int, Clicks] = {}
    for frames in _stretches(corrected, times):
        marks = np.concatenate([expected(i)[:SKIN, :2] for i in (frames[0], *corrected, frames[-1]) if i in frames])
        pictures = {i: _window(rgb, marks) for i, _, rgb in decode(frames)}
        shown = [i for i in frames if i in pictures]
        if not shown:
            continue
        low, scale = _place(marks)
        carried = [_carried(order, clicked, pictures, times, low, scale) for order in (shown, shown[::-1])]
        for i in shown:
            both = _blended(carried[0].get(i, {}), carried[1].get(i, {}))
            if both:
                names = sorted(both)
                pixels = np.array([both[k][0] for k in names])
                confidence = np.array([both[k][1] for k in names])
                out[i] = Clicks(landmarks68[names], pixels, confidence)
    return out


def _stretches(corrected: np.ndarray, times: np.ndarray) -> list[list[int]]:
    """Runs of frames within REACH of a corrected one, cut at the corrected frames' gaps."""
    if not len(corrected):
        return []
    near = np.abs(times[:, None] - times[corrected]).min(axis=1) <= REACH
    numbers = np.flatnonzero(near)
    return [run.tolist() for run in np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)]


def _place(marks: np.ndarray) -> tuple[np.ndarray, float]:
    """The window's corner in the frame, and its pixels a pixel of the frame."""
    first, last = marks.min(axis=0), marks.max(axis=0)
    room = _ROOM * float((last - first).max())
    low = np.maximum(np.floor(first - room), 0)
    return low, min(1.0, _SIDE / float((last + room - low).max()))


def _window(rgb: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """(h, w) uint8 grey about the face."""
    low, scale = _place(marks)
    last = marks.max(axis=0) + _ROOM * float(np.ptp(marks, axis=0).max())
    x0, y0 = low.astype(int)
    x1, y1 = np.maximum(np.ceil(last).astype(int), [x0 + 32, y0 + 32])
    grey = cv2.cvtColor(np.ascontiguousarray(rgb[y0:y1, x0:x1]), cv2.COLOR_RGB2GRAY)
    size = (max(16, round(grey.shape[1] * scale)), max(16, round(grey.shape[0] * scale)))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _carried(
    order: list[int],
    clicked: dict[int, dict[int, np.ndarray]],
    pictures: dict[int, np.ndarray],
    times: np.ndarray,
    low: np.ndarray,
    scale: float,
) -> dict[int, dict[int, tuple[np.ndarray, float]]]:
    """Frame by frame in `order`: of each point its pixels and confidence."""
    out: dict[int, dict[int, tuple[np.ndarray, float]]] = {}
    held: dict[int, tuple[np.ndarray, float]] = {}
    before = order[0]
    for i in order:
        if held:
            held = _stepped(held, pictures[before], pictures[i], low, scale)
            fade = float(np.exp(-abs(times[i] - times[before]) / FADES))
            held = {k: (at, c * fade) for k, (at, c) in held.items() if c * fade > LEAST}
        held |= {k: (at, 1.0) for k, at in clicked.get(i, {}).items()}
        out[i], before = dict(held), i
    return out


def _stepped(
    held: dict[int, tuple[np.ndarray, float]], a: np.ndarray, b: np.ndarray, low: np.ndarray, scale: float
) -> dict[int, tuple[np.ndarray, float]]:
    """The points one picture farther; those that flow there and back does not agree on lose confidence."""
    there, back = flow(a, b), flow(b, a)
    at = np.array([(x - low) * scale - 0.5 for x, _ in held.values()], np.float32)
    step = _sampled(there, at)
    apart = np.linalg.norm(step + _sampled(back, at + step), axis=1)
    trust = 1 / (1 + (apart / _AGREE) ** 2)
    moved = (at + step + 0.5) / scale + low
    h, w = a.shape
    inside = ((at + step > 0) & (at + step < (w - 1, h - 1))).all(axis=1)
    return {
        k: (moved[n].astype(np.float64), c * float(trust[n] * inside[n])) for n, (k, (_, c)) in enumerate(held.items())
    }


def _sampled(field: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(q, 2) of a flow field (h, w, 2) at (q, 2) OpenCV pixels."""
    x, y = np.ascontiguousarray(at.T)
    return cv2.remap(field, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]


def _blended(
    one: dict[int, tuple[np.ndarray, float]], other: dict[int, tuple[np.ndarray, float]]
) -> dict[int, tuple[np.ndarray, float]]:
    out = {}
    for k in one.keys() | other.keys():
        known = [side[k] for side in (one, other) if k in side]
        c = np.array([c for _, c in known])
        worth = c / (1 - c + _LEAST_DOUBT)
        if c.max() > LEAST:
            out[k] = (worth / worth.sum() @ np.array([x for x, _ in known]), 1 - float(np.prod(1 - c)))
    return out


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
