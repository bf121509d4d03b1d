"""An eye painted by formula: iris with fibres, collarette and limbal ring, pupil, and a white with faint veins."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.geometry.raster import interpolate, rasterise
from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.registration.eye_shape import EyeShape
from avatarbuild.template import Template
from avatarbuild.texture.chart import continued

PUPIL = 1.9  # mm, indoors
WHITE = np.array([0.60, 0.545, 0.505])  # linear: a healthy adult's sclera, faintly warm
HAZEL = np.array([0.16, 0.105, 0.055])
DARK = 0.006  # linear: a pupil
_SEED = 11
_FIBRES = ((48, 3, 0.5), (110, 4, 0.7), (230, 5, 0.8), (460, 7, 0.6))  # round the iris, along it, strength
_VEINS = 60
_RIM = 0.4  # mm over which the iris passes into the white


@dataclass(frozen=True)
class EyePainting:
    """
    Layers of a texture, linear: white (s, s, 3), stroma (s, s, 3) where there is an iris; iris, pupil (s, s) in [0, 1]
    how far they cover what lies below; share (s, s): 0 at the pupil's edge, 1 at the limbus, beyond both outside.
    """

    white: np.ndarray
    stroma: np.ndarray
    iris: np.ndarray
    pupil: np.ndarray
    share: np.ndarray

    def colour(self) -> np.ndarray:
        """(s, s, 3) linear: pupil over stroma over white."""
        below = self.white + self.iris[..., None] * (self.stroma - self.white)
        return below + self.pupil[..., None] * (DARK - below)


def eye_map(template: Template, size: int) -> np.ndarray:
    """
    (size, size, 3) mm from the left eyeball's centre of every texel of its own chart, whose box is stretched over the
    whole square, v up; texels outside the charts take the nearest one's.
    """
    part = template.parts["eye_left"]
    faces = template.uv_triangles[part.triangles]
    uv = template.part_uv("eye_left")
    pixels = uv * [size, -size] + [0, size]
    raster = rasterise(pixels, np.ones(len(uv)), np.ascontiguousarray(faces, np.int32), (size, size))
    offset = template.mean - template.eye_centres[0]
    corners = template.triangles[part.triangles]
    found = interpolate(offset, corners, raster.triangle, raster.barycentric)
    return continued(found, raster.triangle >= 0).astype(np.float64)


def paint_eye(offset: np.ndarray, shape: EyeShape, iris: np.ndarray = HAZEL, seed: int = _SEED) -> EyePainting:
    """
    The colours at points (s, s, 3) mm about the centre of the template's eyeball, which looks along +z; `iris` (3,)
    linear: the iris's middle colour.
    """
    rng = np.random.default_rng(seed)
    radius = np.hypot(offset[..., 0], offset[..., 1])
    turn = np.arctan2(offset[..., 1], offset[..., 0])
    front = offset[..., 2] > 0
    share = np.where(front, (radius - PUPIL) / (shape.limbus_radius - PUPIL), 9.0)
    within = 1 - smooth_step(radius, shape.limbus_radius - _RIM / 2, shape.limbus_radius + _RIM / 2)
    within = np.where(front, within, 0.0)
    white = _white(offset, rng)
    rows, columns = np.nonzero(within > 0)
    stroma = np.zeros_like(white)
    stroma[rows, columns] = _stroma(turn[rows, columns], share[rows, columns], np.asarray(iris), rng)
    pupil = np.where(front, 1 - smooth_step(radius, PUPIL - 0.12, PUPIL + 0.14), 0.0)
    return EyePainting(white, stroma, within, pupil, share)


def _stroma(turn: np.ndarray, share: np.ndarray, iris: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(k, 3) linear: the iris's fibres at angles (k,) and shares (k,) of the way from the pupil to the limbus."""
    s = np.clip(share, 0, 1)
    waves = turn + 0.05 * np.sin(3 * turn + rng.uniform(0, 6.3)) * s
    fibre = np.zeros(len(turn))
    for around, along, strength in _FIBRES:
        fibre += strength * _polar_noise(rng, around, along, waves, s)
    fibre /= np.sqrt(sum(f[2] ** 2 for f in _FIBRES)) * 0.6
    crypts = np.clip(_polar_noise(rng, 26, 5, turn, s) - 0.55, 0, None) * np.exp(-(((s - 0.42) / 0.22) ** 2))
    edge = 0.30 + 0.05 * _polar_noise(rng, 40, 2, turn, np.full_like(s, 0.5))
    collarette = np.exp(-(((s - edge) / 0.07) ** 2))
    inner = smooth_step(edge - s, -0.06, 0.06)
    furrow = 0.06 * np.sin(14 * s + 2 * _polar_noise(rng, 9, 2, turn, s)) * smooth_step(s, 0.5, 0.8)
    tone = 0.30 * fibre * np.sin(np.pi * (0.12 + 0.8 * s)) + 0.38 * collarette - 0.10 * inner - 0.9 * crypts + furrow
    tone = tone - 1.15 * smooth_step(s, 0.78, 1.0) - 0.4 * smooth_step(0.10 - s, 0.0, 0.10)
    warm = 0.35 * inner + 0.15 * collarette + 0.08 * _polar_noise(rng, 12, 2, turn, s)
    return np.clip(iris * np.exp(tone[:, None] + warm[:, None] * [0.35, 0.0, -0.55]), 0.002, 0.9)


