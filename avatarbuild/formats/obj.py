"""Wavefront OBJ: vertices and faces; everything else of the format is passed over."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatarbuild.errors import InputError


class Obj(NamedTuple):
    """vertices (n, 3) float; triangles (m, 3) int32, polygons cut into fans; polygon (m,) int32, each one's face."""

    vertices: np.ndarray
    triangles: np.ndarray
    polygon: np.ndarray


def read_obj(path: Path) -> Obj:
    """Vertices and faces of an OBJ file.

    Raises:
        InputError: no such file, a line that is no vertex or face, a face of a vertex that is not there.
    """
    lines = _lines(path)
    vertices = _vertices(lines, path)
    faces = []
    try:
        for line in lines:
            if line[:2] in (b"f ", b"f\t"):
                faces.append([int(corner.split(b"/")[0]) for corner in line.split()[1:]])
    except ValueError as error:
        raise InputError(f"{path}: not a Wavefront OBJ file (a face reads {error}); export the mesh again") from error
    triangles, polygon = _fans(faces)
    # negative numbers count back from the last vertex, the others from 1
    triangles = np.where(triangles < 0, triangles + len(vertices), triangles - 1)
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        raise InputError(f"{path}: a face names a vertex beyond the {len(vertices)} of the file; export the mesh again")
    return Obj(vertices, triangles.astype(np.int32), polygon)


def read_obj_vertices(path: Path) -> np.ndarray:
    """(n, 3) float vertices alone: all that a morph target adds to its neutral mesh.

    Raises:
        InputError: no such file, or a line that is no vertex.
    """
    return _vertices(_lines(path), path)


def _lines(path: Path) -> list[bytes]:
    try:
        return path.read_bytes().splitlines()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); a Wavefront OBJ file is needed") from error


def _vertices(lines: list[bytes], path: Path) -> np.ndarray:
    rows = [line[2:].split()[:3] for line in lines if line[:2] in (b"v ", b"v\t")]
    try:
        vertices = np.array(rows, dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: not a Wavefront OBJ file (a vertex reads {error}); export the mesh again") from error
    if not len(rows) or vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InputError(f"{path}: no vertices with three coordinates; a Wavefront OBJ file is needed")
    return vertices


def _fans(faces: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (m, 3) about each polygon's first corner, and the polygon (m,) of each, in the file's order."""
    sizes = np.array([len(face) for face in faces], int)
    blocks, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for size in np.unique(sizes[sizes >= 3]):
        rows = np.flatnonzero(sizes == size)
        corners = np.array([faces[i] for i in rows])
        for k in range(1, size - 1):
            blocks.append(corners[:, [0, k, k + 1]])
            owners.append(rows)
    triangles, polygon = np.concatenate(blocks), np.concatenate(owners)
    order = np.argsort(polygon, kind="stable")
    return triangles[order], polygon[order].astype(np.int32)
