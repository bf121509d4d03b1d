"""The atlas beside the skin: eyeballs, teeth, gums and tongue, and what lies between the charts."""

from __future__ import annotations

import cv2
import numpy as np

from avatarbuild.formats.avatar_glb import EYES, LOOKS, part_uv
from avatarbuild.formats.colour import linear_from_srgb
from avatarbuild.template import Template
from avatarbuild.texture.photos import linear_picture


def paint_inner_parts(colour: np.ndarray, part: np.ndarray, template: Template, eye_texture: np.ndarray) -> None:
    """
    Colours, in place, the charts of all parts but the skin: colour (s, s, 3) linear, part (s, s) as in `Chart`.

    eye_texture (e, e, 3) uint8 sRGB fills the square of an eye's own chart; teeth, gums and tongue have one colour.
    """
    size = len(part)
    eye = linear_picture(eye_texture)
    for k, name in enumerate(template.parts):
        if name == "skin":
            continue
        here = part == k + 1
        if name not in EYES:
            colour[here] = linear_from_srgb(np.array(LOOKS[name].colour))
            continue
        rows, columns = np.flatnonzero(here.any(axis=1)), np.flatnonzero(here.any(axis=0))
        if not len(rows):
            continue
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        used = np.unique(template.uv_triangles[template.parts[name].triangles])
        low, high = template.uv[used].min(axis=0), template.uv[used].max(axis=0)
        assert np.allclose(part_uv(template, name)[used].min(axis=0), 0)
        u = ((np.arange(size)[window[1]] + 0.5) / size - low[0]) / (high[0] - low[0])
        v = (1 - (np.arange(size)[window[0]] + 0.5) / size - low[1]) / (high[1] - low[1])
        x, y = np.meshgrid(u * eye.shape[1] - 0.5, (1 - v) * eye.shape[0] - 0.5)
        table = x.astype(np.float32), y.astype(np.float32)
        painted = cv2.remap(_reduced(eye, len(u)), *table, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        colour[window][here[window]] = painted[here[window]]


def _reduced(picture: np.ndarray, columns: int) -> np.ndarray:
    """The picture, blurred to `columns` where it has more."""
    ratio = picture.shape[1] / max(columns, 1)
    return cv2.GaussianBlur(picture, (0, 0), 0.4 * ratio) if ratio > 1.3 else picture


def spread(colour: np.ndarray, known: np.ndarray) -> np.ndarray:
    """
    (s, s, 3) float32: colour where known (s, s), elsewhere ever coarser means of what is known around.

    Source: Gortler, Grzeszczuk, Szeliski, Cohen, The lumigraph, 1996 (pull and push).
    """
    s = len(colour)
    if s <= 2 or known.all():
        total = max(float(known.sum()), 1e-12)
        return np.where(known[..., None], colour, (colour * known[..., None]).sum(axis=(0, 1)) / total)
    half = (s + 1) // 2
    pad = ((0, 2 * half - s), (0, 2 * half - s))
    weight = np.pad(known.astype(np.float32), pad)
    held = np.pad(np.where(known[..., None], colour, 0).astype(np.float32), (*pad, (0, 0)))
    quarter = weight.reshape(half, 2, half, 2).sum(axis=(1, 3))
    mean = held.reshape(half, 2, half, 2, 3).sum(axis=(1, 3)) / np.maximum(quarter, 1)[..., None]
    coarse = spread(mean, quarter > 0)
    fine = cv2.resize(coarse, (2 * half, 2 * half), interpolation=cv2.INTER_LINEAR)[:s, :s]
    return np.where(known[..., None], colour, fine).astype(np.float32)
