"""Writing small video clips: rendered captures, animations and test media."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange

from avatarbuild.formats.frame import display_matrix, stored_frame

_ENCODERS = {"h264": "libx264", "hevc": "libx265"}
_CLOCK = 90000

# ITU-T H.273: Y'CbCr matrix, transfer, primaries
_COLOUR = {"SDR": (1, 1, 1), "HLG": (9, 18, 9), "PQ": (9, 16, 9)}


def encode_clip(
    path: Path,
    frames: Iterable[np.ndarray],
    fps: float,
    *,
    codec: str = "h264",
    pix_fmt: str = "yuv420p",
    quality: int = 18,
    rotation: int = 0,
    mirror: bool = False,
    times: Sequence[float] | None = None,
    transfer: str = "SDR",
    keyframe_every: int = 30,
) -> None:
    """
    Writes an MP4 or MOV of frames (h, w, 3): uint8 sRGB, or uint16 full-range BT.2020 signal for 'HLG' and 'PQ'.

    The frames are given upright, width and height even; they are stored turned and flipped so that a player has to
    mirror (left to right) and then turn them by `rotation` degrees clockwise. codec 'h264' or 'hevc'; `times` (s,
    rising from 0) replaces the even rate; `quality` is the constant rate factor. One thread and no dates: the same
    bytes every time.
    """
    matrix, curve, primaries = _COLOUR[transfer]
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(_ENCODERS[codec], rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = pix_fmt
        stream.options = _encoder_options(codec, quality, keyframe_every)
        context = stream.codec_context
        if codec == "hevc":
            context.codec_tag = "hvc1"
        context.time_base, context.thread_count = Fraction(1, _CLOCK), 1
        context.colorspace, context.color_trc, context.color_primaries = matrix, curve, primaries
        context.color_range = int(ColorRange.MPEG)
        if rotation or mirror:
            stream.set_display_matrix(display_matrix(rotation, mirror))
        for i, rgb in enumerate(frames):
            frame = stored_frame(rgb, pix_fmt, rotation, mirror, wide=transfer != "SDR")
            frame.colorspace, frame.color_trc, frame.color_primaries = matrix, curve, primaries
            seconds = i / fps if times is None else times[i]
            frame.pts, frame.time_base = round(seconds * _CLOCK), Fraction(1, _CLOCK)
            if i == 0:
                stream.width, stream.height = frame.width, frame.height
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def _encoder_options(codec: str, quality: int, keyframe_every: int) -> dict[str, str]:
    if codec == "h264":
        # x264's macroblock tree reads beyond rows that are no multiple of 64 long: now and then other bytes
        steady = {"threads": "1", "mbtree": "0"}
        return {"crf": str(quality), "g": str(keyframe_every), "preset": "veryfast", **steady}
    # no B-frames: x265 leaves the decoding times of clips shorter than its look-ahead unset
    still = "bframes=0:log-level=none:pools=none:frame-threads=1:no-info=1"
    return {"preset": "veryfast", "x265-params": f"crf={quality}:keyint={keyframe_every}:{still}"}
