"""Video of any phone, frame by frame, upright and sRGB; and a writer of small clips."""

from __future__ import annotations

import calendar
import logging
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, Interpolation

from avatarbuild.errors import InputError
from avatarbuild.formats import colour

log = logging.getLogger(__name__)

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".3gp", ".mkv"})

_HDR = {ColorTrc.ARIB_STD_B67: "HLG", ColorTrc.SMPTE2084: "PQ"}
_PRIMARIES = {
    ColorPrimaries.BT2020: "BT.2020",
    ColorPrimaries.SMPTE432: "Display P3",
    ColorPrimaries.BT470BG: "BT.601-625",
    ColorPrimaries.SMPTE170M: "BT.601-525",
}

# Y'CbCr matrix, transfer and primaries as numbered by ITU-T H.273
_ENCODED_COLOUR = {"SDR": (1, 1, 1), "HLG": (9, 18, 9), "PQ": (9, 16, 9)}
_EXACT = Interpolation.BICUBIC | Interpolation.FULL_CHR_H_INT | Interpolation.ACCURATE_RND | Interpolation.BITEXACT


@dataclass(frozen=True)
class VideoFile:
    """
    What a video's header and packets tell, for the upright picture.

    size      width, height in pixels
    fps       nominal, frames a second;  duration s from the first frame's time to the end of the last
    frames    frames that the decoder gives for a sound file
    codec     'h264', 'hevc', …;  bits a sample: 8, 10 or 12
    rotation  degrees clockwise that the stored frames are turned by to stand upright: 0, 90, 180, 270
    mirrored  True where the header flips the stored frames, so that the upright picture is a mirror image;
              None: nothing is said
    hdr       '', 'HLG' or 'PQ'
    time      s from 1970-01-01 00:00 of the camera's own clock, or UTC where that is not told; NaN if unknown
    focal     pixels; NaN: video headers do not tell
    """

    path: Path
    size: tuple[int, int]
    fps: float
    duration: float
    frames: int
    codec: str
    bits: int
    rotation: int
    mirrored: bool | None
    hdr: str
    time: float
    focal: float


@dataclass(frozen=True)
class _Packets:
    """The frames' presentation times (f,) in ticks, sorted, those of keyframes among them, and a tick in seconds."""

    ticks: np.ndarray
    keys: np.ndarray
    tick: Fraction
    tail: float


