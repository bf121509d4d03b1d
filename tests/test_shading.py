"""Shape from shading on surfaces whose relief and light are known."""

from __future__ import annotations

from dataclasses import replace

import cv2
import derivatives
import numpy as np
import performances
import scipy.sparse as sp
import synthetic

from avatarbuild.artefacts import Blendshapes
from avatarbuild.energies import harmonics
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.shading import observation, registration
from avatarbuild.shading.light import Field, Light, clip_light
from avatarbuild.shading.relief import ReliefWeights, _Hollow, light_seen, relief
from avatarbuild.shading.sky import DIRECTIONS
from avatarbuild.shading.surface import Drawn, FineSkin, draw, fine_skin
from avatarbuild.simulation.subject import random_subject
from avatarbuild.stages.refinement import untouched
from avatarbuild.tracking import modelling
from avatarbuild.tracking.fit import State
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.rig import Rig

LENS = Lens(600.0, 0.0, (96, 128))
WAY = np.array([0.45, -0.6, -0.66])  # to a window, from a face before the camera
LIGHT = Light(0.4 + 3.0 * np.maximum(DIRECTIONS @ WAY, 0) ** 3, 0.2, np.ones(1))
CLOSE = ReliefWeights(light=0.3, small=1e-4, slope=1e-3, bend=1e-2, scatter=0.0, rounds=4, steps=80)


def wall(depth: float = 300.0) -> Drawn:
    """A wall across the line of sight, white, with nothing about it."""
    w, h = LENS.size
    rows, columns = np.mgrid[0:h, 0:w] + 0.5
    point = np.stack([(columns - w / 2) / LENS.focal, (rows - h / 2) / LENS.focal, np.ones((h, w))], axis=-1) * depth
    normal = np.zeros((h, w, 3), np.float32)
    normal[..., 2] = -1
    uv = np.stack([columns / w, 1 - rows / h], axis=-1)
    flat = np.zeros((h, w), np.float32)
    one = np.zeros((1, 3), int)
    same = sp.csr_matrix(np.ones((1, 1)))
    skin = FineSkin(same, one, uv, one, np.ones(1, bool), build_mipmap(flat[..., None]), one, np.zeros(1, int), same)
    there = np.zeros((h, w), np.int32), np.full((h, w, 3), 1 / 3, np.float32)
    sky = np.ones((1, len(DIRECTIONS)), bool)
    return Drawn(1, np.zeros(2), point, normal, uv, flat, flat + 1, np.ones((h, w), bool), *there, skin, sky)


def lit(drawn: Drawn, normals: np.ndarray) -> np.ndarray:
    """(h, w) the light on a head of other normals."""
    return LIGHT.field(drawn).shade(normals)


def bumps() -> np.ndarray:
    """(h, w) mm towards the eye: three of a millimetre and less."""
    w, h = LENS.size
    rows, columns = np.mgrid[0:h, 0:w]
    out = np.zeros((h, w))
    for x, y, high, wide in ((30, 40, 0.8, 7), (62, 70, -0.6, 6), (40, 95, 0.5, 5)):
        out += high * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * wide**2))
    return out


def normals_of(drawn: Drawn, d: np.ndarray) -> np.ndarray:
    """Unit normals, towards the eye, of the surface that d (h, w) mm along the rays makes, by differences."""
    ray = drawn.point / np.linalg.norm(drawn.point, axis=-1, keepdims=True)
    p = drawn.point + d[..., None] * ray
    n = np.cross(np.gradient(p, axis=0), np.gradient(p, axis=1))
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def test_lights_slope_is_its_derivative_and_that_of_even_light_is_none() -> None:
    rng = np.random.default_rng(0)
    come = np.abs(rng.standard_normal((4, len(DIRECTIONS)))).astype(np.float32)
    field = Field(np.ones((1, 4), bool), come)
    n = rng.standard_normal((1, 4, 3))
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    for k in range(4):

        def shade(p: np.ndarray, k: int = k) -> np.ndarray:
            turned = n.copy()
            turned[0, k] = p
            return field.change(turned)[0][0, k : k + 1]

        np.testing.assert_allclose(field.change(n)[1][0, k], derivatives.numerical(shade, n[0, k])[0], atol=1e-5)
    drawn = wall()
    s, slope = Light(np.ones(len(DIRECTIONS)), 0.0, np.ones(1)).field(drawn).change(drawn.normal)
    np.testing.assert_allclose(s, 1, rtol=0.01)
    assert np.abs(slope[..., :2]).max() < 0.02


