"""Video of any phone, frame by frame, upright and sRGB."""

from __future__ import annotations

import calendar
import logging
import math
import time
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import av
import numpy as np

from avatarbuild.errors import InputError
from avatarbuild.formats import colour
from avatarbuild.formats.frame import display_turn, square_size, upright_srgb

log = logging.getLogger(__name__)

VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".m4v", ".3gp", ".mkv"})


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


@dataclass(frozen=True)
class _Packets:
    """
    ticks (f,) the frames' presentation times, sorted;  keys (j,) those of keyframes, also of hidden ones;
    tick seconds of one;  tail the last frame's seconds.
    """

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
        stream = _stream(container)
        first = _first_frame(path, container, stream)
        turn = display_turn(first)
        width, height = square_size(first, stream)
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
            hdr=colour.HDR_CURVES.get(int(first.color_trc or 0), ""),
            time=_taken(container.metadata),
        )


def frame_times(path: Path) -> np.ndarray:
    """
    (f,) float64 s: presentation times of the frames in the decoder's order, the first 0, from the packets alone.

    Raises InputError as `open_video`.
    """
    packets = _packets(path)
    return (packets.ticks - packets.ticks[0]) * float(packets.tick)


def keyframes(path: Path) -> np.ndarray:
    """(j,) int: indices of the frames that decode alone, cheap to `decode_frames` by themselves, in rising order."""
    packets = _packets(path)
    found = np.searchsorted(packets.ticks, packets.keys)
    return np.unique(found[found < len(packets.ticks)])


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
        stream = _stream(container)
        for index, frame in _picked(container, packets, list(asked)):
            given += 1
            yield index, float(times[index]), upright_srgb(frame, square_size(frame, stream))
    if given < len(asked):
        log.warning("%s: %d of %d frames cannot be decoded", path.name, len(asked) - given, len(asked))


def _picked(container: Any, packets: _Packets, asked: list[int]) -> Iterator[tuple[int, av.VideoFrame]]:
    """(index, frame) of the frames asked for (rising), in one pass that skips to keyframes where that saves work."""
    index_of: dict[int | None, int] = {int(tick): i for i, tick in enumerate(packets.ticks)}
    keys = list(np.searchsorted(packets.ticks, packets.keys))
    stream = _stream(container)
    frames, position = _decoded(container, stream), -1
    for index in asked:
        earlier = bisect_right(keys, index)
        if earlier and keys[earlier - 1] > position + 1:
            frames, position = _from_keyframe(container, packets.keys[:earlier], int(packets.ticks[index])), -1
        for frame in frames:
            position = index_of.get(frame.pts, position)
            if position >= index:
                break
        else:
            return
        if position == index:
            yield index, frame


def _from_keyframe(container: Any, keys: np.ndarray, wanted: int) -> Iterator[av.VideoFrame]:
    """Frames from the last of these keyframes (ticks) on, from an earlier one where seeking lands behind `wanted`."""
    stream = _stream(container)
    for key in reversed(keys):
        container.seek(int(key), stream=stream, backward=True)
        frames = _decoded(container, stream)
        first = next(frames, None)
        if first is not None and first.pts is not None and first.pts <= wanted:
            return chain([first], frames)
    container.seek(0, backward=True)
    return _decoded(container, stream)


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
        stream = _stream(container)
        if stream is None:
            raise InputError(f"{path}: holds no video that can be read; copy it from the camera again or remove it")
        if stream.codec_context is None:
            raise InputError(f"{path}: its video codec cannot be decoded; convert it to H.264 or HEVC in an MP4 file")
        stream.thread_type = "FRAME"
        stream.codec_context.thread_count = 2
        yield container


def _stream(container: Any) -> Any:
    """The main video stream, or None; cover pictures are none."""
    streams = [s for s in container.streams.video if not s.disposition & av.stream.Disposition.attached_pic]
    best = container.streams.best("video")
    return best if best in streams else next(iter(streams), None)


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
        stream = _stream(container)
        try:
            for packet in container.demux(stream):
                tick = packet.pts if packet.pts is not None else packet.dts
                if packet.size == 0 or packet.is_corrupt or tick is None:
                    continue
                if packet.is_keyframe:
                    keys.append(tick)
                # a trimmed clip keeps the frames before its start for the decoder, not for the eye
                if not packet.is_discard:
                    ticks.append(tick)
                    last = packet.duration or last
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


def _taken(metadata: dict[str, str]) -> float:
    """Seconds from 1970-01-01 00:00 on the camera's clock (QuickTime's local creation date), else UTC; NaN."""
    for key in ("com.apple.quicktime.creationdate", "creation_time"):
        try:
            return float(calendar.timegm(time.strptime(metadata.get(key, "")[:19], "%Y-%m-%dT%H:%M:%S")))
        except ValueError:
            continue
    return math.nan
