"""The texture layout: the skin's one chart, the hidden bags, and the small parts in the free corners.

The skin's chart holds head, neck, rim and the first rings of the mouth bag, so that the seam inside the mouth is out of
sight; the rest of the mouth bag and the eye sockets are charts of their own.
"""

from __future__ import annotations

import cv2
import numpy as np
from cage import HEAD, MOUTH, NECK, SOCKET_LEFT, SOCKET_RIGHT
from unwrap import cut_back, flatten

MOUTH_RINGS = 2  # rings of the mouth bag in the skin's chart
BACK_SCALE = 0.33  # wanted scale behind the ears against the face's
MARGIN = 0.006  # of the unit square around every chart
GRID = 1024
# wanted side of each small chart, as a share of the map; all shrink together until they fit
SIDES = {
    "eye_left": 0.13,
    "eye_right": 0.13,
    "teeth_upper": 0.11,
    "teeth_lower": 0.11,
    "gums": 0.12,
    "tongue": 0.09,
    "mouth": 0.09,
    "socket_left": 0.05,
    "socket_right": 0.05,
}


def skin_charts(
    vertices: np.ndarray, triangles: np.ndarray, labels: np.ndarray
) -> tuple[np.ndarray, np.ndarray, dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """The skin's chart and the bags' charts.

    vertices (n, 3) mm, triangles (m, 3), labels (m,) of the cage. Returns the main chart as (uv (u, 2) filling the unit
    square, its triangles (m, 3), -1 outside it) and name -> (uv, triangles (k, 3), their rows in `triangles`).
    """
    main = np.isin(labels, [HEAD, NECK])
    reached = np.zeros(len(vertices), bool)
    reached[triangles[labels == HEAD]] = True
    for _ in range(MOUTH_RINGS):
        main |= (labels == MOUTH) & reached[triangles].any(axis=1)
        reached[triangles[main]] = True
    points, faces = _sub_mesh(vertices, triangles[main])
    cut, source = cut_back(points, faces)
    positions = points[source]
    uv = _upright(flatten(positions, cut, wanted_scale(positions, cut)), positions)
    uv = MARGIN + (1 - 2 * MARGIN) * (uv - uv.min(axis=0)) / np.ptp(uv, axis=0).max()
    uv[:, 0] += 0.5 - (uv[:, 0].min() + uv[:, 0].max()) / 2
    whole = np.full(triangles.shape, -1)
    whole[main] = cut
    bags = {}
    for name, label in (("mouth", MOUTH), ("socket_left", SOCKET_LEFT), ("socket_right", SOCKET_RIGHT)):
        rows = np.flatnonzero((labels == label) & ~main)
        points, faces = _sub_mesh(vertices, triangles[rows])
        flat = flatten(points, faces, np.ones(len(faces)))
        bags[name] = ((flat - flat.min(axis=0)) / np.ptp(flat, axis=0).max(), faces, rows)
    return uv, whole, bags


def wanted_scale(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(m,) 1 on the face, falling to BACK_SCALE behind the ears and on the neck."""
    middle = vertices[triangles].mean(axis=1)
    front = _smooth(-105, -25, middle[:, 2]) * _smooth(-160, -105, middle[:, 1])
    return BACK_SCALE + (1 - BACK_SCALE) * front


def _smooth(a: float, b: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - a) / (b - a), 0, 1)
    return t * t * (3 - 2 * t)


def _sub_mesh(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, local = np.unique(triangles, return_inverse=True)
    return vertices[used], local.reshape(-1, 3)


def _upright(uv: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """The chart turned so that the face stands upright: a rotation by the Procrustes fit to (x, y) of the front."""
    front = positions[:, 2] > np.quantile(positions[:, 2], 0.6)
    a = uv[front] - uv[front].mean(axis=0)
    b = positions[front, :2] - positions[front, :2].mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1, np.linalg.det(u @ vt)]) @ vt
    return (uv - uv.mean(axis=0)) @ turn


def pack(uv: np.ndarray, triangles: np.ndarray, names: list[str]) -> dict[str, tuple[np.ndarray, float]]:
    """name -> (lower left corner (2,), side) of a square of free map for each small chart."""
    taken = draw(uv, triangles, GRID)
    sides = {name: SIDES[name] for name in names}
    for _ in range(40):
        places = _place(taken, sides)
        if places is not None:
            return places
        sides = {name: 0.95 * side for name, side in sides.items()}
    raise ValueError("the small charts do not fit into the corners")


def _place(taken: np.ndarray, sides: dict[str, float]) -> dict[str, tuple[np.ndarray, float]] | None:
    """Greedily, largest first, each square as near to a corner of the map as it goes."""
    size = len(taken)
    busy = taken.astype(np.uint8)
    pad = int(np.ceil(MARGIN * size))
    busy = cv2.dilate(busy, np.ones((2 * pad + 1, 2 * pad + 1), np.uint8))
    places = {}
    for name in sorted(sides, key=lambda n: (-sides[n], n)):
        k = int(np.ceil(sides[name] * size))
        count = cv2.integral(busy)
        free = (count[k:, k:] - count[:-k, k:] - count[k:, :-k] + count[:-k, :-k]) == 0
        free[:pad] = free[:, :pad] = False
        free[-pad:] = free[:, -pad:] = False
        rows, columns = np.nonzero(free)
        if not len(rows):
            return None
        y, x = rows + k / 2, columns + k / 2
        best = int(np.argmin(np.minimum(x, size - x) ** 2 + np.minimum(y, size - y) ** 2))
        row, column = int(rows[best]), int(columns[best])
        busy[max(0, row - pad) : row + k + pad, max(0, column - pad) : column + k + pad] = 1
        places[name] = (np.array([column, size - row - k]) / size, k / size)
    return places


def draw(uv: np.ndarray, triangles: np.ndarray, size: int) -> np.ndarray:
    """(size, size) bool, row 0 on top: texels whose square a chart touches."""
    image = np.zeros((size, size), np.uint8)
    points = np.stack([uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5], axis=1)
    for corners in np.round(points[triangles] * 256).astype(np.int32):
        cv2.fillConvexPoly(image, corners, 1, cv2.LINE_8, 8)
    return image > 0


def border_distance(uv: np.ndarray, triangles: np.ndarray, size: int = GRID) -> np.ndarray:
    """(size, size) float32 texels from each texel's centre to the border of its chart, 0 outside the charts."""
    return cv2.distanceTransform(draw(uv, triangles, size).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