def test_a_nose_throws_its_shadow_where_the_light_does_not_come_from() -> None:
    template = synthetic.template()
    skin = fine_skin(template, np.full((64, 64, 3), 128, np.uint8))
    lens = Lens(400.0, 0.0, (120, 160))
    drawn = draw(skin, template.mean, lens, np.diag([1.0, -1, -1]), np.array([0, 0, 600.0]), 1)
    to_window = DIRECTIONS @ np.array([-0.9, 0, -0.44]) > 0.95
    window = Light(np.where(to_window, 20.0, 0.0), 0.0, np.ones(1))
    open_ = replace(drawn, sky=np.ones_like(drawn.sky))
    lost = 1 - window.shade(drawn) / window.shade(open_)
    left, right = np.zeros((2, *drawn.on.shape), bool)
    middle = int(lens.project(np.array([[0, 0, 600.0]]))[0][0, 0])
    left[:, :middle], right[:, middle:] = drawn.on[:, :middle], drawn.on[:, middle:]
    lit_once = window.shade(open_) > 0.2
    assert lost[right & lit_once].mean() > 3 * lost[left & lit_once].mean() > 0


def test_harmonics_are_those_of_the_open_light() -> None:
    facing = np.maximum(DIRECTIONS @ DIRECTIONS.T, 0) * (4 / len(DIRECTIONS))
    np.testing.assert_allclose(harmonics.basis(DIRECTIONS) @ LIGHT.harmonics(), facing @ LIGHT.radiance, rtol=0.05)


def test_bumps_come_back_from_their_shading() -> None:
    drawn = wall()
    truth = normals_of(drawn, -bumps())
    made = relief(drawn, lit(drawn, truth), LIGHT, LENS, CLOSE)
    inner = (slice(8, -8), slice(8, -8))
    off = np.degrees(np.arccos(np.clip((made.normal * truth).sum(axis=-1), -1, 1)))[inner]
    flat = np.degrees(np.arccos(np.clip(-truth[..., 2], -1, 1)))[inner]
    assert off.mean() < 0.65 * flat.mean()  # one light tells slopes along one direction only
    assert np.corrcoef(made.d[inner].ravel(), -bumps()[inner].ravel())[0, 1] > 0.8


def test_a_flat_wall_stays_flat() -> None:
    drawn = wall()
    for w in (CLOSE, replace(CLOSE, hollow=1.0)):
        assert np.abs(relief(drawn, LIGHT.shade(drawn), LIGHT, LENS, w).d).max() < 1e-6


def test_a_furrow_under_even_light_is_seen_by_its_darkness() -> None:
    drawn = wall()
    even = Light(np.full(len(DIRECTIONS), 0.9), 0.0, np.ones(1))
    rows = np.mgrid[0 : LENS.size[1], 0 : LENS.size[0]][0]
    furrow = 0.3 * np.exp(-(((rows - 64) / 3.0) ** 2))
    reach = 2.4 / (300 / LENS.focal)  # pixels
    around = cv2.GaussianBlur(furrow, (0, 0), reach)
    seen = 0.9 * (1 - 0.8 * (furrow - around))
    blind, told = (relief(drawn, seen, even, LENS, replace(CLOSE, hollow=hollow, reach=2.4)) for hollow in (0.0, 0.8))
    inner = (slice(20, -20), slice(10, -10))
    assert np.abs(blind.d).max() < 0.15 * np.abs(told.d).max()  # directions are not quite evenly spread
    assert np.corrcoef(told.d[inner].ravel(), furrow[inner].ravel())[0, 1] > 0.9
    depth = told.d[64, 48] - told.d[40, 48]
    assert 0.6 * 0.3 < depth < 1.2 * 0.3


