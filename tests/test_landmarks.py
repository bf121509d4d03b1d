from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from captures import benchmark_photo
from media import texture

from avatarbuild import landmarks
from avatarbuild.landmarks import Region, canonical_face, crop, detect, find_faces, mirror, region_about
from avatarbuild.template import ARKIT_NAMES

RNG = np.random.default_rng(5)


def flat_face() -> np.ndarray:
    points = canonical_face().points
    return np.r_[points, points[:10]] * (1.0, -1.0, -1.0) + (200.0, 300.0, 0.0)


def test_the_mean_face_is_a_face_in_millimetres() -> None:
    points, rigidity = canonical_face()
    assert points.shape == (468, 3)
    assert 80 < np.linalg.norm(points[33] - points[263]) < 100  # outer eye corners
    assert points[263, 0] > 0  # the subject's left eye at positive x
    assert points[4, 2] == points[:, 2].max()  # the nose's tip
    assert points[152, 1] < points[10, 1]  # the chin below the forehead
    assert (rigidity > 0).sum() == 33


def test_mirror_undoes_itself_and_mirrors_the_mean_face() -> None:
    twin = mirror()
    assert np.array_equal(twin[twin], np.arange(478))
    assert np.allclose(canonical_face().points[twin[:468]], canonical_face().points * (-1, 1, 1), atol=1e-4)
    assert mirror()[33] == 263


def test_every_expression_but_the_tongue_has_a_score() -> None:
    assert sorted(landmarks._SCORE_COLUMNS) == [i for i, name in enumerate(ARKIT_NAMES) if name != "tongueOut"]
    assert len(landmarks._SCORED_POINTS) == 146


def test_anchors_by_hand() -> None:
    anchors = landmarks._anchors()
    assert anchors.shape == (896, 2)
    assert anchors[:3].tolist() == [[4, 4], [4, 4], [12, 4]]
    assert anchors[512:519].tolist() == [[8, 8]] * 6 + [[24, 8]]


def test_the_region_turns_and_scales_with_the_points() -> None:
    points = flat_face()
    region = region_about(points)
    angle, factor, shift = 0.4, 1.7, np.array([31.0, -12.0])
    moved = points.copy()
    moved[:, :2] = points[:, :2] @ landmarks._rotation(angle).T * factor + shift
    again = region_about(moved)
    assert np.isclose(again.turn, region.turn + angle)
    assert np.isclose(again.side, region.side * factor)
    assert np.allclose(again.centre, landmarks._rotation(angle) @ region.centre * factor + shift)


def test_a_crop_of_the_whole_is_the_whole() -> None:
    rgb = texture(64, 64)
    same, to_picture = crop(rgb, Region(np.array([32.0, 32.0]), 64.0, 0.0), 64)
    assert np.array_equal(same, rgb)
    assert np.allclose(to_picture, [[1, 0, 0], [0, 1, 0]])


def test_a_crop_maps_its_pixels_to_the_picture() -> None:
    """A bright spot stands where the map says, turned and reduced, with the first pixel's centre at 0.5."""
    for side, turn in ((100.0, 0.0), (90.0, 0.5), (900.0, -0.3)):
        rgb = np.zeros((1000, 1000, 3), np.uint8)
        y, x = np.mgrid[:1000, :1000] + 0.5
        at, width = np.array([520.0, 470.0]), side / 20
        spot = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * width**2))
        rgb[:] = (255 * spot)[..., None].astype(np.uint8)
        small, to_picture = crop(rgb, Region(np.array([500.0, 480.0]), side, turn), 128)
        weight = small[..., 0].astype(float)
        v, u = np.mgrid[:128, :128] + 0.5
        found = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
        assert np.allclose(to_picture[:, :2] @ found + to_picture[:, 2], at, atol=0.004 * side)


def test_no_face_in_noise_and_in_nothing() -> None:
    assert not [face for face in find_faces(texture(300, 200)) if face.presence > 0.9]
    assert detect(np.zeros((50, 80, 3), np.uint8)) == []
    assert find_faces(np.zeros((1, 1, 3), np.uint8)) == []


def test_networks_are_read_one_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV's reader is not safe beside another one: it may say that it knows no operator of the network."""
    readers: list[int] = []
    most = []

    def read(*_: object, **__: object) -> None:
        readers.append(0)
        most.append(len(readers))
        time.sleep(0.01)
        readers.pop()

    monkeypatch.setattr(landmarks.cv2.dnn, "readNetFromTFLite", read)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: landmarks._load(), range(4)))
    assert len(most) == 12
    assert max(most) == 1


def test_threads_find_the_same_bits() -> None:
    region = Region(np.array([150.0, 100.0]), 180.0, 0.1)
    pictures = [texture(300, 200, seed=i % 2) for i in range(6)]
    with ThreadPoolExecutor(3) as pool:
        points = list(pool.map(lambda rgb: landmarks.trace(rgb, region).points, pictures))
    assert all(np.array_equal(points[i], points[i % 2]) for i in range(6))


def test_a_face_is_found_and_follows_the_picture() -> None:
    """The same points, moved along, when the picture is mirrored, padded or halved."""
    rgb = benchmark_photo(15)
    (face,) = find_faces(rgb)
    eyes = np.linalg.norm(face.points[33, :2] - face.points[263, :2])
    assert face.presence > 0.99
    assert np.isnan(face.scores[51])
    assert ((face.scores[:51] >= 0) & (face.scores[:51] <= 1)).all()

    (flipped,) = find_faces(np.ascontiguousarray(rgb[:, ::-1]))
    back = flipped.points[mirror()] * (-1, 1, 1) + (rgb.shape[1], 0, 0)
    assert np.linalg.norm((back - face.points)[:, :2], axis=1).mean() < 0.01 * eyes

    (moved,) = find_faces(np.pad(rgb, ((40, 0), (60, 0), (0, 0))))
    assert np.linalg.norm((moved.points - face.points)[:, :2] - (60, 40), axis=1).mean() < 0.01 * eyes

    half = rgb[: rgb.shape[0] // 2 * 2, : rgb.shape[1] // 2 * 2]
    half = half.reshape(half.shape[0] // 2, 2, half.shape[1] // 2, 2, 3).mean((1, 3)).astype(np.uint8)
    (small,) = find_faces(half)
    assert np.linalg.norm((2 * small.points - face.points)[:, :2], axis=1).mean() < 0.015 * eyes


def test_a_small_face_in_a_large_picture_is_found() -> None:
    rgb = benchmark_photo(15)
    canvas = texture(rgb.shape[1] * 5, rgb.shape[0] * 4)
    at = (int(2.2 * rgb.shape[1]), rgb.shape[0])
    canvas[at[1] : at[1] + rgb.shape[0], at[0] : at[0] + rgb.shape[1]] = rgb
    (face,) = find_faces(rgb)
    found = [f for f in find_faces(canvas) if f.presence > 0.9]
    assert len(found) == 1
    eyes = np.linalg.norm(face.points[33, :2] - face.points[263, :2])
    assert np.linalg.norm((found[0].points - face.points)[:, :2] - at, axis=1).mean() < 0.02 * eyes
