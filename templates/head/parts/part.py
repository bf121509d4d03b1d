"""The artefact that every generator of a part returns, and the few mesh operations they share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@dataclass(frozen=True)
class Part:
    """A mesh of n vertices, m triangles and u texture points, mirror symmetric in x.

    vertices (n, 3) mm, x to the subject's left, y up, z forward; triangles (m, 3), counter-clockwise from outside.
    uv (u, 2) in [0, 1], origin bottom left; uv_triangles (m, 3), counter-clockwise too, no two overlapping.
    mirror (n,) the vertex at (-x, y, z). groups: vertex ids by name (ordered where the generator says so).
    points: named surface points as (triangle, (3,) barycentric). deltas: named displacements (n, 3) mm at weight 1.
    fields: named scalars (n,), which colour the part.
    """

    name: str
    vertices: Floats
    triangles: Ints
    uv: Floats
    uv_triangles: Ints
    mirror: Ints
    groups: Mapping[str, Ints] = field(default_factory=dict)
    points: Mapping[str, tuple[int, Floats]] = field(default_factory=dict)
    deltas: Mapping[str, Floats] = field(default_factory=dict)
    fields: Mapping[str, Floats] = field(default_factory=dict)


@dataclass(frozen=True)
class Half:
    """The half x >= 0 of a part. Vertices with x = 0 and texture points with u = 1/2 are shared with the other half."""

    vertices: Floats
    triangles: Ints
    uv: Floats
    uv_triangles: Ints
    groups: Mapping[str, Ints] = field(default_factory=dict)
    deltas: Mapping[str, Floats] = field(default_factory=dict)
    fields: Mapping[str, Floats] = field(default_factory=dict)


def grid_triangles(ids: Ints) -> Ints:
    """Triangles (2 (r-1)(c-1), 3) of an (r, c) grid of vertex ids: counter-clockwise when columns run to the right and
    rows run up."""
    a, b, c, d = ids[:-1, :-1].ravel(), ids[:-1, 1:].ravel(), ids[1:, 1:].ravel(), ids[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def fan_triangles(ring: Ints, apex: int) -> Ints:
    """Triangles (len(ring) - 1, 3) from consecutive ring vertices to the apex, which lies to the left of the ring."""
    return np.stack([ring[:-1], ring[1:], np.full(len(ring) - 1, apex)], 1).astype(np.int32)


def signed_areas(uv: Floats, uv_triangles: Ints) -> Floats:
    """Signed areas (m,) of the triangles of a chart, positive when counter-clockwise."""
    a, b, c = (uv[uv_triangles[:, k]] for k in range(3))
    e, f = b - a, c - a
    return np.asarray(0.5 * (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]))


def join_halves(halves: list[Half]) -> Half:
    """One half out of several, their vertices and texture points one after the other. Groups, deltas and fields of the
    same name are joined too, so every piece must have the same deltas and fields."""
    starts = np.cumsum([0] + [len(h.vertices) for h in halves])
    uv_starts = np.cumsum([0] + [len(h.uv) for h in halves])
    groups: dict[str, Ints] = {}
    for half, start in zip(halves, starts, strict=False):
        for name, ids in half.groups.items():
            groups[name] = np.concatenate([groups.get(name, ids[:0]), ids + np.int32(start)])
    return Half(
        np.concatenate([h.vertices for h in halves]),
        np.concatenate([h.triangles + np.int32(s) for h, s in zip(halves, starts, strict=False)]),
        np.concatenate([h.uv for h in halves]),
        np.concatenate([h.uv_triangles + np.int32(s) for h, s in zip(halves, uv_starts, strict=False)]),
        groups,
        {k: np.concatenate([h.deltas[k] for h in halves]) for k in halves[0].deltas},
        {k: np.concatenate([h.fields[k] for h in halves]) for k in halves[0].fields},
    )


def join_parts(name: str, parts: list[Part]) -> Part:
    """One part out of several in the same frame and the same texture; their group names stay."""
    starts = np.cumsum([0] + [len(p.vertices) for p in parts]).astype(np.int32)
    uv_starts = np.cumsum([0] + [len(p.uv) for p in parts]).astype(np.int32)
    return Part(
        name,
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.triangles + s for p, s in zip(parts, starts, strict=False)]),
        np.concatenate([p.uv for p in parts]),
        np.concatenate([p.uv_triangles + s for p, s in zip(parts, uv_starts, strict=False)]),
        np.concatenate([p.mirror + s for p, s in zip(parts, starts, strict=False)]),
        {k: ids + s for p, s in zip(parts, starts, strict=False) for k, ids in p.groups.items()},
        fields={k: np.concatenate([p.fields[k] for p in parts]) for k in parts[0].fields},
    )


def reflect(name: str, half: Half) -> Part:
    """The whole part from its half: own vertices first, then the reflected ones. Groups become the union of both
    sides, and `NAME_left`, `NAME_right` are given beside it when NAME leaves out the middle plane."""
    vertices = half.vertices.copy()
    on_plane = np.abs(vertices[:, 0]) < 1e-9
    vertices[on_plane, 0] = 0.0
    image = _images(on_plane)
    seam = np.abs(half.uv[:, 0] - 0.5) < 1e-9
    uv = np.where(np.stack([seam, np.zeros_like(seam)], 1), 0.5, half.uv)
    uv_image = _images(seam)
    mirror = np.concatenate([image, np.flatnonzero(~on_plane).astype(np.int32)])
    groups: dict[str, Ints] = {}
    for key, ids in half.groups.items():
        groups[key] = np.unique(np.concatenate([ids, image[ids]]))
        if not on_plane[ids].any():
            groups[key + "_left"], groups[key + "_right"] = ids, image[ids]
    flip, uv_flip = np.array([-1.0, 1.0, 1.0]), np.array([-1.0, 1.0])
    return Part(
        name,
        np.concatenate([vertices, vertices[~on_plane] * flip]),
        np.concatenate([half.triangles, image[half.triangles][:, ::-1]]),
        np.concatenate([uv, uv[~seam] * uv_flip + np.array([1.0, 0.0])]),
        np.concatenate([half.uv_triangles, uv_image[half.uv_triangles][:, ::-1]]),
        mirror,
        groups,
        {},
        {k: _on_plane_flat(d, on_plane, flip) for k, d in half.deltas.items()},
        {k: np.concatenate([f, f[~on_plane]]) for k, f in half.fields.items()},
    )


def _images(fixed: NDArray[np.bool_]) -> Ints:
    """The id of every reflected point, when the fixed ones stay and the others are appended in order."""
    n = len(fixed)
    image = np.arange(n)
    image[~fixed] = n + np.arange(int((~fixed).sum()))
    return image.astype(np.int32)


def _on_plane_flat(delta: Floats, on_plane: NDArray[np.bool_], flip: Floats) -> Floats:
    delta = delta.copy()
    delta[on_plane, 0] = 0.0
    return np.concatenate([delta, delta[~on_plane] * flip])
