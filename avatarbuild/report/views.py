"""The report's pictures of cloud and head from the sides: as they are, and as a heat map of the fit."""

from __future__ import annotations

import numpy as np

from avatarbuild.artefacts import Cloud, Neutral
from avatarbuild.formats.colour import decode_srgb, linear_from_srgb
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.raster import interpolate
from avatarbuild.report.rendering import View, finish, look, shade
from avatarbuild.report.shading import Light
from avatarbuild.report.splats import draw_splats, splat
from avatarbuild.template import Template

SIDES = (("their right side", -90.0), ("half right", -45.0), ("front", 0.0), ("half left", 45.0), ("their left", 90.0))
SCALES = (0.5, 1.0, 2.0, 5.0)  # mm at the colour bar's ends
INWARD, EVEN, OUTWARD = (0.09, 0.29, 0.66), (0.94, 0.93, 0.90), (0.74, 0.13, 0.10)  # sRGB
UNKNOWN, UNSEEN = (0.58, 0.58, 0.60), (0.78, 0.78, 0.80)
_STRIPE = 9  # pixels of the picture from one hatching line to the next
_CLAY = 0.52
_MOST, _AREA = 500_000, 2.0e5  # points drawn; mm^2 of a head and shoulders
_EVEN_LIGHT = Light(lamp=0.30, above=0.72, below=0.50, gloss=0.0)


def side_views(size: tuple[int, int]) -> list[View]:
    """The five sides."""
    return [View(yaw=yaw, size=size, height=310.0, centre=(0.0, -20.0, -60.0)) for _, yaw in SIDES]


def cloud_pictures(cloud: Cloud, neutral: Neutral, size: tuple[int, int]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The cloud from five sides in its colours, and as clay, which shows shape alone."""
    turn, shift = neutral.head_from_cloud[:3, :3], neutral.head_from_cloud[:3, 3]
    thin = max(1, len(cloud.points) // _MOST)
    points, normals = cloud.points[::thin] @ turn.T + shift, cloud.normals[::thin] @ turn.T
    colours = decode_srgb(cloud.colours[::thin])
    # discs that touch where the points of a head and shoulders lie evenly
    radius = float(np.clip(1.1 * np.sqrt(_AREA / max(len(points), 1)), 0.3, 3.0))
    drawn = [splat(points, normals, colours, radius, view) for view in side_views(size)]
    return (
        [draw_splats(splats, light=_EVEN_LIGHT) for splats in drawn],
        [draw_splats(splats, clay=_CLAY) for splats in drawn],
    )


def heat_scale(neutral: Neutral, template: Template) -> float:
    """mm at the ends of the colour bar: the least of SCALES that holds nine tenths of the face's distances."""
    off = np.abs(neutral.distance[template.regions["face"]])
    off = off[np.isfinite(off)]
    most = float(np.quantile(off, 0.9)) if len(off) else 0.0
    return next((scale for scale in SCALES if most <= scale), SCALES[-1])


def heat_colour(distance: np.ndarray, scale: float) -> np.ndarray:
    """(…, 3) linear: blue where the cloud lies inside the head (-scale), red where outside (+scale), pale at 0."""
    share = np.clip(np.asarray(distance, float) / scale, -1, 1)[..., None]
    low, middle, high = (linear_from_srgb(c) for c in (INWARD, EVEN, OUTWARD))
    return middle + np.abs(share) * (np.where(share < 0, low, high) - middle)


def heat_picture(neutral: Neutral, template: Template, view: View, scale: float, factor: int = 2) -> np.ndarray:
    """(h, w, 3) uint8 sRGB: Neutral.distance on the skin; grey where it is not known, hatched where the prior decided.

    A pixel's distance is the mean of its triangle's known corners, weighted by its barycentric coordinates.
    """
    skin = template.triangles[template.parts["skin"].triangles]
    seen = look(neutral.vertices, skin, view, factor)
    known = np.isfinite(neutral.distance)
    columns = np.stack([np.where(known, neutral.distance, 0), known, neutral.seen], axis=1)
    mean = interpolate(columns, skin, seen.raster.triangle, seen.raster.barycentric)
    share = mean[..., 1:2]
    heat = heat_colour(mean[..., 0] / np.maximum(share[..., 0], 1e-3), scale)
    image = np.where(share > 0.5, heat, linear_from_srgb(UNKNOWN))
    h, w = seen.raster.triangle.shape
    row, column = np.ogrid[:h, :w]
    stripe = ((row + column) // factor % _STRIPE < 2)[..., None]
    prior = mean[..., 2:3] < 0.5
    image = np.where(prior, 0.35 * image + 0.65 * linear_from_srgb(UNSEEN), image)
    image = np.where(prior & stripe, linear_from_srgb(UNKNOWN), image)
    normals = vertex_normals(neutral.vertices, skin)
    dull = np.zeros(len(neutral.vertices))
    linear = shade(seen, normals, image.astype(np.float32), dull, _EVEN_LIGHT)
    return finish(linear, seen.raster.triangle >= 0, factor)
