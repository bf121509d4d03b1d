"""What the light tells of shapes, on a drawn clip of a head whose raised brow bulges, unknown to its rig."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import synthetic
from test_details_stage import BROWS, FRAMES, LENS, LIGHT, R, T, albedo, performance, shapes, weights

from avatarbuild.artefacts import Performance
from avatarbuild.formats.colour import encode_srgb
from avatarbuild.progress import Silent
from avatarbuild.shading.clip import good_frames, pictures
from avatarbuild.shading.depth import Told, told
from avatarbuild.shading.registration import FREEDOM
from avatarbuild.shading.surface import draw, fine_skin

HIGH, ABOUT, WIDE = 19.0, 9.0, 14.0  # mm: the bulge's place, its spread up and aside


def bulge() -> np.ndarray:
    """(n,) mm forward at full weight of all brows, in the mean 1.5 mm at its top."""
    x, y, z = shapes().neutral.T
    return 2.5 * np.exp(-(((y - HIGH) / ABOUT) ** 2) - (x / WIDE) ** 2) * (z > 0)


@cache
def picture(i: int) -> np.ndarray:
    template = synthetic.template()
    skin = fine_skin(template, albedo().albedo)
    posed = shapes().neutral + np.tensordot(weights()[i], shapes().deltas.astype(float), 1)
    posed[:, 2] += weights()[i, BROWS[0]] * bulge()
    drawn = draw(skin, posed, LENS, R, T, 1, whole=True)
    grey = np.where(drawn.on, 0.55 * np.exp(drawn.tone) * LIGHT.shade(drawn), 0.1)
    return np.repeat(encode_srgb(grey)[..., None], 3, axis=2)


def asked(take: Performance) -> Told:
    images = [SimpleNamespace(rgb=partial(picture, i)) for i in range(FRAMES)]
    frames = SimpleNamespace(images=images)
    capture: Any = SimpleNamespace(clip=SimpleNamespace(file="clip.mp4", processed=take.processed, frames=frames))
    found = (capture, albedo(), shapes(), take, np.arange(FRAMES), synthetic.template())
    return told(*found, 1.0, FREEDOM.worth, Silent())


def forward(deltas: np.ndarray) -> float:
    """How much of the bulge the brows' shapes have."""
    b = bulge()
    moved = (deltas - shapes().deltas)[BROWS, :, 2].sum(axis=0)
    return float(moved @ b / (b @ b))


def test_the_light_tells_of_a_bulge_and_is_not_believed_twice() -> None:
    evidence = np.zeros(52)
    evidence[BROWS] = 1.0
    take = replace(performance(), evidence=evidence)
    first = asked(take)
    assert forward(first.deltas) > 0.1
    lit = replace(take, deltas=first.deltas.astype(np.float32))
    known = asked(replace(lit, depth=(first.deltas - shapes().deltas).astype(np.float32)))
    twice = asked(lit)
    assert forward(first.deltas) < forward(known.deltas) < 1.6 * forward(first.deltas)
    assert forward(twice.deltas) > 1.15 * forward(known.deltas)


def test_frames_without_a_face_move_no_pictures() -> None:
    images = [SimpleNamespace(rgb=lambda i=i: np.full((1, 1, 3), i)) for i in range(5)]
    clip: Any = SimpleNamespace(processed=np.array([0, 3, 6, 9, 12]), frames=SimpleNamespace(images=images))
    take: Any = SimpleNamespace(processed=np.array([0, 9, 12]))  # no face in 3 and 6
    rgb = pictures(clip, take)
    assert [int(rgb(row)[0, 0, 0]) for row in range(3)] == [0, 3, 4]


def test_frames_that_a_hand_hides_in_part_tell_nothing() -> None:
    quality = np.full(7, 1.0)
    quality[2] = 0.45
    teaches = np.array([True, True, False, True])
    take = replace(performance(), processed=np.array([0, 2, 4, 6]), modelled=teaches, quality=quality)
    assert good_frames(take).tolist() == [0, 3]
