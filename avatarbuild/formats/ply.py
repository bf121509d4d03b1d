"""Point clouds and meshes as binary little-endian PLY."""

from __future__ import annotations

import numpy as np

_VERTEX = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    + [(name, "u1") for name in ("red", "green", "blue", "views")]
)
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
_NAMES = {"<f4": "float", "|u1": "uchar"}


def _header(n: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    lines += [f"property {_NAMES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def cloud_bytes(points: np.ndarray, normals: np.ndarray, colours: np.ndarray, views: np.ndarray) -> bytes:
    """A PLY file of points (n, 3), normals (n, 3), colours (n, 3) uint8 and views (n,) uint8."""
    rows = np.empty(len(points), _VERTEX)
    for i, axis in enumerate("xyz"):
        rows[axis], rows[f"n{axis}"] = points[:, i], normals[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, i]
    rows["views"] = views
    return _header(len(points)) + rows.tobytes()


def read_cloud(data: bytes) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    Points, normals (float32), colours and views (uint8) of a file written by `cloud_bytes`.

    Raises ValueError for any other layout.
    """
    end = data.find(b"end_header\n") + len(b"end_header\n")
    rows = np.frombuffer(data, _VERTEX, offset=end)
    if data[:end] != _header(len(rows)):
        raise ValueError("not a point cloud written by this program")
    stack = lambda names: np.stack([rows[name] for name in names], axis=1)  # noqa: E731
    return stack(["x", "y", "z"]), stack(["nx", "ny", "nz"]), stack(["red", "green", "blue"]), rows["views"].copy()


def mesh_bytes(vertices: np.ndarray, triangles: np.ndarray) -> bytes:
    """A PLY file of vertices (n, 3), stored as float32, and triangles (m, 3)."""
    header = [
        *("ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"),
        *(f"property float {axis}" for axis in "xyz"),
        *(f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"),
    ]
    faces = np.empty(len(triangles), _FACE)
    faces["count"], faces["corners"] = 3, triangles
    return ("\n".join(header) + "\n").encode("ascii") + vertices.astype("<f4").tobytes() + faces.tobytes()


def mesh_triangles(data: bytes) -> np.ndarray:
    """
    Triangles (m, 3) int32 of a file written by `mesh_bytes`.

    Raises ValueError for any other layout.
    """
    end = data.find(b"end_header\n") + len(b"end_header\n")
    counts = [int(line.split()[-1]) for line in data[:end].splitlines() if line.startswith(b"element ")]
    if len(counts) != 2 or len(data) != end + 12 * counts[0] + _FACE.itemsize * counts[1]:
        raise ValueError("not a mesh written by this program")
    return np.frombuffer(data, _FACE, offset=end + 12 * counts[0])["corners"].astype(np.int32)
