"""Tangents of a textured mesh, as glTF's TANGENT wants them."""

from __future__ import annotations

import numpy as np

from avatarbuild.geometry.meshes import corner_sums


def vertex_tangents(vertices: np.ndarray, normals: np.ndarray, uv: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """
    (n, 4): t in xyz, unit, orthogonal to the normal, along growing u; w = +-1 with w (n x t) along growing v.

    Per triangle the gradient of u and v over the surface; per vertex their sum over the triangles, weighted by twice
    their area, made orthogonal to the normal. vertices, normals (n, 3), normals unit; uv (n, 2) one for each vertex,
    v up (cut the mesh at its seams first); triangles (m, 3). Where no triangle tells a direction t is any across the
    normal and w is 1.

    Source: Lengyel, Foundations of game engine development, volume 2, section 7.5, 2019.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    p, q, r = (uv[triangles[:, k]] for k in range(3))
    e1, e2, d1, d2 = b - a, c - a, q - p, r - p
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    flat = np.abs(area) < 1e-14
    inverse = np.where(flat, 0.0, 1.0 / np.where(flat, 1.0, area))[:, None]
    along_u = (e1 * d2[:, 1:] - e2 * d1[:, 1:]) * inverse
    along_v = (e2 * d1[:, :1] - e1 * d2[:, :1]) * inverse
    weight = np.linalg.norm(np.cross(e1, e2), axis=1)[:, None]
    n = len(vertices)
    u, v = (corner_sums(_unit(w) * weight, triangles, n) for w in (along_u, along_v))
    t = u - (u * normals).sum(axis=1, keepdims=True) * normals
    lost = np.linalg.norm(t, axis=1) < 1e-9
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    t = np.where(lost[:, None], helper - (helper * normals).sum(axis=1, keepdims=True) * normals, t)
    t = _unit(t)
    side = (np.cross(normals, t) * v).sum(axis=1)
    return np.concatenate([t, np.where(side < 0, -1.0, 1.0)[:, None]], axis=1)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-15)
