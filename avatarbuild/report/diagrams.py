"""Drawings in SVG, which follow the page's colours: the photos' directions, cameras about the head, weights in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from html import escape

import cv2
import numpy as np

from avatarbuild.artefacts import Cameras, Capture, Neutral, Performance
from avatarbuild.landmarks import TRUSTED_PRESENCE, TRUSTED_YAW, face_size
from avatarbuild.report.overlay import Shot
from avatarbuild.template import ARKIT_NAMES, Template

_SOFT, _BLURRED = 1.25, 1.6  # times the usual blur
_YAW, _PITCH = 95.0, 45.0  # degrees at the coverage plot's edges
_BIN = 15.0  # degrees of yaw that need a photo each
_DRAWN = 600  # points of a curve; more no screen shows
_STEP = 4.0  # mm of the raster that the head's outline is traced in


@dataclass(frozen=True)
class Dot:
    """A photo in the drawings: its name, the yaw (positive: seen from the subject's left) and pitch (positive: from
    above) in degrees that it sees the head from, its kind ('sharp', 'softened', 'blurred', 'untrusted' or 'left-out'),
    and where it stood (3,) mm and looked (3,) unit in the head frame, None where it could not be placed."""

    name: str
    yaw: float
    pitch: float
    kind: str
    at: np.ndarray | None
    gaze: np.ndarray | None


def dots(capture: Capture, found: list[Shot]) -> list[Dot]:
    """All photos whose direction is known, by their camera or, where they are left out, by the face in them."""
    photos = capture.photos
    trusted = photos.trusted(TRUSTED_PRESENCE, TRUSTED_YAW)
    size = np.array([face_size(p) if np.isfinite(p).all() else np.nan for p in photos.landmarks])
    blur = 1 / np.maximum(photos.sharpness * size, 1e-12)  # relative to the face, as a viewer sees it
    usual = float(np.median(blur[trusted])) if trusted.any() else np.inf
    placed = {shot.photo: shot for shot in found}
    answer = []
    for i, name in enumerate(photos.names):
        kind = "untrusted"
        if trusted[i]:
            kind = "blurred" if blur[i] > _BLURRED * usual else "softened" if blur[i] > _SOFT * usual else "sharp"
        shot = placed.get(i)
        if shot is not None:
            answer.append(Dot(name, shot.yaw, shot.pitch, kind, shot.centre, shot.rotation[2]))
        elif np.isfinite(photos.pose[i]).all():
            # a subject who looks to their left shows their right side, one who looks up is seen from below
            answer.append(Dot(name, -float(photos.pose[i, 0]), -float(photos.pose[i, 1]), "left-out", None, None))
    return answer


def coverage(found: list[Dot]) -> str:
    """An SVG: a dot for each photo at the direction it sees the face from, the subject's right side on the left."""
    w, h, left, top, right, bottom = 720, 420, 44, 16, 706, 372
    x = lambda yaw: left + (np.clip(yaw, -_YAW, _YAW) + _YAW) / (2 * _YAW) * (right - left)  # noqa: E731
    y = lambda pitch: top + (_PITCH - np.clip(pitch, -_PITCH, _PITCH)) / (2 * _PITCH) * (bottom - top)  # noqa: E731
    parts = [_open(w, h, "Directions from which the photos see the face")]
    good = [dot.yaw for dot in found if dot.kind in ("sharp", "softened", "blurred")]
    for low in np.arange(-TRUSTED_YAW, TRUSTED_YAW, _BIN):
        if not any(low <= yaw < low + _BIN for yaw in good):
            parts.append(
                f'<rect class="lack" x="{x(low):.1f}" y="{top}" width="{x(low + _BIN) - x(low):.1f}" '
                f'height="{bottom - top}"/>'
            )
    for yaw in range(-90, 91, 15):
        parts.append(f'<path class="grid" d="M{x(yaw):.1f} {top}V{bottom}"/>')
        if yaw % 30 == 0:
            parts.append(_text(x(yaw), bottom + 17, f"{abs(yaw)}°"))
    for pitch in range(-45, 46, 15):
        parts.append(f'<path class="grid" d="M{left} {y(pitch):.1f}H{right}"/>')
        parts.append(_text(left - 8, y(pitch) + 4, f"{abs(pitch)}°", "end"))
    parts.append(f'<rect class="frame" x="{left}" y="{top}" width="{right - left}" height="{bottom - top}"/>')
    parts += [_text(x(-74), bottom + 38, "their right side"), _text(x(0), bottom + 38, "front")]
    parts += [_text(x(74), bottom + 38, "their left side"), _text(x(0), top + 18, "from above", "middle", "faint")]
    parts.append(_text(x(0), bottom - 9, "from below", "middle", "faint"))
    for dot in found:
        parts.append(_mark(x(dot.yaw), y(dot.pitch), dot))
    return "".join(parts) + "</svg>"


