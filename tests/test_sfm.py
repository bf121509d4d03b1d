"""Structure from motion on made-up features of a known scene: a head-sized cloud in front of a room."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from avatarbuild.geometry.similarity import similarity
from avatarbuild.sfm import focal, head, matching, metric
from avatarbuild.sfm.features import Features, extract
from avatarbuild.sfm.mapping import map_photos, regrow

SIZE, FOCAL, NOISE = (1000, 1300), 1000.0, 0.3


@dataclass(frozen=True)
class Scene:
    """k photos of n points: features, their point numbers, true poses; the head's points come first."""

    features: list[Features]
    points_of: list[np.ndarray]
    rotations: np.ndarray
    centres: np.ndarray
    points: np.ndarray
    on_head: int


def scene(photos: int = 10, turn: float = 0.0, seed: int = 0) -> Scene:
    """Photos on a quarter circle; the head turns by up to `turn` degrees from one photo to the next."""
    rng = np.random.default_rng(seed)
    head_points = rng.normal(size=(900, 3))
    head_points *= np.array([70, 95, 80]) / np.linalg.norm(head_points, axis=1, keepdims=True)
    room = rng.uniform([-1500, -900, -1500], [1500, 900, -700], (1500, 3))
    points = np.concatenate([head_points, room])
    codes = rng.integers(0, 120, (len(points), 128))
    features, points_of, rotations, centres = [], [], [], []
    for i, angle in enumerate(np.radians(np.linspace(-50, 50, photos))):
        centre = 430 * np.array([np.sin(angle), 0.1 * np.sin(3 * angle), np.cos(angle)])
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0.0, -1.0, 0.0], z)
        x /= np.linalg.norm(x)
        rotation = Rotation.from_rotvec(rng.normal(size=3) * 0.03).as_matrix() @ np.stack([x, np.cross(z, x), z])
        moved = points.copy()
        spin = Rotation.from_euler("y", turn * (-1) ** i, degrees=True).as_matrix()
        moved[: len(head_points)] = head_points @ spin.T
        cam = (moved - centre) @ rotation.T
        pixels = FOCAL * cam[:, :2] / cam[:, 2:] + np.array(SIZE) / 2 + rng.normal(size=(len(points), 2)) * NOISE
        facing = np.ones(len(points), bool)
        facing[: len(head_points)] = ((moved - centre) * moved)[: len(head_points)].sum(axis=1) < 0
        middle = FOCAL * (-centre @ rotation.T)[:2] / (-centre @ rotation.T)[2] + np.array(SIZE) / 2
        behind = np.linalg.norm((pixels - middle) / (0.2 * FOCAL, 0.25 * FOCAL), axis=1) < 1
        behind[: len(head_points)] = False
        seen = facing & ~behind & (cam[:, 2] > 50) & (pixels > 0).all(axis=1) & (pixels < SIZE).all(axis=1)
        number = rng.permutation(np.flatnonzero(seen))
        descriptors = np.clip(codes[number] + rng.integers(-12, 13, (len(number), 128)), 0, 255).astype(np.uint8)
        features.append(Features(pixels[number].astype(np.float32), np.full(len(number), 2.0, np.float32), descriptors))
        points_of.append(number)
        rotations.append(rotation)
        centres.append(centre)
    return Scene(features, points_of, np.array(rotations), np.array(centres), points, len(head_points))


def lens(factor: float = 1.0) -> pycolmap.Camera:
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.SIMPLE_RADIAL, FOCAL * factor, *SIZE)
    camera.has_prior_focal_length = True
    return camera


def all_matches(s: Scene) -> dict[tuple[int, int], np.ndarray]:
    units = [matching.unit_descriptors(f.descriptors) for f in s.features]
    k = len(units)
    found = {(i, j): matching.match(units[i], units[j]) for i in range(k) for j in range(i + 1, k)}
    return {pair: m for pair, m in found.items() if len(m) >= 15}


def solve(s: Scene, claimed: float = 1.03) -> pycolmap.Reconstruction:
    camera = lens(claimed)
    pairs = {
        (i, j): matching.verify(s.features[i], s.features[j], m, (camera, camera))
        for (i, j), m in all_matches(s).items()
    }
    names = [f"{i:02d}.jpg" for i in range(len(s.features))]
    return map_photos(names, s.features, [camera], np.zeros(len(names), int), pairs, lambda: None)[0]


