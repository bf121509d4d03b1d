"""
How far the eyes are shut, by what the picture shows between the corners of the lids: eye or skin.

The detector hardly sees lids close: its points leave a third of the opening, its score stays at a half. The white of
the eye and the iris have less colour than the skin about them; closed lids hide them.
"""

from __future__ import annotations

import cv2
import numpy as np

from avatarbuild.registration.pins import LID_RIMS
from avatarbuild.texture.photos import linear_picture

SIDES = ("left", "right")
RIMS = tuple(np.array(sorted({*LID_RIMS[f"lid_upper_{s}"], *LID_RIMS[f"lid_lower_{s}"]})) for s in SIDES)
"""The detector's points on the lids' rims, left and right eye."""
_CORNERS = tuple((LID_RIMS[f"lid_upper_{s}"][0], LID_RIMS[f"lid_upper_{s}"][-1]) for s in SIDES)
_SIZE = (48, 32)  # pixels of the window: the corners' distance wide, from so far above their line to so far below
_ABOVE, _BELOW = 0.42, 0.25
_SKIN_ABOVE, _SKIN_BELOW = 0.32, 0.21  # beyond these the window shows skin
_PALE = 0.65  # of the skin's red to blue: what has less is eye
_DARK = 0.15  # of the skin's green: lashes are darker
_LEAST_WIDTH = 10.0  # pixels between the corners
_LEAST_OPEN = 0.06  # of the window: eyes that show less when open cannot be judged so
_DOWN = 0.6  # of the opening: what lids hide that follow an eye looking down at weight 1
_MOST = 0.75  # of the opening: looking down hides no more
_HIDDEN, _WEIGHT = (0.12, 0.9, 1.0), (0.0, 0.6, 1.0)  # eyeBlink by the hidden share; it closes before it ends


def eye_shown(rgb: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """
    (2,) the share of the window about the left and the right eye that shows eye, NaN where it is too small: pixels
    whose red to blue is less than _PALE of the skin's above and below. rgb (h, w, 3) uint8 sRGB; marks (478, 2 or 3).
    """
    shares = np.full(2, np.nan)
    w, h = _SIZE
    height = np.linspace(-_ABOVE, _BELOW, h)
    skin = (height < -_SKIN_ABOVE) | (height > _SKIN_BELOW)
    for side, (first, last) in enumerate(_CORNERS):
        a, b = marks[first, :2], marks[last, :2]
        across = b - a
        width = float(np.linalg.norm(across))
        if not width >= _LEAST_WIDTH:
            continue
        down = np.array([-across[1], across[0]])
        down = down if down[1] > 0 else -down
        low = np.maximum(np.floor(np.minimum(a, b) - width), 0).astype(int)
        high = np.ceil(np.maximum(a, b) + width).astype(int)
        part = rgb[low[1] : high[1], low[0] : high[0]]
        if min(part.shape[:2]) < 2:
            continue
        k = max(1, int(width / w))
        u, v = np.meshgrid(np.linspace(0, 1, w), height)
        at = np.asarray(a - low + u[..., None] * across + v[..., None] * down - 0.5, np.float32)
        seen = cv2.remap(
            cv2.blur(part, (k, k)), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        light = linear_picture(seen) + 1e-3
        usual = np.median(light[skin].reshape(-1, 3), axis=0)
        colour = (light[..., 0] / light[..., 2]) / (usual[0] / usual[2])
        eye = (colour < _PALE) & (light[..., 1] > _DARK * usual[1])
        shares[side] = eye[~skin].mean()
    return shares


def usually_open(shown: np.ndarray) -> np.ndarray:
    """(2,) what open eyes show, the median over a clip's frames (f, 2); NaN where that is too little to judge by."""
    out = np.full(2, np.nan)
    for side in range(2):
        known = shown[np.isfinite(shown[:, side]), side]
        if len(known) and np.median(known) >= _LEAST_OPEN:
            out[side] = np.median(known)
    return out


def shut(shown: np.ndarray, opened: np.ndarray, down: np.ndarray | float = 0.0) -> np.ndarray:
    """
    (2,) the weight of eyeBlink, from `shown` (2,) beside what open eyes show and eyeLookDown's weights `down` (2,),
    whose lids hide a part; of lids that hide more, no gaze can be read. NaN unknown.
    """
    hidden = 1 - shown / opened
    expected = _DOWN * np.asarray(down) * np.clip((_MOST - hidden) / (_MOST - _DOWN), 0, 1)
    hidden = (hidden - expected) / (1 - expected)
    return np.where(np.isfinite(hidden), np.interp(np.nan_to_num(hidden), _HIDDEN, _WEIGHT), np.nan)
