"""Whether the focal length that the photos claim can be right."""

from __future__ import annotations

import numpy as np
import pycolmap

from avatarbuild.sfm.features import Features

_FACTORS = (1.0, 0.5, 0.71, 1.41, 2.0)
_PAIRS = 10
_BETTER = 1.1  # another factor must explain this many times the matches


def plausible_factor(
    features: list[Features],
    matches: dict[tuple[int, int], np.ndarray],
    cameras: list[pycolmap.Camera],
    camera_of: np.ndarray,
) -> float:
    """
    The factor on the claimed focal lengths, among 1/2, 1/sqrt 2, 1, sqrt 2 and 2, under which most matches agree with an
    essential matrix; 1 unless another is clearly better.

    matches: (p, 2) of pairs of photos that show a good deal of motion; the first few in order of their number serve.
    """
    chosen = sorted(matches, key=lambda pair: (-len(matches[pair]), pair))
    # neighbours that hardly moved fit any focal length: of the best half, those furthest apart in shooting order
    chosen = sorted(chosen[: len(chosen) // 2 + 1], key=lambda pair: (pair[0] - pair[1], pair))[:_PAIRS]
    options = pycolmap.TwoViewGeometryOptions()
    options.detect_watermark = False
    options.ransac.random_seed = 0
    options.ransac.max_error = 2.0
    explained = []
    for factor in _FACTORS:
        scaled = [_scaled(camera, factor) for camera in cameras]
        count = 0
        for i, j in chosen:
            ends = [features[n].points.astype(float) for n in (i, j)]
            lens = [scaled[camera_of[n]] for n in (i, j)]
            geometry = pycolmap.estimate_calibrated_two_view_geometry(
                lens[0], ends[0], lens[1], ends[1], matches[i, j], options
            )
            count += len(geometry.inlier_matches)
        explained.append(count)
    best = int(np.argmax(explained))
    return _FACTORS[best] if explained[best] > _BETTER * explained[0] else 1.0


def _scaled(camera: pycolmap.Camera, factor: float) -> pycolmap.Camera:
    copy = pycolmap.Camera(camera.todict())
    copy.params = [camera.params[0] * factor, *camera.params[1:]]
    return copy
