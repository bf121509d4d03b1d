"""One decoded video frame: its Y'CbCr samples to upright sRGB, and the way back for clips that are written."""

from __future__ import annotations

import math
from typing import Any

import av
import cv2
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation

from avatarbuild.formats import colour, ycbcr

# luma equations by the numbers of ITU-T H.273
_LUMA = {1: ycbcr.BT709, 5: ycbcr.BT601, 6: ycbcr.BT601, 9: ycbcr.BT2020}

_PLANAR = {"yuv420p", "yuvj420p", "yuv422p", "yuvj422p", "yuv444p", "yuvj444p"} | {
    f"yuv{chroma}p{bits}le" for chroma in (420, 422, 444) for bits in (10, 12)
}

# swscale's other modes are off by one or two grey levels
_EXACT = Interpolation.BILINEAR | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND | Interpolation.BITEXACT


def upright_srgb(frame: av.VideoFrame, size: tuple[int, int]) -> np.ndarray:
    """
    (h, w, 3) uint8: the decoded frame in sRGB, scaled to size (width, height as stored) and turned upright.

    SDR signals are taken for sRGB's, as players show them; wide primaries and HLG or PQ are converted by `colour`.
    """
    hdr = colour.HDR_CURVES.get(int(frame.color_trc or 0), "")
    rgb = _signal(frame, deep=bool(hdr))
    primaries = colour.WIDE_PRIMARIES.get(int(frame.color_primaries or 0))
    if hdr:
        rgb = colour.srgb_from_hdr(rgb, hdr, primaries or "BT.2020")
    elif primaries:
        rgb = colour.srgb_from_primaries(rgb, primaries)
    if size != (frame.width, frame.height):
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR)
    turns, flipped = display_turn(frame)
    if flipped:
        rgb = rgb[:, ::-1]
    return np.ascontiguousarray(np.rot90(rgb, -turns))


def _signal(frame: av.VideoFrame, deep: bool) -> np.ndarray:
    """(h, w, 3) full-range R'G'B' as stored, uint8 or uint16."""
    if frame.format.name not in _PLANAR:
        frame = frame.reformat(format="yuv444p10le" if deep else "yuv444p", interpolation=_EXACT, threads=1)
    bits = frame.format.components[0].bits
    kind = np.dtype(np.uint8 if bits == 8 else "<u2")
    planes = [
        np.frombuffer(memoryview(plane), kind).reshape(-1, plane.line_size // kind.itemsize)[
            : plane.height, : plane.width
        ]
        for plane in frame.planes
    ]
    full = frame.color_range == ColorRange.JPEG or frame.format.name.startswith("yuvj")
    return ycbcr.rgb_from_planes(planes[0], planes[1], planes[2], bits, _luma(frame), full, deep)


def _luma(frame: av.VideoFrame) -> tuple[float, float]:
    """The luma equation of a frame: as tagged, else BT.709 from 720 lines on and BT.601 below, as players have it."""
    unknown = ycbcr.BT709 if min(frame.width, frame.height) >= 720 else ycbcr.BT601
    return _LUMA.get(int(frame.colorspace), unknown)


def stored_frame(rgb: np.ndarray, pix_fmt: str, rotation: int, mirror: bool, wide: bool) -> av.VideoFrame:
    """The inverse of `upright_srgb` without its curves: uint8 or uint16 RGB to limited-range BT.709 or BT.2020."""
    stored = np.rot90(rgb, rotation // 90)
    stored = np.ascontiguousarray(stored[:, ::-1] if mirror else stored)
    return av.VideoFrame.from_ndarray(stored, format="rgb24" if rgb.dtype == np.uint8 else "rgb48le").reformat(
        format=pix_fmt,
        dst_colorspace=Colorspace.BT2020 if wide else Colorspace.ITU709,
        src_color_range=ColorRange.JPEG,
        dst_color_range=ColorRange.MPEG,
        interpolation=_EXACT,
        threads=1,
    )


def square_size(frame: av.VideoFrame, stream: Any) -> tuple[int, int]:
    """Width and height as stored, the width stretched where pixels are not square."""
    aspect = stream.sample_aspect_ratio
    return round(frame.width * float(aspect)) if aspect else frame.width, frame.height


def display_turn(frame: av.VideoFrame) -> tuple[int, bool]:
    """
    (quarter turns clockwise, flipped left to right before them) that make a stored frame upright.

    The container's matrix (a b u; c d v; x y w) takes a stored pixel (x, y) to (a x + c y, b x + d y), y down.
    """
    try:
        found: Any = frame.side_data.get("DISPLAYMATRIX")
    except ValueError:  # the decoder gives data besides, such as EXIF, that this PyAV has no name for
        return round(-frame.rotation / 90) % 4, False
    if found is None:
        return 0, False
    a, b, _, c, d = np.frombuffer(bytes(found), np.int32)[:5].astype(float)
    flipped = a * d - b * c < 0
    angle = math.atan2(-b, -a) if flipped else math.atan2(b, a)
    return round(angle / (math.pi / 2)) % 4, flipped


def display_matrix(rotation: int, mirror: bool) -> list[int]:
    """The inverse of `display_turn`: nine fixed-point numbers."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[rotation // 90 % 4]
    flip = -1 if mirror else 1
    one = 1 << 16
    return [flip * cos * one, flip * sin * one, 0, -sin * one, cos * one, 0, 0, 0, 1 << 30]
