"""A video of one person: the sharpest frame of each moment, and the person's face in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from avatarbuild.artefacts import Clip
from avatarbuild.faces import Identity, Look, look
from avatarbuild.formats import images, video
from avatarbuild.options import CaptureOptions
from avatarbuild.parallel import in_order
from avatarbuild.progress import Progress, Task
from avatarbuild.survey import FURTHER, Survey, survey_frames


def read_clip(
    source: video.VideoFile,
    file: Path,
    focal: float,
    known: Identity | None,
    options: CaptureOptions,
    progress: Progress,
    copies: bool,
) -> tuple[Clip, Survey]:
    """
    The video's frames, the sharpest of each 1 / frame_rate seconds, with the `known` person followed through them.

    file: its name in the clip; focal: pixels, a prior; `copies`: the frames' JPEGs are kept.
    Raises InputError as `open_video`.
    """
    times = video.frame_times(source.path)
    with progress.task("video", len(times)) as task:
        indices, looks, kept = _frames(source, times, options, copies, task)
    frames = survey_frames(file, indices, times[indices], looks, kept, known, focal, options.presence)
    return Clip(file.as_posix(), source.size, source.fps, times, focal, np.array(indices), frames.views), frames


def _frames(
    source: video.VideoFile, times: np.ndarray, options: CaptureOptions, copies: bool, task: Task
) -> tuple[list[int], list[Look], list[bytes]]:
    """The sharpest frame of each 1 / frame_rate seconds: its number, a look at it, its JPEG."""

    def pick(item: tuple[int, list[tuple[int, np.ndarray]]]) -> tuple[int, Look, bytes]:
        number, window = item
        index, rgb = _sharpest(window, options.presence)
        seen = look(rgb, options.presence, further=number % FURTHER == 0)
        return index, seen, images.encode_jpeg(rgb, options.jpeg_quality) if copies else b""

    indices, looks, kept = [], [], []
    windows = enumerate(_windows(source, times, options.frame_rate, task))
    for index, seen, copy in in_order(pick, windows, ahead=1):
        indices.append(index)
        looks.append(seen)
        kept.append(copy)
    return indices, looks, kept


def _windows(
    source: video.VideoFile, times: np.ndarray, rate: float, task: Task
) -> Iterator[list[tuple[int, np.ndarray]]]:
    """The decoded frames (number, rgb) of each 1 / rate seconds that has any."""
    slot = np.floor(times * rate + 1e-6).astype(int)
    window: list[tuple[int, np.ndarray]] = []
    for index, _, rgb in video.decode_frames(source.path):
        task.advance()
        if window and slot[index] != slot[window[0][0]]:
            yield window
            window = []
        window.append((index, rgb))
    if window:
        yield window


def _sharpest(window: list[tuple[int, np.ndarray]], presence: float) -> tuple[int, np.ndarray]:
    """The frame whose face, where it is in the middle frame, has the most energy in its Laplacian."""
    if len(window) == 1:
        return window[0]
    middle = window[len(window) // 2][1]
    seen = look(middle, presence, careful=False).faces
    part = np.s_[:, :]
    if seen:
        points = seen[0].face.points[:468, :2]
        low, high = np.maximum(points.min(0), 0).astype(int), points.max(0).astype(int)
        if ((high - low) > 16).all():
            part = np.s_[low[1] : high[1], low[0] : high[0]]

    def energy(rgb: np.ndarray) -> float:
        grey = cv2.GaussianBlur(cv2.cvtColor(rgb[part], cv2.COLOR_RGB2GRAY), (0, 0), 1.0)
        return float(cv2.Laplacian(grey, cv2.CV_32F).var())

    return max(window, key=lambda item: (energy(item[1]), -item[0]))
