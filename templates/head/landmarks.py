"""The 478 landmarks on the template: what the detector sees on renderings of many heads, snapped to lids and lips.

Each detection is carried to the surface point under it; from the weighted geometric median over heads and views, made
symmetric, each landmark moves to the point of the surface with the least error in the pictures. Points on lid and lip
rims stay on the rims, iris points on the eyeballs. The silhouette of jaw and forehead is marked as sliding.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import igl
import numpy as np
from scipy.spatial import cKDTree
from sketch import View, draw, look, pinhole, vertex_normals

HEADS, SEED = 240, 5
YAW, PITCH = 45.0, 8.0  # degrees to either side
TURNED = 8.0  # degrees of yaw from which the far half of the outline is not carried to the surface
REACH = 12.0  # mm that a landmark may move from where detections lie in the middle
AROUND, FACING = 5.0, 0.25  # mm; a view counts where the skin so far around faces it by more than this cosine
PULL = 0.02  # pixels a mm
OVAL = (
    *(10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152, 148, 176, 149),
    *(150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109),
)
POINTS68 = (
    *(162, 234, 93, 58, 172, 136, 149, 148, 152, 377, 378, 365, 397, 288, 323, 454, 389),
    *(70, 63, 105, 66, 107, 336, 296, 334, 293, 300, 6, 197, 5, 4, 98, 97, 2, 326, 327),
    *(33, 160, 158, 133, 153, 144, 362, 385, 387, 263, 373, 380),
    *(61, 40, 37, 0, 267, 270, 291, 321, 405, 17, 181, 91, 78, 81, 13, 311, 308, 402, 14, 178),
)
RIMS = {
    "lips_inner_upper": (78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308),
    "lips_inner_lower": (95, 88, 178, 87, 14, 317, 402, 318, 324),
    "lips_outer_upper": (61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291),
    "lips_outer_lower": (146, 91, 181, 84, 17, 314, 405, 321, 375),
    "lid_upper_right": (33, 246, 161, 160, 159, 158, 157, 173, 133),
    "lid_lower_right": (7, 163, 144, 145, 153, 154, 155),
    "lid_upper_left": (362, 398, 384, 385, 386, 387, 388, 466, 263),
    "lid_lower_left": (382, 381, 380, 374, 373, 390, 249),
}
IRIS = {"eye_right": 468, "eye_left": 473}
# pairs of landmarks across which skin is stretched and folded by expressions
STRAIN = (
    *((10, 151), (151, 9), (9, 8), (109, 108), (338, 337), (67, 69), (297, 299), (103, 104), (332, 333)),
    *((69, 66), (299, 296), (108, 107), (337, 336), (104, 105), (333, 334), (107, 9), (336, 9), (55, 8), (285, 8)),
    *((65, 158), (295, 385), (52, 160), (282, 387), (53, 246), (283, 466), (70, 33), (300, 263)),
    *((33, 143), (263, 372), (130, 35), (359, 265), (145, 230), (374, 450), (153, 231), (380, 451)),
    *((6, 197), (193, 168), (417, 168), (188, 6), (412, 6), (129, 203), (358, 423), (98, 165), (327, 391)),
    *((50, 205), (280, 425), (117, 50), (346, 280), (205, 207), (425, 427), (203, 206), (423, 426)),
    *((0, 164), (17, 18), (18, 200), (61, 57), (291, 287), (61, 0), (291, 0), (61, 17), (291, 17)),
    *((37, 167), (267, 393), (57, 212), (287, 432), (200, 199), (204, 211), (424, 431), (78, 13), (308, 13)),
)


class Sighting(NamedTuple):
    """One view of one head: pixels (n, 2) of its vertices, facing (n,) cosine between normals and view, and the
    landmarks' pixels (478, 2) by the detector."""

    pixels: np.ndarray
    facing: np.ndarray
    found: np.ndarray


