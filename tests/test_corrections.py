"""Points set by hand: the file, what it makes stale, how the points travel and pull."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest
from test_tracking import UPRIGHT, A, face, frame_of, state, template

from avatarbuild import options, pipeline
from avatarbuild.errors import InputError
from avatarbuild.formats.corrections import Corrections, corrections_bytes, read_corrections
from avatarbuild.project import Project
from avatarbuild.template import expression_weights
from avatarbuild.tracking import corrections, fit, neck
from avatarbuild.tracking.fit import State, Weights
from avatarbuild.tracking.markers import SKIN, Clicks

SCHEMA = json.loads((Path(__file__).parent.parent / "docs" / "schemas" / "corrections.schema.json").read_text())
TOLD = Corrections(
    {12: {48: np.array([100.5, 200.25]), 30: np.array([1.0, 2.0])}},
    {"IMG_0003": {"lipsOuterUpper": np.array([[10.5, 11.5], [12.5, 13.5]])}},
    (12, 40),
)


def test_there_and_back() -> None:
    data = corrections_bytes(TOLD)
    jsonschema.validate(json.loads(data), SCHEMA)
    assert json.loads(data)["video"]["12"]["48"] == [100.0, 199.75]  # the first pixel's centre at 0
    again = read_corrections(data, "corrections.json")
    assert corrections_bytes(again) == data
    np.testing.assert_allclose(again.video[12][48], TOLD.video[12][48])
    np.testing.assert_allclose(again.photo["IMG_0003"]["lipsOuterUpper"], TOLD.photo["IMG_0003"]["lipsOuterUpper"])


def test_points_by_name() -> None:
    said = {"version": 1, "video": {"3": {"noseTip": [4, 5]}}}
    jsonschema.validate(said, SCHEMA)
    np.testing.assert_allclose(read_corrections(json.dumps(said).encode(), "c").video[3][30], [4.5, 5.5])


@pytest.mark.parametrize(
    "said, says",
    [
        ("{", "not valid JSON"),
        ("[]", '"version": 1'),
        ('{"version": 2}', '"version": 1'),
        ('{"version": 1, "vidoe": {}}', "unknown section 'vidoe'"),
        ('{"version": 1, "video": []}', "'video' must hold an object"),
        ('{"version": 1, "video": {"-1": {"3": [1, 2]}}}', "frame '-1'"),
        ('{"version": 1, "video": {"1": {"68": [1, 2]}}}', "no point '68'"),
        ('{"version": 1, "video": {"1": {"3": [1]}}}', "expected [x, y]"),
        ('{"version": 1, "video": {"1": {"3": [1, NaN]}}}', "expected [x, y]"),
        ('{"version": 1, "photo": {"a": {"lips": [[1, 2], [3, 4]]}}}', "no such contour"),
        ('{"version": 1, "photo": {"a": {"browLeft": [1, 2]}}}', "expected a list of 2 or more [x, y]"),
        ('{"version": 1, "photo": {"a": {"browLeft": [[1, 2]]}}}', "expected a list of 2 or more [x, y]"),
        ('{"version": 1, "reviewed": [1, -1]}', "'reviewed' must be a list"),
    ],
)
def test_faults_in_one_line(said: str, says: str) -> None:
    with pytest.raises(InputError) as fault:
        read_corrections(said.encode(), "corrections.json")
    assert says in str(fault.value)
    assert "\n" not in str(fault.value)


def test_only_what_depends_on_a_section_is_stale(tmp_path: Path) -> None:
    chosen = options.stage_options("standard", {})
    before = pipeline.keys("x", "t", chosen, Corrections())
    assert before == pipeline.keys("x", "t", chosen)

    def stale(told: Corrections) -> list[str]:
        after = pipeline.keys("x", "t", chosen, told)
        return [name for name in pipeline.NAMES if after[name] != before[name]]

    assert stale(replace(TOLD, photo={})) == pipeline.NAMES[pipeline.NAMES.index("tracking") :]
    assert stale(replace(TOLD, video={})) == pipeline.NAMES[pipeline.NAMES.index("neutral") :]
    assert stale(replace(TOLD, video={}, photo={})) == []
    project = Project(tmp_path)
    assert project.corrections() == Corrections()
    project.save_corrections(TOLD)
    assert project.corrections().digest("video") == TOLD.digest("video")
    assert project.corrections().reviewed == TOLD.reviewed
    assert [path.name for path in tmp_path.iterdir()] == ["corrections.json"]


def noise(rng: np.random.Generator) -> np.ndarray:
    grey = cv2.GaussianBlur(rng.normal(0, 1, (200, 200)), (0, 0), 2.0)
    return np.clip(128 + 60 * grey / grey.std(), 0, 255).astype(np.uint8)


def test_points_ride_on_the_flow_and_fade() -> None:
    """A picture slides by (2, 1) pixels a frame; the point is set in frame 5 and, 4 pixels off, in frame 15."""
    grey = np.repeat(noise(np.random.default_rng(0))[..., None], 3, axis=2)
    times = np.arange(200) / 10
    marks = np.random.default_rng(1).uniform(40, 120, (478, 3))
    off = np.array([0.0, 4.0])

    def decode(frames: list[int]):
        for i in frames:
            shift = np.array([[1, 0, 2.0 * i], [0, 1, 1.0 * i]])
            yield i, times[i], cv2.warpAffine(grey, shift, (200, 200), borderMode=cv2.BORDER_REFLECT)

    at = np.array([80.0, 90.0])
    clicked = {5: {30: at + (10, 5)}, 15: {30: at + (30, 15) + off}}
    found = corrections.propagated(clicked, np.arange(68), times, lambda i: marks, decode)
    assert sorted(found)[:26] == list(range(26))
    assert max(found) <= 15 + 10 * corrections.REACH
    error = np.array([found[i].pixels[0] - at - (2 * i, i) for i in range(25)])
    np.testing.assert_allclose(error[5], 0, atol=0.02)
    np.testing.assert_allclose(error[15], off, atol=0.02)
    np.testing.assert_allclose(error[10], off / 2, atol=0.5)
    np.testing.assert_allclose(error[2], 0, atol=0.5)
    np.testing.assert_allclose(error[20], off, atol=0.5)
    sure = [found[i].confidence[0] for i in range(25)]
    assert sure[5] == sure[15] == 1
    assert 0.5 < sure[10] < 1
    assert sure[20] == pytest.approx(np.exp(-0.5 / corrections.FADES), abs=0.1)
    assert corrections.propagated({}, np.arange(68), times, lambda i: marks, decode) == {}


def test_neighbours_move_along() -> None:
    f = face()
    marks = np.c_[frame_of(f, state(np.zeros(A))).marks, np.zeros(478)]
    m = replace(f.markers, offset=np.tile([1.0, 0.0, 0.0], (SKIN, 1)))
    corner = int(template().landmarks68[48])
    clicks = Clicks(np.array([corner]), marks[[corner], :2] + (8.0, 0.0), np.ones(1))
    out = corrections.shifted(marks, clicks, m)
    way = out[:SKIN, 0] - marks[:SKIN, 0]
    scale = 700 / 420
    assert way[corner] == pytest.approx((8 + scale) / 1.2, rel=0.05)  # to where it should see the point: 1 mm beside
    far = int(template().landmarks68[24])
    assert abs(way[far]) < 0.1
    np.testing.assert_array_equal(out[SKIN:], marks[SKIN:])


def test_a_frame_whose_detector_is_off_is_put_right() -> None:
    f = face()
    truth = state(neck.padded(expression_weights(jawOpen=0.5, mouthSmileLeft=0.6), 0.0))
    here = frame_of(f, truth)
    marks = np.c_[here.marks, np.zeros(478)]
    mouth = np.array([*template().landmarks68[48:68]])
    near = np.linalg.norm(marks[:SKIN, None, :2] - marks[mouth, :2], axis=2).min(axis=1) < 12
    wrong = marks.copy()
    wrong[:SKIN][near, :2] += (0.0, 8.0)
    clicks = Clicks(mouth, marks[mouth, :2], np.ones(len(mouth)))
    start = State(UPRIGHT, np.array([0.0, 0.0, 450.0]), np.zeros(A))
    w = Weights()

    def error(marks_: np.ndarray, told: Clicks | None) -> float:
        frame = replace(here, marks=marks_, clicks=told)
        found = fit.fit_points(f, frame, fit.detected(f, frame, w), start, w, rigid=6, steps=15)
        posed, wanted = (f.rig.posed(s.weights) @ s.R.T + s.t for s in (found, truth))
        return float(np.linalg.norm((posed - wanted)[template().regions["lips"], :2], axis=1).mean())

    sound, hurt = error(marks, None), error(wrong, None)
    right = error(corrections.shifted(wrong, clicks, f.markers), clicks)
    assert hurt > sound + 1.5
    assert (right - sound) < 0.2 * (hurt - sound)
