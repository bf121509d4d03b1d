"""The fitted head drawn over the photos and frames that it came from."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import pycolmap

from avatarbuild.artefacts import Cameras, Capture, Neutral
from avatarbuild.geometry.meshes import face_vectors
from avatarbuild.geometry.raster import rasterise
from avatarbuild.registration.lids import seen_line
from avatarbuild.sfm.metric import placed_photos
from avatarbuild.template import Template

WIRE, LIDS, LIPS, BROWS, OUTLINE, DETECTED = (
    *((255, 255, 255), (0, 229, 255), (255, 80, 200), (255, 214, 0), (130, 255, 90), (255, 255, 255)),
)
_YAWS = (-70.0, -42.0, -16.0, 16.0, 42.0, 70.0)  # degrees that the photos are spread over
_MARGIN = 0.07  # of the head's extent, about it
_FAINT = 0.36  # of the wire's white
_HIDDEN = 2.5  # mm that a vertex may lie behind what its pixel sees
_FINE = 4  # bits of the drawing's fractions of a pixel


class Shot(NamedTuple):
    """A placed photo: its number in the capture, its camera, R (3, 3) and t (3,) from the head frame, and the yaw and
    pitch in degrees from which it sees the head: positive from the subject's left, and from above."""

    photo: int
    camera: pycolmap.Camera
    rotation: np.ndarray
    translation: np.ndarray
    yaw: float
    pitch: float

    @property
    def centre(self) -> np.ndarray:
        """(3,) mm in the head frame."""
        return -self.rotation.T @ self.translation

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels (n, 2), the first centre at 0.5, through the whole lens, and depth (n,) of points (n, 3)."""
        seen = points @ self.rotation.T + self.translation
        return np.asarray(self.camera.img_from_cam(np.ascontiguousarray(seen), False)), seen[:, 2]


class Crop(NamedTuple):
    """A part of a photo, scaled: image (h, w, 3) uint8; its pixel p shows the photo's p / scale + origin."""

    image: np.ndarray
    origin: np.ndarray
    scale: np.ndarray

    def place(self, pixels: np.ndarray) -> np.ndarray:
        """The photo's pixels (n, 2) in the crop."""
        return (pixels - self.origin) * self.scale


class Lines(NamedTuple):
    """What is drawn of a template: wire (e, 2), the edges of the cage's quads (else of the triangles) on the skin that
    shows; inner (k, 2), the edges of face, nose and ears, where an outline may run, between triangles sides (k, 2)."""

    wire: np.ndarray
    inner: np.ndarray
    sides: np.ndarray


def shots(capture: Capture, cameras: Cameras, neutral: Neutral) -> list[Shot]:
    """The placed photos, in the capture's order."""
    placed = placed_photos(cameras.model, [f"{name}.jpg" for name in capture.photos.names])
    turn, shift = neutral.head_from_cloud[:3, :3], neutral.head_from_cloud[:3, 3]
    found = []
    for i, camera, R, t in zip(placed.index, placed.cameras, placed.rotation, placed.translation, strict=True):
        rotation = R @ turn.T
        found.append(directed(int(i), camera, rotation, t - rotation @ shift))
    return found


def directed(photo: int, camera: pycolmap.Camera, rotation: np.ndarray, translation: np.ndarray) -> Shot:
    """A shot with its yaw and pitch."""
    x, y, z = -rotation.T @ translation
    yaw, pitch = np.degrees([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])
    return Shot(photo, camera, rotation, translation, float(yaw), float(pitch))


def spread(found: list[Shot], capture: Capture) -> list[Shot]:
    """Up to six photos of which each is the best near one of six directions, level and sharp; the frontal one is in."""
    if not found:
        return []
    usual = float(np.nanmedian(capture.photos.sharpness)) or 1.0
    level = float(np.median([s.pitch for s in found]))
    chosen: list[Shot] = []
    for wanted in _YAWS:
        rest = [s for s in found if s not in chosen and abs(s.yaw - wanted) < 20]
        if rest:
            sharp = {s.photo: float(np.nan_to_num(capture.photos.sharpness[s.photo])) / usual for s in rest}
            cost = lambda s: abs(s.yaw - wanted) + 0.4 * abs(s.pitch - level) - 8 * min(sharp[s.photo], 1.3)  # noqa: E731, B023
            chosen.append(min(rest, key=cost))
    frontal = next((s for s in found if s.photo == capture.frontal), None)
    if frontal is not None and frontal not in chosen:
        nearest = min(range(len(chosen)), key=lambda i: abs(chosen[i].yaw - frontal.yaw), default=None)
        chosen = [*chosen, frontal] if nearest is None else [*chosen[:nearest], frontal, *chosen[nearest + 1 :]]
    return sorted(chosen, key=lambda s: s.yaw)


