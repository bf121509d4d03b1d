from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from captures import EVEN_LIGHT, darker, face_at, look_of

from avatarbuild.capture_folder import CaptureFolder
from avatarbuild.faces import Candidate, Look
from avatarbuild.formats.images import PhotoFacts
from avatarbuild.judgement import GOOD, RESHOOT, USABLE, Finding, has_face, judge, neutral
from avatarbuild.survey import Shot, Survey, survey_frames, survey_photos
from avatarbuild.template import ARKIT_NAMES

RNG = np.random.default_rng(4)
PORTRAIT = RNG.normal(0, 0.1, (96, 96)).astype(np.float32)
FOLDER = CaptureFolder(Path("c"), [], [], {})
YAWS = np.linspace(-75, 75, 51)
JAW = ARKIT_NAMES.index("jawOpen")
BLINKS = [ARKIT_NAMES.index("eyeBlinkLeft"), ARKIT_NAMES.index("eyeBlinkRight")]


def sweep(**changes: object) -> list[Candidate]:
    """A good capture: a half circle, with a row from above and one from below."""
    faces = [face_at(yaw=y, portrait=PORTRAIT if abs(y) < 25 else None, **changes) for y in YAWS]  # type: ignore[arg-type]
    return faces + [face_at(yaw=y, pitch=p, **changes) for p in (-20, 20) for y in (-40, -20, 0, 20, 40)]  # type: ignore[arg-type]


def photos_of(looks: list[Look], focal: float = 150.0) -> Survey:
    facts = PhotoFacts((200, 200), focal, "", np.nan, "", "one lens", None, "")
    shots = [Shot(Path(f"p{i:02d}.jpg"), facts, (200, 200), focal, look, b"") for i, look in enumerate(looks)]
    return survey_photos(shots, 0.9, {})


def frames_of(looks: list[Look], photos: Survey) -> Survey:
    k = len(looks)
    times = np.arange(k) / 3.0
    return survey_frames(Path("v.mp4"), list(range(k)), times, looks, [b""] * k, photos.identity, 150.0, 0.9)


def lines(photos: Survey, frames: Survey | None = None, seconds: float = 30.0) -> dict[str, Finding]:
    return {f.name: f for f in judge(photos, frames, seconds, FOLDER, 0.9, 60.0)}


def test_a_good_capture_is_good() -> None:
    photos = photos_of([look_of(face) for face in sweep()])
    found = lines(photos)
    assert {f.verdict for name, f in found.items() if name != "video"} == {GOOD}
    assert has_face(photos, 0.9, 60.0)
    trusted = photos.views.trusted(0.9, 60.0)
    assert neutral(photos.views, trusted).tolist() == trusted.tolist()
    assert all(f.advice == "" for f in found.values() if f.verdict == GOOD)


@pytest.mark.parametrize("faces, photos, expected", [(7, 10, False), (8, 32, True), (8, 33, False), (0, 20, False)])
def test_a_face_needs_eight_photos_and_a_quarter(faces: int, photos: int, expected: bool) -> None:
    looks = [look_of(face_at())] * faces + [look_of()] * (photos - faces)
    assert has_face(photos_of(looks), 0.9, 60.0) is expected


def test_lacking_directions_are_named_as_the_subjects_sides() -> None:
    """Who looks to their left (positive yaw) shows the right side."""
    photos = photos_of([look_of(face) for face in sweep() if not 10 < face.pose[0] < 50])
    found = lines(photos)["yaw coverage"]
    assert found.verdict == USABLE
    assert found.values["lacking"] == [[15.0, 30.0], [30.0, 45.0]]
    assert "their right side at 15-30 degrees" in found.found
    one_sided = lines(photos_of([look_of(face) for face in sweep() if face.pose[0] < 5]))["yaw coverage"]
    assert one_sided.verdict == RESHOOT
    assert "the profile of their right side" in one_sided.found


def test_no_rows_from_above_or_below() -> None:
    found = lines(photos_of([look_of(face) for face in sweep() if face.pose[1] > -5]))["pitch coverage"]
    assert (found.verdict, found.values) == (USABLE, {"above": 0, "below": 5})


