"""How much of the sky a point of the head sees, in which mean direction, and which parts of it: by rays."""

from __future__ import annotations

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from avatarbuild.geometry.meshes import vertex_normals

RAYS = 144
_LIFT = 0.15  # mm along the normal: rays must not meet the triangles that they start from
_CLEAR = 0.5  # the same, of flat triangles that stand for skin whose shadows are soft
_HORIZON = -0.3
_STEP = 12  # rays of every point in one query
_GOLDEN = np.pi * (3 - np.sqrt(5))


def ambient(
    vertices: np.ndarray,
    triangles: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    rays: int = RAYS,
    lift: float = _LIFT,
) -> tuple[np.ndarray, np.ndarray]:
    """
    a = (1/pi) int V(d) max(n . d, 0) dd in (k,), and the mean d where V = 1, weighted alike, in (k, 3), unit.

    V(d) is 0 where a ray from the point meets a triangle. vertices (n, 3) mm, triangles (m, 3); points and unit
    normals (k, 3). `rays` directions on a spiral whose density is the cosine, turned for every point by an angle of
    its own, so that nothing is random and neighbours do not share their error; they start `lift` mm off the surface.
    Where nothing is open the direction is the normal.
    """
    scene = RayMeshIntersector(trimesh.Trimesh(vertices, triangles, process=False))
    points, normals = np.asarray(points, np.float64), np.asarray(normals, np.float64)
    k = np.arange(rays) + 0.5
    radius = np.sqrt(k / rays)
    turn = (np.arange(len(points)) * 2.399963) % (2 * np.pi)
    tangent, across = frames(normals)
    count, mean = np.zeros(len(points)), np.zeros((len(points), 3))
    start = points + lift * normals
    for first in range(0, rays, _STEP):
        some = slice(first, min(first + _STEP, rays))
        angle = _GOLDEN * k[some, None] + turn
        r = radius[some, None]
        d = (r * np.cos(angle))[..., None] * tangent + (r * np.sin(angle))[..., None] * across
        d += np.sqrt(1 - r**2)[..., None] * normals
        origins = np.broadcast_to(start, d.shape).reshape(-1, 3)
        free = ~scene.intersects_any(origins, d.reshape(-1, 3)).reshape(d.shape[:2])
        count += free.sum(axis=0)
        mean += (free[..., None] * d).sum(axis=0)
    # a faint share of the normal keeps the direction of a closed pocket defined
    mean += 1e-3 * rays * normals
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    return count / rays, mean / np.maximum(length, 1e-9)


def of_vertices(
    vertices: np.ndarray, triangles: np.ndarray, only: slice, rays: int = RAYS
) -> tuple[np.ndarray, np.ndarray]:
    """`ambient` at the vertices of one part, a range: (n,), 1 on the others, and (n, 3), theirs the normals."""
    normals = vertex_normals(vertices, triangles)
    open_, bent = np.ones(len(vertices)), normals.copy()
    open_[only], bent[only] = ambient(vertices, triangles, vertices[only], normals[only], rays)
    return open_, bent


def seen(
    vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray, normals: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """
    (k, d) bool: V of unit directions (d, 3) at points with unit normals (k, 3), mm; False well below the horizon, where
    no neighbour's normal looks.
    """
    scene = RayMeshIntersector(trimesh.Trimesh(vertices, triangles, process=False))
    point, way = np.nonzero(normals @ directions.T > _HORIZON)
    free = np.zeros((len(points), len(directions)), bool)
    free[point, way] = ~scene.intersects_any(points[point] + _CLEAR * normals[point], directions[way])
    return free


def between_skin(open_: np.ndarray, reflectance: np.ndarray) -> np.ndarray:
    """
    a / (1 - r (1 - a)): (…, 3) the share of light that comes to a hollow of openness a (…,) whose walls are the same
    skin of reflectance r (3,) and as bright as the point itself: red light fills creases more than blue light.

    Source: the geometric series of diffuse interreflections in a uniform cavity.
    """
    a = np.asarray(open_)[..., None]
    return a / (1 - np.asarray(reflectance) * (1 - a))


def frames(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (k, 3) each that stand across the unit normals (k, 3) and each other."""
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    tangent = np.cross(helper, normals)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    return tangent, np.cross(normals, tangent)
