"""Eyeballs from irises, lids and the model, and lids on eyeballs."""

import cv2
import numpy as np
import pycolmap
import pytest

from avatarbuild.landmarks import IRISES
from avatarbuild.registration.eye_shape import eye_shape
from avatarbuild.registration.eyes import eyeballs
from avatarbuild.registration.iris_sightings import Photos, iris_sightings
from avatarbuild.registration.lids import FAR, lid_bands, lid_fit, seen_line, settle_lids
from avatarbuild.sfm.metric import Placed
from avatarbuild.simulation.photographs import look_at
from avatarbuild.simulation.subject import random_subject
from avatarbuild.template import EYE_PARTS, Template

SIZE, FOCAL = (900, 1200), 1100.0


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.load()


def painted_photos(centres: np.ndarray, radius: float, shape, *, follow: bool, seed: int = 0) -> Photos:
    """Pictures of nothing but two irises, on balls at `centres`, that look ahead or at the camera."""
    rng = np.random.default_rng(seed)
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    camera = pycolmap.Camera(
        model="PINHOLE", width=SIZE[0], height=SIZE[1], params=[FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2]
    )
    yaw = np.array([-32.0, -20.0, -9.0, 0.0, 8.0, 19.0, 31.0])
    rotation, translation, pictures, marks = [], [], [], np.full((len(yaw), 478, 3), np.nan)
    size = radius / shape.radius
    for i, turn in enumerate(np.radians(yaw)):
        eye = 380.0 * np.array([np.sin(turn), 0.05, np.cos(turn)])
        R = look_at(eye, np.array([0.0, -5.0, 0.0]))
        t = -R @ eye
        rotation.append(R)
        translation.append(t)
        picture = np.full((SIZE[1], SIZE[0]), 190, np.uint8)
        for centre, iris in zip(centres, IRISES):
            gaze = (eye - centre) / np.linalg.norm(eye - centre) if follow else np.array([0.0, 0.0, 1.0])
            right = np.cross([0.0, 1.0, 0.0], gaze)
            right /= np.linalg.norm(right)
            up = np.cross(gaze, right)
            a = np.linspace(0, 2 * np.pi, 400)
            around = shape.limbus_radius * size * (np.cos(a)[:, None] * right + np.sin(a)[:, None] * up)
            rim = centre + shape.limbus_depth * size * gaze + around
            x = rim @ R.T + t
            pixels = x[:, :2] / x[:, 2:] * FOCAL + K[:2, 2]
            cv2.fillPoly(picture, [np.round((pixels - 0.5) * 64).astype(np.int32)], 60, cv2.LINE_AA, 6)
            middle = centre + shape.limbus_depth * size * gaze @ np.eye(3)
            flat = middle @ R.T + t
            marks[i, iris, :2] = flat[:2] / flat[2] * FOCAL + K[:2, 2] + rng.normal(0, 1.5, 2)
        noisy = cv2.GaussianBlur(picture, (0, 0), 1.0) + rng.normal(0, 2, picture.shape)
        pictures.append(np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2))
    placed = Placed(np.arange(len(yaw)), [camera] * len(yaw), np.array(rotation), np.array(translation))
    return Photos(placed, marks, np.ones(len(yaw), bool), yaw, np.ones(len(yaw)), lambda i: pictures[i])


def noisy(template: Template, vertices: np.ndarray, amount: float, seed: int) -> np.ndarray:
    """Vertices with smooth noise of `amount` mm standard deviation."""
    from avatarbuild.simulation.chart import softened

    rng = np.random.default_rng(seed)
    field = np.stack([softened(template, rng.standard_normal(len(vertices)), 5) for _ in range(3)], axis=1)
    return vertices + amount * field / field.std()


def test_profile_is_the_shipped_eyeballs(template):
    shape = eye_shape(template)
    assert shape.radius == pytest.approx(12.0, abs=1e-3)
    assert shape.limbus_radius == pytest.approx(5.85, abs=0.01)
    assert shape.surface(np.array([0.0]), 6.0)[0] == pytest.approx(6.0, abs=1e-3)
    for k, name in enumerate(EYE_PARTS):
        d = template.mean[template.parts[name].vertices] - template.eye_centres[k]
        r = np.linalg.norm(d, axis=1)
        np.testing.assert_allclose(shape.surface(d[:, 2] / r, 12.0), r, atol=0.005)


def test_bands_are_closed_rings_about_both_eyes(template):
    for band in lid_bands(template):
        count = np.bincount(band.ring[(band.ring >= 0) & (band.ring < 10)])
        assert (count == count[0]).all()  # nested closed rings of equally many vertices
        assert len(band.contact) == count[0]
        assert (band.ring[band.contact] == -1).all()
        assert not (template.regions["sockets"][: len(band.ring)] & (band.ring >= 0) & (band.ring < FAR)).any()


def test_lower_lids_have_an_inner_edge_on_the_ball_behind_their_rims(template):
    assert (seen_line(template, "lid_upper_left") == template.contours["lid_upper_left"]).all()
    for band, side in zip(lid_bands(template), ("left", "right")):
        line, edge = template.contours[f"lid_lower_{side}"], seen_line(template, f"lid_lower_{side}")
        assert (edge[[0, -1]] == line[[0, -1]]).all()
        assert np.isin(edge[1:-1], band.contact).all()
        assert len(np.unique(edge)) == len(edge)
        thick = np.linalg.norm(template.mean[edge] - template.mean[line], axis=1)[3:-3]
        assert thick.min() > 0.5
        assert thick.max() < 2.0
        assert (template.mean[edge][3:-3, 1] > template.mean[line][3:-3, 1]).all()


