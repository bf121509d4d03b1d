"""Irises found in photos, and the texture that takes their colours."""

import cv2
import numpy as np
import pycolmap
import pytest

from avatarbuild.formats.colour import decode_srgb, encode_srgb
from avatarbuild.registration.eye_painting import WHITE, eye_map, paint_eye
from avatarbuild.registration.eye_shape import eye_shape
from avatarbuild.registration.eyes import Eyeballs
from avatarbuild.registration.iris_patches import RADIUS, SIZE, find_circle, frontal_photos
from avatarbuild.registration.iris_sightings import Photos
from avatarbuild.registration.iris_texture import coloured, eye_texture, light_of, match
from avatarbuild.sfm.metric import Placed
from avatarbuild.simulation.photographs import look_at
from avatarbuild.template import Template

BLUE = np.array([0.10, 0.19, 0.30])
PHOTO, FOCAL = (1200, 900), 2200.0


@pytest.fixture(scope="module")
def template() -> Template:
    return Template.load()


@pytest.fixture(scope="module")
def balls(template) -> Eyeballs:
    gaze = np.tile([0.0, 0.0, 1.0], (2, 1))
    return Eyeballs(template.eye_centres, np.full(2, 12.0), gaze, 0.0)


def photos_of(
    template: Template, iris: np.ndarray, light: np.ndarray, yaws=(-25.0, 4.0, 20.0), *, shut=False
) -> Photos:
    """Flat pictures of the template's eyes: skin, white, iris, pupil, a highlight, in a light of some colour."""
    camera = pycolmap.Camera(
        model="PINHOLE", width=PHOTO[0], height=PHOTO[1], params=[FOCAL, FOCAL, PHOTO[0] / 2, PHOTO[1] / 2]
    )
    rng = np.random.default_rng(3)
    rotation, translation, pictures = [], [], []
    for yaw in np.radians(yaws):
        eye = 400 * np.array([np.sin(yaw), 0, np.cos(yaw)])
        R = look_at(eye, np.zeros(3))
        t = -R @ eye
        rotation.append(R)
        translation.append(t)

        def fill(picture, points, colour, R=R, t=t):
            x = points @ R.T + t
            pixels = x[:, :2] / x[:, 2:] * FOCAL + [PHOTO[0] / 2, PHOTO[1] / 2]
            cv2.fillPoly(picture, [np.round((pixels - 0.5) * 16).astype(np.int32)], colour.tolist(), cv2.LINE_AA, 4)

        picture = np.tile(np.array([0.45, 0.25, 0.17]) * light, (PHOTO[1], PHOTO[0], 1)).astype(np.float32)
        for k, side in enumerate(("left", "right")):
            if shut:
                continue
            outline = np.concatenate(
                [template.contours[f"lid_upper_{side}"], template.contours[f"lid_lower_{side}"][::-1]]
            )
            before = picture.copy()
            fill(picture, template.mean[outline], WHITE * light)
            opening = (picture != before).any(axis=2)
            a = np.linspace(0, 2 * np.pi, 100)
            ring = np.stack([np.cos(a), np.sin(a), np.zeros(100)], axis=1)
            middle = template.eye_centres[k] + [0, 0, 10.55]
            inner = picture.copy()
            fill(inner, middle + 5.85 * ring, iris * light)
            fill(inner, middle + 1.9 * ring, np.full(3, 0.005))
            fill(inner, middle + [2.5, 2.0, 0] + 0.8 * ring, np.full(3, 0.9))
            picture[opening] = inner[opening]
        picture = cv2.GaussianBlur(picture, (0, 0), 1.0) + rng.normal(0, 0.003, picture.shape)
        pictures.append(encode_srgb(picture))
    count = len(yaws)
    placed = Placed(np.arange(count), [camera] * count, np.array(rotation), np.array(translation))
    marks = np.full((count, 478, 3), np.nan)
    return Photos(placed, marks, np.ones(count, bool), np.array(yaws), np.ones(count), lambda i: pictures[i])


def test_histogram_matching_by_hand():
    source = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    target = np.array([10.0, 12.0, 14.0, 16.0, 18.0])
    np.testing.assert_allclose(match(np.array([0.0, 1.5, 4.0]), source, target, 0.0), [10, 13, 18])
    np.testing.assert_allclose(match(np.array([-1.0, 6.0]), source, target, 0.0), [9, 20])
    # a step: three quarters of the target are 5
    np.testing.assert_allclose(match(np.array([3.9]), source, np.array([1.0, 5, 5, 5, 5]), 0.0), [5])


