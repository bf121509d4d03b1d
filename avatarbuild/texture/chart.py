"""The template's texture chart: which point of the head each texel stands for, and which texels touch across seams."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.geometry.meshes import face_vectors
from avatarbuild.geometry.raster import interpolate, rasterise
from avatarbuild.template import Template


@dataclass(frozen=True)
class Chart:
    """
    s texels along a side, row 0 on top (v = 1).

    triangle (s, s) int32 of the mesh it was drawn from, -1 outside; barycentric (s, s, 3) float32 in it; part (s, s)
    uint8: 0 outside, k the k-th part of the template, skin = 1.
    """

    size: int
    triangle: np.ndarray
    barycentric: np.ndarray
    part: np.ndarray

    def field(self, values: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """(s, s) or (s, s, c) float32: a quantity (n,) or (n, c) at the corners of triangles (m, 3)."""
        return interpolate(values, triangles, self.triangle, self.barycentric)


def draw_chart(template: Template, uv: np.ndarray, uv_triangles: np.ndarray, size: int) -> Chart:
    """
    The chart of the template's triangles, or of its uniformly refined ones: the r triangles of each follow one another.

    uv (u, 2), uv_triangles (r m, 3).
    """
    raster = rasterise(uv * [size, -size] + [0, size], np.ones(len(uv)), uv_triangles, (size, size))
    each = len(uv_triangles) // len(template.triangles)
    part_of = np.zeros(len(uv_triangles) + 1, np.uint8)  # the last one is "outside", which -1 finds
    for k, part in enumerate(template.parts.values()):
        part_of[each * part.triangles.start : each * part.triangles.stop] = k + 1
    return Chart(size, raster.triangle, raster.barycentric, part_of[raster.triangle])


def seam_ties(template: Template, chart: Chart) -> np.ndarray:
    """
    (l, 2) flat indices of texels that lie on the two sides of the skin's seams, face to face.

    A mesh edge whose two triangles have different texture edges is walked in steps of a texel of the longer of them;
    on each side the texel is the one a texel's width inside.
    """
    skin = template.parts["skin"].triangles
    corners, tex = template.triangles[skin].astype(np.int64), template.uv_triangles[skin]
    size = chart.size
    places = template.uv * [size, -size] + [0, size]
    half = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2)
    tex_half = np.stack([tex, np.roll(tex, -1, axis=1)], axis=2).reshape(-1, 2)
    inside = places[tex].mean(axis=1).repeat(3, axis=0)
    swap = half[:, 0] > half[:, 1]
    half[swap], tex_half[swap] = half[swap, ::-1], tex_half[swap, ::-1]
    order = np.lexsort((half[:, 1], half[:, 0]))
    first, second = order[:-1], order[1:]
    seam = (half[first] == half[second]).all(axis=1) & (tex_half[first] != tex_half[second]).any(axis=1)
    found = []
    for one, two in zip(first[seam], second[seam]):
        a, b = (places[tex_half[side]] for side in (one, two))
        steps = int(np.ceil(max(float(np.linalg.norm(a[1] - a[0])), float(np.linalg.norm(b[1] - b[0])), 1.0)))
        share = ((np.arange(steps) + 0.5) / steps)[:, None]
        texels = []
        for ends, middle in ((a, inside[one]), (b, inside[two])):
            along = ends[1] - ends[0]
            across = np.array([-along[1], along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
            if float(across @ (middle - ends[0])) < 0:
                across = -across
            column, row = np.floor(ends[0] + share * along + 0.75 * across).astype(np.int64).T
            texels.append(np.clip(row, 0, size - 1) * size + np.clip(column, 0, size - 1))
        found.append(np.stack(texels, axis=1))
    if not found:
        return np.zeros((0, 2), np.int64)
    ties = np.unique(np.concatenate(found), axis=0)
    on_skin = (chart.part.reshape(-1)[ties] == 1).all(axis=1)
    return ties[on_skin & (ties[:, 0] != ties[:, 1])]


def texels_per_mm(template: Template, vertices: np.ndarray, size: int) -> float:
    """Median over the face of a head (n, 3) of the length of a millimetre, in texels of a chart of size x size."""
    face = template.regions["face"][template.triangles].all(axis=1)
    surface = np.linalg.norm(face_vectors(vertices, template.triangles[face]), axis=1)
    p, q, r = np.moveaxis(template.uv[template.uv_triangles[face]] * size, 1, 0)
    flat = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    return float(np.median(np.sqrt(flat / np.maximum(surface, 1e-9))))


def continued(image: np.ndarray, known: np.ndarray, reach: float = np.inf) -> np.ndarray:
    """The image (h, w, c) with the nearest known texel's value within `reach` texels of the known (h, w) bool ones."""
    distance, label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    inside = np.flatnonzero(known)
    source = np.zeros(int(label.max()) + 1, np.int64)
    source[label.reshape(-1)[inside]] = inside
    near = ~known & (distance <= reach)
    out = image.copy()
    out[near] = image.reshape(-1, image.shape[2])[source[label[near]]]
    return out
