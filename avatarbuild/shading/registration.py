"""
All blendshapes refined jointly against the depth maps of all frames (equation 14).

  min_B  sum_f sum_v c_fv (n_fv^T (R_f B_v(w_f) + t_f - p_fv))^2 + closeness + smoothness

p_fv - x_fv is the displacement d of shape from shading along the ray at the vertex's pixel, c its certainty. The
displacement is from the smooth mesh to the depth map, so that the smoothing itself moves nothing. Closeness is to the
shapes that enter the stage; prior and unknowns are those of modelling (`tracking.modelling`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.shading.observation import View
from avatarbuild.shading.relief import Relief
from avatarbuild.shading.surface import Drawn
from avatarbuild.template import Template
from avatarbuild.tracking.fit import State
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.modelling import Freedom, Space, nearest, with_rest
from avatarbuild.tracking.rig import Rig

FREEDOM = Freedom(share=0.03, least=0.015, length=20.0, depth=10.0, neutral=0.003, worth=0.2, steps=30)
"""Ten times freer along the line of sight than across it: there lies what shading knows and points do not. Across it
points know more, and the skin would slide."""
_SIGMAS = 3.0  # of the prior: as far as a shape is believed to stray at a vertex
_RIM = 7  # pixels of the face's border whose depth is not used
_COVER = 3.0  # mm: a vertex this far from what its pixel shows is hidden
_FACING = 0.2


@dataclass(frozen=True)
class Planes:
    """What a frame asks of n vertices: normal (n, 3) in the head frame, offset (n,) mm along it, sure (n,) in 0..1."""

    normal: np.ndarray
    offset: np.ndarray
    sure: np.ndarray


def planes(template: Template, head: View, lens: Lens, drawn: Drawn, relief: Relief) -> Planes:
    """Equation (14)'s n, p and certainty at the vertices of the skin of a head that was drawn."""
    part = template.parts["skin"]
    camera = head.vertices[: part.vertices.stop] @ head.R.T + head.t
    normals = vertex_normals(camera, template.triangles[part.triangles])
    at = drawn.pixels(lens.project(camera)[0])[:, ::-1].T
    on = cv2.erode(drawn.on.astype(np.uint8), np.ones((_RIM, _RIM), np.uint8)) * relief.sure
    d, sure = (map_coordinates(image, at, order=1) for image in (relief.d, on))
    depth = map_coordinates(drawn.point[..., 2], at, order=0)
    into = (normals * camera).sum(axis=1) / np.linalg.norm(camera, axis=1)
    sure = sure * (np.abs(depth - camera[:, 2]) < _COVER) * np.clip((-into - _FACING) / 0.5, 0, 1)
    return Planes(normals @ head.R, d * into, np.clip(sure, 0, 1))


def refine(
    template: Template,
    base: Rig,
    drawn: Rig,
    states: list[State],
    asked: list[Planes],
    axis: np.ndarray,
    freedom: Freedom = FREEDOM,
) -> Rig:
    """
    The rig nearest to `base` that meets the planes of all frames, which tell how far off `drawn` is; axis (3,) the mean
    line of sight, head frame. Of what a shape strays at a vertex, y standard deviations of the prior, y / sqrt(1 +
    |y|^2 / _SIGMAS^2) stay: where slopes were read wrongly in one frame, a ridge would stand out at weight 1.
    """
    space = Space(template, base, axis, freedom)
    free, count = space.free, len(states)
    normal = np.stack([p.normal[free] for p in asked])
    worth = freedom.worth * np.stack([p.sure[free] for p in asked])
    moved = np.stack([(drawn.posed(s.weights) - base.posed(s.weights))[free] for s in states])
    offset = np.stack([p.offset[free] for p in asked]) + (normal * moved).sum(axis=-1)

    def along(distance: np.ndarray) -> np.ndarray:
        """(f, 3 n) of distances (f, n) along the normals."""
        return (distance[..., None] * normal).reshape(count, -1)

    def pulled(moved: np.ndarray) -> np.ndarray:
        return along((moved.reshape(normal.shape) * normal).sum(axis=-1) * worth)

    still = np.zeros((1 + len(base.deltas), len(free), 3))
    diagonal = worth[..., None] * normal**2
    found = nearest(space, base, with_rest(states), pulled, diagonal, along(worth * offset), still, freedom)
    strayed = (found.deltas - base.deltas)[:, free]
    y = np.linalg.norm(strayed @ space.back, axis=2) / space.stray[1:]
    deltas = found.deltas.copy()
    deltas[:, free] = base.deltas[:, free] + strayed / np.sqrt(1 + (y / _SIGMAS) ** 2)[..., None]
    return Rig(found.neutral, deltas, found.triangles)
