"""One frame of an avatar: posed, textured, its details added, lit, as sRGB."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from avatarbuild.animation.skin_light import bent, shaded_hollows, shading
from avatarbuild.artefacts import Albedo, Blendshapes
from avatarbuild.details.synthesis import Synthesis
from avatarbuild.formats.colour import decode_srgb
from avatarbuild.geometry.meshes import vertex_normals, vertex_of_uv
from avatarbuild.geometry.mipmap import Mipmap, build_mipmap, sample_texture
from avatarbuild.geometry.raster import interpolate
from avatarbuild.geometry.tangents import vertex_tangents
from avatarbuild.report.heads import plain, posed
from avatarbuild.report.rendering import View, finish, look
from avatarbuild.report.shading import Light, lit, occlusion
from avatarbuild.template import PIVOT, Refined, Template
from avatarbuild.texture.photos import shrunk

_TEXTURE = 2048  # texels: finer ones no frame shows
_BRIGHT = 0.78  # of the light that a face turned to the camera gets
_SHINE = Light(lamp=0.0, above=0.0, below=0.0, gloss=0.8)


@dataclass(frozen=True)
class Model:
    """
    An avatar that can be drawn: the rig, its refinement, still maps (albedo, slopes along u and v, occlusion: six
    channels), which vertex each texture coordinate belongs to, gloss (n',), and the synthesis of its details, if any.
    """

    template: Template
    rig: Blendshapes
    refined: Refined
    vertex_of_uv: np.ndarray
    still: Mipmap
    gloss: np.ndarray
    skin: np.ndarray
    skin_colour: np.ndarray
    details: Synthesis | None


def model(template: Template, rig: Blendshapes, albedo: Albedo, details: Synthesis | None) -> Model:
    """What is needed of an avatar for its frames."""
    refined = template.subdivide(1)
    corner = vertex_of_uv(refined.triangles, refined.uv_triangles, len(refined.uv))
    step = max(1, albedo.albedo.shape[0] // _TEXTURE)
    colour = shrunk(decode_srgb(albedo.albedo).astype(np.float32), step)
    side = colour.shape[0]
    normal = albedo.normal.astype(np.float32) / 127.5 - 1
    slopes = cv2.resize(-normal[..., :2] / np.maximum(normal[..., 2:], 0.05), (side, side))
    dark = cv2.resize(albedo.occlusion.astype(np.float32) / 255, (side, side))
    still = build_mipmap(np.concatenate([colour, slopes, dark[..., None]], axis=-1))
    each = len(refined.triangles) // len(template.triangles)
    skin = np.arange(len(refined.triangles)) < each * template.parts["skin"].triangles.stop
    gloss = refined.matrix @ plain(template).gloss
    return Model(template, rig, refined, corner, still, gloss, skin, albedo.skin_colour, details)


def exposed(harmonics: np.ndarray) -> np.ndarray:
    """The light y (9, 3), scaled so that a face turned to the camera is well lit: mean y^T phi((0, 0, 1)) = 0.78."""
    front = float((harmonics[0] + harmonics[3] + 2 * harmonics[8]).mean())
    return harmonics * (_BRIGHT / max(front, 1e-6))


def frame(
    model: Model, weights: np.ndarray, turn: np.ndarray, view: View, light: np.ndarray | Light, factor: int = 2
) -> np.ndarray:
    """
    (h, w, 3) uint8 sRGB of weights (52,), the head turned by a rotation (3, 3), under harmonics (9, 3) in the axes of
    the head at rest, or under a lamp.
    """
    coarse = posed(model.template, model.rig, model.template.allowed(weights))
    refined = model.refined
    vertices = (refined.matrix @ coarse - PIVOT) @ turn.T + PIVOT
    seen = look(vertices, refined.triangles, view, factor, cull=True)
    triangle, barycentric = seen.raster.triangle, seen.raster.barycentric
    normals = vertex_normals(vertices, refined.triangles)
    split = vertex_tangents(vertices[model.vertex_of_uv], normals[model.vertex_of_uv], refined.uv, refined.uv_triangles)
    columns = np.concatenate([normals, model.gloss[:, None]], axis=1)
    smooth = interpolate(columns, refined.triangles, triangle, barycentric)
    tangents = interpolate(split, refined.uv_triangles, triangle, barycentric)
    where = (seen.raster, seen.pixels, seen.depth, seen.triangles, refined.uv, refined.uv_triangles)
    still = sample_texture(model.still, *where)
    slopes, dark = still[..., 3:5].copy(), still[..., 5].copy()
    if model.details is not None:
        moving = sample_texture(build_mipmap(_moving(model.details, coarse)), *where)
        on = model.skin[triangle] & (triangle >= 0)
        slopes[on] += moving[on, :2]
        dark[on] *= moving[on, 2]
    relief = bent(smooth[..., :3], tangents, slopes)
    camera = np.concatenate([relief @ seen.rotation.T.astype(np.float32), smooth[..., 3:]], axis=-1)
    on_skin = model.skin[triangle]
    near = occlusion(seen.raster.depth, np.ascontiguousarray(smooth @ _wide(seen.rotation)), seen.focal)
    hollow = shaded_hollows(np.where(on_skin, np.minimum(dark, 0.5 + 0.5 * near), dark * near), model.skin_colour)
    image = still[..., :3] * hollow
    if isinstance(light, Light):
        linear = lit(seen.raster.depth, camera, image, light, seen.focal)
    else:
        linear = image * shading(relief, light)
        linear += lit(seen.raster.depth, camera, np.zeros_like(image), _SHINE, seen.focal)
    return finish(linear, triangle >= 0, factor)


def _wide(rotation: np.ndarray) -> np.ndarray:
    """(4, 4) float32 that turns normals (…, 3) and leaves the gloss beside them."""
    out = np.eye(4, dtype=np.float32)
    out[:3, :3] = rotation.T
    return out


def _moving(details: Synthesis, vertices: np.ndarray) -> np.ndarray:
    """(s, s, 3) float32: slopes along u and v, and occlusion, of the details of a head (n, 3)."""
    map_ = details.evaluate(details.strain_of(vertices))
    map_[..., :2] /= -np.maximum(map_[..., 2:3], 0.05)
    return np.ascontiguousarray(map_[..., [0, 1, 3]])
