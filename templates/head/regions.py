"""Region masks and contours of the skin, told by rings around eyes and mouth and by where vertices lie in the mean."""

from __future__ import annotations

import numpy as np
from cage import HEAD, MOUTH, NECK, SOCKET_LEFT, SOCKET_RIGHT
from lids import CREST, LidBand
from lips import LipBand

LID_RINGS = 14
LIP_RINGS = 13
BROW_HEIGHT, BROW_HALF = 20.5, 4.5  # mm above the eye's centre, half width


def lip_limit(band: LipBand, vertices: np.ndarray) -> np.ndarray:
    """(n,) the ring up to which the red of the lips reaches at each vertex: none past the corners."""
    corner = np.abs(vertices[band.halves[4][0][[0, -1]], 0]).mean() + 2.0
    share = np.clip(1 - (vertices[:, 0] / corner) ** 2, 0, 1)
    return 1 + LIP_RINGS * share**0.4


def brow_line(x: np.ndarray, centre: np.ndarray, side: float) -> np.ndarray:
    """Height of the brow's middle at positions x, for the eye at `centre` (3,) and `side` +1 left, -1 right."""
    out = side * (x - centre[0])
    return centre[1] + BROW_HEIGHT - 0.3 * np.clip(out - 6, 0, None) - 0.12 * np.clip(-out, 0, None)


def regions(
    vertices: np.ndarray,
    triangles: np.ndarray,
    labels: np.ndarray,
    lid_bands: list[LidBand],
    lips: LipBand,
    eyes: np.ndarray,
    mirror: np.ndarray,
) -> dict[str, np.ndarray]:
    """Name -> (n,) bool over the skin's vertices; symmetric."""
    n = len(vertices)
    x, y, z = vertices.T

    def touched(*wanted: int) -> np.ndarray:
        mask = np.zeros(n, bool)
        mask[triangles[np.isin(labels, wanted)]] = True
        return mask

    skin = touched(HEAD)
    ears = skin & (np.abs(x) > 70) & (z < -45) & (z > -125) & (y > -50) & (y < 42)
    brows = np.zeros(n, bool)
    for centre, side in zip(eyes, (1.0, -1.0), strict=True):
        out = side * (x - centre[0])
        half = np.interp(out, [-20, 8, 26], [BROW_HALF, BROW_HALF, 0.5 * BROW_HALF])
        brows |= skin & (out > -19) & (out < 25) & (np.abs(y - brow_line(x, centre, side)) < half) & (z > -30)
    lids = np.zeros(n, bool)
    for band in lid_bands:
        lids |= (band.ring >= 0) & (band.ring <= LID_RINGS)
    mouth_y = vertices[lips.upper, 1].mean()
    width = np.interp(y, [mouth_y + 16, mouth_y + 30, -6, 2], [21, 21, 9, 8])
    face = skin & ~ears & (z > -70) & (y > mouth_y - 48) & (y < 62)
    masks = {
        "face": face,
        "lips": skin & (lips.ring >= 1) & (lips.ring <= lip_limit(lips, vertices)),
        "lids": lids & skin,
        "nose": skin & (np.abs(x) < width) & (y > mouth_y + 15) & (y < 2) & (z > -25),
        "brows": brows,
        "ears": ears,
        "scalp": skin & ~ears & ~face & (y > -20),
        "neck": touched(NECK) | (skin & ~ears & ~face & (y <= -20)),
        "sockets": touched(SOCKET_LEFT, SOCKET_RIGHT),
        "mouth": touched(MOUTH),
    }
    return {name: mask | mask[mirror] for name, mask in masks.items()}


def contours(
    vertices: np.ndarray, lid_bands: list[LidBand], lips: LipBand, brows: np.ndarray, eyes: np.ndarray
) -> dict[str, np.ndarray]:
    """Name -> polyline of vertices from the subject's right to the left."""
    limit = lip_limit(lips, vertices)
    found = {}
    for i, half in enumerate(("upper", "lower")):
        columns = np.stack([_follow(lips, k, i, vertices) for k in range(16)])
        ends = np.clip(np.round(limit[columns[4]]).astype(int), 2, 15)
        found[f"lips_outer_{half}"] = columns[ends, np.arange(columns.shape[1])]
        found[f"lips_inner_{half}"] = columns[4]
    for band, side in zip(lid_bands, ("left", "right"), strict=True):
        rim = np.flatnonzero(band.ring == CREST - 1)
        inner, outer = rim[np.argmin(vertices[rim, 0])], rim[np.argmax(vertices[rim, 0])]
        share = (vertices[rim, 0] - vertices[inner, 0]) / (vertices[outer, 0] - vertices[inner, 0])
        chord = vertices[inner, 1] + share * (vertices[outer, 1] - vertices[inner, 1])
        for half, chosen in (("upper", vertices[rim, 1] >= chord), ("lower", vertices[rim, 1] <= chord)):
            ids = rim[chosen]
            found[f"lid_{half}_{side}"] = ids[np.argsort(vertices[ids, 0])]
    ids = np.flatnonzero(brows)
    for centre, sign, side in zip(eyes, (1.0, -1.0), ("left", "right"), strict=True):
        out = np.linspace(-18, 24, 15)
        x = np.sort(centre[0] + sign * out)
        goal = np.stack([x, brow_line(x, centre, sign)], axis=1)
        near = np.linalg.norm(vertices[ids, None, :2] - goal, axis=2).argmin(axis=0)
        line = ids[near]
        found[f"brow_{side}"] = line[np.r_[True, line[1:] != line[:-1]]]
    return {name: line.astype(np.int32) for name, line in found.items()}


def _follow(band: LipBand, ring: int, half: int, vertices: np.ndarray) -> np.ndarray:
    """Vertices of one ring's half, right to left, one for each vertex of ring 4."""
    line = band.halves[ring][half][::-1]
    if len(line) == len(band.halves[4][half]):
        return line
    wanted = vertices[band.halves[4][half][::-1], 0]
    return line[np.abs(vertices[line, 0][:, None] - wanted).argmin(axis=0)]
