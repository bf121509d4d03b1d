"""What a head of the template looks like in the report's pictures: colours by part and region, or by the cloud."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from avatarbuild.artefacts import Blendshapes, Cloud, Neutral
from avatarbuild.geometry.meshes import adjacency
from avatarbuild.geometry.mipmap import build_mipmap
from avatarbuild.report.rendering import Decal, Paint, View, draw
from avatarbuild.report.shading import Light, decode_srgb
from avatarbuild.template import Template, expression_weights

# sRGB, as they look
SKIN, LIP, BROW = (0.80, 0.64, 0.56), (0.69, 0.43, 0.40), (0.30, 0.23, 0.19)
WHITE, IRIS, PUPIL = (0.88, 0.86, 0.84), (0.35, 0.24, 0.15), (0.03, 0.03, 0.03)
TOOTH, GUM, TONGUE, INSIDE = (0.90, 0.87, 0.80), (0.70, 0.38, 0.38), (0.70, 0.38, 0.38), (0.30, 0.12, 0.12)
LIT_ALREADY = Light(lamp=0.35, above=0.78, below=0.55, gloss=0.7)  # for colours that hold the photos' own light

_EYES = ("eye_left", "eye_right")
_GLOSS = {"teeth_upper": 0.62, "teeth_lower": 0.62, "gums": 0.5, "tongue": 0.45, "eye_left": 0.95, "eye_right": 0.95}
_NEAR = 2.5  # mm: a point of the cloud colours the vertices within
_NEIGHBOURS = 6
_TRUSTED = 0.15  # of Neutral.seen: below it points are hair's or clothes'
_SHOULDERS = -150.0  # mm: below it they are clothes' in any case
_SPREADING = 60  # passes that carry colour into what no point shows
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
        w = expression_weights(**weights)
        x = np.asarray(self.blendshapes.neutral, np.float64).copy()
        for j in np.flatnonzero(w):
            x += w[j] * self.blendshapes.deltas[j]
        turns = self.template.eye_rotation_matrices(w)
        for name, centre, turn in zip(_EYES, self.blendshapes.eye_centres, turns, strict=True):
            if name in self.template.parts:
                ball = self.template.parts[name].vertices
                x[ball] = (x[ball] - centre) @ turn.T + centre
        return self.matrix @ x

    def picture(self, weights: dict[str, float], view: View) -> np.ndarray:
        """(h, w, 3) uint8 sRGB."""
        return draw(self.posed(weights), self.triangles, self.paint, view, light=LIT_ALREADY)


def coarse(figure: Figure) -> Figure:
    """The same head without refinement, for small pictures: Loop's scheme keeps the old vertices first."""
    template, paint = figure.template, figure.paint
    n = template.vertex_count
    uv = _eye_uv(template, template.uv, template.uv_triangles, 1)
    eyes = [template.parts[name].triangles for name in _EYES if name in template.parts]
    decals = [Decal(where, d.texture, uv, template.uv_triangles) for where, d in zip(eyes, paint.decals)]
    own = Paint(paint.colours[:n], paint.gloss[:n], decals)
    return Figure(template, figure.blendshapes, sp.identity(n, format="csr"), template.triangles, own)


def expression(name: str) -> dict[str, float]:
    """The weights that show an expression at 1: with an open jaw where it makes no sense without."""
    return {**_COMPANIONS.get(name, {}), name: 1.0}


def plain(template: Template, eye_texture: np.ndarray | None = None) -> Paint:
    """A template head in the colours of a doll; eye_texture (s, s, 3) uint8 covers the square of one eye's UV."""
    colours = np.tile(decode_srgb(SKIN), (template.vertex_count, 1))
    mouth = template.regions["mouth"] & ~template.regions["face"]
    for mask, colour in ((template.regions["lips"], LIP), (template.regions["brows"], BROW), (mouth, INSIDE)):
        colours[mask] = decode_srgb(colour)
    for name, colour in (("teeth_upper", TOOTH), ("teeth_lower", TOOTH), ("gums", GUM), ("tongue", TONGUE)):
        if name in template.parts:
            colours[template.parts[name].vertices] = decode_srgb(colour)
    for name, centre in zip(_EYES, template.eye_centres, strict=True):
        if name in template.parts:
            rows = template.parts[name].vertices
            offset = template.mean[rows] - centre
            across, front = np.hypot(offset[:, 0], offset[:, 1]), offset[:, 2] > 0
            ring = np.where((front & (across < 6.0))[:, None], decode_srgb(IRIS), decode_srgb(WHITE))
            colours[rows] = np.where((front & (across < 2.3))[:, None], decode_srgb(PUPIL), ring)
    gloss = np.full(template.vertex_count, 0.2)
    for name, value in _GLOSS.items():
        if name in template.parts:
            gloss[template.parts[name].vertices] = value
    gloss[template.regions["lips"]] = 0.4
    gloss[mouth | template.regions["sockets"]] = 0.2
    return Paint(colours, gloss, () if eye_texture is None else _irises(template, eye_texture))


