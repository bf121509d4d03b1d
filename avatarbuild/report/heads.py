"""What a head of the template looks like in the report's pictures: a doll's colours, or the person's albedo."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatarbuild.artefacts import Blendshapes
from avatarbuild.formats.colour import decode_srgb, linear_from_srgb
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.report.rendering import Decal, Paint, View, draw
from avatarbuild.template import EYE_PARTS, Template, expression_weights
from avatarbuild.texture.photos import shrunk

# sRGB, as they look
SKIN, LIP, BROW = (0.80, 0.64, 0.56), (0.69, 0.43, 0.40), (0.30, 0.23, 0.19)
WHITE, IRIS, PUPIL = (0.88, 0.86, 0.84), (0.35, 0.24, 0.15), (0.03, 0.03, 0.03)
TOOTH, GUM, TONGUE, INSIDE = (0.90, 0.87, 0.80), (0.70, 0.38, 0.38), (0.70, 0.38, 0.38), (0.30, 0.12, 0.12)

_GLOSS = {"teeth_upper": 0.62, "teeth_lower": 0.62, "gums": 0.5, "tongue": 0.45, "eye_left": 0.95, "eye_right": 0.95}
_TEXTURE = 2048  # texels: finer ones no picture shows
_COMPANIONS = {"mouthClose": {"jawOpen": 1.0}, "tongueOut": {"jawOpen": 0.45}}  # shapes that make sense with others


@dataclass(frozen=True)
class Figure:
    """A head that can be drawn with any expression: rig, Loop refinement (n', n) and its triangles, and paint (n')."""

    template: Template
    blendshapes: Blendshapes
    matrix: sp.csr_matrix
    triangles: np.ndarray
    paint: Paint

    def posed(self, weights: dict[str, float]) -> np.ndarray:
        """(n', 3): neutral + sum_j w_j deltas_j, eyeballs turned, refined."""
        return self.matrix @ posed(self.template, self.blendshapes, expression_weights(**weights))

    def picture(self, weights: dict[str, float], view: View) -> np.ndarray:
        """(h, w, 3) uint8 sRGB."""
        return draw(self.posed(weights), self.triangles, self.paint, view)


def posed(template: Template, rig: Blendshapes, weights: np.ndarray) -> np.ndarray:
    """(n, 3) mm: neutral + sum_j w_j deltas_j of a rig at weights (52,), eyeballs turned about its own centres."""
    x = np.asarray(rig.neutral, np.float64).copy()
    for j in np.flatnonzero(weights):
        x += weights[j] * rig.deltas[j]
    template.turn_eyes(x, weights, rig.eye_centres)
    return x


def coarse(figure: Figure) -> Figure:
    """The same head without refinement, for small pictures: Loop's scheme keeps the old vertices first."""
    template, paint = figure.template, figure.paint
    n = template.vertex_count
    decals = [
        Decal(slice(0, len(template.triangles)), d.texture, template.uv, template.uv_triangles) for d in paint.decals
    ]
    own = Paint(paint.colours[:n], paint.gloss[:n], decals)
    return Figure(template, figure.blendshapes, sp.identity(n, format="csr"), template.triangles, own)


def expression(name: str) -> dict[str, float]:
    """The weights that show an expression at 1: with an open jaw where it makes no sense without."""
    return {**_COMPANIONS.get(name, {}), name: 1.0}


def plain(template: Template) -> Paint:
    """A template head in the colours of a doll."""
    colours = np.tile(linear_from_srgb(SKIN), (template.vertex_count, 1))
    mouth = template.regions["mouth"] & ~template.regions["face"]
    for mask, colour in ((template.regions["lips"], LIP), (template.regions["brows"], BROW), (mouth, INSIDE)):
        colours[mask] = linear_from_srgb(colour)
    for name, colour in (("teeth_upper", TOOTH), ("teeth_lower", TOOTH), ("gums", GUM), ("tongue", TONGUE)):
        if name in template.parts:
            colours[template.parts[name].vertices] = linear_from_srgb(colour)
    for name, centre in zip(EYE_PARTS, template.eye_centres, strict=True):
        if name in template.parts:
            rows = template.parts[name].vertices
            offset = template.mean[rows] - centre
            across, front = np.hypot(offset[:, 0], offset[:, 1]), offset[:, 2] > 0
            ring = np.where((front & (across < 6.0))[:, None], linear_from_srgb(IRIS), linear_from_srgb(WHITE))
            colours[rows] = np.where((front & (across < 2.3))[:, None], linear_from_srgb(PUPIL), ring)
    gloss = np.full(template.vertex_count, 0.2)
    for name, value in _GLOSS.items():
        if name in template.parts:
            gloss[template.parts[name].vertices] = value
    gloss[template.regions["lips"]] = 0.4
    gloss[mouth | template.regions["sockets"]] = 0.2
    return Paint(colours, gloss)


def figure(blendshapes: Blendshapes, albedo: np.ndarray, template: Template, levels: int) -> Figure:
    """The person's head, `levels` times refined, in its albedo (s, s, 3) uint8 sRGB, which covers all its parts."""
    refined = template.subdivide(levels)
    gloss = refined.matrix @ plain(template).gloss
    step = max(1, albedo.shape[0] // _TEXTURE)
    texture = shrunk(decode_srgb(albedo).astype(np.float32), step)
    skin = Decal(slice(0, len(refined.triangles)), build_mipmap(texture), refined.uv, refined.uv_triangles)
    colours = np.tile(linear_from_srgb(SKIN), (len(gloss), 1))
    return Figure(template, blendshapes, refined.matrix, refined.triangles, Paint(colours, gloss, [skin]))
