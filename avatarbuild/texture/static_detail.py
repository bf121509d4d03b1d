"""The neutral head's fine relief and its own shadow: a tangent-space normal map and an occlusion map.

The skin's occlusion is that of the head at rest. Teeth, gums, tongue and the mouth's walls are seen when it is open:
theirs is that of the mean head, at the more open one of two expressions that show them.

Two sources of height h over the mesh, in millimetres: what the point cloud says beyond the mesh, as far as it stands
above its own noise; and pores, from the fine band of the albedo: dark is deep. The normal in tangent space is
(-dh/dx, -dh/dy, 1), normalised, x along growing u, y along growing v (up), on the surface in millimetres.

Sources: Beeler et al., High-quality single-shot capture of facial geometry, 2010, section 5 (mesoscopic detail);
Wiener, Extrapolation, interpolation, and smoothing of stationary time series, 1949 (the shrinking of what noise may
have made).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import igl
import numpy as np

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.template import MOUTH_PARTS, Template, expression_weights
from avatarbuild.texture import occlusion
from avatarbuild.texture.chart import Chart, continued, draw_chart

_CLOUD_GRID = 1024  # texels of the cloud's relief: points are half a millimetre apart
_NEAR = 1.5  # mm from the mesh beyond which a point says nothing of its relief
_SPLAT = 0.7  # mm: standard deviation of the blur that carries points to texels
_WIDE = 6.0  # mm: longer waves are the mesh's own
_STEEPEST = 0.6  # slope at which relief is bent down
_LEAST_OPEN, _SOCKET = 0.3, 0.55  # least openness of the skin, and of the sockets: other expressions open them
_LEAST_INSIDE = 0.2  # of the mouth: light from before the face reaches farther in than that of a whole sky
_SHOWN = (  # expressions that show what is in the mouth
    expression_weights(jawOpen=1.0),
    expression_weights(jawOpen=0.15, mouthSmile=0.7, mouthUpperUp=0.6, mouthLowerDown=0.6),
)


@dataclass(frozen=True)
class DetailWeights:
    """
    pore_slope  root mean square slope that pores have on plain skin
    pore_fine   mm: standard deviation of the blur below which the albedo is noise
    pore_wide   mm: standard deviation of the blur above which it is colour, not relief
    """

    pore_slope: float = 0.07
    pore_fine: float = 0.12
    pore_wide: float = 0.7


@dataclass(frozen=True)
class StaticDetail:
    """normal (d, d, 3) uint8 with (128, 128, 255) flat, +Y up; occlusion (d, d) uint8, 255 open; relief (d, d) float32
    mm, what the two were made from."""

    normal: np.ndarray
    occlusion: np.ndarray
    relief: np.ndarray


def maps(
    template: Template,
    vertices: np.ndarray,
    points: np.ndarray,
    albedo: np.ndarray,
    seen: np.ndarray,
    openness: np.ndarray | None = None,
    *,
    size: int = 2048,
    weights: DetailWeights | None = None,
) -> StaticDetail:
    """
    The maps of a neutral head: vertices (n, 3) mm, points (k, 3) mm of the cloud in the same frame, albedo (s, s, 3)
    linear, seen (s, s) in [0, 1], openness (n,) of the vertices as `occlusion.of_vertices` gives it (found again where
    None). Flat on all parts but the skin; the eyes are open.
    """
    w = DetailWeights() if weights is None else weights
    chart = draw_chart(template, template.uv, template.uv_triangles, size)
    skin = chart.part == 1
    metric = chart.field(_metric(template, vertices) * size, template.triangles)
    scale = np.median(metric[skin].mean(axis=-1)) if skin.any() else 1.0
    plain = plain_skin(template, chart)
    coarse = cloud_relief(template, vertices, points, min(_CLOUD_GRID, size))
    relief = cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC)
    luminance = _resized(albedo.mean(axis=-1), size)
    known = np.clip(_resized(seen, size) * 2, 0, 1)
    relief = relief + pores(luminance, plain * known, float(scale), w)
    if openness is None:
        openness, _ = occlusion.of_vertices(vertices, template.triangles, template.parts["skin"].vertices)
    dark = _occlusion(template, chart, openness)
    inside = cv2.erode(skin.astype(np.uint8), np.ones((3, 3))) > 0
    return StaticDetail(_normals(relief, metric, inside), dark, relief)


def cloud_relief(template: Template, vertices: np.ndarray, points: np.ndarray, size: int) -> np.ndarray:
    """
    (size, size) float32 mm: h = s / (s + v) m at every texel, m the weighted mean of the points' signed distances near
    it less its long waves, v the variance of that mean, s what the variance of m exceeds v by, nearby.
    """
    triangles = np.ascontiguousarray(template.triangles[template.parts["skin"].triangles], np.int64)
    mesh = np.ascontiguousarray(vertices, np.float64)
    out = np.zeros((size, size), np.float32)
    if not len(points):
        return out
    _, face, foot = igl.point_mesh_squared_distance(np.ascontiguousarray(points, np.float64), mesh, triangles)[:3]
    corners = [np.ascontiguousarray(mesh[triangles[face, k]]) for k in range(3)]
    barycentric = igl.barycentric_coordinates(np.ascontiguousarray(foot), *corners)
    signed = _above(points, foot, barycentric, corners, vertex_normals(mesh, triangles)[triangles[face]])
    keep = np.abs(signed) < _NEAR
    place = np.einsum("kc,kcx->kx", barycentric, template.uv[template.uv_triangles[face]]) * [size, -size] + [0, size]
    column, row = np.clip(np.floor(place[keep]).astype(np.int64), 0, size - 1).T
    at = row * size + column
    count, total, square = (
        np.bincount(at, values, size * size).reshape(size, size).astype(np.float32)
        for values in (np.ones(int(keep.sum())), signed[keep], signed[keep] ** 2)
    )
    scale = float(np.median(_metric(template, vertices)[template.regions["face"]])) * size
    sigma = max(_SPLAT * scale, 0.5)

    def near(image: np.ndarray, width: float) -> np.ndarray:
        return cv2.GaussianBlur(image, (0, 0), width)

    weight = near(count, sigma)
    enough = weight > 1e-3
    mean = near(total, sigma) / np.maximum(weight, 1e-6)
    scatter = np.maximum(near(square, sigma) / np.maximum(weight, 1e-6) - mean**2, 1e-4)
    # the mean of k points has 1 / k of their variance; k is what the blur gathers
    variance = scatter / np.maximum(weight * 4 * np.pi * sigma**2, 1.0)
    mask = enough.astype(np.float32)
    wide = _WIDE * scale
    area = np.maximum(near(mask, wide), 1e-3)
    fine = (mean - near(mean * mask, wide) / area) * mask
    energy = near(fine**2 * mask, wide / 2) / np.maximum(near(mask, wide / 2), 1e-3)
    signal = np.maximum(energy - near(variance * mask, wide / 2) / np.maximum(near(mask, wide / 2), 1e-3), 0)
    shrunk = np.clip(fine, -0.4, 0.4) * signal / (signal + variance + 1e-6)
    # the cloud's own rim is its worst part
    edge = np.clip(near(mask, 4 * sigma) * 4 - 3, 0, 1)
    chart = draw_chart(template, template.uv, template.uv_triangles, size)
    plain = plain_skin(template, chart) * (
        1 - chart.field(template.regions["ears"].astype(np.float32), template.triangles)
    )
    return (shrunk * edge * plain).astype(np.float32)


def _above(
    points: np.ndarray, foot: np.ndarray, barycentric: np.ndarray, corners: list[np.ndarray], normals: np.ndarray
) -> np.ndarray:
    """
    (k,) mm: the points' heights over the curved surface that the mesh's normals stand for, not over its flat triangles,
    whose facets would show: f + 3/4 sum_i b_i ((x_i - f) . n_i) n_i above the foot f of each point.

    normals (k, 3, 3) of the corners. Source: Boubekeur, Alexa, Phong tessellation, 2008.
    """
    normal = _unit(np.einsum("kc,kcx->kx", barycentric, normals))
    lift = np.zeros_like(foot)
    for c in range(3):
        along = ((corners[c] - foot) * normals[:, c]).sum(axis=1)
        lift += 0.75 * (barycentric[:, c] * along)[:, None] * normals[:, c]
    return ((points - foot - lift) * normal).sum(axis=1)


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def pores(luminance: np.ndarray, plain: np.ndarray, scale: float, w: DetailWeights) -> np.ndarray:
    """(d, d) float32 mm: the band of log luminance between two blurs, hair and moles clipped, as steep as asked for."""
    log = np.log(np.maximum(luminance, 0.004)).astype(np.float32)
    fine = cv2.GaussianBlur(log, (0, 0), max(w.pore_fine * scale, 0.3))
    band = fine - cv2.GaussianBlur(log, (0, 0), w.pore_wide * scale)
    on = plain > 0.5
    if not on.any():
        return np.zeros_like(log)
    spread = 1.4826 * float(np.median(np.abs(band[on]))) + 1e-6
    band = spread * np.tanh(band / (2.5 * spread)) * 2.5 * plain
    rows, columns = np.gradient(band)
    slope = np.sqrt(np.mean(rows[on] ** 2 + columns[on] ** 2)) * scale
    return (band * (w.pore_slope / max(float(slope), 1e-6))).astype(np.float32)


def plain_skin(template: Template, chart: Chart) -> np.ndarray:
    """(d, d) float32 in [0, 1]: skin without brows, lids' rims, mouth, sockets."""
    other = np.zeros(len(template.mean), np.float32)
    for name in ("brows", "lids", "mouth", "sockets"):
        other[template.regions[name]] = 1
    rest = 1 - np.clip(1.5 * chart.field(other, template.triangles), 0, 1)
    return rest * (chart.part == 1)


