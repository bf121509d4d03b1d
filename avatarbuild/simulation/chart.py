"""The template's texture chart as maps: which point of the mean head each texel stands for."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry.raster import interpolate, rasterise
from avatarbuild.template import Template


@dataclass(frozen=True)
class Chart:
    """
    t x t texels, first row on top.

    position (t, t, 3) mm on the mean head, zero outside; triangle (t, t) int32, -1 outside, and barycentric
    (t, t, 3) in it; part (t, t) int8 index into the template's parts, -1 outside; scale: texels per mm on the face.
    """

    template: Template
    size: int
    triangle: np.ndarray
    barycentric: np.ndarray
    position: np.ndarray
    part: np.ndarray
    scale: float

    def field(self, values: np.ndarray) -> np.ndarray:
        """(t, t) or (t, t, c) float32: a per-vertex quantity (n,) or (n, c) over the chart."""
        return interpolate(values, self.template.triangles, self.triangle, self.barycentric)

    def region(self, name: str, blur: int = 2) -> np.ndarray:
        """(t, t) float32 in [0, 1]: a region of the template, softened over `blur` rings of neighbours."""
        return self.field(softened(self.template, self.template.regions[name].astype(np.float64), blur))

    def texel(self, points: np.ndarray) -> np.ndarray:
        """(k, 2) column and row of the texels nearest to points (k, 3) of the mean head."""
        from scipy.spatial import cKDTree

        skin = self.part == 0
        rows, columns = np.nonzero(skin)
        step = max(len(rows) // 400_000, 1)
        _, nearest = cKDTree(self.position[rows[::step], columns[::step]]).query(points)
        return np.stack([columns[::step][nearest], rows[::step][nearest]], axis=1)


def chart_of(template: Template, size: int) -> Chart:
    """Draw the chart at size x size texels."""
    uv = template.uv * [size, -size] + [0, size]
    raster = rasterise(uv, np.ones(len(uv)), template.uv_triangles, (size, size))
    names = list(template.parts)
    part_of = np.full(len(template.triangles) + 1, -1, np.int8)
    for k, name in enumerate(names):
        part_of[template.parts[name].triangles] = k
    position = interpolate(template.mean, template.triangles, raster.triangle, raster.barycentric)
    face = template.regions["face"][template.triangles].all(axis=1)
    scale = float(np.median(_texels_per_mm(template, size)[face]))
    return Chart(
        template, size, raster.triangle, raster.barycentric, position, part_of[raster.triangle], max(scale, 1e-3)
    )


def softened(template: Template, values: np.ndarray, rounds: int) -> np.ndarray:
    """(n,) means over the neighbours, `rounds` times."""
    t = template.triangles
    n = len(template.mean)
    rows, columns = t[:, [0, 1, 2, 1, 2, 0]].reshape(-1), t[:, [1, 2, 0, 0, 1, 2]].reshape(-1)
    graph = sp.coo_matrix((np.ones(rows.size), (rows, columns)), shape=(n, n)).tocsr() + sp.identity(n)
    graph.data[:] = 1
    means = sp.diags(1 / np.asarray(graph.sum(axis=1)).ravel()) @ graph
    for _ in range(rounds):
        values = means @ values
    return values


def filled(image: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The image (t, t, c) continued beyond `known` (t, t) bool by means of ever coarser neighbourhoods."""
    weight = known.astype(np.float32)
    levels: list[tuple[np.ndarray, np.ndarray]] = [(image * weight[..., None], weight)]
    while min(levels[-1][1].shape) > 1:
        colour, w = levels[-1]
        size = (max(w.shape[1] // 2, 1), max(w.shape[0] // 2, 1))
        small = cv2.resize(w, size, interpolation=cv2.INTER_AREA)
        shrunk = cv2.resize(colour, size, interpolation=cv2.INTER_AREA).reshape(*small.shape, -1)
        levels.append((shrunk, small))
    colour, w = levels[-1]
    full = colour / np.maximum(w, 1e-8)[..., None]
    for colour, w in levels[-2::-1]:
        coarse = cv2.resize(full, w.shape[::-1], interpolation=cv2.INTER_LINEAR).reshape(*w.shape, -1)
        own = colour / np.maximum(w, 1e-8)[..., None]
        full = np.where((w > 1e-6)[..., None], own, coarse)
    return full


def slopes(height: np.ndarray, scale: float) -> np.ndarray:
    """(t, t, 2) dh/du and dh/dv in mm per mm of a relief (t, t) in mm; v points up, rows down."""
    rows, columns = np.gradient(height)
    return np.stack([columns * scale, -rows * scale], axis=-1).astype(np.float32)


def _texels_per_mm(template: Template, size: int) -> np.ndarray:
    """(m,) square root of the ratio of areas."""
    a, b, c = np.moveaxis(template.mean[template.triangles], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    p, q, r = np.moveaxis(template.uv[template.uv_triangles] * size, 1, 0)
    chart = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    return np.sqrt(chart / np.maximum(area, 1e-9))
