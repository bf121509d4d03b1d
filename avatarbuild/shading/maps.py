"""Relief of a frame in the template's texture: normals in tangent space, and how sure they are."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.geometry.meshes import vertex_normals, vertex_of_uv
from avatarbuild.geometry.tangents import vertex_tangents
from avatarbuild.shading.relief import Relief
from avatarbuild.shading.surface import Drawn
from avatarbuild.template import Template
from avatarbuild.texture.chart import Chart, draw_chart
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.samples import flow_region

_COVER = 3.0  # mm: a texel this far behind what its pixel shows is hidden
_TINY = 1e-9


@dataclass(frozen=True)
class FaceChart:
    """
    The texels of the face, t of them, on the whole chart of side x side: flat (t,) indices, corners (t, 3) of the mesh,
    uv_corners (t, 3) of the texture, barycentric (t, 3).
    """

    template: Template
    chart: Chart
    flat: np.ndarray
    corners: np.ndarray
    uv_corners: np.ndarray
    barycentric: np.ndarray

    @property
    def side(self) -> int:
        """Texels along a side."""
        return self.chart.size

    def field(self, values: np.ndarray) -> np.ndarray:
        """(t, c) of a quantity (n, c) at the vertices."""
        return np.einsum("tk,tkc->tc", self.barycentric, values[self.corners])

    def map(self, values: np.ndarray, rest: np.ndarray | float) -> np.ndarray:
        """(side, side, …) float32 with values (t, …), `rest` elsewhere."""
        out = np.empty((self.side * self.side, *values.shape[1:]), np.float32)
        out[:] = rest
        out[self.flat] = values
        return out.reshape(self.side, self.side, *values.shape[1:])


def face_chart(template: Template, side: int) -> FaceChart:
    """The face's texels, without mouth and sockets."""
    chart = draw_chart(template, template.uv, template.uv_triangles, side)
    on = np.append(flow_region(template), False)[chart.triangle]
    flat = np.flatnonzero(on)
    triangle = chart.triangle.reshape(-1)[flat]
    barycentric = chart.barycentric.reshape(-1, 3)[flat].astype(np.float64)
    return FaceChart(template, chart, flat, template.triangles[triangle], template.uv_triangles[triangle], barycentric)


@dataclass(frozen=True)
class Frames:
    """Of t texels: position (t, 3) mm and the unit tangent, bitangent and normal (t, 3) each, head frame."""

    position: np.ndarray
    tangent: np.ndarray
    bitangent: np.ndarray
    normal: np.ndarray


def frames(chart: FaceChart, vertices: np.ndarray) -> Frames:
    """The tangent frames that a renderer makes at the texels of a posed head (n, 3), as glTF asks."""
    template = chart.template
    normals = vertex_normals(vertices, template.triangles)
    vertex_of = vertex_of_uv(template.triangles, template.uv_triangles, len(template.uv))
    cut = vertex_tangents(vertices[vertex_of], normals[vertex_of], template.uv, template.uv_triangles)
    normal = _unit(chart.field(normals))
    mixed = np.einsum("tk,tkc->tc", chart.barycentric, cut[chart.uv_corners])
    tangent = _unit(mixed[:, :3] - (mixed[:, :3] * normal).sum(axis=1, keepdims=True) * normal)
    bitangent = np.cross(normal, tangent) * np.where(mixed[:, 3:] < 0, -1.0, 1.0)
    return Frames(chart.field(vertices), tangent, bitangent, normal)


def tangent_normals(
    axes: Frames, drawn: Drawn, found: Relief, lens: Lens, R: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    (t, 3) float32 unit normals in the tangent frames, flat where nothing is known; (t,) in 0..1 how sure; (t,) mm that
    the relief stands out along the normal.
    """
    camera = axes.position @ R.T + t
    x, y = drawn.pixels(lens.project(camera)[0]).astype(np.float32).T.reshape(2, -1, 1)

    def at(image: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
        return _remapped(np.ascontiguousarray(image, np.float32), x, y, how)

    depth = at(drawn.point[..., 2], cv2.INTER_NEAREST)
    into = (axes.normal @ R.T * camera).sum(axis=1) / np.maximum(np.linalg.norm(camera, axis=1), _TINY)
    sure = at(found.sure) * np.clip((-into - 0.2) / 0.4, 0, 1) * (np.abs(depth - camera[:, 2]) < _COVER)
    n = _unit(at(found.normal)) @ R
    local = np.stack([(n * axis).sum(axis=1) for axis in (axes.tangent, axes.bitangent, axes.normal)], axis=1)
    local = np.where((sure > 0)[:, None] & (local[:, 2:] > 0.1), local, [0.0, 0.0, 1.0])
    return local.astype(np.float32), np.clip(sure, 0, 1).astype(np.float32), at(found.d) * into * (sure > 0)


def _remapped(image: np.ndarray, x: np.ndarray, y: np.ndarray, how: int) -> np.ndarray:
    """(t,) or (t, c) at places (t, 1) each: cv2's remap takes no side over 32767, so it goes in rows."""
    w = 1024
    count = x.size
    rows = -(-count // w)
    padded = [np.full(rows * w, -1, np.float32) for _ in (x, y)]
    for place, given in zip(padded, (x, y), strict=True):
        place[:count] = np.nan_to_num(given.ravel(), nan=-1.0)
    out = cv2.remap(image, padded[0].reshape(rows, w), padded[1].reshape(rows, w), how, borderValue=0)
    return np.asarray(out.reshape(rows * w, *image.shape[2:])[:count])


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), _TINY))
