"""What the frames of a clip show on the tracked head: aligned pictures, the clip's light, and what all frames share.

The albedo of the photos and the mesh at rest are never quite the video's: moles lie a little elsewhere, a shadow falls
on a cheek. What the logarithm of light is off by in the median of all frames, texel by texel, belongs to the skin and
the light and not to an expression; it is added to the albedo, so that no mole becomes a bump.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.parallel import each_alone
from avatarbuild.shading.light import Light, clip_light
from avatarbuild.shading.surface import Drawn, FineSkin, draw, picture
from avatarbuild.tracking.dense import flow_there_and_back, levelled
from avatarbuild.tracking.lens import Lens

_CHART = 512  # texels of what all frames share
_SPREAD = 1.0  # texels over which it is smoothed
_ENOUGH = 3  # frames that must see a texel
_DRIFT = 6.0  # pixels over which the flow of the alignment is smoothed
_AGREE = 1.0  # pixels between the flow there and back
_SHADOW = 0.02


@dataclass(frozen=True)
class View:
    """One frame to be looked at: its row, the posed head (n, 3), and its camera x_cam = R x + t."""

    row: int
    vertices: np.ndarray
    R: np.ndarray
    t: np.ndarray


@dataclass(frozen=True)
class Seen:
    """A frame: the head drawn, its picture (h, w) linear grey moved onto the drawing, and the flow (h, w, 2) pixels by
    which it was moved: drawing to frame."""

    row: int
    drawn: Drawn
    grey: np.ndarray
    flow: np.ndarray


@dataclass(frozen=True)
class Watched:
    """All frames of a clip, its light, and `shared` (c, c) what is added to the tone at a texel."""

    frames: list[Seen]
    light: Light
    shared: np.ndarray

    def more(self, drawn: Drawn) -> np.ndarray:
        """(h, w) of `shared` at the pixels of a drawing."""
        return at_uv(self.shared, drawn.uv)


def watch(
    skin: FineSkin,
    views: Iterable[View],
    rgb: Callable[[int], np.ndarray],
    lens: Lens,
    factor: int,
    advance: Callable[[], object] = lambda: None,
) -> Watched:
    """The views of a clip, each with the picture (H, W, 3) uint8 of its row, at `factor` frame pixels a pixel."""

    def look(view: View) -> tuple[int, Drawn, np.ndarray]:
        drawn = draw(skin, view.vertices, lens, view.R, view.t, factor)
        return view.row, drawn, picture(drawn, rgb(view.row))

    seen = []
    for one in each_alone(look, views):
        seen.append(one)
        advance()
    light = clip_light([(drawn, grey, np.zeros_like(grey)) for _, drawn, grey in seen])
    frames = list(each_alone(lambda k: align(*seen[k], light, float(light.gains[k])), range(len(seen))))
    shared = what_all_share(frames, light)
    more = [at_uv(shared, one.drawn.uv) for one in frames]
    light = clip_light([(one.drawn, one.grey, m) for one, m in zip(frames, more, strict=True)])
    return Watched(frames, light, what_all_share(frames, light))


def align(row: int, drawn: Drawn, grey: np.ndarray, light: Light, gain: float, more: np.ndarray | None = None) -> Seen:
    """The picture `grey` (h, w) moved by the smooth part of the dense flow from the lit drawing to it."""
    tone = drawn.tone if more is None else drawn.tone + more
    expected = np.log(gain * light.shade(drawn) * np.exp(tone) + _SHADOW).astype(np.float32)
    ours, theirs = levelled(expected, drawn.on), levelled(np.log(grey + _SHADOW), drawn.on)
    there, apart = flow_there_and_back(ours, theirs)
    trust = (drawn.on * np.exp(-((apart / _AGREE) ** 2))).astype(np.float32)
    total = cv2.GaussianBlur(trust, (0, 0), _DRIFT) + 1e-3
    flow = cv2.GaussianBlur(trust[..., None] * there, (0, 0), _DRIFT) / total[..., None]
    return Seen(row, drawn, moved(grey, flow), flow)


def moved(image: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """image(x + flow(x)): (h, w) or (h, w, c)."""
    rows, columns = np.mgrid[0 : flow.shape[0], 0 : flow.shape[1]].astype(np.float32)
    return np.asarray(cv2.remap(image, columns + flow[..., 0], rows + flow[..., 1], cv2.INTER_CUBIC))


def what_all_share(frames: list[Seen], light: Light) -> np.ndarray:
    """(c, c) float32: log c - log(g e^tone s(n)), median over frames, per texel that enough see."""
    maps = np.full((len(frames), _CHART, _CHART), np.nan, np.float32)
    for k, one in enumerate(frames):
        drawn = one.drawn
        on = (cv2.erode(drawn.on.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (one.grey > 0)
        expected = light.gains[k] * light.shade(drawn) * np.exp(drawn.tone)
        off = np.log(np.maximum(one.grey[on], 1e-3) / expected[on])
        column, row = np.clip(drawn.uv[on] * [_CHART, -_CHART] + [0, _CHART], 0, _CHART - 1).astype(np.int64).T
        at, weight = row * _CHART + column, drawn.facing[on]
        total = np.bincount(at, weight, _CHART * _CHART)
        mean = np.bincount(at, weight * off, _CHART * _CHART) / np.maximum(total, 1e-9)
        maps[k] = np.where(total > _SPREAD * 0.2, mean, np.nan).reshape(_CHART, _CHART)
    known = np.isfinite(maps).sum(axis=0) >= min(_ENOUGH, len(frames))
    middle = np.zeros((_CHART, _CHART), np.float32)
    middle[known] = np.nanmedian(maps[:, known], axis=0)
    mask = cv2.GaussianBlur(known.astype(np.float32), (0, 0), _SPREAD)
    return np.asarray(cv2.GaussianBlur(middle, (0, 0), _SPREAD) / np.maximum(mask, 1e-3) * (mask > 0.05))


def at_uv(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(…) of an image (c, c), row 0 on top, at texture coordinates uv (h, w, 2)."""
    side = image.shape[0]
    x, y = (uv * [side, -side] + [-0.5, side - 0.5]).astype(np.float32).transpose(2, 0, 1)
    return np.asarray(cv2.remap(image, np.ascontiguousarray(x), np.ascontiguousarray(y), cv2.INTER_LINEAR))
