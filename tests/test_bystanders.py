from __future__ import annotations

import cv2
import numpy as np
import pytest
from captures import benchmark_photo

from avatarbuild import faces
from avatarbuild.bystanders import further_faces
from avatarbuild.landmarks import face_size, find_faces


@pytest.fixture(scope="module")
def somebody_behind() -> np.ndarray:
    """A photo of a face, with a face of a third its size over the wall."""
    rgb = benchmark_photo(15).copy()
    (face,) = find_faces(benchmark_photo(18))
    points = face.points[:, :2]
    low, high = points.min(0).astype(int), points.max(0).astype(int)
    part = benchmark_photo(18)[low[1] - 40 : high[1] + 20, low[0] - 30 : high[0] + 30]
    part = cv2.resize(part, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA)
    rgb[: part.shape[0], : part.shape[1]] = part
    return rgb


def test_somebody_behind_the_subject_is_found(somebody_behind: np.ndarray) -> None:
    seen = find_faces(somebody_behind)
    assert len(seen) == 1
    (other,) = further_faces(somebody_behind, seen, 0.9)
    assert 0.3 < face_size(other.points) / face_size(seen[0].points) < 0.6
    assert other.points[:468, 0].mean() < seen[0].points[:468, 0].mean()

    look = faces.look(somebody_behind, 0.9, further=True)
    assert faces.follow([look], 0.9, continuous=False) == [0]
    assert faces.others(look, 0, 0.9) == 1
    assert faces.others(faces.look(somebody_behind, 0.9), 0, 0.9) == 0


def test_nobody_is_found_where_nobody_is() -> None:
    for number in (5, 15, 16):
        rgb = benchmark_photo(number)
        assert further_faces(rgb, find_faces(rgb), 0.7) == []