def figure(neutral: Neutral, blendshapes: Blendshapes, cloud: Cloud, template: Template, levels: int) -> Figure:
    """The person's head, `levels` times refined, each vertex in the colour of the cloud about it.

    c_i = sum_j c_j / (d_ij + 0.2 mm) over the nearest points within 2.5 mm; where there are none, or the fit did not
    trust them, colour spreads from the neighbours over the mesh. Eyes, teeth and the mouth's inside are the doll's.
    """
    refined = template.subdivide(levels)
    doll = plain(template, neutral.eye_texture)
    own, found = _cloud_colours(refined.matrix @ neutral.vertices, neutral.head_from_cloud, cloud)
    skin = np.zeros(template.vertex_count)
    skin[template.parts["skin"].vertices] = 1
    bare = (refined.matrix @ neutral.seen > _TRUSTED) & (refined.matrix @ template.mean[:, 1] > _SHOULDERS)
    skin[template.regions["mouth"] & ~template.regions["lips"] | template.regions["sockets"]] = 0
    outside = refined.matrix @ skin > 0.6
    known = outside & found & bare
    n = template.vertex_count  # Loop's scheme keeps the old vertices first
    filled = _spread(own[:n], known[:n], template.triangles)
    colours = np.where(known[:, None], own, refined.matrix @ filled)
    colours[~outside] = (refined.matrix @ doll.colours)[~outside]
    fine = 4**levels  # triangles that each became
    uv = _eye_uv(template, refined.uv, refined.uv_triangles, fine)
    decals = [
        Decal(slice(d.where.start * fine, d.where.stop * fine), d.texture, uv, refined.uv_triangles)
        for d in doll.decals
    ]
    return Figure(
        template,
        blendshapes,
        refined.matrix,
        refined.triangles,
        Paint(np.clip(colours, 0, 1), refined.matrix @ doll.gloss, decals),
    )


def _spread(colours: np.ndarray, known: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n, 3): each unknown colour the mean of its neighbours', from the known ones outwards."""
    links = adjacency(len(colours), triangles)
    step = sp.diags(1 / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1)) @ links
    mean = np.median(colours[known], axis=0) if known.any() else decode_srgb(SKIN)
    filled = np.where(known[:, None], colours, mean)
    for _ in range(_SPREADING):
        filled = np.where(known[:, None], colours, step @ filled)
    return filled


def _cloud_colours(vertices: np.ndarray, head_from_cloud: np.ndarray, cloud: Cloud) -> tuple[np.ndarray, np.ndarray]:
    """Colours (n, 3) linear, and whether (n,) any point is near."""
    thin = max(1, len(cloud.points) // 250_000)
    points = cloud.points[::thin] @ head_from_cloud[:3, :3].T + head_from_cloud[:3, 3]
    bright = decode_srgb(cloud.colours[::thin])
    if not len(points):
        return np.zeros((len(vertices), 3)), np.zeros(len(vertices), bool)
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    distance, nearest = tree.query(vertices, k=_NEIGHBOURS, distance_upper_bound=_NEAR)
    near = np.isfinite(distance)
    weights = np.where(near, 1 / (np.where(near, distance, 0) + 0.2), 0)
    total = weights.sum(axis=1)
    colours = np.einsum("ij,ijk->ik", weights, bright[np.where(near, nearest, 0)])
    return colours / np.maximum(total, 1e-9)[:, None], total > 0


def _irises(template: Template, texture: np.ndarray) -> list[Decal]:
    mipmap = build_mipmap(decode_srgb(texture).astype(np.float32))
    uv = _eye_uv(template, template.uv, template.uv_triangles, 1)
    return [
        Decal(template.parts[name].triangles, mipmap, uv, template.uv_triangles)
        for name in _EYES
        if name in template.parts
    ]


def _eye_uv(template: Template, uv: np.ndarray, uv_triangles: np.ndarray, times: int) -> np.ndarray:
    """The UVs with each eye's square stretched to the whole texture."""
    out = uv.copy()
    for name in _EYES:
        if name in template.parts:
            part = template.parts[name].triangles
            rows = np.unique(uv_triangles[part.start * times : part.stop * times])
            low, high = uv[rows].min(axis=0), uv[rows].max(axis=0)
            out[rows] = (uv[rows] - low) / (high - low)
    return out
