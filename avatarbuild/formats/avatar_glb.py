"""
avatar.glb: the head with its 52 shapes, inner parts, eyeballs and performance, as docs/formats.md lays it out.

Millimetres in the head frame come in, metres in the same axes go out; texture coordinates are turned upside down, since
glTF counts v from the top. n vertices of the template, e = 52 shapes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from avatarbuild import __version__
from avatarbuild.formats.gltf import Writer
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.tangents import vertex_tangents
from avatarbuild.template import COMBINATION_LIMITS, EYE_PARTS, Template

if TYPE_CHECKING:
    from avatarbuild.artefacts import Performance

METRES = 1e-3  # a millimetre
NODES = {"skin": "head"}  # the template's name of a part -> the node's and mesh's, where they differ


@dataclass(frozen=True)
class Look:
    """The name of a material, and its roughness."""

    name: str
    roughness: float


# Wet surfaces are smoother than skin; the cornea mirrors windows.
LOOKS = {
    "skin": Look("skin", 0.5),
    "eye_left": Look("eye", 0.08),
    "eye_right": Look("eye", 0.08),
    "teeth_upper": Look("teeth", 0.22),
    "teeth_lower": Look("teeth", 0.22),
    "gums": Look("gums", 0.3),
    "tongue": Look("tongue", 0.4),
}


@dataclass(frozen=True)
class Rig:
    """
    neutral (n, 3) mm; deltas (e, n, 3) mm at weight 1; eye_centres (2, 3) mm. In a shape, displacements below
    `least_motion` mm and turns of normals below `least_turn` degrees are left out.
    """

    neutral: np.ndarray
    deltas: np.ndarray
    eye_centres: np.ndarray
    least_motion: float
    least_turn: float


@dataclass(frozen=True)
class Pictures:
    """
    PNG or JPEG files. In the template's UV: albedo sRGB, of all parts but the eyes; normal with +Y up and occlusion in
    R, of the skin. The eye's fills the square of its own UV and serves both eyes.
    """

    eye: bytes
    albedo: bytes
    normal: bytes
    occlusion: bytes


@dataclass(frozen=True)
class Made:
    """
    The file, and what went into it: vertices and triangles of each mesh, each mesh's shapes without effect, the largest
    displacement (mm) that was left out.
    """

    glb: bytes
    sizes: dict[str, tuple[int, int]]
    without_effect: dict[str, list[str]]
    left_out: float


@dataclass(frozen=True)
class SplitPart:
    """
    A part cut along its texture's seams: sources (v,) the part's vertices, uv (v, 2), triangles (m, 3) into them.

    The part's own vertices come first, in their order; second and further copies at seams follow.
    """

    sources: np.ndarray
    uv: np.ndarray
    triangles: np.ndarray


def split_at_seams(triangles: np.ndarray, uv_triangles: np.ndarray, uv: np.ndarray, n: int) -> SplitPart:
    """One vertex for every pair (vertex, texture coordinate) that a corner of triangles (m, 3) uses; n vertices."""
    pairs, corner = np.unique(
        np.stack([triangles.ravel(), uv_triangles.ravel()], axis=1).astype(np.int64), axis=0, return_inverse=True
    )
    first = np.diff(pairs[:, 0], prepend=-1) > 0
    place = np.empty(len(pairs), np.int64)
    place[first] = pairs[first, 0]
    place[~first] = n + np.arange(int((~first).sum()))
    sources = np.concatenate([np.arange(n), pairs[~first, 0]])
    coordinates = np.zeros((len(sources), 2))  # a vertex without triangles has none
    coordinates[place] = uv[pairs[:, 1]]
    return SplitPart(sources, coordinates, place[corner.reshape(-1)].reshape(-1, 3))


def write(
    template: Template,
    rig: Rig,
    pictures: Pictures,
    extras: dict[str, Any],
    performance: Performance | None = None,
) -> Made:
    """avatar.glb of a rig in the template's topology, animated if there are tracked frames; `extras` are added."""
    writer = Writer(f"avatarbuild {__version__}")
    materials = _materials(writer, template, pictures)
    normals, turns = _normals(template, rig)
    nodes: dict[str, int] = {}
    sizes: dict[str, tuple[int, int]] = {}
    without_effect: dict[str, list[str]] = {}
    left_out = 0.0
    for part, where in template.parts.items():
        name = NODES.get(part, part)
        eye = EYE_PARTS.index(part) if part in EYE_PARTS else None
        centre = np.zeros(3) if eye is None else rig.eye_centres[eye]
        uv = template.uv if eye is None else template.part_uv(part)
        v = where.vertices
        split = split_at_seams(
            template.triangles[where.triangles] - v.start,
            template.uv_triangles[where.triangles],
            uv,
            v.stop - v.start,
        )
        attributes = {
            "POSITION": writer.attribute((rig.neutral[v] - centre)[split.sources] * METRES, bounds=True),
            "NORMAL": writer.attribute(normals[v][split.sources]),
            "TEXCOORD_0": writer.attribute(np.stack([split.uv[:, 0], 1 - split.uv[:, 1]], axis=1)),
        }
        if part == "skin":
            # the map was made in these tangents; without them a viewer guesses, and the validator warns
            turned = vertex_tangents(
                rig.neutral[v][split.sources], normals[v][split.sources], split.uv, split.triangles
            )
            attributes["TANGENT"] = writer.attribute(turned)
        primitive: dict[str, Any] = {
            "attributes": attributes,
            "indices": writer.indices(split.triangles),
            "material": materials[part],
        }
        mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
        if eye is None:
            targets, still, omitted = _targets(writer, template, rig, turns, v, split)
            primitive["targets"] = targets
            mesh["weights"] = [0.0] * len(targets)
            mesh["extras"] = {"targetNames": list(template.expression_names), "noEffect": still}
            without_effect[name] = still
            left_out = max(left_out, omitted)
        sizes[name] = (len(split.sources), len(split.triangles))
        node: dict[str, Any] = {"name": name, "mesh": writer.add("meshes", mesh)}
        if eye is not None:
            node["translation"] = (centre * METRES).tolist()
            node["extras"] = {"eyeLook": eye_look(template, part)}
        nodes[part] = writer.add("nodes", node)
    # the head carries what is inside it, so that one pose moves all
    writer.tree["nodes"][nodes["skin"]]["children"] = [index for part, index in nodes.items() if part != "skin"]
    roots = [nodes["skin"]]
    if performance is not None and len(performance.times):
        from avatarbuild.formats import glb_performance

        roots.append(glb_performance.add(writer, template, performance, nodes))
    writer.tree["scenes"] = [{"name": "avatar", "nodes": roots}]
    writer.tree["scene"] = 0
    writer.tree["extras"] = {
        "eyeLook": {name: about for eye in EYE_PARTS for name, about in eye_look(template, eye).items()},
        "weightLimits": [{"shape": shape, "atMost": limit} for shape, limit in COMBINATION_LIMITS],
        **extras,
    }
    return Made(writer.glb(), sizes, without_effect, left_out)


