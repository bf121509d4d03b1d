"""Everything that stands before the camera, made once: subject, skin, wrinkles, room, light and its occlusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.energies.harmonics import basis
from avatarbuild.geometry.meshes import corner_sums, vertex_normals
from avatarbuild.geometry.mipmap import Mipmap, build_mipmap
from avatarbuild.simulation import wrinkles as folding
from avatarbuild.simulation.chart import Chart, chart_of
from avatarbuild.simulation.light import Light, occlusion, room_light
from avatarbuild.simulation.rendering import Lit, Skin
from avatarbuild.simulation.room import Surroundings, furnished_room
from avatarbuild.simulation.skin import Surface, paint, random_person
from avatarbuild.simulation.subject import Subject, random_subject
from avatarbuild.simulation.wrinkles import Wrinkles
from avatarbuild.template import Template

_WRINKLE_CHART = 1024


@dataclass(frozen=True)
class Head:
    """
    A subject with a skin; triangles (m, 3): the template's, less what the shirt hides.

    shut, wide: occlusion (n,) and mean unoccluded direction (n, 3), mouth closed and open; surface as painted on
    `chart`, and as a mipmap for drawing.
    """

    subject: Subject
    triangles: np.ndarray
    chart: Chart
    surface: Surface
    drawn: Mipmap
    wrinkles: Wrinkles
    shut: tuple[np.ndarray, np.ndarray]
    wide: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Studio:
    """The subject, the room, and its light; `others` are further people in view, each with where they are (4, 4)."""

    head: Head
    room: Surroundings
    light: Light
    room_texture: Mipmap
    shirt_open: np.ndarray
    others: list[tuple[Head, np.ndarray]]


def build_head(
    subject: Subject, rng: np.random.Generator, texture: int, *, shirt: tuple[np.ndarray, np.ndarray] | None
) -> Head:
    """A subject's skin; `shirt`: vertices and triangles that also hide light from the neck."""
    template = subject.template
    chart = chart_of(template, texture)
    surface = paint(chart, random_person(rng))
    wrinkles = folding.folds(chart_of(template, min(_WRINKLE_CHART, texture)), int(rng.integers(1 << 20)))
    weights = np.zeros(len(template.expression_names))
    shut = _occlusion(subject, subject.posed(weights), shirt)
    weights[template.expression_index["jawOpen"]] = 0.8
    wide = _occlusion(subject, subject.posed(weights), shirt)
    triangles = drawn_triangles(subject)
    return Head(subject, triangles, chart, surface, build_mipmap(surface.channels()), wrinkles, shut, wide)