def lines_of(template: Template) -> Lines:
    """The edges that are drawn; the corners of the cage's quads are the template's first vertices."""
    inside = template.regions["sockets"] | (template.regions["mouth"] & ~template.regions["lips"])
    skin = np.zeros(template.vertex_count, bool)
    skin[template.parts["skin"].vertices] = True
    triangles = template.triangles[template.parts["skin"].triangles]
    faces = template.quads if len(template.quads) else triangles
    pairs = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    wire = np.unique(np.sort(pairs, axis=1), axis=0)
    halves = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    order = np.argsort(halves[:, 0] * template.vertex_count + halves[:, 1], kind="stable")
    first, second = order[:-1], order[1:]
    twins = (halves[first] == halves[second]).all(axis=1)
    where = (template.regions["face"] | template.regions["ears"]) & ~inside
    where &= ~template.regions["lips"] & ~template.regions["lids"]
    twins &= where[halves[first]].all(axis=1)
    sides = np.stack([first[twins], second[twins]], axis=1) // 3
    return Lines(wire[(skin & ~inside)[wire].all(axis=1)], halves[first[twins]], sides)


def cut(photo: np.ndarray, low: np.ndarray, high: np.ndarray, size: tuple[int, int]) -> Crop:
    """The smallest part of a photo (h, w, 3) with the shape of size (w, h) that holds the box low…high, at that size.

    It may reach beyond the photo, and is grey there.
    """
    w, h = size
    centre, extent = (low + high) / 2, np.maximum(high - low, 1.0)
    scale = float(min(w / extent[0], h / extent[1]))
    origin = np.floor(centre - np.array([w, h]) / scale / 2)
    spans = np.ceil(np.array([w, h]) / scale).astype(int)
    x, y = origin.astype(int)
    part = np.full((spans[1], spans[0], 3), 128, np.uint8)
    top, left = max(y, 0), max(x, 0)
    piece = photo[top : max(y + spans[1], 0), left : max(x + spans[0], 0)]
    if piece.size:
        part[top - y : top - y + piece.shape[0], left - x : left - x + piece.shape[1]] = piece
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return Crop(cv2.resize(part, (w, h), interpolation=method), origin, np.array([w, h]) / spans)


def mesh_over_photo(
    photo: np.ndarray, shot: Shot, vertices: np.ndarray, template: Template, lines: Lines, size: tuple[int, int]
) -> Crop:
    """A crop on the head (n, 3) with its mesh's quads, the rims of lids and lips, the brows and the outline over it."""
    pixels, depth = shot.project(vertices)
    shown = template.regions["face"] | template.regions["ears"] | template.regions["scalp"]
    low, high = pixels[shown].min(axis=0), pixels[shown].max(axis=0)
    room = _MARGIN * (high - low)
    crop = cut(photo, low - room, high + room, size)
    at = crop.place(pixels)
    visible = _visible(at, depth, template.triangles, size)
    faint = crop.image.copy()
    _lines(faint, at[lines.wire[visible[lines.wire].all(axis=1)]], WIRE, 1)
    image = cv2.addWeighted(faint, _FAINT, crop.image, 1 - _FAINT, 0)
    skin = template.triangles[template.parts["skin"].triangles]
    outline = _outline(vertices, skin, lines, shot.centre)
    _lines(image, at[outline[visible[outline].all(axis=1)]], OUTLINE, 1)
    _contours(image, at, visible, template)
    return Crop(image, crop.origin, crop.scale)