def is_video(path: Path) -> bool:
    """Whether the name is a video's; hidden files are none."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")


def open_video(path: Path) -> VideoFile:
    """
    Reads the header, all packets and the first frame.

    Raises InputError for files that cannot be opened, hold no video, use a codec without decoder, or give no frame.
    """
    packets = _packets(path)
    with _opened(path) as container:
        stream = container.streams.video[0]
        first = _first_frame(path, container, stream)
        turn = _display_turn(first)
        width, height = _square_size(first, stream)
        seconds = float((packets.ticks[-1] - packets.ticks[0]) * packets.tick) + packets.tail
        rate = stream.average_rate or stream.guessed_rate
        return VideoFile(
            path=path,
            size=(width, height) if turn[0] % 2 == 0 else (height, width),
            fps=float(rate) if rate else len(packets.ticks) / seconds,
            duration=seconds,
            frames=len(packets.ticks),
            codec=stream.codec_context.name,
            bits=first.format.components[0].bits,
            rotation=90 * turn[0],
            mirrored=True if turn[1] else None,
            hdr=_HDR.get(first.color_trc, ""),
            time=_taken(container.metadata),
            focal=math.nan,
        )


def frame_times(path: Path) -> np.ndarray:
    """
    (f,) float64 s: presentation times of the frames in the decoder's order, the first 0, from the packets alone.

    Raises InputError as `open_video`.
    """
    packets = _packets(path)
    return (packets.ticks - packets.ticks[0]) * float(packets.tick)


def decode_frames(path: Path, wanted: Iterable[int] | None = None) -> Iterator[tuple[int, float, np.ndarray]]:
    """
    (index, time s, (h, w, 3) uint8 sRGB upright) of all frames, or of the wanted indices, in rising order.

    Index and time are those of `frame_times`. Frames that cannot be decoded are left out, with one warning in the log.
    Long gaps between wanted frames are crossed by seeking to keyframes. Raises InputError as `open_video`.
    """
    packets = _packets(path)
    times = frame_times(path)
    asked = range(len(times)) if wanted is None else sorted({i for i in wanted if 0 <= i < len(times)})
    given = 0
    with _opened(path) as container:
        stream = container.streams.video[0]
        for index, frame in _picked(container, packets, list(asked)):
            given += 1
            yield index, float(times[index]), _upright_srgb(frame, _square_size(frame, stream))
    if given < len(asked):
        log.warning("%s: %d of %d frames cannot be decoded", path.name, len(asked) - given, len(asked))


def _picked(container: Any, packets: _Packets, asked: list[int]) -> Iterator[tuple[int, av.VideoFrame]]:
    """(index, frame) of the frames asked for (rising), in one pass that skips to keyframes where that saves work."""
    index_of = {int(t): i for i, t in enumerate(packets.ticks)}
    stream = container.streams.video[0]
    frames, at = _decoded(container, stream), 0
    position = -1
    while at < len(asked):
        target = int(packets.ticks[asked[at]])
        key = packets.keys[packets.keys <= target]
        key_index = index_of[int(key[-1])] if len(key) else 0
        if key_index > position + 1 and position < asked[at]:
            container.seek(int(key[-1]), stream=stream, backward=True)
            stream.codec_context.flush_buffers()
            frames = _decoded(container, stream)
        for frame in frames:
            position = index_of.get(frame.pts, position)
            while at < len(asked) and asked[at] < position:
                at += 1
            if at < len(asked) and asked[at] == position:
                yield position, frame
                at += 1
                break
        else:
            return


def _decoded(container: Any, stream: Any) -> Iterator[av.VideoFrame]:
    """Frames in presentation order from where the container stands; ends at the first fault that stops the reader."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.FFmpegError:
            packet = None
        try:
            frames = stream.decode(packet)
        except av.FFmpegError:
            frames = []
        yield from (frame for frame in frames if not frame.is_corrupt)
        if packet is None:
            return


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
    Writes frames (h, w, 3) uint8 sRGB, or uint16 full-range signal for transfer 'HLG' and 'PQ' (BT.2020), as MP4 or MOV.

    The frames are given upright; they are stored turned and flipped so that a player has to mirror (left to right) and
    then turn them by `rotation` degrees clockwise. `times` (s, rising from 0) replaces the even rate; `quality` is the
    constant rate factor. One thread and no dates: the same bytes every time.
    """
    clock = 90000
    with av.open(str(path), "w") as container:
        encoder = {"h264": "libx264", "hevc": "libx265"}[codec]
        stream = container.add_stream(encoder, rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = pix_fmt
        stream.options = _encoder_options(codec, quality, keyframe_every)
        if codec == "hevc":
            stream.codec_context.codec_tag = "hvc1"
        stream.codec_context.time_base = Fraction(1, clock)
        stream.codec_context.thread_count = 1
        matrix, trc, primaries = _ENCODED_COLOUR[transfer]
        stream.codec_context.colorspace = matrix
        stream.codec_context.color_trc = trc
        stream.codec_context.color_primaries = primaries
        stream.codec_context.color_range = int(ColorRange.MPEG)
        if rotation or mirror:
            stream.set_display_matrix(_display_matrix(rotation, mirror))
        for i, rgb in enumerate(frames):
            stored = np.rot90(rgb, rotation // 90)
            stored = stored[:, ::-1] if mirror else stored
            source = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(stored), format="rgb24" if rgb.dtype == np.uint8 else "rgb48le"
            )
            frame = source.reformat(
                format=pix_fmt,
                dst_colorspace=Colorspace.BT2020 if transfer != "SDR" else Colorspace.ITU709,
                src_color_range=ColorRange.JPEG,
                dst_color_range=ColorRange.MPEG,
                interpolation=_EXACT,
                threads=1,
            )
            frame.colorspace, frame.color_trc, frame.color_primaries = matrix, trc, primaries
            seconds = i / fps if times is None else times[i]
            frame.pts, frame.time_base = round(seconds * clock), Fraction(1, clock)
            if i == 0:
                stream.width, stream.height = frame.width, frame.height
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def _encoder_options(codec: str, quality: int, keyframe_every: int) -> dict[str, str]:
    if codec == "h264":
        return {"crf": str(quality), "g": str(keyframe_every), "threads": "1", "preset": "veryfast"}
    quiet = "log-level=none:pools=none:frame-threads=1:no-info=1"
    return {"preset": "veryfast", "x265-params": f"crf={quality}:keyint={keyframe_every}:{quiet}"}


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The container, one video stream guaranteed, decoding on two threads."""
    try:
        with path.open("rb") as f:
            empty = not f.read(1)
    except OSError as e:
        raise InputError(f"{path}: cannot be opened ({e.strerror or e}); check its permissions or remove it") from e
    if empty:
        raise InputError(f"{path}: the file is empty; copy it from the camera again or remove it")
    try:
        container = av.open(str(path), metadata_errors="replace")
    except (av.FFmpegError, OSError, ValueError) as e:
        raise InputError(f"{path}: damaged or not a video; copy it from the camera again or remove it") from e
    with container:
        if not container.streams.video:
            raise InputError(f"{path}: holds no video; remove it or record a video")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise InputError(f"{path}: its video codec cannot be decoded; convert it to H.264 or HEVC in an MP4 file")
        stream.thread_type = "FRAME"
        stream.codec_context.thread_count = 2
        yield container


def _packets(path: Path) -> _Packets:
    """The frames of a video by its packets; kept for the next call while the file does not change."""
    try:
        about = path.stat()
    except OSError as e:
        raise InputError(f"{path}: cannot be opened ({e.strerror or e}); check its permissions or remove it") from e
    return _scan(path, about.st_mtime_ns, about.st_size)


