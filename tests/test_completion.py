"""Completion: what was seen stays, no border shows, the person's colour and pores go on, inner parts have theirs."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from avatarbuild.template import Template
from avatarbuild.texture import completion, template_skin
from avatarbuild.texture.chart import draw_chart, seam_ties
from avatarbuild.texture.occlusion import of_vertices

SIZE = 512
SKIN = np.array([0.24, 0.13, 0.085])


@lru_cache
def scene() -> SimpleNamespace:
    """A darker person than the template, with pores, whose left side nobody saw; and the completed texture."""
    template = Template.load()
    chart = draw_chart(template, template.uv, template.uv_triangles, SIZE)
    x = chart.field(template.mean, template.triangles)[..., 0]
    z = chart.field(template.mean, template.triangles)[..., 2]
    rng = np.random.default_rng(4)
    noise = cv2.GaussianBlur(rng.standard_normal((SIZE, SIZE)).astype(np.float32), (0, 0), 0.8)
    noise *= 0.06 / noise.std()
    albedo = (SKIN * np.exp(noise)[..., None]).astype(np.float32)
    skin = chart.part == 1
    seen = np.where(skin & (x < 12) & (z > -50), 0.9, 0).astype(np.float32)
    albedo[seen == 0] = 0
    texture = template_skin.skin_texture(template, SIZE)
    open_, _ = of_vertices(template.mean, template.triangles, template.parts["skin"].vertices)
    dark = template.regions["nose"] & (open_ < 0.15)
    whole = completion.complete(albedo, seen, template, texture, dark=dark)
    regions = template.regions
    hidden = chart.field(
        (regions["mouth"] | regions["sockets"] | regions["lips"] | dark).astype(np.float32), template.triangles
    )
    fields = {"albedo": albedo, "seen": seen, "texture": texture, "whole": whole, "x": x, "z": z, "hidden": hidden}
    return SimpleNamespace(template=template, chart=chart, dark=dark, **fields)


def test_seen_texels_are_untouched() -> None:
    s = scene()
    deep = cv2.erode((s.seen > 0).astype(np.uint8), np.ones((17, 17))) > 0
    assert deep.sum() > 5000
    deep &= cv2.dilate(s.hidden, np.ones((17, 17))) == 0
    assert np.array_equal(s.whole[deep], s.albedo[deep])


def test_lids_are_the_photos_up_to_the_rim() -> None:
    s = scene()
    lids, sockets = (
        s.chart.field(s.template.regions[name].astype(np.float32), s.template.triangles) for name in ("lids", "sockets")
    )
    from_rim = cv2.distanceTransform((sockets < 0.5).astype(np.uint8), cv2.DIST_L2, 5)
    at = (lids > 0.99) & (s.seen > 0) & (s.x < 0) & (from_rim > 2) & (sockets == 0)
    assert at.sum() > 50
    assert np.abs(s.whole[at] - s.albedo[at]).max() < 1e-6
    assert not np.array_equal(s.whole[sockets > 0.9], s.albedo[sockets > 0.9])


def test_unseen_specks_on_lids_are_filled_from_beside_them() -> None:
    s = scene()
    lids = s.chart.field(s.template.regions["lids"].astype(np.float32), s.template.triangles) > 0.99
    sockets = s.chart.field(s.template.regions["sockets"].astype(np.float32), s.template.triangles)
    from_rim = cv2.distanceTransform((sockets == 0).astype(np.uint8), cv2.DIST_L2, 5)
    row, column = (int(k[0]) for k in np.nonzero(lids & (s.seen > 0) & (s.x < 0) & (from_rim > 3)))
    albedo, seen = s.albedo.copy(), s.seen.copy()
    albedo[row, column], seen[row, column] = 0, 0
    filled, known = completion._across_specks(albedo, seen, lids, 4.0)
    around = s.albedo[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3)
    assert known[row, column] == 1
    assert any(np.array_equal(filled[row, column], colour) for colour in around)
    assert not albedo[row, column].any()


def test_fine_parts_pass_the_seam_without_a_step() -> None:
    s = scene()
    ties = seam_ties(s.template, s.chart)
    noise = np.random.default_rng(1).standard_normal((SIZE, SIZE)).astype(np.float32)
    before = cv2.GaussianBlur(noise, (0, 0), 1.5)
    after = before.copy()
    completion._mix_across(after, ties, s.chart.part == 1, 6.0)

    def step(fine: np.ndarray) -> float:
        return float(np.abs(np.diff(fine.reshape(-1)[ties], axis=1)).mean())

    assert step(after) < 0.5 * step(before)
    changed = after != before
    assert 0.8 < after[changed].std() / before[changed].std() < 1.15
    assert np.array_equal(after[s.chart.part != 1], before[s.chart.part != 1])


def test_nothing_is_left_empty() -> None:
    s = scene()
    assert (s.whole.max(axis=-1) > 0.0025).all()  # a pupil is 0.003
    assert np.isfinite(s.whole).all()
    assert s.whole.dtype == np.float32


def test_no_border_shows() -> None:
    """Means of strips on both sides of the border differ no more than those of strips within what was seen."""
    s = scene()
    log = np.log(s.whole.mean(axis=-1))
    face = (s.chart.field(s.template.regions["face"].astype(float), s.template.triangles) > 0.99) & (s.hidden == 0)
    level = lambda low, high: log[face & (s.x > low) & (s.x <= high)].mean()  # noqa: E731
    at_border = abs(level(12, 18) - level(6, 12))
    assert at_border < 0.04
    assert abs(level(18, 30) - level(-6, 6)) < 0.12


def test_the_persons_colour_goes_on() -> None:
    s = scene()
    face = (s.chart.field(s.template.regions["face"].astype(float), s.template.triangles) > 0.99) & (s.hidden == 0)
    unseen = np.median(s.whole[face & (s.x > 25)], axis=0)
    assert np.allclose(unseen / SKIN, 1, atol=0.15)
    back = np.median(s.whole[(s.chart.part == 1) & (s.z < -120)], axis=0)
    assert np.allclose(back / SKIN, 1, atol=0.3)


def test_pores_match() -> None:
    s = scene()
    log = np.log(s.whole.mean(axis=-1))
    fine = log - cv2.GaussianBlur(log, (0, 0), 1.5)
    face = (s.chart.field(s.template.regions["face"].astype(float), s.template.triangles) > 0.99) & (s.hidden == 0)
    ratio = fine[face & (s.x > 25)].std() / fine[face & (s.x < 0)].std()
    assert ratio == pytest.approx(1, abs=0.2)


def test_parts_keep_the_textures_colours() -> None:
    s = scene()
    for part in range(2, 8):
        at = s.chart.part == part
        assert np.array_equal(s.whole[at], s.texture[at])


def test_eyes() -> None:
    s = scene()
    eye = np.zeros((64, 64, 3), np.float32)
    eye[:32] = [0.1, 0.2, 0.3]
    eye[32:] = [0.5, 0.4, 0.3]
    whole = completion.complete(s.albedo, s.seen, s.template, s.texture, eye)
    for part in (2, 3):
        rows = np.nonzero((s.chart.part == part).any(axis=1))[0]
        upper = s.chart.part == part
        upper[(rows.min() + rows.max()) // 2 - 3 :] = False
        assert np.allclose(whole[upper], [0.1, 0.2, 0.3], atol=1e-5)


def test_nostrils_are_dark_whatever_photos_show() -> None:
    s = scene()
    inside = (s.chart.field(s.dark.astype(np.float32), s.template.triangles) > 0.99) & (s.x < 6)
    assert inside.sum() > 50
    assert np.median(s.whole[inside]) < 0.4 * np.median(s.albedo[inside])


def test_nothing_seen_gives_the_template() -> None:
    s = scene()
    whole = completion.complete(np.zeros_like(s.albedo), np.zeros_like(s.seen), s.template, s.texture)
    assert np.array_equal(whole[s.chart.part == 1], s.texture[s.chart.part == 1])


def test_it_repeats() -> None:
    s = scene()
    assert np.array_equal(s.whole, completion.complete(s.albedo, s.seen, s.template, s.texture, dark=s.dark))


def test_the_shipped_texture() -> None:
    """Lips are redder than cheeks, teeth are the brightest, and the file is small."""
    s = scene()
    lips = s.chart.field(s.template.regions["lips"].astype(float), s.template.triangles) > 0.99
    cheek = (s.chart.field(s.template.regions["face"].astype(float), s.template.triangles) > 0.99) & (s.hidden == 0)
    redness = lambda at: np.median(s.texture[at][:, 0] / s.texture[at][:, 1])  # noqa: E731
    assert redness(lips) > 1.2 * redness(cheek)
    assert s.texture[s.chart.part == 4].mean() > 1.3 * s.texture[s.chart.part == 1].mean()
    from avatarbuild.template import template_folder

    assert (template_folder() / "skin.jpg").stat().st_size < 1.5e6


def test_a_template_of_the_shipped_chart_has_the_shipped_texture() -> None:
    other = replace(scene().template, name="another")
    np.testing.assert_array_equal(template_skin.skin_texture(other, SIZE), scene().texture)


def test_a_template_of_another_chart_has_plain_colours() -> None:
    other = replace(scene().template, uv=0.9 * scene().template.uv)
    image = template_skin.skin_texture(other, 128)
    assert image.shape == (128, 128, 3)
    assert (image > 0).all()