@pytest.mark.parametrize(
    "name, change",
    [
        ("blur", {"measures": EVEN_LIGHT._replace(blur=1.6)}),
        ("exposure", {"measures": darker(2.0)}),
        ("white balance", {"measures": EVEN_LIGHT._replace(white_balance=np.array([0.1, -0.4]))}),
        ("expression", {"scores": {JAW: 0.8}}),
        ("eyes", {"scores": {BLINKS[0]: 0.9, BLINKS[1]: 0.9}}),
    ],
)
def test_every_third_photo_is_off(name: str, change: dict) -> None:
    good, bad = sweep(), sweep(**change)
    photos = photos_of([look_of(b if i % 3 == 0 else g) for i, (g, b) in enumerate(zip(good, bad))])
    assert lines(photos)[name].verdict != GOOD
    if name in ("expression", "eyes"):
        trusted = photos.views.trusted(0.9, 60.0)
        assert neutral(photos.views, trusted).tolist() == [bool(t and i % 3) for i, t in enumerate(trusted)]


@pytest.mark.parametrize(
    "name, change, verdict",
    [
        ("face size", {"resolution": 1.5}, USABLE),
        ("light", {"measures": EVEN_LIGHT._replace(side_light=1.5)}, USABLE),
        ("light", {"measures": EVEN_LIGHT._replace(side_light=-3.0)}, RESHOOT),
        ("light", {"measures": EVEN_LIGHT._replace(contrast=3.0)}, RESHOOT),
        ("exposure", {"measures": EVEN_LIGHT._replace(clipped=0.2)}, RESHOOT),
        ("expression", {"scores": {JAW: 0.8}}, USABLE),
    ],
)
def test_all_photos_are_off(name: str, change: dict, verdict: str) -> None:
    photos = photos_of([look_of(face) for face in sweep(**change)])
    assert lines(photos)[name].verdict == verdict


def test_somebody_else_in_the_background() -> None:
    looks = [look_of(face) for face in sweep()]
    looks[7] = look_of(looks[7].faces[0], face_at(x=30, size=50))
    found = lines(photos_of(looks))["other people in photos"]
    assert (found.verdict, found.values["pictures"]) == (USABLE, ["p07"])


def test_an_assumed_lens_is_told() -> None:
    found = lines(photos_of([look_of(face) for face in sweep()], focal=np.nan))["lens"]
    assert (found.verdict, found.values["assumed"]) == (USABLE, 61)


def test_no_video_a_short_one_and_a_long_one() -> None:
    photos = photos_of([look_of(face) for face in sweep()])
    assert lines(photos)["video"].verdict == USABLE
    frames = frames_of([look_of(face_at(portrait=PORTRAIT))] * 30, photos)
    assert lines(photos, frames, 3.0)["video"].verdict == RESHOOT
    assert lines(photos, frames, 13.0)["video"].verdict == USABLE
    assert lines(photos, frames, 40.0)["video"].verdict == GOOD


def test_a_mirrored_video_and_another_person_in_it() -> None:
    photos = photos_of([look_of(face) for face in sweep()])
    symmetric = (PORTRAIT + PORTRAIT[:, ::-1]) / 2
    mostly = np.ascontiguousarray(PORTRAIT[:, ::-1]) * 0.5 + symmetric * 0.5
    found = lines(photos, frames_of([look_of(face_at(portrait=mostly))] * 30, photos))
    assert found["mirrored"].verdict == RESHOOT
    assert found["person in video"].verdict == GOOD
    stranger = face_at(portrait=RNG.normal(0, 0.1, (96, 96)).astype(np.float32))
    stranger = Candidate(**{**vars(stranger), "shape": stranger.shape + RNG.normal(0, 3.0, (33, 3))})
    found = lines(photos, frames_of([look_of(stranger)] * 30, photos))
    assert found["mirrored"].verdict == GOOD
    assert found["person in video"].verdict == RESHOOT
    assert found["person"].verdict == GOOD


def test_expressions_that_the_video_never_shows() -> None:
    """Shown is what once rises tenfold in odds; what the network cannot tell is not counted."""
    photos = photos_of([look_of(face) for face in sweep()])
    faces = [
        face_at(portrait=PORTRAIT, scores={JAW: 0.7} if i == 5 else {BLINKS[0]: 0.1} if i == 6 else {})
        for i in range(30)
    ]
    found = lines(photos, frames_of([look_of(face) for face in faces], photos))["expressions"]
    assert found.verdict == RESHOOT
    assert len(found.values["never"]) == 44
    assert "jawOpen" not in found.values["never"]
    assert "eyeBlinkLeft" in found.values["never"]
    assert "tongueOut" in found.values["cannot_be_judged"]