def test_hollows_are_measured_against_what_is_about_them() -> None:
    on = np.ones((60, 80))
    hollow = _Hollow.of(on, 4.0)
    rng = np.random.default_rng(5)
    a, b = rng.standard_normal((2, 60, 80))
    np.testing.assert_allclose((a * hollow(b)).sum(), (hollow(a) * b).sum(), rtol=1e-9)
    assert np.abs(hollow(on)[20:-20, 20:-20]).max() < 1e-3


def test_l1_keeps_a_crease_sharper_than_squares_do() -> None:
    drawn = wall()
    rows = np.mgrid[0 : LENS.size[1], 0 : LENS.size[0]][0]
    crease = 0.4 * np.exp(-np.abs(rows - 64) / 3.0)
    truth = normals_of(drawn, crease)
    noise = 1 + 0.02 * np.random.default_rng(2).standard_normal(rows.shape)
    off = []
    for sharp in (0.0, 0.05):
        w = ReliefWeights(light=0.1, small=5e-4, slope=0.02, bend=0.5, scatter=0.0, sharp=sharp, rounds=6)
        made = relief(drawn, lit(drawn, truth) * noise, LIGHT, LENS, w)
        tilt = np.degrees(np.arccos(np.clip((made.normal * truth).sum(axis=-1), -1, 1)))
        off.append(tilt[58:70, 10:-10].mean())
    assert off[1] < 0.95 * off[0]


def test_light_and_exposures_are_found_again() -> None:
    rng = np.random.default_rng(3)
    frames = []
    gains = np.array([0.8, 1.0, 1.25])
    for gain in gains:
        drawn = wall()
        n = rng.standard_normal(drawn.normal.shape)
        n[..., 2] = -np.abs(n[..., 2]) - 0.3
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        tone = rng.normal(-2, 0.2, drawn.tone.shape).astype(np.float32)
        drawn = replace(drawn, normal=n, tone=tone)
        frames.append((drawn, (gain * np.exp(tone) * LIGHT.shade(drawn)).astype(np.float32), 0 * tone))
    found = clip_light(frames)
    np.testing.assert_allclose(found.gains, gains / np.exp(np.log(gains).mean()), rtol=0.01)
    np.testing.assert_allclose(found.shade(drawn), LIGHT.shade(drawn), rtol=0.03)
    assert np.linalg.norm(DIRECTIONS[found.radiance.argmax()] - WAY) < 0.5


def test_a_mole_that_all_frames_show_is_skin_and_no_bump() -> None:
    drawn = wall()
    mole = np.ones(LENS.size[::-1], np.float32)
    mole[60:66, 40:46] = 0.3
    grey = (LIGHT.shade(drawn) * mole).astype(np.float32)
    seen = [observation.Seen(i, drawn, grey, np.zeros((*grey.shape, 2), np.float32)) for i in range(4)]
    light = replace(LIGHT, gains=np.ones(4))
    more = observation.at_uv(observation.what_all_share(seen, light), drawn.uv)
    fine = ReliefWeights(light=0.1, small=5e-4, slope=0.1, bend=0.1, hollow=1.0)
    high = [np.abs(relief(drawn, light_seen(drawn, grey, 1.0, m), light, LENS, fine).d).max() for m in (more, 0 * more)]
    assert high[0] < 0.1 < high[1]


