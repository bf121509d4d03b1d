"""Stages refinement and details on a drawn clip: a head under one light whose brow wrinkles when it is raised."""

from __future__ import annotations

import re
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import synthetic

from avatarbuild.artefacts import Albedo, Blendshapes, Details, Performance, Refinement
from avatarbuild.errors import InputError
from avatarbuild.formats.colour import encode_srgb
from avatarbuild.formats.details import read_details
from avatarbuild.options import DetailsOptions, RefinementOptions
from avatarbuild.progress import Silent
from avatarbuild.report.wrinkles import wrinkles_section
from avatarbuild.shading.light import Light
from avatarbuild.shading.sky import DIRECTIONS
from avatarbuild.shading.surface import draw, fine_skin, normals_of_all
from avatarbuild.simulation.noise import fractal
from avatarbuild.stages import avatar, details, refinement
from avatarbuild.template import ARKIT_NAMES
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.neck import UNBENT

SIZE = (180, 240)
LENS = Lens(310.0, 0.0, SIZE)
LIGHT = Light(0.4 + 3.0 * np.maximum(DIRECTIONS @ [0.3, -0.7, -0.65], 0) ** 3, 0.2, np.ones(1))
R, T = np.diag([1.0, -1, -1]), np.array([0.0, 0, 420])
FRAMES = 6
BROWS = [ARKIT_NAMES.index(name) for name in ("browInnerUp", "browOuterUpLeft", "browOuterUpRight")]


def raised(i: int) -> bool:
    return i % 3 == 2


def weights() -> np.ndarray:
    out = np.zeros((FRAMES, 52))
    for i in range(FRAMES):
        out[i, BROWS] = 0.8 * raised(i)
    return out


@cache
def shapes() -> Blendshapes:
    template = synthetic.template()
    return Blendshapes(template.mean.copy(), template.expressions.astype(np.float32), template.eye_centres)


@cache
def albedo() -> Albedo:
    rows, columns = np.mgrid[0:512, 0:512] / 512.0
    place = np.stack([columns * 200, rows * 200, 0 * rows], axis=-1).reshape(-1, 3)
    speckles = 0.35 + 0.12 * fractal(place, 3.0, 2, 5).reshape(512, 512)
    picture = encode_srgb(np.clip(speckles, 0.05, 0.9))
    colour = np.repeat(picture[..., None], 3, axis=2)
    none = np.zeros((16, 16), np.uint8)
    level = np.full((16, 16, 3), (128, 128, 255), np.uint8)
    light = np.zeros((9, 3))
    light[[0, 3]] = 0.5
    found = (light, np.full(3, 0.4), np.ones((1, 3)))
    return Albedo(colour, colour, colour, none + 255, level, none + 255, *found)


@cache
def picture(i: int) -> np.ndarray:
    """(H, W, 3) uint8: the head lit, with furrows across the forehead where the brows are up."""
    template = synthetic.template()
    skin = fine_skin(template, albedo().albedo)
    posed = shapes().neutral + np.tensordot(weights()[i], shapes().deltas.astype(float), 1)
    drawn = draw(skin, posed, LENS, R, T, 1, whole=True)
    normal = drawn.normal.copy()
    if raised(i):
        head = (drawn.point - T) @ R
        high = np.exp(-(((head[..., 1] - 40) / 14) ** 2)) * np.exp(-((head[..., 0] / 30) ** 4))
        normal[..., 1] += 0.7 * high * np.sin(2 * np.pi * head[..., 1] / 14)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    grey = np.where(drawn.on, 0.55 * np.exp(drawn.tone) * LIGHT.field(drawn).shade(normal), 0.1)
    return np.repeat(encode_srgb(grey)[..., None], 3, axis=2)


@cache
def capture() -> Any:
    images = [SimpleNamespace(rgb=partial(picture, i)) for i in range(FRAMES)]
    frames = SimpleNamespace(images=images)
    return SimpleNamespace(clip=SimpleNamespace(file="clip.mp4", processed=performance().processed, frames=frames))


@cache
def performance() -> Performance:
    s = shapes()
    return Performance(
        *("clip.mp4", SIZE, 10.0, LENS.focal, 0.0, np.arange(FRAMES) / 10, weights()),
        *(*(2 * [np.repeat(R[None], FRAMES, axis=0), np.repeat(T[None], FRAMES, axis=0)]), UNBENT, np.ones(FRAMES)),
        *(np.zeros((FRAMES, 2, 2)), np.arange(FRAMES), np.ones(FRAMES, bool)),
        *(s.neutral, s.deltas, np.zeros_like(s.deltas), s.eye_centres, np.zeros(52)),
    )


