"""A simulated capture from photos to cloud, against its truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import igl
import numpy as np
import pytest
import synthetic

from avatarbuild.artefacts import Cameras, Capture
from avatarbuild.geometry.similarity import similarity
from avatarbuild.options import CamerasOptions, CaptureOptions, PointsOptions
from avatarbuild.progress import Silent
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.stages import cameras, capture, points


def aligned(model: Cameras, taken: Capture, truth: synthetic.Truth) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """The similarity from the model to the truth's world, and the distances (mm) of the camera centres after it."""
    placed = placed_photos(model.model, [f"{name}.jpg" for name in taken.photos.names])
    true = {Path(name).stem: camera for name, camera in truth.cameras.items()}
    found = [true[taken.photos.names[i]] for i in placed.index]
    centres = np.array([camera.centre for camera in found])
    s, r, t = similarity(placed.centres, centres)
    return s, r, t, np.linalg.norm(s * placed.centres @ r.T + t - centres, axis=1)


@pytest.fixture(scope="module")
def solved() -> tuple[Path, Capture, Cameras]:
    folder = synthetic.capture(5, photos=18, photo_width=480)
    taken = capture.run(folder, CaptureOptions(), Silent())
    return folder, taken, cameras.run(taken, CamerasOptions(), Silent())


def test_cameras(solved: tuple[Path, Capture, Cameras]) -> None:
    folder, taken, model = solved
    truth = synthetic.truth(folder)
    assert taken.face
    s, r, _, error = aligned(model, taken, truth)
    assert len(error) >= 15
    assert 0.01 < np.sqrt((error**2).mean()) < 2.0
    assert abs(s - 1) < 0.15  # an iris of 11.7 mm is a guess
    assert np.degrees(np.arccos(np.clip((np.trace(r) - 1) / 2, -1, 1))) < 12  # the head frame, from landmarks
    assert model.metric
    assert model.scale["source"] in ("iris", "mean face")


def test_a_known_length_gives_millimetres(solved: tuple[Path, Capture, Cameras]) -> None:
    folder, taken, _ = solved
    truth = synthetic.truth(folder)
    corners = truth.neutral[truth.landmarks68[[36, 45]]]
    ends = []
    for i, name in enumerate(taken.photos.names):
        camera = {Path(n).stem: c for n, c in truth.cameras.items()}[name]
        if abs(taken.photos.pose[i, 0]) < 35:
            a, b = camera.project(corners)[0]
            ends.append({"photo": name, "a": a.tolist(), "b": b.tolist()})
    known = {"mm": float(np.linalg.norm(corners[0] - corners[1])), "points": ends}
    told = replace(taken, settings={"known_length": known})
    model = cameras.run(told, CamerasOptions(), Silent())
    assert model.scale["source"] == "known length"
    s, _, _, _ = aligned(model, taken, truth)
    assert abs(s - 1) < 0.01


def test_cloud(solved: tuple[Path, Capture, Cameras]) -> None:
    folder, taken, model = solved
    truth = synthetic.truth(folder)
    s, r, t, _ = aligned(model, taken, truth)
    cloud = points.run(taken, model, PointsOptions(min_views=2), Silent())
    assert len(cloud.points) > 3000
    there = s * cloud.points.astype(float) @ r.T + t
    nose = truth.neutral[truth.landmarks68[30]]
    face = there[np.linalg.norm(there - nose, axis=1) < 80]
    sample = face[np.random.default_rng(0).choice(len(face), 2000)]
    distance = np.sqrt(igl.point_mesh_squared_distance(sample, truth.neutral, truth.triangles.astype(np.int64))[0])
    assert 0.02 < np.median(distance) < 1.2
    assert np.quantile(distance, 0.9) < 4.0


@pytest.mark.slow
def test_half_the_true_focal_length_in_exif(solved: tuple[Path, Capture, Cameras]) -> None:
    _, taken, model = solved
    wrong = replace(taken, photos=replace(taken.photos, focal=taken.photos.focal / 2))
    again = cameras.run(wrong, CamerasOptions(), Silent())
    lengths = [m.model.cameras[1].mean_focal_length() for m in (model, again)]
    assert abs(lengths[1] / lengths[0] - 1) < 0.02
    assert "EXIF" in " ".join(again.warnings)


@pytest.mark.slow
def test_somebody_else_in_the_photos() -> None:
    folder = synthetic.capture(7, photos=18, photo_width=480, second_person=True)
    taken = capture.run(folder, CaptureOptions(), Silent())
    alone = capture.run(synthetic.capture(7, photos=18, photo_width=480), CaptureOptions(), Silent())
    assert taken.face
    both = np.isfinite(taken.photos.presence) & np.isfinite(alone.photos.presence)
    nose = [views.landmarks[both, 4, :2] for views in (taken.photos, alone.photos)]
    assert np.median(np.linalg.norm(nose[0] - nose[1], axis=1)) < 5
    assert "person" in " ".join(taken.warnings)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_head_that_turns_against_the_room() -> None:
    folder = synthetic.capture(6, photos=16, photo_width=720, head_turn=2.5)
    truth = synthetic.truth(folder)
    taken = capture.run(folder, CaptureOptions(), Silent())
    models = {which: cameras.run(taken, CamerasOptions(features=which), Silent()) for which in ("auto", "all")}
    errors = {which: np.sqrt((aligned(model, taken, truth)[3] ** 2).mean()) for which, model in models.items()}
    assert "the head turned" in " ".join(models["auto"].warnings)
    assert errors["auto"] < errors["all"]