def ring(found: list[Dot], neutral: Neutral, template: Template) -> tuple[str, str]:
    """Two SVGs of the cameras about the head: from above, the face looking down the page; and from their left side.

    Left-out photos that show a face stand, crossed, where its direction puts them, at the others' usual distance.
    """
    skin = neutral.vertices[template.parts["skin"].vertices]
    triangles = template.triangles[template.parts["skin"].triangles]
    far = [float(np.linalg.norm(dot.at)) for dot in found if dot.at is not None]
    usual = float(np.median(far)) if far else 500.0
    reach = 1.12 * max([*far, usual])
    above = _plan(found, skin[:, [0, 2]], triangles, (0, 2), usual, reach, "Cameras seen from above")
    # from the subject's left the face looks to the left of the page
    side = _plan(found, skin[:, [2, 1]] * [-1, -1], triangles, (2, 1), usual, reach, "Cameras seen from the side")
    return above, side


def colour_bar(scale: float, colours: list[tuple[int, int, int]]) -> str:
    """An SVG of the heat map's colours, from -scale to scale mm."""
    w, h, step = 420, 46, 400 / len(colours)
    parts = [_open(w, h, f"Colours from -{scale:g} to {scale:g} mm")]
    for i, (r, g, b) in enumerate(colours):
        parts.append(
            f'<rect x="{10 + i * step:.2f}" y="4" width="{step + 0.6:.2f}" height="16" fill="rgb({r},{g},{b})"/>'
        )
    for share in (-1.0, -0.5, 0.0, 0.5, 1.0):
        label = f"{'≤ −' if share == -1 else '≥ +' if share == 1 else '−' if share < 0 else '+' if share else ''}"
        parts.append(_text(10 + 200 * (1 + share), 38, f"{label}{abs(share) * scale:g}", _anchor(share)))
    return "".join(parts) + "</svg>"


def weights(performance: Performance, names: list[str]) -> str:
    """An SVG: a curve a shape from 0 to 1 over the clip's seconds, with its largest value; lost frames tinted."""
    left, right, top, tall, gap = 152.0, 680.0, 12.0, 26.0, 8.0
    w, bottom = 720, top + len(names) * (tall + gap)
    times = performance.times
    length = max(float(times[-1]), 1e-3)
    x = lambda t: left + (right - left) * t / length  # noqa: E731
    parts = [_open(w, round(bottom + 24), "Weights over time")]
    half = 0.5 * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    for first, last in _runs(performance.quality <= 0):
        a, b = max(times[first] - half, 0.0), min(times[last] + half, length)
        parts.append(
            f'<rect class="lack" x="{x(a):.1f}" y="{top}" width="{x(b) - x(a):.1f}" height="{bottom - top - gap:.1f}"/>'
        )
    step = next((s for s in (1, 2, 5, 10, 20, 30, 60, 120, 300) if length / s <= 10), 600)
    for second in range(0, int(length) + 1, step):
        parts.append(f'<path class="grid" d="M{x(second):.1f} {top}V{bottom - gap:.1f}"/>')
        parts.append(_text(x(second), bottom + 12, f"{second} s"))
    blocks = np.array_split(np.arange(len(times)), min(len(times), _DRAWN))
    at = [x(times[block].mean()) for block in blocks]
    for k, name in enumerate(names):
        base = top + k * (tall + gap) + tall
        w_j = performance.weights[:, ARKIT_NAMES.index(name)]
        line = "L".join(f"{u:.1f} {base - tall * w_j[block].mean():.1f}" for u, block in zip(at, blocks, strict=True))
        parts.append(f'<path class="weight" d="M{at[0]:.1f} {base:.1f}L{line}L{at[-1]:.1f} {base:.1f}Z"/>')
        parts.append(_text(left - 10, base - 8, name, "end"))
        parts.append(_text(right + 8, base - 8, f"{w_j.max():.2f}", "start", "faint"))
    return "".join(parts) + "</svg>"


def _runs(marked: np.ndarray) -> list[tuple[int, int]]:
    """First and last place of every run of True."""
    edges = np.diff(np.concatenate([[0], np.asarray(marked, int), [0]]))
    return list(zip(np.flatnonzero(edges > 0).tolist(), (np.flatnonzero(edges < 0) - 1).tolist(), strict=True))


def _anchor(share: float) -> str:
    return "start" if share == -1 else "end" if share == 1 else "middle"