def test_match_agrees_with_the_slow_way() -> None:
    rng = np.random.default_rng(3)
    base = rng.integers(0, 255, (40, 128))
    a = matching.unit_descriptors(np.clip(base + rng.integers(-30, 30, base.shape), 0, 255).astype(np.uint8))
    b = matching.unit_descriptors(np.clip(base[::-1] + rng.integers(-30, 30, base.shape), 0, 255).astype(np.uint8))
    angles = np.arccos(np.clip(a.astype(float) @ b.T.astype(float), -1, 1))
    expected = []
    for i, row in enumerate(angles):
        j = int(row.argmin())
        second = np.sort(row)[1]
        if angles[:, j].argmin() == i and row[j] < 0.7 and row[j] < 0.8 * second:
            expected.append((i, j))
    assert len(expected) > 20
    np.testing.assert_array_equal(matching.match(a, b), expected)
    assert len(matching.match(a[:1], b)) == 0


def test_pairs_of_small_and_large_sets() -> None:
    assert len(matching.choose_pairs(np.zeros((5, 5), int), 2, 2, 10)) == 10
    alike = np.zeros((30, 30), int)
    alike[0, 20] = alike[20, 0] = 50
    pairs = matching.choose_pairs(alike, 2, 3, 10)
    assert (0, 20) in pairs
    assert (0, 2) in pairs
    assert (0, 3) not in pairs
    assert len(pairs) == 28 * 2 + 1 + 1


@pytest.fixture(scope="module")
def solved() -> tuple[Scene, pycolmap.Reconstruction]:
    s = scene()
    return s, solve(s)


def test_places_every_photo(solved: tuple[Scene, pycolmap.Reconstruction]) -> None:
    s, model = solved
    placed = metric.placed_photos(model, [f"{i:02d}.jpg" for i in range(10)])
    assert len(placed.index) == 10
    scale, rotation, t = similarity(placed.centres, s.centres)
    error = np.linalg.norm(scale * placed.centres @ rotation.T + t - s.centres, axis=1)
    assert 0.005 < np.sqrt((error**2).mean()) < 1.0
    assert abs(model.cameras[1].mean_focal_length() / FOCAL - 1) < 0.01


def test_known_length_gives_the_scale(solved: tuple[Scene, pycolmap.Reconstruction]) -> None:
    s, model = solved
    placed = metric.placed_photos(model, [f"{i:02d}.jpg" for i in range(10)])
    a, b = np.array([-40.0, 20, 75]), np.array([45.0, 10, 70])
    rng = np.random.default_rng(5)
    ends = []
    for i in (3, 5, 6):
        flat = (np.stack([a, b]) - s.centres[i]) @ s.rotations[i].T
        pixels = FOCAL * flat[:, :2] / flat[:, 2:] + np.array(SIZE) / 2 + rng.normal(size=(2, 2)) * 0.3
        ends.append((i, pixels[0], pixels[1]))
    found = metric.known_length(placed, ends)
    assert found is not None
    truth = similarity(placed.centres, s.centres)[0]
    assert abs(np.linalg.norm(a - b) / found[0] / truth - 1) < 0.005
    assert 0 < found[1] < 0.02
    assert metric.known_length(placed, ends[:1]) is None


def test_the_same_model_twice() -> None:
    s = scene(6, seed=2)
    one, two = solve(s), solve(s)
    for i in one.images:
        np.testing.assert_array_equal(one.images[i].cam_from_world().matrix(), two.images[i].cam_from_world().matrix())


@pytest.mark.parametrize("claimed", [0.5, 2.0])
def test_a_wrong_focal_length_is_put_right(claimed: float) -> None:
    s = scene(8, seed=4)
    assert abs(solve(s, claimed).cameras[1].mean_focal_length() / FOCAL - 1) < 0.01


def off_the_head(s: Scene, model: pycolmap.Reconstruction, turn: float) -> float:
    """RMSE (mm) of the cameras as a head that keeps still would see them, where it turned by `turn` degrees."""
    placed = metric.placed_photos(model, [f"{i:02d}.jpg" for i in range(len(s.features))])
    assert len(placed.index) == len(s.features)
    angles = turn * (-1.0) ** np.arange(len(s.features))
    still = np.array([c @ Rotation.from_euler("y", a, degrees=True).as_matrix() for c, a in zip(s.centres, angles)])
    scale, rotation, t = similarity(placed.centres, still)
    return float(np.sqrt((np.linalg.norm(scale * placed.centres @ rotation.T + t - still, axis=1) ** 2).mean()))