def test_mean_lids_lie_on_the_mean_eyes_and_stay(template):
    radius = np.full(2, 12.0)
    fit = lid_fit(template.mean, template.eye_centres, radius, template)
    assert fit.contact < 1e-6
    assert fit.poke == 0
    settled = settle_lids(template.mean, template.eye_centres, radius, template)
    np.testing.assert_allclose(settled, template.mean, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_lids_of_other_people_settle_on_other_balls(template, seed):
    person = random_subject(template, np.random.default_rng(seed))
    skin = noisy(template, person.neutral, 0.3, seed)
    centres = person.eye_centres + np.array([[0.5, -0.4, 0.6], [-0.5, 0.3, 0.7]])
    radius = np.full(2, 12.4)
    before = lid_fit(skin, centres, radius, template)
    assert before.contact > 0.5
    settled = settle_lids(skin, centres, radius, template)
    fit = lid_fit(settled, centres, radius, template)
    assert fit.contact < 0.01
    assert fit.rim < 0.01
    assert fit.poke < 0.05
    moved = np.linalg.norm(settled - skin, axis=1)
    far = np.linalg.norm(template.mean[:, None] - template.eye_centres, axis=2).min(axis=1) > 40
    assert moved[far].max() == 0
    assert moved.max() < 2.5


def test_skin_that_the_cloud_knows_follows_the_lids_less_far(template):
    person = random_subject(template, np.random.default_rng(1))
    centres, radius = person.eye_centres + np.array([0.0, 0.0, 0.8]), np.full(2, 12.0)
    seen = np.ones(len(person.neutral))
    moved = {}
    for name, known in (("told", seen), ("untold", None)):
        settled = settle_lids(person.neutral, centres, radius, template, None, known)
        fit = lid_fit(settled, centres, radius, template)
        assert max(fit.contact, fit.rim) < 0.01
        assert fit.poke < 0.05
        off = np.linalg.norm(settled - person.neutral, axis=1)
        moved[name] = [
            np.mean([off[: len(band.ring)][band.ring == ring].mean() for band in lid_bands(template)])
            for ring in (2, 5, 8)
        ]
    assert moved["told"][0] == pytest.approx(moved["untold"][0])  # the rim lies on the ball all the same
    assert moved["told"][1] < 0.6 * moved["untold"][1]
    assert moved["told"][2] < 0.3 * moved["untold"][2]


def test_lids_settle_wherever_the_head_stands(template):
    turn = cv2.Rodrigues(np.array([0.1, -0.3, 0.2]))[0]
    person = random_subject(template, np.random.default_rng(5))
    centres, radius = person.eye_centres + 0.4, np.full(2, 11.7)
    here = settle_lids(person.neutral, centres, radius, template)
    there = settle_lids(person.neutral @ turn.T + 7, centres @ turn.T + 7, radius, template, turn[:, 2])
    np.testing.assert_allclose(there, here @ turn.T + 7, atol=1e-8)


@pytest.mark.parametrize("follow", [False, True])
def test_irises_are_found_where_they_are(template, follow):
    shape = eye_shape(template)
    centres = np.array([[30.0, 1.0, 0.5], [-30.5, 0.0, 0.0]])
    photos = painted_photos(centres, 12.0, shape, follow=follow)
    seen = iris_sightings(photos, np.array([0.0, 0.0, 1.0]), shape.limbus_radius)
    assert len(seen.eye) == 14
    # irises that follow the camera meet in the eye's centre, others where they are
    true = centres + (0 if follow else shape.limbus_depth) * np.array([0.0, 0.0, 1.0])
    assert 1e-4 < np.linalg.norm(seen.points - true, axis=1).max() < 0.3
    if not follow:
        assert np.median(seen.radius) == pytest.approx(shape.limbus_radius, rel=0.05)


@pytest.mark.parametrize("follow", [False, True])
@pytest.mark.parametrize("radius", [11.6, 12.5])
def test_balls_are_recovered(template, follow, radius):
    """The person's own skin about the eyes, with noise, on larger or smaller balls than the template's."""
    shape = eye_shape(template)
    person = random_subject(template, np.random.default_rng(3))
    both = np.full(2, radius)
    skin = settle_lids(person.neutral, person.eye_centres, both, template)
    skin = noisy(template, skin, 0.25, 1)
    photos = painted_photos(person.eye_centres, radius, shape, follow=follow)
    found = eyeballs(photos, skin, template, person.identity)
    assert found.radius[0] == found.radius[1]
    assert 1e-6 < abs(found.radius[0] / radius - 1) < 0.04
    assert 1e-3 < np.linalg.norm(found.centres - person.eye_centres, axis=1).max() < 0.7
    assert found.follow == pytest.approx(float(follow), abs=0.15)
    if not follow:
        assert (found.gaze[:, 2] > np.cos(np.radians(4))).all()
    repeated = eyeballs(photos, skin, template, person.identity)
    np.testing.assert_array_equal(repeated.centres, found.centres)


def test_balls_without_irises_come_from_lids_and_model(template):
    person = random_subject(template, np.random.default_rng(4))
    shape = eye_shape(template)
    photos = painted_photos(person.eye_centres, 12.0, shape, follow=False)
    blind = Photos(photos.placed, photos.landmarks, np.zeros(7, bool), photos.yaw, photos.sharpness, photos.picture)
    found = eyeballs(blind, noisy(template, person.neutral, 0.25, 1), template, person.identity)
    seen = iris_sightings(blind, np.array([0.0, 0.0, 1.0]), shape.limbus_radius)
    assert not len(seen.eye)
    assert np.isnan(seen.points).all()
    assert np.linalg.norm(found.centres - person.eye_centres, axis=1).max() < 1.0
