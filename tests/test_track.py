"""track.json and track.csv: read back against the performance they were made of, and their schema."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import performances
import pytest

from avatarbuild.artefacts import Blendshapes, Performance
from avatarbuild.formats.track import CSV_COLUMNS, timecode, track_csv, track_json
from avatarbuild.template import ARKIT_NAMES

DOCS = Path(__file__).parent.parent / "docs"
SCHEMA = json.loads((DOCS / "schemas" / "track.schema.json").read_text())


@cache
def played() -> Performance:
    return performances.performance(Blendshapes(np.zeros((4, 3)), np.zeros((52, 4, 3), np.float32), np.zeros((2, 3))))


def parsed(performance: Performance) -> dict[str, Any]:
    value = json.loads(track_json(performance))
    jsonschema.validate(value, SCHEMA)
    return value


def rows(performance: Performance) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(track_csv(performance).decode())))


def test_every_frame_as_it_was_tracked() -> None:
    p, value = played(), parsed(played())
    assert [frame["frame"] for frame in value["frames"]] == list(range(12))
    for i, frame in enumerate(value["frames"]):
        assert frame["time"] == pytest.approx(i / 30, abs=1e-6)
        assert tuple(frame["weights"]) == ARKIT_NAMES
        np.testing.assert_allclose(list(frame["weights"].values()), p.weights[i], atol=1e-5)
        assert frame["quality"] == p.quality[i]
        np.testing.assert_allclose([frame["eyes"]["left"], frame["eyes"]["right"]], p.gaze[i], atol=1e-5)
        assert frame["pose"][3] == [0, 0, 0, 1]
    assert value["video"] == "MOV_0001.mp4"
    assert value["fps"] == 30
    assert value["image_size"] == [100, 200]


def test_a_point_of_the_head_lands_on_the_pixel_that_opencv_says() -> None:
    """Metres and OpenCV's pixels outside, millimetres and centres at 0.5 inside: u = c + f d (x, y) / z, d of k1."""
    p, value = played(), parsed(played())
    point = np.array([30.0, -40.0, 25.0])
    for i in (0, 7):
        x, y, z = p.rotation[i] @ point + p.translation[i]
        d = 1 + p.k1 * (x * x + y * y) / z**2
        inside = np.array([50 + p.focal * d * x / z, 100 + p.focal * d * y / z])
        pose = np.array(value["frames"][i]["pose"])
        K, dist = (np.array(value["intrinsics"][key]) for key in ("K", "dist"))
        turn, shift = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]
        found = cv2.projectPoints(point[None] / 1000, turn, shift, K, dist)[0].reshape(2)
        np.testing.assert_allclose(found, inside - 0.5, atol=1e-4)


def test_the_columns_of_live_link_face() -> None:
    header = track_csv(played()).decode().splitlines()[0].split(",")
    assert tuple(header) == CSV_COLUMNS
    assert header[:3] == ["Timecode", "BlendShapeCount", "EyeBlinkLeft"]
    assert header[16:21] == ["JawForward", "JawRight", "JawLeft", "JawOpen", "MouthClose"]
    assert header[53:55] == ["TongueOut", "HeadYaw"]
    assert header[-1] == "RightEyeRoll"
    assert len(header) == 2 + 61
    assert {name[0].lower() + name[1:] for name in header[2:54]} == set(ARKIT_NAMES)


def test_the_csv_s_values() -> None:
    p, found = played(), rows(played())
    assert len(found) == 12
    for i, row in enumerate(found):
        assert row["BlendShapeCount"] == "61"
        for j, name in enumerate(ARKIT_NAMES):
            assert float(row[name[0].upper() + name[1:]]) == pytest.approx(p.weights[i, j], abs=1e-6)
        assert float(row["LeftEyeYaw"]) == pytest.approx(p.gaze[i, 0, 0], abs=1e-6)
        assert float(row["RightEyePitch"]) == pytest.approx(p.gaze[i, 1, 1], abs=1e-6)
        assert float(row["LeftEyeRoll"]) == 0
    assert [row["Timecode"] for row in found[:2]] == ["00:00:00:00.000", "00:00:00:01.000"]


@pytest.mark.parametrize(
    ("turned", "angles"),
    [  # columns: where the head's x (to its left), y (up) and z (out of the face) point in the camera's axes
        ([[0, 0, 1], [0, -1, 0], [1, 0, 0]], (np.pi / 2, 0, 0)),  # looks to its left, the picture's right
        ([[1, 0, 0], [0, 0, -1], [0, 1, 0]], (0, np.pi / 2, 0)),  # looks up
        ([[0, 1, 0], [1, 0, 0], [0, 0, -1]], (0, 0, np.pi / 2)),  # the crown at its left, the picture's right
    ],
)
def test_signs_of_the_head(turned: list[list[int]], angles: tuple[float, float, float]) -> None:
    rotation = np.tile(np.array(turned, float), (12, 1, 1))
    row = rows(dataclasses.replace(played(), rotation=rotation))[0]
    found = [float(row[f"Head{name}"]) for name in ("Yaw", "Pitch", "Roll")]
    if angles[1]:  # straight up, yaw and roll are one
        found = [0, found[1], 0]
    np.testing.assert_allclose(found, angles, atol=1e-6)


@pytest.mark.parametrize(
    ("seconds", "fps", "expected"),
    [
        (0.0, 30.0, "00:00:00:00.000"),
        (1 / 3, 30.0, "00:00:00:10.000"),
        (0.35, 30.0, "00:00:00:10.500"),
        (61 + 29.25 / 60, 60.0, "00:01:01:29.250"),
        (0.9999999, 30.0, "00:00:01:00.000"),
        (3725.0, 24.0, "01:02:05:00.000"),
    ],
)
def test_timecode(seconds: float, fps: float, expected: str) -> None:
    assert timecode(seconds, fps) == expected


@pytest.mark.parametrize("fps", [23.976, 29.97, 59.94])
def test_timecode_gives_the_time_back(fps: float) -> None:
    for seconds in np.arange(0, 90, 0.7311):
        h, m, s, frames = timecode(float(seconds), fps).split(":")
        found = 3600 * int(h) + 60 * int(m) + int(s) + float(frames) / fps
        assert found == pytest.approx(seconds, abs=0.6e-3 / fps)


def test_same_bytes_twice() -> None:
    again = performances.performance(Blendshapes(np.zeros((4, 3)), np.zeros((52, 4, 3), np.float32), np.zeros((2, 3))))
    assert track_json(again) == track_json(played())
    assert track_csv(again) == track_csv(played())
    assert b"-0.0," not in track_json(played())


def test_the_columns_are_in_the_documentation() -> None:
    text = (DOCS / "formats.md").read_text(encoding="utf-8")
    for name in ("Timecode", "BlendShapeCount", "HeadYaw", "HeadPitch", "HeadRoll", "LeftEyeYaw"):
        assert re.search(rf"`{name}`", text), name
