"""Equation (3): harmonics, the field, occlusion, the division into skin and light, and the recovery of an albedo."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from avatarbuild.energies import harmonics
from avatarbuild.formats.light import read_light, write_light
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.registration.eye_painting import WHITE
from avatarbuild.solvers import smooth_field
from avatarbuild.template import Template
from avatarbuild.texture import illumination, occlusion, skin_tone
from avatarbuild.texture.chart import draw_chart
from avatarbuild.texture.fused import Fused

SIZE = 256
LIGHT = np.array([1.0, 0.45, 0.3, 0.35, 0.05, 0.1, 0.1, 0.08, -0.03])[:, None] * [1.0, 0.95, 0.88]


@lru_cache
def head() -> SimpleNamespace:
    """The mean head, its chart, normals and occlusion."""
    template = Template.load()
    chart = draw_chart(template, template.uv, template.uv_triangles, SIZE)
    normals = vertex_normals(template.mean, template.triangles)
    open_, bent = occlusion.of_vertices(template.mean, template.triangles, template.parts["skin"].vertices, rays=48)
    normal = chart.field(normals, template.triangles)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    position = chart.field(template.mean, template.triangles)
    return SimpleNamespace(
        template=template, chart=chart, normal=normal, position=position, open=open_, bent=bent, normals=normals
    )


def fused_under(light: np.ndarray, albedo: np.ndarray, shadow: np.ndarray | None = None) -> Fused:
    """The head of `albedo` (s, s, 3) or (3,) under a light's harmonics, with the occlusion of `factor`'s own model."""
    h = head()
    direction = h.normals + h.bent
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    colour = np.asarray(albedo)
    mean = colour if colour.ndim == 1 else np.median(colour[h.chart.part == 1], axis=0)
    lit = occlusion.between_skin(h.open, mean) * np.maximum(harmonics.shading(direction, light), 0.05)
    s = h.chart.field(lit, h.template.triangles)
    s = s if shadow is None else s * shadow[..., None]
    seen = ((h.chart.part == 1) & (h.position[..., 2] > -80)).astype(np.float32)
    return Fused(
        colour=(colour * s * seen[..., None]).astype(np.float32),
        seen=seen,
        label=np.where(seen > 0, 0, -1).astype(np.int16),
        position=h.position,
        normal=h.normal,
        chart=h.chart.part > 0,
        part=h.chart.part,
    )


def factored(fused: Fused, **weights: float) -> illumination.Light:
    h = head()
    return illumination.factor(
        fused, h.template, SimpleNamespace(vertices=h.template.mean), illumination.LightWeights(**weights)
    )


def face() -> np.ndarray:
    """(s, s) bool: the face's skin that light reaches; inside the nostrils it does not."""
    h = head()
    inside = h.chart.field(h.template.regions["face"].astype(float), h.template.triangles) > 0.99
    hidden = np.zeros(len(h.template.mean))
    for name in ("lids", "lips", "mouth", "sockets"):
        hidden[h.template.regions[name]] = 1
    lit = h.chart.field(h.open, h.template.triangles) > 0.2
    return inside & lit & (h.chart.field(hidden, h.template.triangles) == 0)


def spread(values: np.ndarray) -> float:
    """Standard deviation of the log of values (k, 3), about each channel's mean."""
    log = np.log(values)
    return float((log - log.mean(axis=0)).std())


def test_basis_by_hand() -> None:
    assert np.allclose(harmonics.basis(np.array([0.0, 0, 1])), [1, 0, 0, 1, 0, 0, 0, 0, 2])
    assert np.allclose(harmonics.basis(np.array([0.6, 0.8, 0])), [1, 0.6, 0.8, 0, 0.48, 0, 0, -0.28, -1])