def build_studio(
    template: Template,
    seed: int,
    texture: int,
    texel: float,
    *,
    spread: float = 0.875,
    deviation: float = 1.0,
    second_person: bool = False,
    light: int = -1,
) -> Studio:
    """
    The scene of a seed; `texture` texels along the side of the skin's chart, `texel` mm of the room's walls. A `light`
    of 0 or more replaces the room's by one that this number alone decides, from another side.
    """
    person = np.random.default_rng([seed, 1])
    subject = random_subject(template, person, spread=spread, deviation=deviation)
    rng = np.random.default_rng([seed, 2])
    room = furnished_room(rng, texel, collar_of(subject))
    shining = room_light(rng, room.towards_window)
    if light >= 0:
        lamp = np.random.default_rng([light, 9])
        shining = room_light(lamp, np.array([lamp.choice([-1, 1]) * lamp.uniform(0.3, 1.0), 0.2, 0.5]))
    shirt = room.vertices[room.shirt], room.triangles[room.shirt[room.triangles].all(axis=1)]
    number = np.full(len(room.vertices), -1)
    number[room.shirt] = np.arange(len(shirt[0]))
    worn = (shirt[0], number[shirt[1]])
    head = build_head(subject, person, texture, shirt=worn)
    both = np.concatenate([worn[0], head.subject.neutral])
    faces = np.concatenate([worn[1], head.triangles + len(worn[0])])
    shirt_open = occlusion(both, faces, worn[0], room.normals[room.shirt], rays=64)[0]
    others = []
    if second_person:
        place = np.eye(4)
        turn = rng.uniform(-0.4, 0.4)
        place[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        place[:3, 3] = [rng.choice([-1, 1]) * rng.uniform(300, 380), rng.uniform(-40, 80), rng.uniform(-450, -300)]
        neighbour = np.random.default_rng([seed, 8])
        other = random_subject(template, neighbour, spread=spread, deviation=deviation)
        others.append((build_head(other, neighbour, min(texture, 1024), shirt=None), place))
    return Studio(head, room, shining, build_mipmap(room.albedo), shirt_open, others)


def collar_of(subject: Subject) -> np.ndarray:
    """(r, 3) mm: a ring of points as wide as the subject's neck at its narrowest, below the chin, for the shirt."""
    template = subject.template
    skin = subject.neutral[template.parts["skin"].vertices]
    chin = template.landmarks(subject.neutral)[152, 1]
    best, ring = np.inf, skin
    for level in np.arange(chin - 15.0, chin - 60.0, -4.0):
        near = skin[(np.abs(skin[:, 1] - level) < 6.0) & (skin[:, 2] < 5.0)]
        if len(near) > 12 and np.abs(near[:, 0]).max() < best:
            best, ring = np.abs(near[:, 0]).max(), near
    return np.stack([ring[:, 0], np.full(len(ring), chin - 40.0), ring[:, 2]], axis=1)


def drawn_triangles(subject: Subject) -> np.ndarray:
    """(m, 3): the template's triangles, those under the shirt shrunk to nothing, since a shirt hangs where it likes."""
    triangles = subject.template.triangles
    collar = collar_of(subject)
    centre = collar.mean(axis=0)
    reach = np.abs(collar - centre).max(axis=0) + 8.0
    off = (subject.neutral - centre) / np.where(reach > 0, reach, 1.0)
    below = subject.neutral[:, 1] < collar[0, 1] - 12.0
    aside = (np.hypot(off[:, 0], off[:, 2]) > 1) & (subject.neutral[:, 1] < collar[0, 1] + 14.0)
    hidden = (below | aside)[triangles].all(axis=1)
    return np.where(hidden[:, None], np.int32(0), triangles)


def surroundings(studio: Studio, light: Light) -> Lit:
    """The room under a light: the window shines, corners are dim, what is near the window is brighter."""
    room = studio.room
    matt = np.maximum(basis(room.normals) @ light.harmonics, 0.03)
    low, high = room.vertices.min(axis=0), room.vertices.max(axis=0)
    walls = np.stack([room.vertices - low, high - room.vertices], axis=-1)
    # A wall does not darken itself: only distances along the surface count.
    across = np.abs(room.normals)[..., None] < 0.7
    corners = np.prod(np.where(across, 1 - 0.3 * np.exp(-walls / 260.0), 1.0), axis=(1, 2))
    share = corners.copy()
    share[room.shirt] = studio.shirt_open
    shade = matt * share[:, None]
    centre = room.vertices[room.window].mean(axis=0)
    towards = centre - room.vertices
    distance = np.linalg.norm(towards, axis=1)
    facing = np.maximum((towards * room.normals).sum(axis=1) / distance, 0)
    shade += (0.35 * facing / (0.4 + (distance / 1200.0) ** 2))[:, None] * [0.9, 1.0, 1.1] * ~room.shirt[:, None]
    return Lit(
        room.vertices,
        room.triangles,
        room.uv,
        room.triangles,
        studio.room_texture,
        np.where(room.window[:, None], 1.0, shade),
    )


def posed_head(head: Head, weights: np.ndarray, pose: np.ndarray | None = None) -> Skin:
    """The head at weights (e,), moved by `pose` (4, 4) into the world."""
    template = head.subject.template
    R, t = (np.eye(3), np.zeros(3)) if pose is None else (pose[:3, :3], pose[:3, 3])
    vertices = head.subject.posed(weights) @ R.T + t
    normals = vertex_normals(vertices, template.triangles)
    wide = float(np.clip(1.15 * weights[template.expression_index["jawOpen"]], 0, 1))
    open_ = (1 - wide) * head.shut[0] + wide * head.wide[0]
    bent = ((1 - wide) * head.shut[1] + wide * head.wide[1]) @ R.T
    named = dict(zip(template.expression_names, weights.tolist(), strict=True))
    detail = head.wrinkles.detail(folding.gains(named))
    return Skin(
        vertices,
        normals,
        vertex_tangents(vertices, template),
        bent,
        open_,
        head.triangles,
        template.uv,
        template.uv_triangles,
        head.drawn,
        build_mipmap(detail) if detail.any() else None,
    )


def vertex_tangents(vertices: np.ndarray, template: Template) -> np.ndarray:
    """(n, 3) unit: the mean direction of growing u, weighted by the faces' size in the chart."""
    a, b, c = np.moveaxis(vertices[template.triangles], 1, 0)
    p, q, r = np.moveaxis(template.uv[template.uv_triangles], 1, 0)
    along = (b - a) * (r - p)[:, 1:] - (c - a) * (q - p)[:, 1:]
    handed = np.sign((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    total = corner_sums(along * handed[:, None], template.triangles, len(vertices))
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def _occlusion(
    subject: Subject, vertices: np.ndarray, shirt: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    triangles = subject.template.triangles
    hiding, faces = vertices, drawn_triangles(subject)
    if shirt is not None:
        hiding = np.concatenate([vertices, shirt[0]])
        faces = np.concatenate([faces, shirt[1] + len(vertices)])
    return occlusion(hiding, faces, vertices, vertex_normals(vertices, triangles))
