"""What all photos show at the nodes of the head's surface: about a millimetre apart, where photos are compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import igl
import numpy as np
from scipy.spatial import cKDTree

from avatarbuild.geometry.meshes import adjacency, vertex_normals
from avatarbuild.parallel import in_order
from avatarbuild.template import Template
from avatarbuild.texture.photos import Photo, linear_picture, shrunk
from avatarbuild.texture.visibility import Guard, guard, sight

SATURATED = 250  # sRGB bytes from which a channel has lost its light
_PATCH = 1.0  # mm that one observation averages
_GREY = np.array([0.25, 0.6, 0.15], np.float32)
_MEASURED, _BEYOND = 0.3, 6.0  # a vertex is measured from this on; mm that photos are trusted beyond the last one
_LID = 0.9  # mm that a lid's outer side is at least from the eyeball
_FLOOR = 0.02  # linear light below which detail is the sensor's noise


@dataclass(frozen=True)
class Nodes:
    """
    The template's vertices and the midpoints of their edges. position (n, 3) mm in the head frame, normal (n, 3) unit;
    triangles (4 m, 3), four for each of the template's in its order; uv (u, 2) and uv_triangles (4 m, 3); skin (n,)
    bool: a photo may be asked for its colour; front (n,) in [0, 1]: lids, lips and brows, which frontal photos show;
    relief (n,) in [0, 1]: these and the ears, whose colours change within a millimetre; face (n,) bool.
    """

    position: np.ndarray
    normal: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    uv_triangles: np.ndarray
    skin: np.ndarray
    front: np.ndarray
    relief: np.ndarray
    face: np.ndarray


@dataclass(frozen=True)
class Observations:
    """
    p photos at n nodes. colour (p, n, 3) float32 linear, as taken; cosine (p, n) float32 between normal and line of
    sight, 0 where the photo does not see the node; clipped (p, n) share of saturated pixels around it; detail (p, n)
    log of the relative contrast between neighbouring pixels; scale (p, n) pixels per mm.
    """

    colour: np.ndarray
    cosine: np.ndarray
    clipped: np.ndarray
    detail: np.ndarray
    scale: np.ndarray


def nodes_of(
    template: Template, vertices: np.ndarray, measured: np.ndarray, eyes: tuple[np.ndarray, np.ndarray] | None = None
) -> Nodes:
    """
    The nodes of a head (n, 3) in the template's topology.

    measured (n,) in [0, 1]: how far a cloud decided where a vertex lies; where the prior alone did, photos may show the
    room behind the head or the hair before it. eyes: centres (2, 3) and radii (2,) mm, whose neighbourhood, the lids'
    inner side, is not asked for.
    """
    count = template.parts["skin"].vertices.stop
    skin = np.zeros(template.vertex_count)
    skin[:count] = 1
    known = cKDTree(vertices[:count][measured[:count] > _MEASURED])
    skin[:count][known.query(vertices[:count])[0] > _BEYOND] = 0
    skin[template.regions["mouth"] | template.regions["sockets"]] = 0
    if eyes is not None:
        for centre, radius in zip(*eyes):
            skin[np.linalg.norm(vertices - centre, axis=1) < radius + _LID] = 0
    front = np.any([template.regions[name] for name in ("lids", "lips", "brows")], axis=0).astype(float)
    relief = np.maximum(front, template.regions["ears"])
    ring = adjacency(template.vertex_count, template.triangles)
    relief = np.maximum(relief, (ring @ relief > 0).astype(float))
    relief = np.maximum(relief, np.where(ring @ relief > 0, 0.5, 0.0))
    own = vertex_normals(vertices, template.triangles)
    columns = np.column_stack([vertices, own, skin, front, relief, template.regions["face"]])
    fine, triangles = igl.upsample(columns, template.triangles.astype(np.int64))
    flat = np.column_stack([template.uv, np.zeros(len(template.uv))])
    uv, uv_triangles = igl.upsample(flat, template.uv_triangles.astype(np.int64))
    normal = fine[:, 3:6] / np.maximum(np.linalg.norm(fine[:, 3:6], axis=1, keepdims=True), 1e-12)
    return Nodes(
        np.ascontiguousarray(fine[:, :3]),
        normal,
        triangles.astype(np.int32),
        np.ascontiguousarray(uv[:, :2]),
        uv_triangles.astype(np.int32),
        fine[:, 6] > 0.75,
        fine[:, 7],
        fine[:, 8],
        fine[:, 9] > 0.5,
    )


def observe(
    photos: list[Photo], nodes: Nodes, vertices: np.ndarray, triangles: np.ndarray, told: Callable[[], None]
) -> Observations:
    """Every photo at every node; vertices (v, 3), triangles (m, 3) are the whole head, which hides what is behind."""

    # depth maps are drawn here, by all cores, since not every threading layer lets threads share compiled kernels
    guarded = ((photo, guard(photo, vertices, triangles)) for photo in photos)

    def one(pair: tuple[Photo, Guard]) -> tuple[np.ndarray, ...]:
        return _observed(*pair, nodes)

    p, n = len(photos), len(nodes.position)
    out = Observations(
        *(np.zeros((p, n, 3), np.float32), np.zeros((p, n), np.float32), np.zeros((p, n), np.float32)),
        *(np.zeros((p, n), np.float32), np.zeros((p, n), np.float32)),
    )
    for i, (colour, cosine, clipped, detail, scale) in enumerate(in_order(one, guarded, ahead=0)):
        out.colour[i], out.cosine[i], out.clipped[i] = colour, cosine, clipped
        out.detail[i], out.scale[i] = detail, scale
        told()
    return out


def _observed(photo: Photo, seen_by: Guard, nodes: Nodes) -> tuple[np.ndarray, ...]:
    seen = sight(photo, seen_by, nodes.position, nodes.normal)
    use = seen.seen & nodes.skin
    n = len(use)
    if not use.any():
        return np.zeros((n, 3), np.float32), *(np.zeros(n, np.float32) for _ in range(4))
    scale = photo.K[0, 0] / np.maximum(seen.depth, 1.0)
    factor = int(np.clip(round(_PATCH * float(np.median(scale[use]))), 1, 16))
    low = np.maximum(np.floor(seen.pixels[use].min(axis=0)).astype(int) - 2 * factor, 0)
    high = np.ceil(seen.pixels[use].max(axis=0)).astype(int) + 2 * factor
    rgb = photo.image.rgb()[low[1] : high[1], low[0] : high[0]]
    hot: np.ndarray = np.any(rgb >= SATURATED, axis=2)
    clipped = cv2.blur(shrunk(hot.astype(np.float32), factor), (3, 3))
    picture = linear_picture(rgb)
    grey: np.ndarray = np.dot(picture, _GREY)
    rough: np.ndarray = np.subtract(grey, cv2.blur(grey, (3, 3)))
    level = shrunk(grey, factor)
    contrast = 0.5 * np.log((shrunk(np.square(rough), factor) + 1e-9) / np.maximum(level, _FLOOR) ** 2)
    # columns: 3 of colour, clipped, detail
    stack = np.dstack([shrunk(picture, factor), clipped, cv2.blur(contrast, (3, 3))]).astype(np.float32)
    places = ((seen.pixels - low) / factor - 0.5).astype(np.float32)
    places[~use] = 0
    table = np.resize(places, (-(-n // 256), 256, 2))  # remap takes no row longer than 32767
    where = np.ascontiguousarray(table[..., 0]), np.ascontiguousarray(table[..., 1])
    found = np.asarray(cv2.remap(stack, *where, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)).reshape(-1, 5)[:n]
    found[~use] = 0
    scale[~use] = 0
    return found[:, :3], np.where(use, seen.cosine, 0), found[:, 3], found[:, 4], scale
