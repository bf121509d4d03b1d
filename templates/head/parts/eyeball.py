"""The eyeball: an opaque ball with a corneal bulge, whose cornea bears the iris and the pupil in its texture.

glTF viewers without transmission paint a clear cornea opaque or hide what is behind it, and a recessed iris would need
one. So the cornea is part of the closed surface: seen from the front the iris and the pupil stand where they should,
highlights come from the bulge, and lids feel the bulge. The price is that the iris has no parallax behind the cornea.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .part import Floats, Half, Ints, Part, fan_triangles, grid_triangles, reflect

RADIUS = 12.0  # mm, sclera
CORNEA_RADIUS = 7.8  # mm, anterior corneal surface
LIMBUS_RADIUS = 5.85  # mm, half of the visible iris diameter, which hardly differs between adults
PUPIL_RADIUS = 1.9  # mm, a pupil in indoor light
IRIS_UV = 0.205  # radius of the limbus in the texture
FRONT_UV = 0.488  # radius of the front chart in the texture
FRONT_ANGLE = 100.0  # degrees from the gaze where the front chart ends
BACK_UV = 0.112  # radius of the two half discs that hold the back, in the texture's upper corners

_SOFTNESS = 0.12  # mm, rounding of the limbal furrow
_FRONT_RADII = (0.9, PUPIL_RADIUS, 2.9, 3.9, 4.8, 5.4, LIMBUS_RADIUS)
_ANGLES = (31.5, 35.0, 41.0, 48.0, 56.0, 65.0, 75.0, 87.0, FRONT_ANGLE, 116.0, 134.0, 155.0)
_SEGMENTS = 32


def eyeball_radius(angle: Floats, bulge: float = 1.0) -> Floats:
    """Distance in mm of the surface from the rotation centre, at `angle` (radians) from the gaze; shape kept.

    r = 12 + bulge * (max(12, r_cornea) - 12), the maximum rounded at the limbus, with r_cornea the sphere of 7.8 mm
    through the limbus circle. bulge 1 is anatomical (apex at 13.1 mm), 0 a plain ball. A point p lies outside the eye
    when |p| > eyeball_radius(arccos(p_z / |p|)).
    """
    centre = np.sqrt(RADIUS**2 - LIMBUS_RADIUS**2) - np.sqrt(CORNEA_RADIUS**2 - LIMBUS_RADIUS**2)
    cornea = centre * np.cos(angle) + np.sqrt(CORNEA_RADIUS**2 - (centre * np.sin(angle)) ** 2)
    rise = cornea - RADIUS
    return np.asarray(RADIUS + bulge * 0.5 * (rise + np.sqrt(rise**2 + _SOFTNESS**2)) * (np.cos(angle) > 0))


def iris_uv_radius(distance: Floats) -> Floats:
    """Texture radius of the front chart at `distance` mm from the gaze axis (up to the limbus); shape kept."""
    return np.asarray(distance * (IRIS_UV / LIMBUS_RADIUS))


def eyeball(bulge: float = 1.0) -> Part:
    """A closed eyeball looking to +z, rotation centre at the origin; 610 vertices, 1216 triangles.

    Groups: `limbus`, `pupil` (rings of 32 ids, from the subject's left over the top), `cornea`, `sclera`, `apex`,
    `front` (up to 100 degrees from the gaze). Points: `iris_centre`, `iris_left`, `iris_top`, `iris_right`,
    `iris_bottom`, the sides as the subject's: the four on the limbus.
    """
    front = np.array([_angle_at(r, bulge) for r in _FRONT_RADII])
    angles = np.concatenate([front, np.radians(_ANGLES)])
    turn = np.linspace(-np.pi / 2, np.pi / 2, _SEGMENTS // 2 + 1)
    columns, rows = len(turn), len(angles)
    cosine, sine = np.cos(turn), np.sin(turn)
    cosine[[0, -1]] = 0.0
    radius = eyeball_radius(angles, bulge)
    across = (radius * np.sin(angles))[:, None]
    grid = np.stack([across * cosine, across * sine, np.repeat((radius * np.cos(angles))[:, None], columns, 1)], -1)
    poles = np.array([[0.0, 0.0, float(eyeball_radius(np.zeros(1), bulge)[0])], [0.0, 0.0, -RADIUS]])
    vertices = np.concatenate([grid.reshape(-1, 3), poles])
    ids = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    apex, back = rows * columns, rows * columns + 1
    # rows run outwards and columns counter-clockwise: transposed, the rows run to the right as the pattern wants
    triangles = [fan_triangles(ids[0], apex), grid_triangles(ids.T), fan_triangles(ids[-1][::-1], back)]

    last = len(front) + _ANGLES.index(FRONT_ANGLE)
    uv, front_ids, back_ids = _texture(angles, front, cosine, sine, last)
    uv_apex, uv_back = len(uv) - 2, len(uv) - 1
    uv_triangles = [
        fan_triangles(front_ids[0], uv_apex),
        _split_grid(front_ids, back_ids),
        fan_triangles(back_ids[-1][::-1], uv_back),
    ]
    limbus = len(front) - 1
    groups = {
        "cornea": np.append(ids[: limbus + 1].ravel(), apex),
        "sclera": np.append(ids[limbus:].ravel(), back),
        "front": np.append(ids[: last + 1].ravel(), apex),
        "apex": np.array([apex]),
    }
    half = Half(
        vertices,
        np.concatenate(triangles),
        uv,
        np.concatenate(uv_triangles),
        {k: v.astype(np.int32) for k, v in groups.items()},
    )
    part = reflect("eye", half)
    rings = {"limbus": _ring(part, ids[limbus]), "pupil": _ring(part, ids[_FRONT_RADII.index(PUPIL_RADIUS)])}
    corners = [apex, *(int(rings["limbus"][k * _SEGMENTS // 4]) for k in range(4))]
    names = ("iris_centre", "iris_left", "iris_top", "iris_right", "iris_bottom")
    points = {name: _at_vertex(part, v) for name, v in zip(names, corners, strict=True)}
    return replace(part, groups={**part.groups, **rings}, points=points)


def _angle_at(distance: float, bulge: float) -> float:
    """Angle from the gaze at which the surface is `distance` mm from the axis, by bisection."""
    low, high = 0.0, np.pi / 2
    for _ in range(60):
        middle = 0.5 * (low + high)
        reach = float(eyeball_radius(np.array([middle]), bulge)[0]) * np.sin(middle)
        low, high = (middle, high) if reach < distance else (low, middle)
    return 0.5 * (low + high)


def _texture(angles: Floats, front: Floats, cosine: Floats, sine: Floats, last: int) -> tuple[Floats, Ints, Ints]:
    """Texture points: the front as a disc round the middle, iris flat as seen and sclera by angle; the back as a half
    disc in the upper corner, so that the halves mirror each other."""
    columns = len(cosine)
    limbus = front[-1]
    outside = (angles[: last + 1] - limbus) / (np.radians(FRONT_ANGLE) - limbus)
    radii = IRIS_UV + (FRONT_UV - IRIS_UV) * outside
    radii[: len(front)] = iris_uv_radius(np.array(_FRONT_RADII))
    disc = 0.5 + radii[:, None, None] * np.stack([cosine, sine], -1)
    back_angles = angles[last:]
    back_radii = BACK_UV * (np.pi - back_angles) / (np.pi - back_angles[0])
    middle = np.array([0.995, 0.995 - BACK_UV])
    back = middle + back_radii[:, None, None] * np.stack([-cosine, sine], -1)
    uv = np.concatenate([disc.reshape(-1, 2), back.reshape(-1, 2), [[0.5, 0.5]], middle[None]])
    front_ids = np.arange((last + 1) * columns, dtype=np.int32).reshape(-1, columns)
    back_ids = np.arange(back.shape[0] * columns, dtype=np.int32).reshape(-1, columns) + front_ids.size
    return uv, front_ids, back_ids.astype(np.int32)


def _split_grid(front_ids: Ints, back_ids: Ints) -> Ints:
    """grid_triangles over both charts, in the order of grid_triangles of the whole grid."""
    both = [grid_triangles(np.ascontiguousarray(i.T)) for i in (front_ids, back_ids)]
    columns = front_ids.shape[1]
    parts = [b.reshape(2, columns - 1, -1, 3) for b in both]
    return np.concatenate(parts, axis=2).reshape(-1, 3)


def _ring(part: Part, half_ring: Ints) -> Ints:
    """The whole ring in order, from the subject's left over the top."""
    ids = np.unique(np.concatenate([half_ring, part.mirror[half_ring]]))
    turn = np.arctan2(part.vertices[ids, 1], part.vertices[ids, 0])
    return np.asarray(ids[np.argsort(np.mod(turn + 1e-6, 2 * np.pi), kind="stable")], dtype=np.int32)


def _at_vertex(part: Part, vertex: int) -> tuple[int, Floats]:
    triangle, corner = (int(k[0]) for k in np.nonzero(part.triangles == vertex))
    return triangle, np.eye(3)[corner]