def _white(offset: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(s, s, 3) linear: the sclera, warmer and redder away from the iris, with veins from the corners of the eye."""
    unit = offset / np.maximum(np.linalg.norm(offset, axis=-1, keepdims=True), 1e-9)
    away = np.arccos(np.clip(unit[..., 2], -1, 1))  # radians from the gaze
    turn = np.arctan2(offset[..., 1], offset[..., 0])
    size = 768
    net = np.zeros((size, size), np.float32)
    scale = size / 2 / np.radians(110)
    for k in range(_VEINS):
        start = (0.0 if k % 2 else np.pi) + rng.normal(0, 0.45)
        reach = np.linspace(np.radians(100), np.radians(rng.uniform(34, 70)), 40)
        along = np.linspace(0, 1, 40)
        bends = [rng.normal(0, 0.11 / w) * np.sin(w * along + rng.uniform(0, 6.3)) for w in (2.5, 5.0, 9.0, 16.0)]
        a = start + np.sum(bends, axis=0) + rng.normal(0, 0.1) * along
        line = size / 2 + scale * reach[:, None] * np.stack([np.cos(a), np.sin(a)], axis=1)
        layer = np.zeros_like(net)
        cv2.polylines(layer, [np.round(line * 16).astype(np.int32)], False, 1.0, 1, cv2.LINE_AA, 4)
        net = np.maximum(net, layer * np.float32(rng.uniform(0.15, 0.6)))
    soft = cv2.GaussianBlur(net, (0, 0), 0.7)
    x = (size / 2 + scale * away * np.cos(turn) - 0.5).astype(np.float32)
    y = (size / 2 + scale * away * np.sin(turn) - 0.5).astype(np.float32)
    vein = cv2.remap(soft, x, y, cv2.INTER_LINEAR) * smooth_step(away, np.radians(32), np.radians(62))
    far = smooth_step(away, np.radians(50), np.radians(100))[..., None]
    return WHITE * (1 - far * [0.04, 0.15, 0.17]) * (1 - vein[..., None] * [0.10, 0.42, 0.40])


def _polar_noise(rng: np.random.Generator, around: int, along: int, turn: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(k,) smooth noise of unit spread with `around` cells about the iris, closed, and `along` cells from its pupil."""
    cells = rng.standard_normal((along + 3, around)).astype(np.float32)
    cells = np.concatenate([cells[:, -2:], cells, cells[:, :2]], axis=1)
    x = (2 + np.mod(turn / (2 * np.pi), 1.0) * around).astype(np.float32)
    y = (1 + np.clip(share, 0, 1) * along).astype(np.float32)
    width = 4096
    pad = -len(x) % width
    x, y = (np.pad(v, (0, pad)).reshape(-1, width) for v in (x, y))
    return cv2.remap(cells, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).ravel()[: len(turn)] * 1.4