def test_a_mark_that_lies_aside_of_the_albedos_is_no_bump() -> None:
    drawn = wall()
    mole = np.zeros(LENS.size[::-1], np.float32)
    cv2.circle(mole, (48, 64), 4, -1.0, -1)
    tone = cv2.GaussianBlur(mole, (0, 0), 0.8)
    aside = np.roll(tone, 1, axis=1)  # half a millimetre
    fine = ReliefWeights(light=0.3, small=5e-3, slope=0.1, bend=0.1, hollow=1.0)
    marked = replace(drawn, tone=tone)
    seen = LIGHT.shade(drawn) * np.exp(aside - tone)
    taken, left = (np.abs(relief(marked, seen, LIGHT, LENS, replace(fine, apart=k)).d).max() for k in (0.0, 0.1))
    assert left < 0.75 * taken


def test_shapes_follow_depth_maps() -> None:
    template = synthetic.template()
    subject = random_subject(template, np.random.default_rng(4))
    rig = Rig(subject.neutral, template.expressions[:51].astype(np.float64), template.triangles)
    smile = [template.expression_index[name] for name in ("mouthSmileLeft", "mouthSmileRight")]
    n = template.parts["skin"].vertices.stop
    region = template.regions["face"][:n]
    moving = np.linalg.norm(rig.deltas[smile].sum(axis=0), axis=1)[:n]
    bulge = 0.3 * moving * region
    weights = np.zeros(51)
    weights[smile] = 1
    R, t = np.diag([1.0, -1, -1]), np.array([0, 0, 500.0])
    state = State(R, t, weights)
    posed = rig.posed(weights)[:n]
    normals = vertex_normals(posed, template.triangles[template.parts["skin"].triangles])
    asked = registration.Planes(normals, bulge, region * (normals[:, 2] > 0.3) * 1.0)
    made = registration.refine(template, rig, rig, [state] * 8, [asked] * 8, np.array([0, 0, 1.0]))
    moved = ((made.posed(weights)[:n] - posed) * normals).sum(axis=1)
    on = asked.sure > 0
    assert np.abs(moved - bulge)[on].mean() < 0.5 * bulge[on].mean()
    other = np.delete(np.arange(51), smile)
    assert np.abs(made.deltas[other] - rig.deltas[other]).max() < 1e-6

    wild = replace(asked, offset=40 * bulge)  # no shape is believed to stray as far as that
    far = registration.refine(template, rig, rig, [state] * 8, [wild] * 8, np.array([0, 0, 1.0]))
    freedom = registration.FREEDOM
    space = modelling.Space(template, rig, np.array([0, 0, 1.0]), freedom)
    y = ((far.deltas - rig.deltas)[:, space.free] @ space.back) / space.stray[1:, :, None]
    assert 2.5 < np.linalg.norm(y, axis=2).max() <= 3.0


def test_the_head_is_drawn_smooth_and_lit_by_its_albedo() -> None:
    template = synthetic.template()
    albedo = np.full((64, 64, 3), 128, np.uint8)
    skin = fine_skin(template, albedo)
    lens = Lens(400.0, 0.0, (120, 160))
    drawn = draw(skin, template.mean, lens, np.diag([1.0, -1, -1]), np.array([0, 0, 600.0]), 1)
    assert drawn.on.mean() > 0.3
    np.testing.assert_allclose(np.linalg.norm(drawn.normal[drawn.on], axis=1), 1, atol=1e-5)
    assert (drawn.normal[drawn.on][:, 2] < 0).all()
    tone = drawn.tone[drawn.on]
    np.testing.assert_allclose(tone, np.log(0.2158605 + 1e-3), atol=0.02)


def test_without_a_video_the_shapes_stay() -> None:
    template = synthetic.template()
    subject = random_subject(template, np.random.default_rng(4))
    still = performances.nothing(Blendshapes(subject.neutral, template.expressions, subject.eye_centres))
    assert untouched(still, []).deltas is still.deltas
