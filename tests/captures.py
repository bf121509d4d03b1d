"""Small capture folders and made-up looks for tests; and photos of a face where the benchmark is at hand."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from media import exif_block, photo, texture

from avatarbuild.faces import Candidate, Look
from avatarbuild.focus import Measures
from avatarbuild.formats.images import read_photo
from avatarbuild.landmarks import Face, canonical_face

EVEN_LIGHT = Measures(0.5, 0.3, np.array([0.4, -0.4]), 0.0, 0.0, 0.8)


def texture_photos(folder: Path, count: int, seed: int = 0) -> list[Path]:
    """Photos IMG_0001 … without a face, a second apart, the last taken first."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for i in range(count):
        taken = f"2025:03:01 12:00:{59 - i:02d}"
        path = folder / f"IMG_{i + 1:04d}.jpg"
        paths.append(photo(path, texture(96, 128, seed=seed + i), exif_block(f35=26.0, taken=taken)))
    return paths


def benchmark_photo(number: int) -> np.ndarray:
    """(h, w, 3) of a photo of a face; skips the test where there is no benchmark."""
    return _read(benchmark() / "capture_b" / "photos" / f"IMG_{number:04d}.JPG")


def benchmark() -> Path:
    """The folder that AVATARBUILD_BENCHMARK names; skips the test where it names none."""
    folder = os.environ.get("AVATARBUILD_BENCHMARK")
    if not folder:
        pytest.skip("AVATARBUILD_BENCHMARK names no folder with captures of a face")
    return Path(folder)


@cache
def _read(path: Path) -> np.ndarray:
    return read_photo(path, 0.8e6).rgb


def face_at(
    x: float = 100.0,
    y: float = 100.0,
    size: float = 80.0,
    yaw: float = 0.0,
    pitch: float = 0.0,
    presence: float = 1.0,
    portrait: np.ndarray | None = None,
    scores: dict[int, float] | None = None,
    measures: Measures = EVEN_LIGHT,
    resolution: float = 4.0,
) -> Candidate:
    """A face without a picture: the mean face at (x, y)."""
    mean = canonical_face()
    flat = mean.points[:, :2] * (1.0, -1.0)
    scale = size / np.linalg.norm(np.ptp(flat, axis=0))
    points = np.zeros((478, 3))
    points[:468] = np.c_[flat * scale + (x, y), -mean.points[:, 2] * scale]
    points[468:] = points[:468].mean(0)
    values = np.full(52, 0.02)
    values[51] = np.nan
    for i, value in (scores or {}).items():
        values[i] = value
    shape = mean.points[np.flatnonzero(mean.rigidity)]
    face = Face(points, presence, values)
    return Candidate(face, np.array([yaw, pitch, 0.0]), 1.0, size, resolution, shape, portrait, measures)


def look_of(*faces: Candidate) -> Look:
    """A 200 x 200 picture with these faces."""
    return Look((200, 200), list(faces), None if faces else EVEN_LIGHT)


def darker(stops: float, measures: Measures = EVEN_LIGHT) -> Measures:
    return measures._replace(exposure=measures.exposure * 2.0**-stops)
