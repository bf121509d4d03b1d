"""Teeth, gums, tongue and eyeballs put into other heads."""

import cv2
import numpy as np
import pytest

from avatarbuild.registration.inner_parts import FEATURES, inner_parts, stretch_between
from avatarbuild.simulation.subject import random_subject
from avatarbuild.template import EYE_PARTS, MOUTH_PARTS, Template

RADIUS = np.full(2, 12.0)


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.load()


def rows(template: Template, names: tuple[str, ...]) -> np.ndarray:
    parts = [template.parts[name].vertices for name in names]
    return np.concatenate([np.arange(p.start, p.stop) for p in parts])


def test_stretch_of_known_scales_and_turn():
    rng = np.random.default_rng(1)
    a = rng.normal(0, [30, 25, 12], (20, 3))
    turn = cv2.Rodrigues(np.array([0.05, -0.2, 0.1]))[0]
    b = (a * [1.1, 0.95, 1.04]) @ turn.T + [3, -4, 5]
    found = stretch_between(a, b, rng.uniform(0.5, 1, 20))
    np.testing.assert_allclose(found.scale, [1.1, 0.95, 1.04], atol=1e-6)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-6)
    np.testing.assert_allclose(found.apply(a), b, atol=1e-5)


def test_a_stretched_template_gets_stretched_parts(template):
    """Rotation, translation and three scales of the whole head are the parts' own, to the last digit."""
    turn = cv2.Rodrigues(np.array([0.05, -0.2, 0.1]))[0]
    scaled = (template.mean * [1.05, 0.96, 1.1]) @ turn.T + [3, -4, 5]
    centres = (template.eye_centres * [1.05, 0.96, 1.1]) @ turn.T + [3, -4, 5]
    found = inner_parts(template, None, scaled, centres, RADIUS, turn)
    np.testing.assert_allclose(
        found.vertices[rows(template, MOUTH_PARTS)], scaled[rows(template, MOUTH_PARTS)], atol=1e-5
    )
    assert (found.back, found.poke) == (0, 0)
    assert found.lips > 3
    skin = template.parts["skin"].vertices
    np.testing.assert_array_equal(found.vertices[skin], scaled[skin])


def test_eyeballs_stand_where_they_were_found(template):
    centres, radius = template.eye_centres + [[0.5, 1, -2]], np.array([11.0, 13.0])
    found = inner_parts(template, None, template.mean, centres, radius).vertices
    for k, name in enumerate(EYE_PARTS):
        ball = template.parts[name].vertices
        own = (found[ball] - centres[k]) / radius[k]
        np.testing.assert_allclose(own, (template.mean[ball] - template.eye_centres[k]) / 12, atol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_teeth_of_other_people_stay_behind_lips_and_cheeks(template, seed):
    person = random_subject(template, np.random.default_rng(seed))
    found = inner_parts(template, person.identity, person.neutral, person.eye_centres, RADIUS)
    assert found.lips > 2
    assert found.poke < 0.05
    teeth = rows(template, ("teeth_upper", "teeth_lower"))
    off = np.linalg.norm(found.vertices[teeth] - person.neutral[teeth], axis=1).mean()
    assert 1e-3 < off < 1.2
    moved = np.linalg.norm(found.vertices - person.neutral, axis=1)
    shown = ~template.regions["mouth"]
    shown[template.parts["skin"].vertices.stop :] = False
    assert moved[shown].max() == 0  # room is made where nobody sees it


def test_teeth_move_back_behind_flat_lips(template):
    """Lips pressed to where the teeth stand: the teeth give way along the face's own axis."""
    flat = template.mean.copy()
    lips = np.zeros(len(flat), bool)
    lips[template.parts["skin"].vertices] = True
    teeth = template.mean[template.parts["teeth_upper"].vertices]
    middle = teeth[teeth[:, 2].argmax()]
    near = np.exp(-(((flat - middle) / [25, 15, 15]) ** 2).sum(axis=1)) * lips
    flat[:, 2] -= 9.0 * near
    plain = inner_parts(template, None, template.mean, template.eye_centres, RADIUS)
    found = inner_parts(template, None, flat, template.eye_centres, RADIUS)
    assert found.back > 0
    assert found.lips >= 1.0
    front = found.vertices[template.parts["teeth_upper"].vertices][:, 2].max()
    assert front < plain.vertices[template.parts["teeth_upper"].vertices][:, 2].max()


def test_features_come_in_pairs(template):
    """The mouth's inside does not lean to one side on a symmetric head."""
    points = template.landmarks(template.mean)[list(FEATURES)]
    weights = np.array(list(FEATURES.values()))
    assert abs(weights @ points[:, 0]) / weights.sum() < 0.1