@lru_cache(maxsize=8)
def _scan(path: Path, mtime: int, size: int) -> _Packets:
    """Reads all packets: headers promise frames that a broken copy has not, and edit lists hide some that it has."""
    ticks, keys, last = [], [], 0
    with _opened(path) as container:
        stream = container.streams.video[0]
        try:
            for packet in container.demux(stream):
                if packet.size == 0 or packet.is_discard or packet.is_corrupt:
                    continue
                tick = packet.pts if packet.pts is not None else packet.dts
                if tick is None:
                    continue
                ticks.append(tick)
                last = packet.duration or last
                if packet.is_keyframe:
                    keys.append(tick)
        except av.FFmpegError as e:
            log.warning("%s: damaged after %d frames (%s)", path.name, len(ticks), e.strerror)
        if not ticks or not keys:
            raise InputError(f"{path}: not one frame can be read; copy it from the camera again or remove it")
        order = np.unique(np.array(ticks, np.int64))
        tick = stream.time_base
        return _Packets(order, np.unique(np.array(keys, np.int64)), tick, float(last * tick))


def _first_frame(path: Path, container: Any, stream: Any) -> av.VideoFrame:
    frame = next(_decoded(container, stream), None)
    if frame is None:
        raise InputError(f"{path}: not one frame can be decoded; copy it from the camera again or remove it")
    return frame


def _square_size(frame: av.VideoFrame, stream: Any) -> tuple[int, int]:
    """Width and height as stored, made wider or narrower where pixels are not square."""
    aspect = stream.sample_aspect_ratio
    stretch = float(aspect) if aspect else 1.0
    return round(frame.width * stretch), frame.height


def _display_turn(frame: av.VideoFrame) -> tuple[int, bool]:
    """
    (quarter turns clockwise, flipped left to right before them) that make a stored frame upright.

    The container's matrix (a b u; c d v; x y w) takes a stored pixel (x, y) to (a x + c y, b x + d y), y down.
    """
    if "DISPLAYMATRIX" not in frame.side_data:
        return 0, False
    a, b, _, c, d = np.frombuffer(bytes(frame.side_data["DISPLAYMATRIX"]), np.int32)[:5].astype(float)
    flipped = a * d - b * c < 0
    angle = math.atan2(-b, -a) if flipped else math.atan2(b, a)
    return round(angle / (math.pi / 2)) % 4, flipped


def _display_matrix(rotation: int, mirror: bool) -> list[int]:
    """The inverse of `_display_turn`: nine fixed-point numbers."""
    cos, sin = ((1, 0), (0, 1), (-1, 0), (0, -1))[rotation // 90 % 4]
    flip = -1 if mirror else 1
    return [flip * cos << 16, flip * sin << 16, 0, -sin << 16, cos << 16, 0, 0, 0, 1 << 30]


def _upright_srgb(frame: av.VideoFrame, size: tuple[int, int]) -> np.ndarray:
    """(h, w, 3) uint8: the decoded frame in sRGB, square pixels (stored size given), turned upright."""
    hdr = _HDR.get(frame.color_trc, "")
    full = frame.color_range == ColorRange.JPEG or frame.format.name.startswith("yuvj")
    converted = frame.reformat(
        width=size[0],
        height=size[1],
        format="rgb48le" if hdr else "rgb24",
        src_colorspace=_matrix(frame),
        src_color_range=ColorRange.JPEG if full else ColorRange.MPEG,
        dst_color_range=ColorRange.JPEG,
        interpolation=_EXACT,
        threads=1,
    )
    rgb = converted.to_ndarray()
    primaries = _PRIMARIES.get(frame.color_primaries, "BT.709")
    if hdr:
        rgb = colour.srgb_from_hdr(rgb, hdr, primaries if primaries == "Display P3" else "BT.2020")
    elif primaries in ("BT.2020", "Display P3"):
        rgb = colour.srgb_from_primaries(rgb, primaries)
    turns, flipped = _display_turn(frame)
    if flipped:
        rgb = rgb[:, ::-1]
    return np.ascontiguousarray(np.rot90(rgb, -turns))


def _matrix(frame: av.VideoFrame) -> Colorspace:
    """The Y'CbCr matrix of a frame: as tagged, else BT.709 from 720 lines on and BT.601 below, as players have it."""
    tagged = {1: Colorspace.ITU709, 5: Colorspace.ITU601, 6: Colorspace.ITU601, 9: Colorspace.BT2020}
    unknown = Colorspace.ITU709 if min(frame.width, frame.height) >= 720 else Colorspace.ITU601
    return tagged.get(int(frame.colorspace), unknown)


def _taken(metadata: dict[str, str]) -> float:
    """Seconds from 1970-01-01 00:00 on the camera's clock (QuickTime's local creation date), else UTC; NaN."""
    for key in ("com.apple.quicktime.creationdate", "creation_time"):
        try:
            return float(calendar.timegm(time.strptime(metadata.get(key, "")[:19], "%Y-%m-%dT%H:%M:%S")))
        except ValueError:
            continue
    return math.nan