@pytest.mark.parametrize("turn", [0.0, 0.5, 4.0])
def test_a_head_that_turns_against_the_room_is_noticed(turn: float) -> None:
    s = scene(8, turn=turn, seed=6)
    model = solve(s)
    settled = head.settle(model, {f"{i:02d}.jpg": number < s.on_head for i, number in enumerate(s.points_of)})
    assert settled is not None
    assert settled.head_moved == (turn > 0)
    assert 0.1 < settled.after < 0.5
    if turn == 0.5:
        assert off_the_head(s, settled.model, turn) < 1.0
    if turn == 4.0:
        on_head = {
            (i, j): m[(s.points_of[i][m[:, 0]] < s.on_head) & (s.points_of[j][m[:, 1]] < s.on_head)]
            for (i, j), m in all_matches(s).items()
        }
        pairs = {
            (i, j): matching.verify(s.features[i], s.features[j], m, (lens(), lens()))
            for (i, j), m in on_head.items()
            if len(m) >= 15
        }
        names = [f"{i:02d}.jpg" for i in range(len(s.features))]
        assert off_the_head(s, model, turn) > 5.0
        assert 0.01 < off_the_head(s, regrow(model, names, s.features, np.zeros(8, int), pairs), turn) < 1.0


def test_photos_without_landmarks_take_the_head_from_their_neighbours() -> None:
    s = scene(6, seed=7)
    landmarks = np.full((6, 478, 3), np.nan)
    for i in (1, 2, 3):
        own = s.features[i].points[s.points_of[i] < s.on_head]
        landmarks[i, :, :2] = own[np.arange(478) % len(own)]
        landmarks[i, :, 2] = 0
    heads = head.head_features(s.features, landmarks, all_matches(s))
    for found, number in zip(heads, s.points_of):
        truth = number < s.on_head
        assert (found & truth).sum() / truth.sum() > 0.75
        assert (found & truth).sum() / found.sum() > 0.8


def test_features_do_not_depend_on_the_number_of_threads() -> None:
    rng = np.random.default_rng(0)
    images = [
        np.clip(rng.normal(128, 60, (60, 80)), 0, 255).astype(np.uint8).repeat(4, 0).repeat(4, 1) for _ in range(3)
    ]
    found = list(extract(iter(images), 500))
    alone = [next(extract(iter([image]), 500)) for image in images]
    for a, b in zip(found, alone):
        assert 20 < len(a) <= 500
        np.testing.assert_array_equal(a.points, b.points)
        np.testing.assert_array_equal(a.descriptors, b.descriptors)
        assert (np.diff(a.scales) <= 0).all()


def test_a_dolly_zoom_keeps_the_size_of_what_stands_midway(solved: tuple[Scene, pycolmap.Reconstruction]) -> None:
    _, model = solved
    few = focal._fewer(model)
    zoomed = focal._dolly_zoom(few, 1.4)
    assert len(few.points3D) < len(model.points3D)
    for number in few.reg_image_ids():
        seen = [few.points3D[p.point3D_id].xyz for p in few.images[number].points2D if p.has_point3D()]
        assert len(seen) >= 60
        before, after = (m.images[number].cam_from_world() for m in (few, zoomed))
        np.testing.assert_array_equal(before.rotation.matrix(), after.rotation.matrix())
        depth = [np.median(np.array(seen) @ p.rotation.matrix()[2] + p.translation[2]) for p in (before, after)]
        lengths = [m.cameras[1].mean_focal_length() for m in (few, zoomed)]
        assert lengths[1] / depth[1] == pytest.approx(lengths[0] / depth[0])


def test_the_right_focal_length_asks_for_no_other(solved: tuple[Scene, pycolmap.Reconstruction]) -> None:
    _, model = solved
    before = model.cameras[1].params.tolist()
    assert not focal.longer_fits(model)
    assert model.cameras[1].params.tolist() == before


def test_python_s_zlib_works_beside_pycolmap() -> None:
    code = "import avatarbuild, pycolmap, zlib\nfor i in range(200):\n    zlib.compress(bytes(5000 * i))\n"
    code += "    c = zlib.compressobj(); c.compress(bytes(5000 * i)); c.flush()"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_colmap_leaves_no_log_in_the_folder_of_temporary_files(tmp_path: Path) -> None:
    program = "import avatarbuild, pycolmap; pycolmap.logging.info('a'); pycolmap.logging.error('b')"
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, check=True)
    assert run.stderr == b""
    assert list(tmp_path.iterdir()) == []
