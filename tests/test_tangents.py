"""Tangents: by hand on a square, unit and orthogonal on a head, the texture's axes."""

from __future__ import annotations

import numpy as np

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.tangents import vertex_tangents

SQUARE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def test_square_by_hand() -> None:
    uv = SQUARE[:, :2] / 2
    t = vertex_tangents(SQUARE, np.tile([0.0, 0, 1], (4, 1)), uv, TRIANGLES)
    assert np.allclose(t, [1, 0, 0, 1])


def test_mirrored_texture_has_the_other_hand() -> None:
    uv = SQUARE[:, :2] / 2 * [-1, 1]
    t = vertex_tangents(SQUARE, np.tile([0.0, 0, 1], (4, 1)), uv, TRIANGLES)
    assert np.allclose(t, [-1, 0, 0, -1])


def test_turned_texture() -> None:
    uv = np.stack([SQUARE[:, 1], -SQUARE[:, 0]], axis=1)
    t = vertex_tangents(SQUARE, np.tile([0.0, 0, 1], (4, 1)), uv, TRIANGLES)
    assert np.allclose(t, [0, 1, 0, 1])


def test_orthonormal_on_a_bumpy_sheet() -> None:
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.linspace(0, 1, 12), np.linspace(0, 1, 12))
    vertices = np.stack([x, y, 0.2 * np.sin(6 * x) * np.cos(5 * y)], axis=-1).reshape(-1, 3)
    index = np.arange(144).reshape(12, 12)
    a, b, c, d = (k.reshape(-1) for k in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    normals = vertex_normals(vertices, triangles)
    uv = vertices[:, :2] + 0.01 * rng.standard_normal((144, 2))
    t = vertex_tangents(vertices, normals, uv, triangles)
    assert np.allclose(np.linalg.norm(t[:, :3], axis=1), 1)
    assert np.abs((t[:, :3] * normals).sum(axis=1)).max() < 1e-9
    assert (t[:, 3] == 1).all()
    assert (t[:, 0] > 0.5).all()


def test_no_texture_area_still_gives_a_tangent() -> None:
    t = vertex_tangents(SQUARE, np.tile([0.0, 0, 1], (4, 1)), np.zeros((4, 2)), TRIANGLES)
    assert np.isfinite(t).all()
    assert np.allclose(np.linalg.norm(t[:, :3], axis=1), 1)
    assert np.allclose(t[:, 2], 0)
