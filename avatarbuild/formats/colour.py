"""Colour at the border: transfer functions, primaries, ICC profiles and HDR video, all to sRGB."""

from __future__ import annotations

import io
from functools import lru_cache

import numba
import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageCms

# chromaticities of red, green, blue; white is D65 everywhere
PRIMARIES = {
    "BT.709": ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),
    "BT.2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    "Display P3": ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
    "BT.601-525": ((0.630, 0.340), (0.310, 0.595), (0.155, 0.070)),
}
_D65 = (0.3127, 0.3290)

# numbers that videos and HEIC files carry (ITU-T H.273), of what differs from sRGB
HDR_CURVES = {18: "HLG", 16: "PQ"}
WIDE_PRIMARIES = {9: "BT.2020", 12: "Display P3"}

REFERENCE_WHITE = 203.0  # cd/m2: diffuse white in HLG and PQ, ITU-R BT.2408
HLG_PEAK = 1000.0  # cd/m2: the nominal display of ITU-R BT.2100
_KNEE = 0.8  # SDR light from which highlights are compressed


LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB


def linear_from_srgb(signal: ArrayLike) -> np.ndarray:
    """IEC 61966-2-1: signal in 0..1 to linear light in 0..1, float, any shape."""
    v = np.asarray(signal, np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((np.maximum(v, 0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(x: np.ndarray) -> np.ndarray:
    """The inverse of `linear_from_srgb`."""
    x = np.asarray(x, np.float64)
    return np.where(x <= 0.0031308, x * 12.92, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


_LINEAR = linear_from_srgb(np.arange(256) / 255.0)


def decode_srgb(rgb: np.ndarray) -> np.ndarray:
    """Linear light in 0..1, float64, of uint8 sRGB, any shape."""
    return _LINEAR[rgb]


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """uint8 sRGB of linear light, clipped to 0..1, any shape."""
    return np.round(255 * srgb_from_linear(np.clip(linear, 0, 1))).astype(np.uint8)


def scene_from_hlg(v: np.ndarray) -> np.ndarray:
    """ITU-R BT.2100 HLG inverse OETF: signal in 0..1 to scene light in 0..1."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    v = np.asarray(v, np.float64)
    return np.where(v <= 0.5, v * v / 3.0, (np.exp((np.maximum(v, 0.5) - c) / a) + b) / 12.0)


def nits_from_pq(v: np.ndarray) -> np.ndarray:
    """SMPTE ST 2084: signal in 0..1 to display light in cd/m2."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    p = np.maximum(np.asarray(v, np.float64), 0.0) ** (1 / m2)
    return 10000.0 * (np.maximum(p - c1, 0.0) / (c2 - c3 * p)) ** (1 / m1)


def xyz_from_rgb(primaries: str) -> np.ndarray:
    """(3, 3): columns are the XYZ of the primaries, scaled so that R = G = B = 1 is D65 with Y = 1 (SMPTE RP 177)."""
    lift = lambda xy: np.array([xy[0] / xy[1], 1.0, (1.0 - xy[0] - xy[1]) / xy[1]])  # noqa: E731
    p = np.stack([lift(xy) for xy in PRIMARIES[primaries]], axis=1)
    return p * np.linalg.solve(p, lift(_D65))


def gamut_matrix(source: str, target: str = "BT.709") -> np.ndarray:
    """(3, 3) linear RGB of `source` primaries to linear RGB of `target`."""
    return np.linalg.solve(xyz_from_rgb(target), xyz_from_rgb(source))


def srgb_from_icc(image: Image.Image, profile: bytes) -> Image.Image:
    """
    An 8 bit picture ('L', 'RGB' or 'CMYK') in the colours of an ICC profile, as sRGB 'RGB'.

    Relative colorimetric: in-gamut colours exact, others clipped. Raises ValueError where profile and picture disagree.
    """
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if profile[16:20] == b"RGB " and "sRGB" in ImageCms.getProfileDescription(source):
            return image.convert("RGB")
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        done = ImageCms.profileToProfile(image, source, _srgb_profile(), renderingIntent=intent, outputMode="RGB")
    except (ImageCms.PyCMSError, OSError) as e:
        raise ValueError(f"colour profile does not fit the picture ({e})") from e
    assert done is not None
    return done


def profile_name(profile: bytes) -> str:
    """What an ICC profile calls itself; 'unreadable ICC profile' if nothing."""
    try:
        return ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile))).strip()
    except (ImageCms.PyCMSError, OSError):
        return "unreadable ICC profile"


@lru_cache
def _srgb_profile() -> ImageCms.ImageCmsProfile:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))


