from __future__ import annotations

import numpy as np
import pytest
from captures import benchmark_photo, face_at, look_of

from avatarbuild import faces
from avatarbuild.portrait import handedness, likeness, portrait

RNG = np.random.default_rng(3)
ANNA, BEN = (RNG.normal(0, 0.1, (96, 96)).astype(np.float32) for _ in range(2))


def test_the_largest_face_is_followed() -> None:
    looks = [look_of(face_at(size=40), face_at(x=160, size=90)), look_of(face_at(size=90)), look_of()]
    assert faces.follow(looks, 0.9, continuous=False) == [1, 0, -1]


def test_a_face_is_followed_through_a_passer_by() -> None:
    """In a video the subject stays where they were, though someone larger walks past; by size alone they would not."""
    subject = [face_at(x=60 + i, size=60) for i in range(8)]
    stranger = face_at(x=150, size=75)
    looks = [look_of(stranger, s) if 3 <= i <= 4 else look_of(s) for i, s in enumerate(subject)]
    assert faces.follow(looks, 0.9, continuous=True) == [0, 0, 0, 1, 1, 0, 0, 0]
    assert faces.follow(looks, 0.9, continuous=False)[3] == 0


def test_a_known_person_is_followed_although_smaller() -> None:
    looks = [look_of(face_at(size=80, portrait=ANNA))] * 5
    looks.append(look_of(face_at(size=90, portrait=BEN), face_at(x=30, size=70, portrait=ANNA)))
    chosen = faces.follow(looks, 0.9, continuous=False)
    assert chosen[-1] == 0
    person = faces.identity(looks, chosen, 0.9)
    assert person is not None
    shifted = looks[-1].faces[0].shape + RNG.normal(0, 3.0, (33, 3))
    ben = faces.Candidate(**{**vars(looks[-1].faces[0]), "shape": shifted})
    looks[-1] = look_of(ben, looks[-1].faces[1])
    assert faces.follow(looks, 0.9, continuous=False, known=person)[-1] == 1
    assert faces.unlikeness(ben, person) > 1.0
    only_ben = [look_of(ben)]
    assert faces.follow(only_ben, 0.9, continuous=False, known=person) == [-1]
    assert faces.follow(only_ben, 0.9, continuous=True, known=person) == [0]
    assert faces.least_unlikeness(only_ben[0], person, 0.9) == faces.unlikeness(ben, person)
    assert np.isnan(faces.least_unlikeness(look_of(face_at(yaw=60.0)), person, 0.9))
    assert faces.unlikeness(looks[0].faces[0], person) == 0.0


def test_no_identity_without_a_sure_frontal_face() -> None:
    looks = [look_of(), look_of(face_at(presence=0.3, portrait=ANNA)), look_of(face_at(yaw=50.0))]
    assert faces.identity(looks, [-1, 0, 0], 0.9) is None


def test_other_people_are_those_of_comparable_size() -> None:
    look = look_of(face_at(size=90), face_at(x=20, size=60), face_at(x=180, size=20), face_at(size=80, presence=0.5))
    assert faces.others(look, 0, 0.9) == 1
    assert faces.others(look, -1, 0.9) == 0


def test_likeness_and_handedness_of_made_up_portraits() -> None:
    assert likeness(ANNA, ANNA) == pytest.approx(1.0)
    assert abs(likeness(ANNA, BEN)) < 0.1
    assert handedness(ANNA, ANNA) == pytest.approx(1.0)
    assert handedness(ANNA, ANNA[:, ::-1]) == pytest.approx(-1.0)


def test_one_person_in_two_photos_and_in_the_mirror() -> None:
    looks = [faces.look(benchmark_photo(i), 0.9) for i in (14, 16, 18)]
    a, b, c = (look.faces[0].portrait for look in looks)
    assert min(likeness(a, b), likeness(b, c)) > 0.6
    flipped = np.ascontiguousarray(benchmark_photo(16)[:, ::-1])
    other = faces.look(flipped, 0.9).faces[0].portrait
    assert handedness(a, b) > 0.3
    assert handedness(a, other) < -0.3
    again = portrait(benchmark_photo(16), looks[1].faces[0].face.points)
    assert np.array_equal(again, b)
