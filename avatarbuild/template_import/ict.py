"""ICT-FaceKit: a folder FaceXModel of OBJ files that share one topology, in centimetres.

generic_neutral_mesh.obj is the mean, identityNNN.obj the mean plus one standard deviation of a component, and an
OBJ per expression the mean with that expression at 1; vertex_indices.json lists the expressions. ARKit's names end
in Left and Right, these in _L and _R, and two shapes that ARKit has whole come in halves.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from avatarbuild.errors import InputError
from avatarbuild.formats.obj import read_obj, read_obj_vertices
from avatarbuild.template import ARKIT_NAMES
from avatarbuild.template_import.foreign import COMPONENTS, ForeignHead, millimetres

NEUTRAL = "generic_neutral_mesh.obj"
INDICES = "vertex_indices.json"
VERTICES, FACES = 26719, 26384  # of the published topology
SKIN_FACES = 11144  # its first polygons: face, head and neck; mouth socket, eyes, teeth, lashes follow


def folder_of(source: Path) -> Path | None:
    """The folder with the OBJ files: `source` or its FaceXModel; None if neither holds the neutral mesh."""
    for folder in (source, source / "FaceXModel"):
        if (folder / NEUTRAL).is_file():
            return folder
    return None


def read(source: Path) -> ForeignHead:
    """An ICT head from the repository's root or its FaceXModel.

    Raises:
        InputError: no neutral mesh, no identity, or a file of another topology.
    """
    folder = folder_of(source)
    if folder is None:
        raise InputError(f"{source}: no {NEUTRAL} here or in FaceXModel; name the folder of ICT-FaceKit's OBJ files")
    mesh = read_obj(folder / NEUTRAL)
    scale = millimetres(mesh.vertices, str(folder / NEUTRAL))
    shapes = sorted(folder.glob("identity[0-9][0-9][0-9].obj"))[:COMPONENTS]
    if not shapes:
        raise InputError(f"{folder}: no identity000.obj and so on; the full FaceXModel folder is needed")
    identity = np.stack([_delta(path, mesh.vertices) * scale for path in shapes])
    expressions: dict[str, np.ndarray] = {}
    for name in _expression_names(folder):
        arkit, path = arkit_name(name), folder / f"{name}.obj"
        if arkit is not None:
            if not path.is_file():
                raise InputError(f"{path}: {INDICES} lists this expression, and it is not there; copy it as well")
            expressions[arkit] = expressions.get(arkit, 0.0) + _delta(path, mesh.vertices) * scale
    return ForeignHead(
        "ict", mesh.vertices * scale, mesh.triangles, _skin(mesh.polygon, len(mesh.vertices)), identity, expressions
    )


def arkit_name(name: str) -> str | None:
    """ARKit's name for one of ICT's; None for a shape that ARKit has not (PupilDilate, cheekRaiser).

    browInnerUp_L and browInnerUp_R, cheekPuff_L and cheekPuff_R are halves of one ARKit shape: their sum.
    """
    whole = name.removesuffix("_L").removesuffix("_R")
    if whole in ARKIT_NAMES:
        return whole
    sided = whole + {"_L": "Left", "_R": "Right"}.get(name[-2:], "")
    return sided if sided in ARKIT_NAMES else None


def _expression_names(folder: Path) -> list[str]:
    path = folder / INDICES
    if not path.is_file():
        return sorted(file.stem for file in folder.glob("*.obj") if arkit_name(file.stem) is not None)
    try:
        return [str(name) for name in json.loads(path.read_text())["expressions"]]
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise InputError(f"{path}: no list 'expressions' ({error}); copy the file from the model again") from error


def _delta(path: Path, neutral: np.ndarray) -> np.ndarray:
    vertices = read_obj_vertices(path)
    if len(vertices) != len(neutral):
        raise InputError(f"{path}: {len(vertices)} vertices where {NEUTRAL} has {len(neutral)}; copy the folder again")
    return vertices - neutral


def _skin(polygon: np.ndarray, vertex_count: int) -> np.ndarray:
    """(m,) bool: face, head and neck of the published topology; all of any other, as of a cut-down copy."""
    if vertex_count == VERTICES and polygon.max() + 1 == FACES:
        return polygon < SKIN_FACES
    return np.ones(len(polygon), bool)