def zoom(
    photo: np.ndarray,
    shot: Shot,
    neutral: Neutral,
    template: Template,
    landmarks: np.ndarray,
    names: tuple[str, ...],
    size: tuple[int, int],
) -> Crop:
    """A close look at some contours of the mesh, with the detector's points (478, 2) that belong to them as dots."""
    pixels, _ = shot.project(neutral.vertices)
    lines = np.concatenate([template.contours[name] for name in names])
    low, high = pixels[lines].min(axis=0), pixels[lines].max(axis=0)
    room = np.maximum(0.12 * (high - low), 0.1 * (high - low).max())
    crop = cut(photo, low - room, high + room, size)
    at = crop.place(pixels)
    image = crop.image.copy()
    _contours(image, at, np.ones(len(at), bool), template, names)
    for dot in crop.place(landmarks[rim_landmarks(template, names)]):
        _dot(image, dot, 3.2, (0, 0, 0))
        _dot(image, dot, 2.2, DETECTED)
    return Crop(image, crop.origin, crop.scale)


def rim_landmarks(template: Template, names: tuple[str, ...]) -> np.ndarray:
    """The landmarks, of the 478, that lie on a vertex of the named contours."""
    corners = template.triangles[template.landmark_triangles]
    corner = np.take_along_axis(corners, template.landmark_barycentric.argmax(axis=1)[:, None], axis=1)[:, 0]
    on = np.isin(corner, np.concatenate([template.contours[name] for name in names]))
    return np.flatnonzero(on & (template.landmark_barycentric.max(axis=1) > 0.9))


def contour_distance(points: np.ndarray, pixels: np.ndarray, template: Template, names: tuple[str, ...]) -> np.ndarray:
    """(k,) pixels from points (k, 2) to the nearest of the contours `names` as photos show them; pixels (n, 2)."""
    lines = [seen_line(template, name) for name in names]
    ends = [np.stack([pixels[line[:-1]], pixels[line[1:]]], axis=1) for line in lines]
    a, b = np.moveaxis(np.concatenate(ends), 1, 0)
    along = b - a
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    share = np.clip(((points[:, None] - a) * along).sum(axis=2) / length, 0, 1)
    return np.linalg.norm(points[:, None] - a - share[..., None] * along, axis=2).min(axis=1)


def _visible(pixels: np.ndarray, depth: np.ndarray, triangles: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(n,) bool: nothing of the mesh lies more than 2.5 mm in front of the vertex, by its pixel or a neighbour."""
    seen = rasterise(pixels, depth, triangles, size).depth
    farthest = cv2.dilate(np.where(np.isfinite(seen), seen, 1e6).astype(np.float32), np.ones((3, 3)))
    j, i = np.floor(pixels).astype(int).T
    inside = (j >= 0) & (i >= 0) & (j < size[0]) & (i < size[1])
    found = np.zeros(len(pixels), bool)
    found[inside] = depth[inside] <= farthest[i[inside], j[inside]] + _HIDDEN
    return found


def _outline(vertices: np.ndarray, triangles: np.ndarray, lines: Lines, eye: np.ndarray) -> np.ndarray:
    """(e, 2) edges between a triangle that faces the eye and one that does not."""
    front = np.einsum("ij,ij->i", face_vectors(vertices, triangles), eye - vertices[triangles[:, 0]]) > 0
    return lines.inner[front[lines.sides[:, 0]] != front[lines.sides[:, 1]]]


def _contours(
    image: np.ndarray,
    at: np.ndarray,
    visible: np.ndarray,
    template: Template,
    names: tuple[str, ...] | None = None,
) -> None:
    for name in template.contours:
        if names is None or name in names:
            line = seen_line(template, name)
            colour = LIDS if name.startswith("lid") else LIPS if name.startswith("lips") else BROWS
            pairs = np.stack([line[:-1], line[1:]], axis=1)
            _lines(image, at[pairs[visible[pairs].all(axis=1)]], colour, 1)


def _lines(image: np.ndarray, ends: np.ndarray, colour: tuple[int, int, int], width: int) -> None:
    """Segments (e, 2, 2) in pixels whose centres are at +0.5; the drawing counts from the first centre."""
    fixed = np.round((ends - 0.5) * (1 << _FINE)).astype(np.int32)
    cv2.polylines(image, list(fixed), False, colour, width, cv2.LINE_AA, _FINE)


def _dot(image: np.ndarray, centre: np.ndarray, radius: float, colour: tuple[int, int, int]) -> None:
    x, y = np.round((centre - 0.5) * (1 << _FINE)).astype(int)
    cv2.circle(image, (int(x), int(y)), round(radius * (1 << _FINE)), colour, -1, cv2.LINE_AA, _FINE)
