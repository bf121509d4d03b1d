"""SIFT features of grey images, by COLMAP."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pycolmap

from avatarbuild.parallel import in_processes

_FEW = 0.7  # of the features that are asked for
_ROOM = 2


@dataclass(frozen=True)
class Features:
    """
    n features of one image.

    points (n, 2) float32 pixels, centre of the first pixel at 0.5; scales (n,) pixels; descriptors (n, 128) uint8.
    """

    points: np.ndarray
    scales: np.ndarray
    descriptors: np.ndarray

    def __len__(self) -> int:
        return len(self.points)


def _extract(grey: np.ndarray, most: int) -> Features:
    found = _extract_from(grey, most, 0)
    # Octave -1 (an upsampled image) costs three times as much: for photos that are short of features without it.
    return _extract_from(grey, most, -1) if len(found) < _FEW * most else found


def _extract_from(grey: np.ndarray, most: int, octave: int) -> Features:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = 1
    options.sift.max_num_features = _ROOM * most  # COLMAP drops whole levels of scale; the cut is made below
    options.sift.first_octave = octave
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoints, descriptors = extractor.extract_from_uint8_array(np.ascontiguousarray(grey))
    matrix = np.asarray(pycolmap.keypoints_to_matrix(keypoints), np.float32).reshape(-1, 4)
    data = np.asarray(descriptors.data, np.uint8).reshape(-1, 128)
    order = np.lexsort((matrix[:, 3], matrix[:, 0], matrix[:, 1], -matrix[:, 2]))[:most]
    return Features(matrix[order, :2].copy(), matrix[order, 2].copy(), data[order])


def extract(images: Iterator[np.ndarray], most: int) -> Iterator[Features]:
    """
    SIFT features [Lowe 2004] of grey uint8 images (h, w), largest scales first, at most `most` an image; images are
    processed on all cores, the result does not depend on their number.
    """
    yield from in_processes(functools.partial(_extract, most=most), images)
