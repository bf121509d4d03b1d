"""The room around the subject: walls, floor, ceiling, window, posters, shelves and boxes, and the subject's shirt.

Coordinates are those of the head frame (mm, y up, z out of the face); the subject sits, the floor is 1.15 m below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.simulation import patterns
from avatarbuild.simulation.patterns import Grain

_CELL = 80.0  # mm; lens distortion bends lines, so that large faces would be drawn wrongly
_FLOOR, _CEILING = -1150.0, 1380.0


@dataclass(frozen=True)
class Surroundings:
    """
    A textured mesh that stands still.

    vertices (n, 3) mm, normals (n, 3); triangles (m, 3); uv (n, 2); albedo (th, tw, 3) float32, linear, first row on
    top; window, shirt (n,) bool: emits its albedo, is worn; towards_window (3,) unit vector from the head.
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    uv: np.ndarray
    albedo: np.ndarray
    window: np.ndarray
    shirt: np.ndarray
    towards_window: np.ndarray


class _Builder:
    """Collects surfaces, each with its own picture, and packs the pictures row by row into one texture."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.surfaces: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, str]] = []

    def add(
        self,
        points: np.ndarray,
        normals: np.ndarray,
        uv: np.ndarray,
        triangles: np.ndarray,
        picture: np.ndarray,
        *,
        kind: str = "",
    ) -> None:
        self.surfaces.append((points, normals, uv, triangles, picture, kind))

    def rectangle(
        self,
        corner: np.ndarray,
        right: np.ndarray,
        up: np.ndarray,
        picture: np.ndarray,
        *,
        kind: str = "",
    ) -> None:
        """A picture seen upright from the side to which right x up points; `corner` is its lower left."""
        corner, right, up = (np.asarray(v, np.float64) for v in (corner, right, up))
        a = max(int(np.ceil(np.linalg.norm(right) / _CELL)), 1)
        b = max(int(np.ceil(np.linalg.norm(up) / _CELL)), 1)
        v, u = np.meshgrid(np.linspace(0, 1, b + 1), np.linspace(0, 1, a + 1), indexing="ij")
        uv = np.stack([u, v], -1).reshape(-1, 2)
        points = corner + uv[:, :1] * right + uv[:, 1:] * up
        normal = np.cross(right, up)
        normals = np.broadcast_to(normal / np.linalg.norm(normal), points.shape)
        self.add(points, normals, uv, _quads(b, a), picture, kind=kind)

    def box(self, centre: np.ndarray, size: np.ndarray, turn: float, pictures: list[np.ndarray]) -> None:
        """Four sides and a lid; `centre` of the bottom, `size` along x, y, z, `turn` about y in radians."""
        c, s = np.cos(turn), np.sin(turn)
        ex, ey, ez = np.array([c, 0, -s]), np.array([0, 1.0, 0]), np.array([s, 0, c])
        w, h, d = size
        for k, (across, out, wide, deep) in enumerate(
            ((ex, ez, w, d), (-ez, ex, d, w), (-ex, -ez, w, d), (ez, -ex, d, w))
        ):
            self.rectangle(
                centre + out * deep / 2 - across * wide / 2, across * wide, ey * h, pictures[k % len(pictures)]
            )
        self.rectangle(centre + ey * h - ex * w / 2 + ez * d / 2, ex * w, -ez * d, pictures[-1])

    def build(self, towards_window: np.ndarray) -> Surroundings:
        pad = 8
        order = sorted(range(len(self.surfaces)), key=lambda k: -self.surfaces[k][4].shape[0])
        places, x, y, high = {}, 0, 0, 0
        for k in order:
            h, w = self.surfaces[k][4].shape[:2]
            if x + w + 2 * pad > self.width and x > 0:
                x, y, high = 0, y + high, 0
            places[k] = (y + pad, x + pad)
            x, high = x + w + 2 * pad, max(high, h + 2 * pad)
        width = max(places[k][1] + self.surfaces[k][4].shape[1] + pad for k in order)
        height = y + high
        atlas = np.zeros((height, width, 3), np.float32)
        parts: list[list[np.ndarray]] = [[], [], [], [], [], []]
        offset = 0
        for k, (points, normals, uv, triangles, picture, kind) in enumerate(self.surfaces):
            i, j = places[k]
            h, w = picture.shape[:2]
            atlas[i - pad : i + h + pad, j - pad : j + w + pad] = np.pad(
                picture, ((pad, pad), (pad, pad), (0, 0)), "edge"
            )
            placed = np.stack([(j + uv[:, 0] * w) / width, 1 - (i + (1 - uv[:, 1]) * h) / height], -1)
            marks = [np.full(len(points), kind == name) for name in ("window", "shirt")]
            for part, value in zip(parts, (points, normals, placed, triangles + offset, *marks), strict=True):
                part.append(value)
            offset += len(points)
        points, normals, uv, triangles, window, shirt = (np.concatenate(part) for part in parts)
        return Surroundings(points, normals, triangles.astype(np.int32), uv, atlas, window, shirt, towards_window)


def _quads(rows: int, columns: int) -> np.ndarray:
    """(2 rows columns, 3) triangles of a grid of (rows + 1) (columns + 1) vertices, front towards right x up."""
    i = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    a, b, c, d = i, i + 1, i + columns + 2, i + columns + 1
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def furnished_room(rng: np.random.Generator, texel: float, collar: np.ndarray | None = None) -> Surroundings:
    """A room of about 4 m by 4 m with its furniture; `texel` mm per texel of the walls; `collar` (r, 3) the rim of
    the neck around which the shirt is laid, None for no shirt."""
    grain = Grain(rng)
    build = _Builder(width=int(8200 / texel) + 64)
    west, east = -rng.uniform(1500, 2100), rng.uniform(1500, 2100)
    back, front = -rng.uniform(1250, 1700), rng.uniform(2000, 2600)
    high = _CEILING - _FLOOR
    up = np.array([0, high, 0])
    walls = {
        "back": (np.array([west, _FLOOR, back]), np.array([east - west, 0, 0])),
        "front": (np.array([east, _FLOOR, front]), np.array([west - east, 0, 0])),
        "west": (np.array([west, _FLOOR, front]), np.array([0, 0, back - front])),
        "east": (np.array([east, _FLOOR, back]), np.array([0, 0, front - back])),
    }
    for corner, right in walls.values():
        h, w = int(high / texel), int(np.abs(right).sum() / texel)
        build.rectangle(corner, right, up, patterns.wallpaper(rng, grain, h, w, texel))
    coarse = texel * 1.6
    h, w = int((front - back) / coarse), int((east - west) / coarse)
    ground, along, away = np.array([west, _FLOOR, front]), np.array([east - west, 0, 0]), np.array([0, 0, back - front])
    build.rectangle(ground, along, away, patterns.boards(rng, grain, h, w, coarse))
    build.rectangle(ground + up + away, along, -away, patterns.plaster(rng, grain, h, w))

    side = "west" if rng.random() < 0.5 else "east"
    corner, right = walls[side]
    across = right / np.linalg.norm(right)
    inward = np.cross(across, [0, 1.0, 0])
    wide, tall = 1250.0, 1150.0
    # The window is in front of the subject: it lights one cheek and leaves the other in its own shade.
    ahead = np.linalg.norm(right) * (0.32 if side == "west" else 0.68)
    low_left = corner + across * (ahead - wide / 2) + np.array([0, 850.0, 0]) + inward * 12
    build.rectangle(low_left, across * wide, np.array([0, tall, 0]), patterns.window(300, 320), kind="window")
    towards = low_left + across * wide / 2 + np.array([0, tall / 2, 0])

    for name, (corner, right) in walls.items():
        length = np.linalg.norm(right)
        across = right / length
        inward = np.cross(across, [0, 1.0, 0])
        if name in ("back", "west", "east") and name != side:
            wide, tall = rng.uniform(750, 1000), rng.uniform(1150, 1500)
            at = corner + across * rng.uniform(150, length * 0.45) + np.array([0, 0.0, 0])
            rows = int(rng.integers(3, 5))
            picture = patterns.bookshelf(
                rng, grain, int(tall * 1.6 / texel), int(wide * 1.6 / texel), texel / 1.6, rows
            )
            lift = rng.uniform(250, 450)
            low_left = at + np.array([0, lift, 0]) + inward * 240
            build.rectangle(low_left, across * wide, np.array([0, tall, 0]), picture)
            plank = patterns.boards(rng, grain, max(int(tall / texel), 8), max(int(240 / texel), 8), texel)
            up_side = np.array([0, tall, 0])
            build.rectangle(low_left - inward * 240, inward * 240, up_side, plank)
            build.rectangle(low_left + across * wide, -inward * 240, up_side, plank)
            build.rectangle(low_left + up_side, across * wide, -inward * 240, plank[: max(len(plank) // 2, 4)])
        for _ in range(0 if name == side else int(rng.integers(3, 5))):
            wide, tall = rng.uniform(260, 620), rng.uniform(260, 620)
            at = (
                corner
                + across * rng.uniform(80, length - wide - 80)
                + np.array([0, rng.uniform(900, 1900 - tall / 2), 0])
            )
            picture = patterns.poster(rng, grain, int(tall * 2 / texel), int(wide * 2 / texel))
            build.rectangle(at + inward * rng.uniform(9, 25), across * wide, np.array([0, tall, 0]), picture)
    for _ in range(5):
        size = rng.uniform([220, 250, 220], [420, 900, 420])
        angle = rng.uniform(0.35, 0.95) * np.pi * (1 if rng.random() < 0.5 else -1)
        place = np.array([np.sin(angle), 0, np.cos(angle)]) * rng.uniform(850, 1150) + np.array([0, _FLOOR, 0])
        pictures = [patterns.carton(rng, grain, int(size[1] * 1.5 / texel), int(350 * 1.5 / texel)) for _ in range(3)]
        build.box(place, size, rng.uniform(0, np.pi), pictures)
    if collar is not None:
        _add_shirt(build, collar, patterns.cloth(rng, grain, int(2600 / texel), int(4000 / texel)))
    return build.build(towards / np.linalg.norm(towards))


def _add_shirt(build: _Builder, collar: np.ndarray, picture: np.ndarray) -> None:
    """Rings of super-ellipses from a loose collar around the neck over the shoulders down to the waist."""
    centre = collar.mean(axis=0)
    reach = np.abs(collar - centre).max(axis=0)
    top = collar[:, 1].max()
    # height below the collar, half widths along x and z, shift along z, roundness of the super-ellipse
    rings = np.array(
        [
            [14, reach[0] + 6, reach[2] + 6, 0, 2.0],
            [8, reach[0] + 10, reach[2] + 10, 0, 2.0],
            [0, reach[0] + 14, reach[2] + 13, 0, 2.0],
            [-18, reach[0] + 42, reach[2] + 30, -4, 2.0],
            [-42, 138, 104, -8, 2.1],
            [-80, 182, 120, -12, 2.3],
            [-125, 214, 134, -12, 2.5],
            [-200, 226, 132, -6, 2.6],
            [-420, 222, 136, 0, 2.6],
            [-760, 226, 140, 0, 2.6],
        ]
    )
    steps = np.linspace(0, len(rings) - 1, 60)
    rings = np.stack([np.interp(steps, np.arange(len(rings)), _rounded(rings[:, k])) for k in range(5)], 1)
    turns = np.linspace(-np.pi, np.pi, 121)
    c, s = np.cos(turns), np.sin(turns)
    power = 2 / rings[:, 4:]
    x = centre[0] + rings[:, 1:2] * np.sign(s) * np.abs(s) ** power
    z = centre[2] + (rings[:, 3:4] + rings[:, 2:3] * np.sign(c) * np.abs(c) ** power)
    # The trapezius: shoulders fall to the sides, the collar's front lies lower than its back.
    fall = 0.18 * np.maximum(np.abs(x - centre[0]) - reach[0], 0) + 0.25 * (z - centre[2]) * np.clip(
        (150 + rings[:, :1]) / 110, 0, 1
    )
    y = top + rings[:, :1] - fall
    points = np.stack([x, y, z], -1)
    along, around = np.gradient(points, axis=0), np.gradient(points, axis=1)
    normals = np.cross(around, along)
    normals *= -1
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-9
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=-1).mean(axis=1)
    v = 1 - np.concatenate([[0], np.cumsum(lengths)]) / lengths.sum()
    uv = np.stack(np.broadcast_arrays((turns + np.pi)[None, :] / (2 * np.pi), v[:, None]), -1)
    triangles = _quads(len(steps) - 1, len(turns) - 1)[:, ::-1]
    build.add(points.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 2), triangles, picture, kind="shirt")


def _rounded(values: np.ndarray) -> np.ndarray:
    padded = np.concatenate([values[:1], values, values[-1:]])
    return 0.2 * padded[:-2] + 0.6 * padded[1:-1] + 0.2 * padded[2:]
