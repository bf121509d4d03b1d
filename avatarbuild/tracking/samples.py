"""The visible texels O of equation (6): points spread evenly over the skin, with the texture that they should show."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.formats.colour import LUMINANCE
from avatarbuild.geometry.raster import rasterise
from avatarbuild.template import Template
from avatarbuild.texture.chart import Chart, draw_chart, texels_per_mm
from avatarbuild.texture.photos import linear_picture
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.rig import Places

CHART = 2048  # texels: 5 to 6 a millimetre on the face
DARK = 0.02  # linear light, added before the logarithm: below it noise rules
_FACING = 0.3  # cosine between normal and ray from which a texel counts as visible
_COVER = 3.0  # mm: a point this far behind the nearest surface is hidden
_DRAWN = 4  # the depth of the head is drawn at a quarter of the picture's size


@dataclass(frozen=True)
class Samples:
    """
    S samples of one level of the pyramid: places of S x 3 points (v, one footprint to the right, one up), row by row;
    rho (S, 3) logarithm of the albedo, filtered to that level.
    """

    places: Places
    rho: np.ndarray

    def __len__(self) -> int:
        return len(self.rho)


def log_grey(rgb: np.ndarray) -> np.ndarray:
    """(h, w) float32 log(Y + DARK), Y the linear luminance of uint8 sRGB."""
    return np.log(linear_picture(rgb) @ LUMINANCE.astype(np.float32) + np.float32(DARK))


def face_skin(template: Template) -> np.ndarray:
    """(n,) bool vertices of the face's outer skin: without sockets, mouth and ears."""
    r = template.regions
    skin = (r["face"] | r["nose"] | r["lips"] | r["lids"]) & ~(r["mouth"] | r["sockets"] | r["ears"])
    skin[template.parts["skin"].vertices.stop :] = False
    return skin


def flow_region(template: Template) -> np.ndarray:
    """(m,) bool triangles whose skin the photos and the video see alike: the face's, without hair."""
    return (face_skin(template) & ~template.regions["scalp"])[template.triangles].all(axis=1)


def grey_chart(albedo: np.ndarray) -> np.ndarray:
    """(CHART, CHART) float32 the logarithm of grey of an albedo (s, s, 3) uint8."""
    return cv2.resize(log_grey(albedo), (CHART, CHART), interpolation=cv2.INTER_AREA)


def levels_of_samples(
    template: Template, neutral: np.ndarray, grey: np.ndarray, seen: np.ndarray, pixel: list[float], count: list[int]
) -> list[Samples]:
    """
    For each level of the pyramid its samples.

    neutral (n, 3); grey of `grey_chart`; seen (s, s) uint8, stage albedo's coverage; pixel: mm of a pixel on the face
    at each level; count: about how many samples each. Texels that no photo saw are no evidence.
    """
    chart = draw_chart(template, template.uv, template.uv_triangles, CHART)
    known = cv2.resize(seen, (CHART, CHART), interpolation=cv2.INTER_AREA) > 0
    region = np.append(flow_region(template), False)[chart.triangle] & known
    density = texels_per_mm(template, neutral, CHART)
    return [
        _level(chart, grey, region, max(2, round(size * density * _REACH)), n)
        for size, n in zip(pixel, count, strict=True)
    ]


_REACH = 1.5  # pixels between the points of a sample


def _level(chart: Chart, grey: np.ndarray, region: np.ndarray, step: int, count: int) -> Samples:
    # the picture's pixels are box averages, then blurred a little; the texture is brought to the same footprint
    rho = cv2.GaussianBlur(grey, (0, 0), 0.55 * step / _REACH)
    margin = cv2.erode(region.astype(np.uint8), np.ones((2 * step + 1, 2 * step + 1), np.uint8)) > 0
    spacing = max(1, int(np.sqrt(margin.sum() / max(count, 1))))
    offset = spacing // 2
    i, j = (np.nonzero(margin[offset::spacing, offset::spacing])[k] * spacing + offset for k in (0, 1))
    rows = np.stack([i, i, i - step], axis=1)
    columns = np.stack([j, j + step, j], axis=1)
    places = Places(
        chart.triangle[rows, columns].ravel(), chart.barycentric[rows, columns].reshape(-1, 3).astype(np.float64)
    )
    return Samples(places, rho[rows, columns].astype(np.float64))


def visible(
    points: np.ndarray,
    normals: np.ndarray,
    vertices: np.ndarray,
    triangles: np.ndarray,
    lens: Lens,
    R: np.ndarray,
    t: np.ndarray,
) -> np.ndarray:
    """(p,) bool: points (p, 3) with normals (p, 3) that face the camera and that the head (n, 3) does not hide."""
    camera = vertices @ R.T + t
    small = lens.project(camera)[0] / _DRAWN
    w, h = (-(-side // _DRAWN) for side in lens.size)
    depth = rasterise(small, camera[:, 2], triangles, (w, h)).depth
    at = points @ R.T + t
    with np.errstate(invalid="ignore"):
        pixel = np.floor(lens.project(at)[0] / _DRAWN)
    inside = (at[:, 2] > 0) & (pixel >= 0).all(axis=1) & (pixel[:, 0] < w) & (pixel[:, 1] < h)
    x, y = np.where(inside[:, None], pixel, 0).astype(int).T
    facing = -np.einsum("pi,pi->p", normals @ R.T, at) / np.linalg.norm(at, axis=1)
    return inside & (facing > _FACING) & (at[:, 2] < depth[y, x] + _COVER)