def unit_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n, 3) vertex normals; +z where there is none, since glTF allows no zero."""
    normals = vertex_normals(vertices, triangles)
    normals[np.linalg.norm(normals, axis=1) < 0.5] = (0.0, 0.0, 1.0)
    return normals


def _normals(template: Template, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """
    (n, 3) normals of the neutral, (e, n, 3) how far each shape turns them at weight 1.

    A shape that COMBINATION_LIMITS ties to another never acts alone: its normals are those on top of the other.
    """
    limits = dict(COMBINATION_LIMITS)
    deltas = rig.deltas.astype(np.float64)
    rest = unit_normals(rig.neutral, template.triangles)
    posed = [unit_normals(rig.neutral + delta, template.triangles) for delta in deltas]
    turns = []
    for j, name in enumerate(template.expression_names):
        if name not in limits:
            turns.append(posed[j] - rest)
            continue
        i = template.expression_index[limits[name]]
        turns.append(unit_normals(rig.neutral + deltas[i] + deltas[j], template.triangles) - posed[i])
    return rest, np.stack(turns)


def eye_look(template: Template, part: str) -> dict[str, Any]:
    """eyeLook name -> node, axis (in the head's axes, right-handed) and degrees at weight 1, of one eye."""
    return {
        name: {
            "node": f"eye_{turn.eye}",
            "axis": [float(a) + 0.0 for a in turn.axis],
            "degrees": float(turn.degrees),
        }
        for name, turn in template.eye_rotations.items()
        if f"eye_{turn.eye}" == part
    }


def _targets(
    writer: Writer, template: Template, rig: Rig, turns: np.ndarray, v: slice, split: SplitPart
) -> tuple[list[dict[str, int]], list[str], float]:
    """The part's morph targets, the names of those without effect, and the largest displacement left out, in mm."""
    targets, still, left_out = [], [], 0.0
    for name, moved, turned in zip(template.expression_names, rig.deltas[:, v], turns[:, v], strict=True):
        size = np.linalg.norm(moved, axis=1)
        moves = size >= max(rig.least_motion, 1e-12)
        left_out = max(left_out, float(size[~moves].max(initial=0.0)))
        turning = np.linalg.norm(turned, axis=1) >= max(2 * np.sin(np.radians(rig.least_turn) / 2), 1e-12)
        target = {}
        for semantic, values, kept in (("POSITION", moved * METRES, moves), ("NORMAL", turned, turning)):
            rows = np.flatnonzero(kept[split.sources])
            target[semantic] = writer.sparse(rows, values[split.sources[rows]], len(split.sources))
        targets.append(target)
        if not moves.any():
            still.append(name)
    return targets, still, left_out


def _materials(writer: Writer, template: Template, pictures: Pictures) -> dict[str, int]:
    """Part -> material. All parts but the eyes take their colour from the albedo, and their occlusion."""
    albedo, eye = writer.texture(pictures.albedo, "albedo"), writer.texture(pictures.eye, "eye")
    occlusion = writer.texture(pictures.occlusion, "occlusion")
    made: dict[str, int] = {}
    of_look: dict[str, int] = {}
    for part in template.parts:
        look = LOOKS[part]
        if look.name not in of_look:
            material: dict[str, Any] = {
                "name": look.name,
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": eye if part in EYE_PARTS else albedo},
                    "metallicFactor": 0.0,
                    "roughnessFactor": look.roughness,
                },
            }
            if part == "skin":
                material["normalTexture"] = {"index": writer.texture(pictures.normal, "normal")}
            if part not in EYE_PARTS:
                material["occlusionTexture"] = {"index": occlusion}
            of_look[look.name] = writer.add("materials", material)
        made[part] = of_look[look.name]
    return made