def _metric(template: Template, vertices: np.ndarray) -> np.ndarray:
    """(n, 2): sides of the texture along u and along v that a millimetre on the surface takes, mean over the triangles
    about each vertex; shear is left out."""
    a, b, c = np.moveaxis(vertices[template.triangles], 1, 0)
    p, q, r = np.moveaxis(template.uv[template.uv_triangles], 1, 0)
    e1, e2, d1, d2 = b - a, c - a, q - p, r - p
    area = d1[:, 0] * d2[:, 1] - d1[:, 1] * d2[:, 0]
    area = np.where(np.abs(area) < 1e-14, 1e-14, area)[:, None]
    along = [np.linalg.norm((e1 * d2[:, 1:] - e2 * d1[:, 1:]) / area, axis=1)]
    along.append(np.linalg.norm((e2 * d1[:, :1] - e1 * d2[:, :1]) / area, axis=1))
    corners = template.triangles.reshape(-1)
    count = np.maximum(np.bincount(corners, minlength=len(vertices)), 1)
    mean = [np.bincount(corners, np.repeat(length, 3), len(vertices)) / count for length in along]
    return 1 / np.maximum(np.stack(mean, axis=1), 1e-6)


def _normals(relief: np.ndarray, metric: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(d, d, 3) uint8: relief mm, metric (d, d, 2) texels a millimetre along u and v."""
    rows, columns = np.gradient(relief)
    x, y = -columns * metric[..., 0], rows * metric[..., 1]
    steep = np.maximum(np.hypot(x, y), 1e-9)
    bend = _STEEPEST * np.tanh(steep / _STEEPEST) / steep * inside
    n = np.stack([x * bend, y * bend, np.ones_like(x)], axis=-1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    return np.clip(np.round(n * 127.5 + 127.5), 0, 255).astype(np.uint8)


def _occlusion(template: Template, chart: Chart, openness: np.ndarray) -> np.ndarray:
    """(d, d) uint8, 255 open; about every part its own values go on, for filters that reach over its border."""
    value = np.maximum(openness, np.where(template.regions["sockets"], _SOCKET, _LEAST_OPEN))
    inside = _in_the_mouth(template)
    value[inside] = np.maximum(mouth_openness(template), _LEAST_INSIDE)[inside]
    drawn = np.round(255 * np.clip(chart.field(value.astype(np.float32), template.triangles), 0, 1))
    return continued(drawn.astype(np.uint8)[..., None], chart.part > 0)[..., 0]


def mouth_openness(template: Template) -> np.ndarray:
    """(n,) ambient occlusion, 1 open, of the mean head's inside of the mouth; 0 elsewhere."""
    inside = _in_the_mouth(template)
    open_ = np.zeros(len(inside))
    for weights in _SHOWN:
        posed = template.pose(template.mean, weights)
        normals = vertex_normals(posed, template.triangles)[inside]
        here, _ = occlusion.ambient(posed, template.triangles, posed[inside], normals)
        open_[inside] = np.maximum(open_[inside], here)
    return open_


def _in_the_mouth(template: Template) -> np.ndarray:
    """(n,) bool: teeth, gums, tongue and the skin within the lips."""
    inside = template.regions["mouth"].copy()
    for name in MOUTH_PARTS:
        if name in template.parts:
            inside[template.parts[name].vertices] = True
    return inside


def _resized(image: np.ndarray, size: int) -> np.ndarray:
    if image.shape[0] == size:
        return np.asarray(image, np.float32)
    how = cv2.INTER_AREA if size < image.shape[0] else cv2.INTER_LINEAR
    return cv2.resize(np.asarray(image, np.float32), (size, size), interpolation=how)
