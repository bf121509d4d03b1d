"""What a photo's EXIF block tells about camera, lens, focal length, time and orientation. Positions are never read."""

from __future__ import annotations

import calendar
import math
import time
from typing import Any

from PIL.Image import Exif

_MAKE, _MODEL, _ORIENTATION, _EXIF_IFD = 0x010F, 0x0110, 0x0112, 0x8769
_TAKEN, _SUBSECOND, _FOCAL, _WIDTH, _HEIGHT = 0x9003, 0x9291, 0x920A, 0xA002, 0xA003
_PLANE_X, _PLANE_UNIT, _FOCAL_35, _LENS_MODEL = 0xA20E, 0xA210, 0xA405, 0xA434

_MM_PER_PLANE_UNIT = {1: 25.4, 2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35 = math.hypot(36.0, 24.0)


def orientation(exif: Exif) -> int:
    """1 to 8 as EXIF counts them; 1 where the tag is absent or senseless."""
    value = _number(exif.get(_ORIENTATION))
    return int(value) if value in range(1, 9) else 1


def focal_from_35mm(f35: float, width: int, height: int) -> float:
    """
    f = f35 / |(36, 24) mm| * d pixels.

    The equivalent is defined by the diagonal (CIPA DCG-001): d is the picture's. Phone pictures that are wider than
    8 : 5 or nearly square are crops of a 4 : 3 sensor and keep the tag of the whole: d is then the diagonal of the
    4 : 3 frame they were cut from.
    """
    long, short = max(width, height), min(width, height)
    if 1.2 <= long / short <= 1.6:
        d = math.hypot(long, short)
    else:
        d = 1.25 * max(long, short * 4 / 3)
    return f35 / _DIAGONAL_35 * d


def focal(exif: Exif, width: int, height: int) -> tuple[float, str]:
    """Focal length in pixels of the stored picture of width x height, and where it comes from; NaN, '' if unknown."""
    tags = exif.get_ifd(_EXIF_IFD)
    f35 = _number(tags.get(_FOCAL_35))
    if 5.0 <= f35 <= 1000.0:
        return focal_from_35mm(f35, width, height), "EXIF 35 mm equivalent"
    millimetres, per_unit = _number(tags.get(_FOCAL)), _number(tags.get(_PLANE_X))
    unit = _MM_PER_PLANE_UNIT.get(int(_number(tags.get(_PLANE_UNIT), 2.0)), math.nan)
    f = millimetres * per_unit / unit
    # the resolution holds for the picture that the camera wrote; an edited one may be smaller
    written = max(_number(tags.get(_WIDTH)), _number(tags.get(_HEIGHT)))
    if written > 0:
        f *= max(width, height) / written
    if 0.2 <= f / max(width, height) <= 20.0:
        return f, "EXIF focal length and sensor resolution"
    return math.nan, ""


def taken(exif: Exif) -> float:
    """Seconds from 1970-01-01 00:00 of the camera's own clock (no time zone) to the exposure; NaN if not told."""
    tags = exif.get_ifd(_EXIF_IFD)
    try:
        moment = time.strptime(_text(tags.get(_TAKEN)), "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return math.nan
    digits = _text(tags.get(_SUBSECOND))
    return calendar.timegm(moment) + (float(f"0.{digits}") if digits.isascii() and digits.isdigit() else 0.0)


def camera(exif: Exif) -> str:
    """'make model, lens' without serial numbers; '' if not told."""
    make, model = _text(exif.get(_MAKE)), _text(exif.get(_MODEL))
    lens = _text(exif.get_ifd(_EXIF_IFD).get(_LENS_MODEL))
    body = model if model.lower().startswith(make.lower()) else f"{make} {model}".strip()
    return ", ".join(part for part in (body, lens) if part)


def optics(exif: Exif) -> str:
    """Focal length and its 35 mm equivalent as text: tells the lenses and zooms of one phone apart."""
    tags = exif.get_ifd(_EXIF_IFD)
    values = [_number(tags.get(tag)) for tag in (_FOCAL, _FOCAL_35)]
    return " ".join(f"{v:g}mm" for v in values if math.isfinite(v))


def _number(value: Any, default: float = math.nan) -> float:
    """A tag's value as a float; NaN for nothing, zero denominators and text."""
    try:
        return float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return default


def _text(value: Any) -> str:
    """A tag's value as clean text."""
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else value if isinstance(value, str) else ""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())