def test_matched_samples_have_the_histogram():
    rng = np.random.default_rng(0)
    source, target = rng.normal(3, 2, 4000), rng.gamma(2, 1.5, 3000)
    matched = match(source, source, target, 0.01)
    q = np.linspace(0.02, 0.98, 20)
    np.testing.assert_allclose(np.quantile(matched, q), np.quantile(target, q), atol=0.05)
    np.testing.assert_allclose(match(source, source, source, 0.01), source, atol=1e-9)


def test_light_is_told_from_the_white():
    light, tint = light_of(0.7 * WHITE)
    np.testing.assert_allclose(light, 0.7)
    np.testing.assert_allclose(tint, 1)
    light, tint = light_of(WHITE * [1.2, 1.0, 0.8])
    assert light[0] > 1 > light[2]
    assert tint[0] > 1 > tint[2]


def test_circle_is_found_among_lids_and_highlights():
    picture = np.full((SIZE, SIZE), 200, np.uint8)
    cv2.circle(picture, (round((SIZE / 2 + 9 - 0.5) * 16), round((SIZE / 2 - 5 - 0.5) * 16)), 58 * 16, 80, -1, 4, 4)
    cv2.circle(picture, (SIZE // 2 + 9, SIZE // 2 - 5), 20, 20, -1)
    cv2.circle(picture, (SIZE // 2 + 30, SIZE // 2 - 20), 9, 250, -1)
    picture[: SIZE // 2 - 35] = 130  # the upper lid
    circle = find_circle(cv2.GaussianBlur(picture, (0, 0), 3.0))
    assert 0 < np.abs(circle - [SIZE / 2 + 9, SIZE / 2 - 5, 58]).max() < 1.5
    assert find_circle(np.full((SIZE, SIZE), 128, np.uint8)) is None
    assert RADIUS == 64


def test_map_of_the_eyes_own_chart(template):
    """Every vertex finds itself under its place in the texture."""
    size = 512
    offset = eye_map(template, size)
    part = template.parts["eye_left"]
    uv = template.part_uv("eye_left")
    corners, chart = template.triangles[part.triangles], template.uv_triangles[part.triangles]
    middle = template.mean[corners].mean(axis=1) - template.eye_centres[0]
    texel = np.floor(uv[chart].mean(axis=1) * [size, -size] + [0, size]).astype(int)
    off = np.linalg.norm(offset[texel[:, 1], texel[:, 0]] - middle, axis=1)
    assert np.median(off) < 0.05
    assert np.quantile(off, 0.99) < 0.5


def test_most_frontal_sharp_photo_comes_first(template, balls):
    photos = photos_of(template, BLUE, np.ones(3), (-28.0, 3.0, -6.0, 12.0))
    assert frontal_photos(photos, balls) == [1, 2, 3, 0]
    blurred = Photos(
        photos.placed, photos.landmarks, photos.trusted, photos.yaw, np.array([1, 0.3, 1, 1.0]), photos.picture
    )
    assert frontal_photos(blurred, balls)[0] == 2


@pytest.mark.parametrize("light", [(0.8, 0.8, 0.8), (0.75, 0.6, 0.45)])
@pytest.mark.parametrize("iris", [BLUE, np.array([0.13, 0.07, 0.03])])
def test_iris_takes_the_photos_colour(template, balls, iris, light):
    light = np.array(light)
    made = eye_texture(photos_of(template, iris, light), balls, template.mean, template, 256)
    assert len(made.patches) == 2
    assert {patch.photo for patch in made.patches} == {1}
    # half of the light's cast is taken for the eye's own
    own = iris * np.sqrt(light / light.mean())
    assert np.abs(np.log(made.iris / own)).max() < 0.25
    assert made.texture.shape == (256, 256, 3)
    np.testing.assert_array_equal(
        made.texture, eye_texture(photos_of(template, iris, light), balls, template.mean, template, 256).texture
    )


def test_shut_eyes_give_a_usual_eye(template, balls):
    made = eye_texture(photos_of(template, BLUE, np.ones(3), shut=True), balls, template.mean, template, 256)
    assert made.patches == []
    shape = eye_shape(template)
    plain = paint_eye(eye_map(template, 256), shape).colour()
    np.testing.assert_allclose(decode_srgb(made.texture), np.clip(plain, 0, 1), atol=0.02)


def test_pupil_stays_black_and_white_stays_white(template, balls):
    photos = photos_of(template, BLUE, np.full(3, 0.8))
    made = eye_texture(photos, balls, template.mean, template, 256)
    painting = paint_eye(eye_map(template, 256), eye_shape(template))
    again = coloured(painting, made.patches)
    assert again.colour()[painting.pupil > 0.99].max() < 0.02
    np.testing.assert_allclose(again.white, painting.white, atol=0.03)