def find(template, colours: np.ndarray, mirror478: np.ndarray) -> np.ndarray:
    """(478, 3) mm on the mean head, by detection on renderings of random heads; NaN where nothing was seen."""
    from avatarbuild.landmarks import find_faces

    rng = np.random.default_rng(SEED)
    skin = template.parts["skin"].triangles.stop
    places, weights, sightings = [], [], []
    for a in rng.standard_normal((HEADS, len(template.identity))):
        vertices = template.neutral(a)
        view = View(yaw=rng.uniform(-YAW, YAW), pitch=rng.uniform(-PITCH, PITCH), size=(512, 560))
        faces = find_faces(draw(vertices, template.triangles, colours, view))
        if not faces or faces[0].presence < 0.9:
            continue
        found = faces[0].points
        point, weight = _carry(template.mean, vertices, template.triangles, skin, view, found)
        # turned away, the outline lies on whatever the silhouette passes over
        if abs(view.yaw) > TURNED:
            weight[list(OVAL[19:] if view.yaw > 0 else OVAL[1:18])] = 0
        places.append(point)
        weights.append(weight)
        _, pixels, _ = look(vertices, template.triangles, view)
        toward = (np.array(pinhole(view)[1]).T @ -pinhole(view)[2]) - vertices
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        facing = np.einsum("ni,ni->n", vertex_normals(vertices, template.triangles), toward)
        sightings.append(
            Sighting(pixels.astype(np.float32), facing.astype(np.float32), found[:, :2].astype(np.float32))
        )
    return _settle(template, _agree(np.array(places), np.array(weights), mirror478), sightings, mirror478)


def _settle(template, begin: np.ndarray, sightings: list[Sighting], mirror: np.ndarray) -> np.ndarray:
    """(478, 3): each landmark moved, with its mirror image, within REACH mm of `begin` over the surface of the mean, to

    argmin over points s of   sum over views that face s of |P(s) - found| + PULL |s - begin|   (pixels, mm)

    Rim landmarks move along their rims.
    """
    skin = template.triangles[template.parts["skin"].triangles]
    usable = skin[~(template.regions["mouth"] | template.regions["sockets"])[skin].all(axis=1)]
    # vertices, middles of edges and of triangles
    corners = np.concatenate([usable[:, [0, 0, 0]], usable[:, [1, 1, 1]], usable[:, [2, 2, 2]]])
    corners = np.concatenate([corners, *(usable[:, [k, (k + 1) % 3, (k + 1) % 3]] for k in range(3)), usable])
    weights = np.repeat([[1 / 3, 1 / 3, 1 / 3], [0.5, 0.25, 0.25], [1 / 3, 1 / 3, 1 / 3]], len(usable) * 3, axis=0)
    weights = weights[: len(corners)]
    points = np.einsum("sc,scx->sx", weights, template.mean[corners])
    _, first = np.unique(np.round(points, 3), axis=0, return_index=True)
    corners, weights, points = corners[first], weights[first], points[first]
    tree = cKDTree(points)
    twin = tree.query(points * [-1, 1, 1])[1]
    rim = {number: template.contours[name] for name, numbers in RIMS.items() for number in numbers}
    pixels = np.stack([s.pixels for s in sightings])
    facing = np.stack([s.facing for s in sightings])
    found = np.stack([s.found for s in sightings])

    def miss(samples: np.ndarray, number: int, about: np.ndarray) -> np.ndarray:
        near = np.unique(corners[tree.query_ball_point(about, AROUND)])
        seen = np.flatnonzero(facing[:, near].mean(axis=1) > FACING)
        at = np.einsum(
            "sc,vscx->vsx",
            weights[samples],
            pixels[np.ix_(seen, corners[samples].ravel())].reshape(len(seen), len(samples), 3, 2),
        )
        return np.linalg.norm(at - found[seen, number][:, None], axis=2).sum(axis=0)

    out = begin.copy()
    for number in range(468):
        other = int(mirror[number])
        if other < number or not np.isfinite(begin[number]).all():
            continue
        place = points[tree.query(begin[number])[1]]
        if number in rim:
            samples = np.unique(tree.query(template.mean[rim[number]])[1])
        else:
            samples = np.array(sorted(tree.query_ball_point(place, REACH)))
        if other == number:
            samples = samples[np.abs(points[samples, 0]) < 0.02]
        if not len(samples):
            continue
        cost = miss(samples, number, place) + miss(twin[samples], other, place * [-1, 1, 1])
        best = samples[np.argmin(cost + PULL * len(sightings) * np.linalg.norm(points[samples] - place, axis=1))]
        out[number] = points[best]
        out[other] = points[best] * [-1, 1, 1]
    return out


