"""The tracked head as shape from shading sees it: smooth, drawn at the pixels of a crop about the face."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import igl
import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.mipmap import Mipmap, build_mipmap, sample_texture
from avatarbuild.geometry.raster import interpolate, rasterise
from avatarbuild.shading.sky import sky
from avatarbuild.template import Template
from avatarbuild.texture.photos import linear_picture
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.samples import flow_region

GREY = np.array([0, 0.5, 0.5], np.float32)
"""
The grey that shading is read from: linear green and blue. Skin scatters red light over millimetres, which blurs the
shading of wrinkles; Jensen et al., A practical model for subsurface light transport, 2001, table 1.
"""
_LEVELS = 2  # of Loop subdivision
_ROOM = 8  # pixels about the face
_FACING = 0.15  # cosine between normal and ray below which a pixel is no evidence
_CHART = 2048  # texels of the albedo, half a millimetre is three of them
_TINY = 1e-9


@dataclass(frozen=True)
class FineSkin:
    """
    The template's skin after two levels of Loop subdivision: smooth (m, n) takes its n vertices to the m fine ones,
    triangles (16 t, 3), uv (k, 2), uv_triangles (16 t, 3), face (16 t,) bool: the face's, outside mouth and sockets;
    texture: the logarithm of the albedo's GREY. head (q, 3): the triangles of the whole head, which cast shadows; near
    (v,): the vertices of which the face's fine ones are made, by `reach` (m, v).
    """

    smooth: sp.csr_matrix
    triangles: np.ndarray
    uv: np.ndarray
    uv_triangles: np.ndarray
    face: np.ndarray
    texture: Mipmap
    head: np.ndarray
    near: np.ndarray
    reach: sp.csr_matrix

    def positions(self, vertices: np.ndarray) -> np.ndarray:
        """(m, 3) of a head's vertices (n or more, 3), the skin's first."""
        return self.smooth @ vertices[: self.smooth.shape[1]]


@dataclass(frozen=True)
class Drawn:
    """
    The head at the pixels of a crop, each `factor` frame pixels wide: corner (2,) frame pixels; point (h, w, 3)
    mm and unit normal (h, w, 3) in camera axes, zero beside the head; uv (h, w, 2); tone (h, w) logarithm of the
    albedo; facing (h, w) cosine to the ray; on (h, w) bool the face's evidence; triangle (h, w) and barycentric (h, w,
    3) of `skin`, the fine one; sky (v, D) bool: the directions that its vertices `near` see.
    """

    factor: int
    corner: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    uv: np.ndarray
    tone: np.ndarray
    facing: np.ndarray
    on: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray
    skin: FineSkin
    sky: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        """w, h"""
        return self.on.shape[1], self.on.shape[0]

    def pixels(self, frame_pixels: np.ndarray) -> np.ndarray:
        """(…, 2) frame pixels (first centre at 0.5) to array coordinates of the crop (first centre at 0)."""
        return (frame_pixels - self.corner) / self.factor - 0.5

    def sky_at(self, at: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """(p, D) float32: how much of each direction is seen at some of the pixels, whose rows and columns are `at`."""
        corners, share = self.skin.triangles[self.triangle[at]], self.barycentric[at]
        row = np.repeat(np.arange(len(corners)), 3)
        shape = len(corners), self.skin.reach.shape[0]
        spread = sp.csr_matrix((share.ravel(), (row, corners.ravel())), shape=shape) @ self.skin.reach
        return np.asarray(spread.astype(np.float32) @ self.sky.astype(np.float32))


def fine_skin(template: Template, albedo: np.ndarray) -> FineSkin:
    """albedo (s, s, 3) uint8 sRGB."""
    part = template.parts["skin"]
    count = part.vertices.stop
    triangles = template.triangles[part.triangles].astype(np.int64)
    uv_triangles = template.uv_triangles[part.triangles].astype(np.int64)
    smooth = sp.identity(count, format="csr")
    plain = sp.identity(len(template.uv), format="csr")
    for _ in range(_LEVELS):
        # both lay a triangle's four children out alike
        step, triangles = igl.loop_matrix(triangles, smooth.shape[0])
        flat, uv_triangles = igl.upsample_matrix(uv_triangles, plain.shape[0])
        smooth, plain = sp.csr_matrix(step @ smooth), sp.csr_matrix(flat @ plain)
    grey = cv2.resize(linear_picture(albedo) @ GREY, (_CHART, _CHART), interpolation=cv2.INTER_AREA)
    texture = build_mipmap(np.log(grey + np.float32(1e-3))[..., None])
    face = np.repeat(flow_region(template)[part.triangles], 4**_LEVELS)
    shown = np.zeros(smooth.shape[0], bool)
    shown[triangles[face]] = True
    near = np.flatnonzero(shown @ smooth)
    reach = sp.csr_matrix(smooth[:, near])
    return FineSkin(
        smooth, triangles, plain @ template.uv, uv_triangles, face, texture, template.triangles, near, reach
    )


def draw(
    skin: FineSkin, vertices: np.ndarray, lens: Lens, R: np.ndarray, t: np.ndarray, factor: int, *, whole: bool = False
) -> Drawn:
    """
    The head `vertices` (n, 3), head frame, in the camera x_cam = R x + t, cropped to its face, or with `whole` to all
    of the frame.

    `factor` frame pixels make one of the crop's.
    """
    camera = skin.positions(vertices) @ R.T + t
    pixels = lens.project(camera)[0]
    first, last = np.zeros(2), np.array(lens.size, np.float64)
    if not whole:
        on_face = pixels[np.unique(skin.triangles[skin.face])]
        first = np.clip(np.floor((on_face.min(axis=0) - _ROOM) / factor) * factor, 0, last - 8 * factor)
        last = np.clip(on_face.max(axis=0) + _ROOM, first + 8 * factor, last)
    w, h = ((last - first) // factor).astype(int)
    at = (pixels - first) / factor
    raster = rasterise(at, camera[:, 2], skin.triangles, (int(w), int(h)))
    normals = vertex_normals(camera, skin.triangles)
    fields = interpolate(np.concatenate([camera, normals], axis=1), skin.triangles, raster.triangle, raster.barycentric)
    point, normal = fields[..., :3], fields[..., 3:]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), _TINY)
    uv = interpolate(skin.uv, skin.uv_triangles, raster.triangle, raster.barycentric)
    grey = sample_texture(skin.texture, raster, at, camera[:, 2], skin.triangles, skin.uv, skin.uv_triangles)[..., 0]
    facing = -(normal * point).sum(axis=-1) / np.maximum(np.linalg.norm(point, axis=-1), _TINY)
    on = np.append(skin.face, False)[raster.triangle] & (facing > _FACING)
    tone = np.where(on, grey, 0).astype(np.float32)
    above = sky(vertices @ R.T + t, skin.head, skin.near)
    seen = point, normal.astype(np.float32), uv, tone, facing.astype(np.float32), on
    return Drawn(factor, first, *seen, raster.triangle, raster.barycentric, skin, above)


def normals_of_all(
    template: Template, drawn: Drawn, vertices: np.ndarray, lens: Lens, R: np.ndarray, t: np.ndarray
) -> np.ndarray:
    """
    (h, w, 3) float32 a drawing's normals, and those of eyeballs, teeth and tongue where they hide sockets and mouth.
    """
    first = template.parts["skin"].triangles.stop
    triangles = template.triangles[first:]
    camera = vertices @ R.T + t
    raster = rasterise((lens.project(camera)[0] - drawn.corner) / drawn.factor, camera[:, 2], triangles, drawn.size)
    inner = interpolate(vertex_normals(camera, triangles), triangles, raster.triangle, raster.barycentric)
    skin = np.where(drawn.point[..., 2] > 0, drawn.point[..., 2], np.inf)
    before = (raster.triangle >= 0) & (raster.depth < skin) & ~drawn.on
    length = np.linalg.norm(inner, axis=-1, keepdims=True)
    return np.where(before[..., None], inner / np.maximum(length, _TINY), drawn.normal).astype(np.float32)


def picture(drawn: Drawn, rgb: np.ndarray) -> np.ndarray:
    """(h, w) float32 the frame's linear GREY at the crop's pixels, rgb (H, W, 3) uint8 sRGB."""
    (w, h), (x, y) = drawn.size, drawn.corner.astype(int)
    part = np.ascontiguousarray(rgb[y : y + h * drawn.factor, x : x + w * drawn.factor])
    return cv2.resize(linear_picture(part) @ GREY, (w, h), interpolation=cv2.INTER_AREA)


def factor_for(template: Template, vertices: np.ndarray, lens: Lens, R: np.ndarray, t: np.ndarray, mm: float) -> int:
    """How many frame pixels make about `mm` millimetres at the face's middle: 1 or more."""
    middle = float((vertices[template.regions["face"]].mean(axis=0) @ R.T + t)[2])
    return max(1, round(mm * lens.focal / max(middle, 1.0)))
