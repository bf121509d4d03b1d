"""
All blendshapes refined jointly against the depth maps of all frames (equation 14).

  min_B  sum_f sum_v c_fv (n_fv^T (R_f B_v(w_f) + t_f - p_fv))^2 + closeness + smoothness

p_fv - x_fv is the displacement d of shape from shading along the ray at the vertex's pixel, c its certainty. The
displacement is from the smooth mesh to the depth map, so that the smoothing itself moves nothing. Closeness is to the
shapes that enter; prior and unknowns are those of modelling (`tracking.modelling`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.shading.relief import Relief
from avatarbuild.shading.surface import Drawn
from avatarbuild.solvers.sparse import conjugate_gradients
from avatarbuild.template import Template
from avatarbuild.tracking.fit import State
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.modelling import Freedom, Space
from avatarbuild.tracking.rig import Rig

FREEDOM = Freedom(share=0.03, least=0.015, length=20.0, depth=10.0, neutral=0.01, worth=0.2)
"""Ten times freer along the line of sight than across it: there lies what shading knows and points do not. Across it
points know more, and the skin would slide."""
_RIM = 7  # pixels of the face's border whose depth is not used
_COVER = 3.0  # mm: a vertex this far from what its pixel shows is hidden
_FACING = 0.2


@dataclass(frozen=True)
class Planes:
    """What a frame asks of n vertices: normal (n, 3) in the head frame, offset (n,) mm along it, sure (n,) in 0..1."""

    normal: np.ndarray
    offset: np.ndarray
    sure: np.ndarray


def planes(template: Template, rig: Rig, state: State, lens: Lens, drawn: Drawn, relief: Relief) -> Planes:
    """Equation (14)'s n, p and certainty at the skin's vertices."""
    part = template.parts["skin"]
    camera = rig.posed(state.weights)[: part.vertices.stop] @ state.R.T + state.t
    normals = vertex_normals(camera, template.triangles[part.triangles])
    at = drawn.pixels(lens.project(camera)[0])[:, ::-1].T
    on = cv2.erode(drawn.on.astype(np.uint8), np.ones((_RIM, _RIM), np.uint8)) * relief.sure
    d, sure = (map_coordinates(image, at, order=1) for image in (relief.d, on))
    depth = map_coordinates(drawn.point[..., 2], at, order=0)
    into = (normals * camera).sum(axis=1) / np.linalg.norm(camera, axis=1)
    sure = sure * (np.abs(depth - camera[:, 2]) < _COVER) * np.clip((-into - _FACING) / 0.5, 0, 1)
    return Planes(normals @ state.R, d * into, np.clip(sure, 0, 1))


def refine(
    template: Template, rig: Rig, states: list[State], asked: list[Planes], axis: np.ndarray, freedom: Freedom = FREEDOM
) -> Rig:
    """The rig nearest to `rig` that meets the planes of all frames; axis (3,) the mean line of sight, head frame."""
    space = Space(template, rig, axis, freedom)
    n, a, free = len(space.free), len(rig.deltas), space.free
    weights = np.concatenate([np.ones((len(states), 1)), [s.weights for s in states]], axis=1)
    normal = np.stack([p.normal[free] for p in asked])
    worth = freedom.worth * np.stack([p.sure[free] for p in asked])
    offset = np.stack([p.offset[free] for p in asked])

    def strayed(y: np.ndarray) -> np.ndarray:
        return space.stray[:, :, None] * (y @ space.turn)

    def spread(pull: np.ndarray) -> np.ndarray:
        """(1 + a, n, 3) of what each frame pulls its vertices (f, n) by along their normals."""
        return strayed((weights.T @ (pull[..., None] * normal).reshape(len(states), -1)).reshape(1 + a, n, 3))

    def columns(y: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(y.transpose(1, 0, 2).reshape(n, -1))

    def back(y: np.ndarray) -> np.ndarray:
        return y.reshape(n, 1 + a, 3).transpose(1, 0, 2)

    def left(y: np.ndarray) -> np.ndarray:
        moved = (weights @ strayed(y).reshape(1 + a, -1)).reshape(len(states), n, 3)
        return spread((moved * normal).sum(axis=-1) * worth) + back(space.prior @ columns(y))

    y = conjugate_gradients(
        *(left, spread(worth * offset), np.zeros((1 + a, n, 3))),
        lambda r: back(space.factor.solve(columns(r))),
        *(freedom.steps, freedom.tolerance),
    )
    change = strayed(y)
    neutral, deltas = rig.neutral.copy(), rig.deltas.copy()
    neutral[free] += change[0]
    deltas[:, free] += change[1:]
    return Rig(neutral, deltas, rig.triangles)
