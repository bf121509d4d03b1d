"""What the colour of skin can be, and how a mean colour in photos divides into skin and light."""

from __future__ import annotations

import numpy as np

from avatarbuild.formats.colour import LUMINANCE, xyz_from_rgb

# CIELAB of facial skin of all origins, from dark to light: lightness, redness, yellowness (D65)
_LIGHTNESS = (22.0, 35.0, 50.0, 62.0, 74.0)
_REDNESS = (7.5, 10.5, 12.5, 11.5, 9.0)
_YELLOWNESS = (9.0, 14.5, 18.0, 17.0, 14.0)
_STEPS = 105

BRIGHTNESS_SD = 0.35  # of the log of the mean light on the face, whose mean is 0: the exposure
TINT_SD = 0.10  # of the log ratios of the light's channels: what a phone's white balance leaves
SURFACE = 0.02  # of the light: what the skin's surface reflects, white, from all sides; 0.028 straight on (n = 1.4)
SKIN_TINT_SD = 0.10  # of the log ratios of the skin's channels about the line of tones
WHITE_SD = 0.20  # of the log of the light that the whites of the eyes show; half of it where they show more light
WHITE_TAIL = 4.0  # degrees of freedom: whites in a shade of their own are no witnesses


def tones() -> np.ndarray:
    """(k, 3) linear RGB along the line of skin tones, dark to light.

    Source: the range of measured facial skin in Xiao et al., Characterising the variations in ethnic skin colours,
    2017, as a curve through CIELAB.
    """
    lightness = np.linspace(_LIGHTNESS[0], _LIGHTNESS[-1], _STEPS)
    a, b = (np.interp(lightness, _LIGHTNESS, values) for values in (_REDNESS, _YELLOWNESS))
    f = np.stack([(lightness + 16) / 116 + a / 500, (lightness + 16) / 116, (lightness + 16) / 116 - b / 200], axis=1)
    relative = np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29))
    matrix = xyz_from_rgb("BT.709")
    white = matrix.sum(axis=1)
    return np.clip(relative * white @ np.linalg.inv(matrix).T, 1e-3, 1.0)


def divide(mean: np.ndarray, white: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """
    Skin r (3,) and light's factor l (3,) with r l = mean (3,), from the most probable light l' under

    mean = (r + surface) l',  log l' ~ N(0, brightness along luminance, tint across it),
    log (r + surface) = log (tone(k) + surface) + N(0, tint), k uniform,
    white = log l' + t(white), the log of the light that the whites of the eyes show: lids, lashes and age take light
    from them, little adds any.

    The surface's white share, which no view is without, is little beside light skin and half of dark skin's blue: l
    holds it, so that it does not bleach r.

    Every tone is as likely as any other, so that nothing draws dark skin to light. A phone exposes for the whole
    picture, so that brightness alone says little: whites are of one brightness in everybody.
    """
    colour = np.log(np.maximum(np.asarray(mean, np.float64), 1e-4))
    off = colour - np.log(tones() + SURFACE)
    bright = off @ LUMINANCE
    tint = off - bright[:, None]
    light_tint = tint * TINT_SD**2 / (TINT_SD**2 + SKIN_TINT_SD**2)
    cost = (bright / BRIGHTNESS_SD) ** 2 + (tint**2).sum(axis=1) / (TINT_SD**2 + SKIN_TINT_SD**2)
    if white is not None:
        off = (white - bright) * np.where(white > bright, 2.0, 1.0) / WHITE_SD
        cost += WHITE_TAIL * np.log1p(off**2 / WHITE_TAIL)
    best = int(np.argmin(cost))
    light = np.exp(bright[best] + light_tint[best])
    whole = np.exp(colour) / light
    skin = np.maximum(whole - SURFACE, 0.3 * whole)
    return skin, np.exp(colour) / skin