@lru_cache
def _srgb_table() -> np.ndarray:
    """(4097,) uint8: sRGB of linear light (i / 4096)^2; the square keeps the dark end fine."""
    return np.rint(255.0 * srgb_from_linear((np.arange(4097) / 4096.0) ** 2)).astype(np.uint8)


def srgb_from_primaries(rgb: np.ndarray, primaries: str) -> np.ndarray:
    """(h, w, 3) uint8 of sRGB's curve but other primaries, as sRGB; colours outside are clipped."""
    table = _LINEAR.astype(np.float32)
    matrix = gamut_matrix(primaries).astype(np.float32)
    return _recode(np.ascontiguousarray(rgb), table, matrix, _srgb_table(), np.float32(0.0), np.float32(0.0))


def srgb_from_hdr(rgb: np.ndarray, curve: str, primaries: str = "BT.2020") -> np.ndarray:
    """
    (h, w, 3) uint16 full-range HLG or PQ signal (65535 = 1) as sRGB uint8.

    HLG: E = inverse OETF; display light F = 1000 Y^0.2 E cd/m2 (BT.2100 OOTF, gamma 1.2).  PQ: F = EOTF.
    x = M F / 203 with M to BT.709 primaries, negative values to 0; with m = max(x) and the knee k = 0.8
    x <- x g(m) / m,   g(m) = m for m <= k,   else k + (1 - k) s (1 + s / S^2) / (1 + s),   s = (m - k) / (1 - k),
    where S belongs to the peak of 1000 cd/m2: linear up to k, hue kept, the peak at 1.
    """
    signal = np.arange(65536) / 65535.0
    if curve == "HLG":
        table, gamma = scene_from_hlg(signal) * (HLG_PEAK / REFERENCE_WHITE), 0.2
    else:
        table, gamma = nits_from_pq(signal) / REFERENCE_WHITE, 0.0
    matrix = gamut_matrix(primaries).astype(np.float32)
    args = (np.ascontiguousarray(rgb), table.astype(np.float32), matrix, _srgb_table())
    return _recode(*args, np.float32(gamma), np.float32(HLG_PEAK / REFERENCE_WHITE))


@numba.njit(cache=True, nogil=True)
def _recode(rgb, table, matrix, encode, gamma, peak):  # type: ignore[no-untyped-def]
    """Decode by table, HLG's OOTF where gamma > 0, to BT.709, roll-off where peak > 0, encode; (h, w, 3) uint8."""
    h, w, _ = rgb.shape
    out = np.empty((h, w, 3), np.uint8)
    k = np.float32(_KNEE)
    top = (peak - k) / (np.float32(1.0) - k)
    for y in range(h):
        for x in range(w):
            r, g, b = table[rgb[y, x, 0]], table[rgb[y, x, 1]], table[rgb[y, x, 2]]
            if gamma > 0:
                # BT.2020 luminance of scene light, which the table holds times the peak
                luminance = (np.float32(0.2627) * r + np.float32(0.6780) * g + np.float32(0.0593) * b) / peak
                gain = luminance**gamma
                r, g, b = r * gain, g * gain, b * gain
            p = max(matrix[0, 0] * r + matrix[0, 1] * g + matrix[0, 2] * b, np.float32(0.0))
            q = max(matrix[1, 0] * r + matrix[1, 1] * g + matrix[1, 2] * b, np.float32(0.0))
            s = max(matrix[2, 0] * r + matrix[2, 1] * g + matrix[2, 2] * b, np.float32(0.0))
            m = max(p, q, s)
            if peak > 0 and m > k:
                t = min((m - k) / (np.float32(1.0) - k), top)
                scale = (
                    k + (np.float32(1.0) - k) * t * (np.float32(1.0) + t / (top * top)) / (np.float32(1.0) + t)
                ) / m
                p, q, s = p * scale, q * scale, s * scale
            out[y, x, 0] = encode[int(np.sqrt(min(p, np.float32(1.0))) * np.float32(4096.0) + np.float32(0.5))]
            out[y, x, 1] = encode[int(np.sqrt(min(q, np.float32(1.0))) * np.float32(4096.0) + np.float32(0.5))]
            out[y, x, 2] = encode[int(np.sqrt(min(s, np.float32(1.0))) * np.float32(4096.0) + np.float32(0.5))]
    return out
