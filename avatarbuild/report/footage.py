"""The tracked head in the video's frames: over the pictures, and drawn through the video's camera. f frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from avatarbuild.artefacts import Capture, Performance
from avatarbuild.geometry.meshes import vertex_normals
from avatarbuild.geometry.raster import rasterise
from avatarbuild.report.overlay import Crop, Shot, cut, directed
from avatarbuild.report.rendering import Paint, Seen, colour_image, finish, shade
from avatarbuild.report.shading import Light
from avatarbuild.template import ARKIT_NAMES, Template

_ROOM = 0.18  # of a shape's extent, about it
_LEAST = 0.35  # of a shape's largest motion, from which a vertex belongs to it


@dataclass(frozen=True)
class Footage:
    """The frames whose pictures are kept and in which the face was found: numbers (k,) ascending, and their images'
    places (k,) in the capture's clip."""

    numbers: np.ndarray
    places: np.ndarray


def footage(capture: Capture, performance: Performance) -> Footage:
    """Frames tracked in full, of good quality if there is any."""
    none = np.zeros(0, int)
    if capture.clip is None or not len(performance.times):
        return Footage(none, none)
    numbers, places, _ = np.intersect1d(capture.clip.processed, performance.processed, return_indices=True)
    good = performance.good[numbers]
    shown = good if good.any() else performance.quality[numbers] > 0
    return Footage(numbers[shown], places[shown])


def shot(performance: Performance, frame: int) -> Shot:
    """The video's camera at a frame."""
    w, h = performance.size
    camera = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId.SIMPLE_RADIAL, performance.focal, w, h)
    camera.params = [performance.focal, w / 2, h / 2, performance.k1]
    return directed(frame, camera, performance.rotation[frame], performance.translation[frame])


def motion(performance: Performance) -> np.ndarray:
    """(52,) mm: how far each shape moves any vertex at weight 1."""
    return np.array([np.linalg.norm(delta, axis=1).max() for delta in performance.deltas])


def most_active(performance: Performance, count: int, *, pairs: bool = True) -> list[str]:
    """The shapes whose motion varies most over the clip, most first; without `pairs`, left and right count once."""
    good = performance.quality > 0
    activity = performance.weights[good].std(axis=0) * motion(performance) if good.any() else np.zeros(52)
    found: list[str] = []
    for j in np.argsort(-activity, kind="stable"):
        name = ARKIT_NAMES[j]
        twin = name.removesuffix("Left") + "Right" if name.endswith("Left") else name.removesuffix("Right") + "Left"
        if activity[j] > 0 and len(found) < count and (pairs or twin not in found):
            found.append(name)
    return found


def spread(performance: Performance, seen: Footage, count: int) -> np.ndarray:
    """Positions in `seen`: in each of `count` equal parts of the clip, the frame whose face moves most."""
    if not len(seen.numbers):
        return np.zeros(0, int)
    moved = performance.weights[seen.numbers] @ motion(performance)
    parts = np.array_split(np.arange(len(seen.numbers)), min(count, len(seen.numbers)))
    return np.array([part[moved[part].argmax()] for part in parts])


def about(rgb: np.ndarray, at: Shot, vertices: np.ndarray, delta: np.ndarray, template: Template) -> Crop:
    """The part of a frame where a shape delta (n, 3) moves the face, as it is posed by vertices (n, 3)."""
    size = np.linalg.norm(delta, axis=1) * (template.regions["face"] | template.regions["lips"])
    pixels, _ = at.project(vertices[size > _LEAST * size.max()] if size.any() else vertices)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    room = _ROOM * float((high - low).max())
    return cut(rgb, low - room, high + room, (320, 288))


def through(at: Shot, crop: Crop, vertices: np.ndarray, triangles: np.ndarray, paint: Paint) -> np.ndarray:
    """(h, w, 3) uint8 sRGB: a head drawn as the camera saw it, in place of the crop."""
    factor = 2
    h, w = crop.image.shape[:2]
    pixels, depth = at.project(vertices)
    there = crop.place(pixels) * factor
    raster = rasterise(there, depth, triangles, (w * factor, h * factor))
    focal = float(at.camera.mean_focal_length() * crop.scale.mean() * factor)
    seen = Seen(raster, there, depth, triangles, at.rotation, focal)
    linear = shade(seen, vertex_normals(vertices, triangles), colour_image(seen, paint), paint.gloss, Light())
    return finish(linear, raster.triangle >= 0, factor)
