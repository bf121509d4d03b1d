"""The capture's video as a browser plays it beside the avatar: small, H.264, upright, made once a project."""

from __future__ import annotations

import hashlib
import logging
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from avatarbuild.formats.clip import encode_clip
from avatarbuild.formats.video import decode_frames, frame_times, open_video
from avatarbuild.whole_file import whole_file

log = logging.getLogger(__name__)

_LONGER = 720  # pixels of the clip's longer side
_QUALITY = 27  # x264's constant rate factor
_AS_IT_IS = 3_000_000  # bytes: a smaller clip that browsers play is sent unchanged
_FORM = 1  # of the clips: another number, other clips


def for_page(video: Path, folder: Path) -> Path:
    """
    A file that browsers play: the video where it is small and H.264, else a smaller clip of the same times, which is
    kept in `folder`, or in a temporary one where that cannot be written.
    """
    about = open_video(video)
    plain = about.codec == "h264" and about.bits == 8 and not about.hdr and not about.rotation and not about.mirrored
    if plain and video.suffix.lower() in (".mp4", ".m4v") and video.stat().st_size <= _AS_IT_IS:
        return video
    stat = video.stat()
    key = f"{_FORM} {video.resolve()} {stat.st_size} {stat.st_mtime_ns}"
    place = _writable(folder) / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.mp4"
    if place.is_file():
        return place
    log.info("%s: a smaller clip is made for the page", video)
    scale = min(_LONGER / max(about.size), 1.0)
    w, h = (max(2, 2 * round(side * scale / 2)) for side in about.size)
    times = frame_times(video)
    kept: list[float] = []

    def small() -> Iterator[np.ndarray]:
        for _, time, rgb in decode_frames(video):
            kept.append(time)  # the encoder asks for a frame's time after the frame
            yield cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA)

    fps = len(times) / max(about.duration, 1e-6)
    with whole_file(place) as partial:
        encode_clip(partial, small(), fps, quality=_QUALITY, times=kept)
    for other in place.parent.glob("*.mp4"):
        if other != place:
            other.unlink(missing_ok=True)
    return place


def _writable(folder: Path) -> Path:
    try:
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return Path(tempfile.mkdtemp(prefix="avatarbuild-"))