def _carry(
    mean: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, skin: int, view: View, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Detected pixels to points (478, 3) of the mean under them, and weights (478,): the squared cosine to the view."""
    seen, _, _ = look(vertices, triangles, view)
    on_skin = (seen.triangle >= 0) & (seen.triangle < skin)
    distance, nearest = cv2.distanceTransformWithLabels(
        (~on_skin).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(on_skin)
    pixel_of = np.zeros(nearest.max() + 1, np.int64)
    pixel_of[nearest[rows, columns]] = rows * on_skin.shape[1] + columns
    x = np.clip(points[:, 0].astype(int), 0, on_skin.shape[1] - 1)
    y = np.clip(points[:, 1].astype(int), 0, on_skin.shape[0] - 1)
    row, column = np.divmod(pixel_of[nearest[y, x]], on_skin.shape[1])
    triangle = triangles[seen.triangle[row, column]]
    place = np.einsum("ij,ijk->ik", seen.barycentric[row, column].astype(np.float64), mean[triangle])
    normal = np.cross(
        vertices[triangle[:, 1]] - vertices[triangle[:, 0]], vertices[triangle[:, 2]] - vertices[triangle[:, 0]]
    )
    _, r, _ = pinhole(view)
    facing = -(normal @ r.T)[:, 2] / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    return place, np.where((facing > 0.25) & (distance[y, x] < 12), facing**2 / (1 + distance[y, x]), 0)


def _agree(places: np.ndarray, weights: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Weighted geometric median (478, 3) over views and their mirror images. Source: Weiszfeld 1937."""
    flip = np.array([-1.0, 1.0, 1.0])
    places = np.concatenate([places, places[:, mirror] * flip])
    weights = np.concatenate([weights, weights[:, mirror]])
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.einsum("vi,vix->ix", weights, places) / weights.sum(axis=0)[:, None]
        for _ in range(20):
            w = weights / np.maximum(np.linalg.norm(places - middle, axis=2), 1.0)
            middle = np.einsum("vi,vix->ix", w, places) / w.sum(axis=0)[:, None]
    return middle


def anchor(
    template, points: np.ndarray, eyeballs: dict, contours: dict[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """(478,) triangles and (478, 3) barycentric coordinates of the points on the mean head.

    `eyeballs` part name -> its generator's points; rim landmarks go to the nearest vertex of their contour.
    """
    skin = template.parts["skin"].triangles
    tri = template.triangles[skin].astype(np.int64)
    usable = np.flatnonzero(~(template.regions["mouth"] | template.regions["sockets"])[tri].all(axis=1))
    _, row, closest = igl.point_mesh_squared_distance(points[:468], template.mean, tri[usable])[:3]
    triangles = np.zeros(478, np.int64)
    barycentric = np.zeros((478, 3))
    triangles[:468] = usable[row]
    corners = template.mean[tri[triangles[:468]]]
    barycentric[:468] = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(corners[:, k]) for k in range(3)))
    for name, numbers in RIMS.items():
        line = contours[name]
        for number in numbers:
            v = int(line[np.linalg.norm(template.mean[line] - points[number], axis=1).argmin()])
            if number in (61, 78, 33, 362):
                v = int(line[0])
            elif number in (291, 308, 133, 263):
                v = int(line[-1])
            triangles[number], barycentric[number] = _at_vertex(tri, v)
    for name, first in IRIS.items():
        start = template.parts[name].triangles.start
        for k, point in enumerate(("iris_centre", "iris_left", "iris_top", "iris_right", "iris_bottom")):
            triangle, b = eyeballs[name][point]
            triangles[first + k], barycentric[first + k] = start + triangle, b
    return triangles.astype(np.int32), barycentric


def _at_vertex(triangles: np.ndarray, vertex: int) -> tuple[int, np.ndarray]:
    row, corner = (int(k[0]) for k in np.nonzero(triangles == vertex))
    return row, np.eye(3)[corner]


def strain_edges(triangles: np.ndarray, mesh: np.ndarray, barycentric: np.ndarray) -> np.ndarray:
    """(k, 2) vertex pairs nearest to the landmark pairs of STRAIN."""
    vertex = mesh[triangles, barycentric.argmax(axis=1)]
    pairs = vertex[np.array(STRAIN)]
    return pairs[pairs[:, 0] != pairs[:, 1]].astype(np.int32)
