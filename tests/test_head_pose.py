from __future__ import annotations

import numpy as np
import pytest
from captures import benchmark_photo
from scipy.spatial.transform import Rotation

from avatarbuild.geometry.head_pose import head_angles, head_pose
from avatarbuild.landmarks import canonical_face, find_faces

FACING = np.diag([1.0, -1.0, -1.0])


def test_a_head_that_faces_the_camera_has_no_angles() -> None:
    assert np.allclose(head_angles(FACING), 0.0)


@pytest.mark.parametrize(
    "axis, degrees, expected",
    [
        ("y", 30.0, [30.0, 0.0, 0.0]),  # a turn about the upward axis takes the nose to the subject's left
        ("x", -20.0, [0.0, 20.0, 0.0]),  # nose up
        ("z", -10.0, [0.0, 0.0, 10.0]),  # crown to the subject's left
    ],
)
def test_signs(axis: str, degrees: float, expected: list[float]) -> None:
    turned = FACING @ Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    assert np.allclose(head_angles(turned), expected)


def test_angles_are_relative_to_the_line_to_the_head() -> None:
    """A head at the picture's edge that is turned to the camera has no angles; one that is not has them."""
    line = np.array([0.5, 0.0, 1.0])
    off = np.degrees(np.arctan(0.5))
    to_camera = FACING @ Rotation.from_euler("y", -off, degrees=True).as_matrix()
    assert np.allclose(head_angles(to_camera, line), 0.0, atol=1e-9)
    assert np.isclose(head_angles(FACING, line)[0], off)


def test_a_turned_scaled_moved_face_is_recovered() -> None:
    rng = np.random.default_rng(0)
    mean = canonical_face()
    for rotation in Rotation.random(20, random_state=1).as_matrix():
        scale, shift = rng.uniform(0.2, 8.0), rng.normal(0, 500, 3)
        seen = scale * mean.points @ rotation.T + shift
        pose = head_pose(mean.points, mean.rigidity, seen)
        assert np.allclose(pose.rotation, rotation, atol=1e-9)
        assert np.isclose(pose.scale, scale)
        assert pose.misfit < 1e-6
    w = mean.rigidity / mean.rigidity.sum()
    assert np.allclose(pose.middle, (scale * (w @ mean.points) @ rotation.T + shift)[:2])


def test_noise_moves_the_pose_a_little_and_shows_as_misfit() -> None:
    rng = np.random.default_rng(2)
    mean = canonical_face()
    pose = head_pose(mean.points, mean.rigidity, mean.points @ FACING.T + rng.normal(0, 2.0, mean.points.shape))
    off = np.abs(head_angles(pose.rotation))
    assert 0.0 < off.max() < 3.0
    assert 2.0 < pose.misfit < 4.5  # sqrt(3) * 2 mm, by 33 points


@pytest.mark.parametrize("number, yaw", [(15, 8.7), (9, 44.6), (24, -44.3)])
def test_a_photo_of_known_pose(number: int, yaw: float) -> None:
    mean = canonical_face()
    (face,) = find_faces(benchmark_photo(number))
    pose = head_pose(mean.points, mean.rigidity, face.points[:468])
    assert abs(head_angles(pose.rotation)[0] - yaw) < 4.0