def test_nine_numbers_are_recovered() -> None:
    rng = np.random.default_rng(0)
    n = rng.standard_normal((400, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    y = rng.standard_normal(9)
    got = harmonics.fit(harmonics.basis(n), harmonics.basis(n) @ y, np.ones(400), np.full(9, 1e-12), 0.1)
    assert np.abs(got - y).max() < 1e-8


def test_outliers_hardly_move_the_fit() -> None:
    rng = np.random.default_rng(1)
    n = rng.standard_normal((600, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    y = np.array([1.0, 0.2, 0.3, 0.2, 0, 0, 0, 0, 0])
    t = harmonics.basis(n) @ y
    t[:60] -= 0.8
    phi, w, ridge = harmonics.basis(n), np.ones(600), np.full(9, 1e-9)
    robust = np.abs(harmonics.fit(phi, t, w, ridge, 0.02, rounds=20) - y).max()
    plain = np.abs(harmonics.fit(phi, t, w, ridge, 1e9) - y).max()
    assert robust < 0.02
    assert plain > 0.06


@pytest.mark.parametrize("mirror", [None, (0.4, 0.01, 3.0)])
def test_field_against_a_dense_solve(mirror: tuple[float, float, float] | None) -> None:
    rng = np.random.default_rng(2)
    h, w = 10, 12
    residual, mask = rng.standard_normal((h, w)), (rng.random((h, w)) < 0.7) * rng.random((h, w))
    weights = smooth_field.Smoothness(0.05, 0.1, 2.0, mirror)
    one = np.eye(h * w).reshape(-1, h, w)
    laplacian = lambda x: 4 * x - sum(np.roll(x, s, a) for s, a in ((1, -1), (-1, -1), (1, -2), (-1, -2)))  # noqa: E731
    even = (one + one[:, :, ::-1]) / 2
    other = weights.mirror or (0.05, 0.1, 2.0)
    matrix = np.diag(mask.reshape(-1)).reshape(-1, h, w)
    for part, (l1, l2, l3) in ((even, (0.05, 0.1, 2.0)), (one - even, other)):
        matrix = matrix + l1 * part + l2 * laplacian(part) + l3 * laplacian(laplacian(part))
    exact = np.linalg.solve(matrix.reshape(h * w, h * w).T, (mask * residual).reshape(-1)).reshape(h, w)
    got = smooth_field.solve(residual, mask, weights, tolerance=1e-10, steps=400)
    assert np.abs(got - exact).max() < 1e-6


def test_field_without_a_mask_is_one_filter() -> None:
    residual = np.cos(2 * np.pi * np.arange(64) / 32)[None] * np.ones((64, 1))
    got = smooth_field.solve(residual, np.ones((64, 64)), smooth_field.Smoothness(0, 0, smooth_field.cut_off(32.0)))
    assert got.max() == pytest.approx(0.5, abs=0.01)


def test_nothing_hides_a_plane() -> None:
    plane = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    a, b = occlusion.ambient(plane, triangles, np.zeros((1, 3)), np.array([[0.0, 0, 1]]))
    assert a[0] == 1
    assert b[0] @ [0, 0, 1] > 0.999


def test_groove_by_hand() -> None:
    """At the foot between two walls of height h at distance d: a = d / sqrt(d^2 + h^2), they being long."""
    d, h, far = 3.0, 4.0, 4000.0
    walls = [[[s * d, -far, 0], [s * d, far, 0], [s * d, far, h], [s * d, -far, h]] for s in (-1, 1)]
    vertices = np.array(walls, float).reshape(-1, 3)
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    points = np.tile([0.0, 0, -occlusion._LIFT], (40, 1))
    a, b = occlusion.ambient(vertices, triangles, points, np.tile([0.0, 0, 1], (40, 1)))
    assert a.mean() == pytest.approx(d / np.hypot(d, h), abs=0.015)
    # one wall alone: half is open, on the other side
    a, b = occlusion.ambient(vertices[:4] * [1, 1, 1e4], triangles[:2], points + [-d + 0.01, 0, 0], [[0.0, 0, 1]] * 40)
    assert a.mean() == pytest.approx(0.5, abs=0.02)
    assert (b[:, 0] > 0.3).all()


def test_light_between_skin() -> None:
    assert np.allclose(occlusion.between_skin(np.array([1.0]), np.array([0.5, 0.3, 0.2])), 1)
    assert np.allclose(occlusion.between_skin(np.array([0.5]), np.array([0.5, 0.0, 0.2])), [[2 / 3, 0.5, 5 / 9]])


@pytest.mark.parametrize("lightness", [10, 40, 70, 100])
def test_every_tone_stays_what_it_is(lightness: int) -> None:
    tone = skin_tone.tones()[lightness]
    skin, light = skin_tone.divide(tone + skin_tone.SURFACE)
    assert np.allclose(skin, tone, rtol=0.02)
    assert np.allclose(skin * light, tone + skin_tone.SURFACE)


def test_dark_skin_is_not_drawn_to_light() -> None:
    dark, light = skin_tone.tones()[15], skin_tone.tones()[95]
    ratio = np.log(light.mean() / dark.mean())
    found = [skin_tone.divide(tone + skin_tone.SURFACE)[0].mean() for tone in (light, dark)]
    assert np.log(found[0] / found[1]) == pytest.approx(ratio, rel=0.03)


def test_a_warm_lamp_is_light_and_part_of_a_strange_tint() -> None:
    tone = skin_tone.tones()[60]
    warm = (tone + skin_tone.SURFACE) * [1.2, 1.0, 0.8]
    skin, light = skin_tone.divide(warm)
    plain = skin_tone.divide(tone + skin_tone.SURFACE)[1]
    assert light[0] / light[2] > 1.1 * plain[0] / plain[2]
    assert np.allclose(skin * light, warm)


@pytest.mark.parametrize(("exposure", "least", "most"), [(-0.6, 0.8, 1.0), (0.4, 1.0, 1.12)])
def test_whites_tell_what_the_exposure_hides(exposure: float, least: float, most: float) -> None:
    tone = skin_tone.tones()[50]
    seen = (tone + skin_tone.SURFACE) * np.exp(exposure)
    told = skin_tone.divide(seen, exposure)[0] / tone
    untold = skin_tone.divide(seen)[0] / tone
    assert (told >= least).all()
    assert (told <= most).all()
    assert (np.abs(np.log(told)) < 0.5 * np.abs(np.log(untold))).all()


def test_whites_in_a_shade_of_their_own_are_not_believed() -> None:
    tone = skin_tone.tones()[50]
    seen = tone + skin_tone.SURFACE
    assert np.allclose(skin_tone.divide(seen, -4.0)[0], skin_tone.divide(seen)[0], rtol=0.25)


def test_the_white_of_an_eye_is_a_grey_card() -> None:
    """Dark skin under twice the light: alone it passes for lighter skin, beside the whites it does not."""
    template = head().template
    r = skin_tone.tones()[25]
    fused = fused_under(2 * LIGHT, r)
    neutral = SimpleNamespace(
        vertices=template.mean, eye_centres=np.array(template.eye_centres), eye_radius=np.full(2, 12.0)
    )
    white = WHITE * harmonics.shading(np.array([[0.0, 0, 1]]), 2 * LIGHT)[0]
    alone = illumination.factor(fused, template, neutral)
    beside = illumination.factor(fused, template, neutral, whites=[(0, white), (1, white)])
    off = [abs(np.log(light.skin_colour.mean() / r.mean())) for light in (alone, beside)]
    assert off[1] < 0.6 * off[0]


@pytest.mark.parametrize("tone", [20, 90])
def test_constant_albedo_is_found_constant(tone: int) -> None:
    r = skin_tone.tones()[tone]
    fused = fused_under(LIGHT, r)
    light = factored(fused)
    on = face()
    before, after = spread(fused.colour[on]), spread(light.albedo[on])
    assert before > 0.2
    assert 1e-6 < after < 0.03
    assert np.allclose(np.median(light.albedo[on], axis=0) / r, 1, atol=0.35)
    assert np.allclose(light.albedo[on] * light.shading[on], fused.colour[on], rtol=1e-3)
    assert np.allclose(light.harmonics * light.skin_colour, LIGHT * r, atol=0.12 * np.abs(LIGHT * r).max())


def test_the_field_takes_a_smooth_shadow_and_leaves_a_mole() -> None:
    h = head()
    r = skin_tone.tones()[70]
    x, y, _ = np.moveaxis(h.position, -1, 0)
    shadow = (1 - 0.3 * np.exp(-(((x - 45) / 30) ** 2) - ((y + 40) / 30) ** 2)).astype(np.float32)
    mole = np.hypot(x + 40, y + 45) < 3
    albedo = np.where(mole[..., None], 0.45 * r, r)
    fused = fused_under(LIGHT, albedo, shadow)
    with_field, without = factored(fused), factored(fused, field=False)
    on = face() & ~mole & (np.hypot(x + 40, y + 45) > 6)
    assert spread(with_field.albedo[on]) < 0.6 * spread(without.albedo[on])
    there = mole & face()
    ratio = with_field.albedo[there].mean(axis=0) / np.median(with_field.albedo[on], axis=0)
    assert np.allclose(ratio, 0.45, atol=0.06)


def test_three_lights_give_one_albedo() -> None:
    h = head()
    rng = np.random.default_rng(3)
    noise = cv2.GaussianBlur(rng.standard_normal((SIZE, SIZE)).astype(np.float32), (0, 0), 1.0)
    albedo = (skin_tone.tones()[60] * np.exp(0.3 * noise)[..., None]).astype(np.float32)
    lights = []
    for side in (-1, 0, 1):
        y = LIGHT.copy()
        y[1], y[5] = side * 0.5 * y[0], 0.1 * side * y[0]
        lights.append(y)
    fused = [fused_under(y, albedo) for y in lights]
    light = [factored(f) for f in fused]
    on = face() & (h.chart.part == 1)

    def apart(images: list[np.ndarray]) -> float:
        logs = [np.log(image[on]) for image in images]
        logs = [log - np.median(log, axis=0) for log in logs]
        return float(np.mean([np.abs(a - b).mean() for k, a in enumerate(logs) for b in logs[k + 1 :]]))

    assert apart([each.albedo for each in light]) < 0.15 * apart([f.colour for f in fused])


def test_highlights_over_the_lower_envelope_go() -> None:
    r = skin_tone.tones()[60]
    fused = fused_under(LIGHT, r)
    x, y, _ = np.moveaxis(head().position, -1, 0)
    shine = 0.12 * np.exp(-((x - 20) ** 2 + (y - 30) ** 2) / 14**2)[..., None] * (fused.seen > 0)[..., None]
    glossy = replace(fused, colour=(fused.colour + shine).astype(np.float32), low=fused.colour)
    on = face() & (np.hypot(x - 20, y - 30) < 12)
    plain = factored(replace(glossy, low=None), field=False).albedo[on].mean()
    assert abs(factored(glossy, field=False).albedo[on].mean() / r.mean() - 1) < abs(plain / r.mean() - 1) * 0.6


def test_cloth_is_not_skin_and_the_face_always_is() -> None:
    h = head()
    r = skin_tone.tones()[60]
    neck = (h.position[..., 1] < -125) & (h.chart.part == 1)
    fused = fused_under(LIGHT, np.where(neck[..., None], np.array([0.1, 0.2, 0.5]), r))
    skin = factored(fused).skin
    deep = cv2.erode(neck.astype(np.uint8), np.ones((9, 9))) > 0
    assert skin[deep & (fused.seen > 0)].max() < 0.5
    assert skin[face()].min() == 1


def test_a_speck_at_the_rim_is_a_collars_and_elsewhere_a_mole() -> None:
    h, r = head(), skin_tone.tones()[60]
    plain = fused_under(LIGHT, r)
    seen = np.where(h.position[..., 1] < -140, 0, plain.seen)
    inside = cv2.distanceTransform((seen > 0).astype(np.uint8), cv2.DIST_L2, 5) / 0.65  # mm, about
    face_itself = h.chart.field(h.template.regions["face"].astype(float), h.template.triangles)
    neck = (seen > 0) & (h.position[..., 1] < -90) & (face_itself == 0)
    specks = []
    for least, most in ((2.0, 5.0), (10.0, 30.0)):
        rows, columns = np.nonzero(neck & (inside > least) & (inside < most))
        specks.append((rows[len(rows) // 2], columns[len(rows) // 2]))
    albedo = np.tile(r, (SIZE, SIZE, 1))
    for at in specks:
        albedo[at] = [0.02, 0.06, 0.05]
    fused = replace(fused_under(LIGHT, albedo), seen=seen)
    fused = replace(fused, colour=fused.colour * (seen > 0)[..., None])
    skin = factored(fused).skin
    assert skin[specks[0]] < 0.5
    assert skin[specks[1]] > 0.9


def test_a_crease_that_photos_do_not_show_is_no_light() -> None:
    lit = np.ones((80, 120, 3), np.float32)
    lit[:, 28:33] = lit[:, 88:93] = 0.4
    matt = 0.5 * np.ones_like(lit)
    matt[:, 28:33] *= 0.4
    told = illumination._as_seen(lit, matt, np.ones((80, 120)), 3.0)
    assert abs(told[40, 30, 0] - 0.4) < 0.03
    assert told[40, 90, 0] > 0.7
    assert np.abs(told[:, 55:65] - 1).max() < 0.03


def test_nothing_seen_is_even_light() -> None:
    fused = fused_under(LIGHT, skin_tone.tones()[50])
    none = replace(fused, seen=np.zeros_like(fused.seen), colour=np.zeros_like(fused.colour))
    light = factored(none)
    assert np.isfinite(light.albedo).all()
    assert np.isfinite(light.shading).all()
    assert np.allclose(light.harmonics[1:], 0)


def test_it_repeats() -> None:
    fused = fused_under(LIGHT, skin_tone.tones()[50])
    one, two = factored(fused), factored(fused)
    assert np.array_equal(one.albedo, two.albedo)
    assert np.array_equal(one.harmonics, two.harmonics)


def test_a_damaged_light_is_told(tmp_path: Path) -> None:
    write_light(tmp_path, np.zeros((9, 3)), np.ones(3), np.ones((2, 3)))
    whole = (tmp_path / "light.npz").read_bytes()
    for damaged in (whole[:200], b"no archive", whole[:100] + bytes(len(whole) - 100)):
        (tmp_path / "light.npz").write_bytes(damaged)
        with pytest.raises((ValueError, KeyError)):
            read_light(tmp_path)