def _plan(
    found: list[Dot],
    flat: np.ndarray,
    triangles: np.ndarray,
    axes: tuple[int, int],
    usual: float,
    reach: float,
    title: str,
) -> str:
    """Both axes of the page in the order of `axes`; flat (n, 2) are the skin's vertices on the page, mm."""
    sign = np.array([1.0, 1.0]) if axes == (0, 2) else np.array([-1.0, -1.0])
    on_page = lambda p: np.asarray(p)[list(axes)] * sign  # noqa: E731
    places = [on_page(dot.at if dot.at is not None else usual * _direction(dot)) for dot in found]
    all_ = np.concatenate([flat, np.array(places).reshape(-1, 2)])
    low, high = all_.min(axis=0) - 0.06 * reach, all_.max(axis=0) + 0.06 * reach
    w, h = 420.0, 320.0
    scale = float(min([w, h] / (high - low)))
    low = (low + high) / 2 - np.array([w, h]) / scale / 2
    to = lambda p: (np.asarray(p) - low) * scale  # noqa: E731
    parts = [_open(round(w), round(h), title)]
    origin = to([0.0, 0.0])
    for radius in np.arange(250.0, reach + 1, 250.0):
        parts.append(f'<circle class="grid" cx="{origin[0]:.1f}" cy="{origin[1]:.1f}" r="{radius * scale:.1f}"/>')
        # where the face looks, so that the circle is on the page
        ahead = np.array([0.0, 1.0] if axes == (0, 2) else [-1.0, 0.0])
        x, y = origin + radius * scale * ahead
        if 10 < x < w - 60 and y < h - 4:
            parts.append(_text(x + 22, y - 4, f"{radius / 10:.0f} cm", "middle", "faint"))
    parts.append(f'<path class="head" d="{_outline(flat, triangles, to)}"/>')
    walk = [to(place) for dot, place in zip(found, places) if dot.at is not None]
    if len(walk) > 1:
        parts.append('<path class="walk" d="M' + "L".join(f"{p[0]:.1f} {p[1]:.1f}" for p in walk) + '"/>')
    size = 0.032 * w
    for dot, place in zip(found, places):
        p = to(place)
        if dot.gaze is None:
            parts.append(_mark(float(p[0]), float(p[1]), dot))
            continue
        ahead = on_page(dot.gaze)
        length = float(np.linalg.norm(ahead))
        ahead = ahead / max(length, 1e-9) * max(length, 0.5)  # one that looks across the page still shows its way
        across = np.array([-ahead[1], ahead[0]])
        corners = [p, p + size * (1.3 * ahead + 0.62 * across), p + size * (1.3 * ahead - 0.62 * across)]
        text = " ".join(f"{c[0]:.1f},{c[1]:.1f}" for c in corners)
        parts.append(f'<polygon class="camera {dot.kind}" points="{text}"><title>{escape(dot.name)}</title></polygon>')
    return "".join(parts) + "</svg>"


def _direction(dot: Dot) -> np.ndarray:
    yaw, pitch = np.radians([dot.yaw, dot.pitch])
    return np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])


def _outline(flat: np.ndarray, triangles: np.ndarray, to: Callable[[np.ndarray], np.ndarray]) -> str:
    """The SVG path about the shadow of a mesh."""
    low = flat.min(axis=0) - _STEP
    size = np.ceil((flat.max(axis=0) + _STEP - low) / _STEP).astype(int)
    mask = np.zeros((size[1], size[0]), np.uint8)
    for corners in np.round((flat[triangles] - low) / _STEP * 16).astype(np.int32):
        cv2.fillConvexPoly(mask, corners, 1, cv2.LINE_8, 4)
    lines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_TC89_L1)
    paths = []
    for line in lines:
        points = to(line[:, 0] * _STEP + low)
        paths.append("M" + "L".join(f"{p[0]:.1f} {p[1]:.1f}" for p in points) + "Z")
    return "".join(paths)


def _open(w: int, h: int, title: str) -> str:
    return f'<svg viewBox="0 0 {w} {h}" role="img" aria-label="{escape(title)}">'


def _text(x: float, y: float, text: str, anchor: str = "middle", kind: str = "") -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _mark(x: float, y: float, dot: Dot) -> str:
    title = f"<title>{escape(dot.name)}</title>"
    if dot.kind == "left-out":
        arms = f"M{x - 5:.1f} {y - 5:.1f}l10 10M{x - 5:.1f} {y + 5:.1f}l10 -10"
        return f'<path class="left-out" d="{arms}">{title}</path>'
    return f'<circle class="dot {dot.kind}" cx="{x:.1f}" cy="{y:.1f}" r="5.5">{title}</circle>'


def left_out(capture: Capture, cameras: Cameras) -> list[str]:
    """Names of the photos that have no camera."""
    placed = {cameras.model.images[i].name for i in cameras.model.reg_image_ids()}
    return [name for name in capture.photos.names if f"{name}.jpg" not in placed]
