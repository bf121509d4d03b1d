"""The eyes' texture: a painted eye whose iris takes its colours from a photo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from avatarbuild.formats.colour import encode_srgb
from avatarbuild.registration.eye_painting import WHITE, EyePainting, eye_map, paint_eye
from avatarbuild.registration.eye_shape import eye_shape
from avatarbuild.registration.eyes import Eyeballs
from avatarbuild.registration.iris_patches import IrisPatch, frontal_photos, iris_patch
from avatarbuild.registration.iris_sightings import Photos
from avatarbuild.template import Template

TEXTURE = 1024
_QUANTILES = 65
_ENDS = (0.01, 0.1, 0.1)  # of the histograms of brightness and colours: the share at either end that is chance
_BLACK = 0.004  # linear: darker colours are noise
_CAST = 0.5  # of the white's colour cast that is the light's; the rest is the eye's own
_TINT = (0.85, 1.15)  # of the painted white, at most
_BAND = (0.08, 0.80)  # of the way from pupil to limbus: what is compared, without the dark edges


@dataclass(frozen=True)
class EyeTexture:
    """texture (s, s, 3) uint8 sRGB, in the box of one eye's own chart; patches it comes from, none: a usual eye; iris
    (3,) linear: the median colour of the iris in the texture."""

    texture: np.ndarray
    patches: list[IrisPatch]
    iris: np.ndarray


def eye_texture(
    photos: Photos, eyes: Eyeballs, skin: np.ndarray, template: Template, size: int = TEXTURE
) -> EyeTexture:
    """
    The painted eye with the histogram of the iris in the most frontal sharp photo, both eyes together, in
    logarithms of brightness and of colour ratios, so that a dark fibre has the colour of a bright one; where that photo
    shows too little, of the next ones.

    The light is told from the white: its brightness against a healthy sclera's gives the exposure, half of its cast the
    light's colour; the other half tints the painted white. skin (>= v, 3): with the eyes' lids.
    """
    shape = eye_shape(template)
    assert shape is not None
    painting = paint_eye(eye_map(template, size), shape)
    patches: list[IrisPatch] = []
    photos = replace(photos, picture=lru_cache(maxsize=1)(photos.picture))
    for p in frontal_photos(photos, eyes):
        found = [iris_patch(photos, p, eye, eyes, skin, template, shape) for eye in range(2)]
        patches = [patch for patch in found if patch is not None]
        if patches:
            break
    if patches:
        painting = coloured(painting, patches)
    colour = painting.colour()
    texture = encode_srgb(colour)
    return EyeTexture(texture, patches, np.median(colour[_compared(painting)], axis=0))


def coloured(painting: EyePainting, patches: list[IrisPatch]) -> EyePainting:
    """The painting with the patches' colours, matched in the logarithms of G, R/G and B/G."""
    light, tint = light_of(np.median(np.concatenate([patch.window[patch.white] for patch in patches]), axis=0))
    iris = np.concatenate([patch.window[patch.stroma] - patch.veil for patch in patches]) / light
    source, target = _opponent(painting.stroma[_compared(painting)]), _opponent(iris)
    within = painting.iris > 0
    values = _opponent(painting.stroma[within])
    matched = np.stack([match(values[:, c], source[:, c], target[:, c], _ENDS[c]) for c in range(3)], axis=1)
    stroma = np.zeros_like(painting.stroma)
    stroma[within] = _linear(matched)
    return replace(painting, white=np.clip(painting.white * tint, 0, 1), stroma=np.clip(stroma, 0, 1))


def light_of(white: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The light's colour (3,) by the white of an eye in a photo (3,) linear, and the tint (3,) of the painted white."""
    ratio = np.maximum(white, 1e-4) / WHITE
    cast = ratio / ratio.mean()
    tint = np.clip(cast ** (1 - _CAST), *_TINT)
    tint /= tint.mean()
    return ratio / tint, tint


def match(values: np.ndarray, source: np.ndarray, target: np.ndarray, ends: float) -> np.ndarray:
    """
    F_target^-1(F_source(v)): values (k,) as if the sample `source` (a,) had the histogram of `target` (b,). By
    quantiles at equal steps from `ends` to 1 - `ends`, linear in between; a value beyond keeps its distance from them.
    """
    q = np.linspace(ends, 1 - ends, _QUANTILES)
    a, b = np.quantile(source, q), np.quantile(target, q)
    inside = np.clip(values, a[0], a[-1])
    distinct = np.r_[True, a[1:] > a[:-1]]
    return np.interp(inside, a[distinct], b[distinct]) + values - inside


def _compared(painting: EyePainting) -> np.ndarray:
    return (painting.share > _BAND[0]) & (painting.share < _BAND[1])


def _opponent(linear: np.ndarray) -> np.ndarray:
    """(k, 3) log G, log R/G, log B/G of linear colours (k, 3)."""
    r, g, b = np.log(np.maximum(linear, _BLACK)).T
    return np.stack([g, r - g, b - g], axis=1)


def _linear(opponent: np.ndarray) -> np.ndarray:
    g, r, b = opponent.T
    return np.exp(np.stack([g + r, g, g + b], axis=1))