@cache
def refined() -> Refinement:
    found = (capture(), albedo(), shapes(), performance())
    return refinement.run(*found, RefinementOptions(pixel=1.0), Silent(), synthetic.template())


@cache
def made() -> Details:
    options = DetailsOptions(pixel=1.0, side=256, keyframes=2)
    found = (capture(), albedo(), performance(), refined())
    return details.run(*found, options, Silent(), synthetic.template(), Path("nowhere"))


def test_refinement_leaves_true_shapes_nearly_alone() -> None:
    assert refined().figures["frames"] == FRAMES
    assert np.linalg.norm(refined().neutral - shapes().neutral, axis=1).max() < 0.5
    still = [i for i in range(51) if i not in BROWS and ARKIT_NAMES[i] != "mouthClose"]
    assert np.abs(refined().deltas[still] - shapes().deltas[still]).max() < 0.5
    assert np.isfinite(refined().light).all()


def test_eyeballs_hide_their_sockets() -> None:
    template = synthetic.template()
    skin = fine_skin(template, albedo().albedo)
    head = shapes().neutral
    whole = draw(skin, head, LENS, R, T, 1, whole=True)
    normal = normals_of_all(template, whole, head, LENS, R, T)
    for centre in template.eye_centres:
        x, y = LENS.project(centre @ R.T + T)[0].astype(int)
        assert normal[y, x, 2] < -0.9
    changed = np.abs(normal - whole.normal).max(axis=-1) > 0.01
    assert not changed[whole.on].any()
    assert changed.sum() < 0.05 * whole.on.sum()


def test_furrows_come_with_the_brows_and_go_without_them() -> None:
    template = synthetic.template()
    synthesis = read_details(made().files, template)
    up, rest = (shapes().neutral + np.tensordot(weights()[i], shapes().deltas.astype(float), 1) for i in (2, 0))
    chart = details.maps.face_chart(template, 256)
    place = chart.field(shapes().neutral)
    brow = (np.abs(place[:, 0]) < 20) & (np.abs(place[:, 1] - 40) < 12)
    cheek = (np.abs(place[:, 1] + 35) < 10) & (np.abs(place[:, 0]) > 30)
    lean = []
    for head in (up, rest):
        normal = synthesis.evaluate(synthesis.strain_of(head)).reshape(-1, 4)[chart.flat, :3]
        lean.append(np.degrees(np.arccos(np.clip(normal[:, 2], -1, 1))))
    assert lean[0][brow].mean() > 2
    assert lean[0][brow].mean() > 3 * lean[1][brow].mean()
    assert lean[0][cheek].mean() < 2


def test_the_report_shows_the_keyframes_with_and_without() -> None:
    section = wrinkles_section(made(), performance(), albedo(), shapes(), synthetic.template())
    assert section.count("<img") == 4
    assert {int(n) for n in re.findall(r"Frame (\d+), with details", section)} <= set(range(FRAMES))
    assert wrinkles_section(Details({}), performance(), albedo(), shapes(), synthetic.template()) == ""


def test_states_of_wrinkles_for_other_viewers() -> None:
    states = avatar.wrinkle_states(synthetic.template(), made(), performance())
    assert len(states) == 2
    for state in states:
        assert set(state["weights"]) == ({ARKIT_NAMES[k] for k in BROWS} if raised(state["frame"]) else set())
        assert {state[name].removeprefix("details/") for name in ("normal", "occlusion")} <= set(made().files)
    assert avatar.wrinkle_states(synthetic.template(), Details({}), performance()) == []


def test_without_a_video_there_are_no_details() -> None:
    still = refinement.untouched(performance(), [])
    none = SimpleNamespace(clip=None)
    found = details.run(
        *(none, albedo(), performance(), still), DetailsOptions(), Silent(), synthetic.template(), Path("nowhere")
    )
    assert found.files == {}


def test_frames_to_save_are_named_or_refused(tmp_path: Path) -> None:
    assert details.frame_numbers("21, 3", 30) == [3, 21]
    assert details.frame_numbers("", 30) == []
    with pytest.raises(InputError, match="save_frames names '30': numbers from 0 to 29"):
        details.frame_numbers("30", 30)
    kept = made()
    kept.save(tmp_path / "d")
    assert Details.load(tmp_path / "d").files == kept.files
