"""What the photos say of single points of the skin: landmarks, and the rims of lips and lids as curves."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from avatarbuild.registration.lids import seen_line
from avatarbuild.registration.shell import Pins
from avatarbuild.registration.sightings import Sightings
from avatarbuild.template import Template

LID_RIMS: dict[str, tuple[int, ...]] = {
    "lid_upper_right": (33, 246, 161, 160, 159, 158, 157, 173, 133),
    "lid_lower_right": (33, 7, 163, 144, 145, 153, 154, 155, 133),
    "lid_upper_left": (362, 398, 384, 385, 386, 387, 388, 466, 263),
    "lid_lower_left": (362, 382, 381, 380, 374, 373, 390, 249, 263),
}
LIP_BORDERS: dict[str, tuple[int, ...]] = {
    "lips_outer_upper": (61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291),
    "lips_outer_lower": (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291),
}
SEAM: dict[str, tuple[int, ...]] = {
    "lips_inner_upper": (78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308),
    "lips_inner_lower": (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308),
}
BROWS: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {  # the upper and the lower edge
    "brow_right": ((70, 63, 105, 66, 107), (46, 53, 52, 65, 55)),
    "brow_left": ((336, 296, 334, 293, 300), (285, 295, 282, 283, 276)),
}
_DEPTH = 1.5  # mm: standard deviation of the depth at which the photos see the lids' rims
_SEALED = 1.5  # mm: lips whose inner rims are seen this close are closed
_SEAL = 20.0  # stiffness that holds closed lips together, mm^0


def curve(points: np.ndarray, own: np.ndarray, rim: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    A contour in space as the photos show it, at the template's contour vertices: places and unit tangents (v, 3).

    points (c, 3) the landmarks along it in space, own (c, 3) the same on the template, rim (v, 3) the contour's
    vertices on the template. Between landmarks the curve is read off by arc length; both ends belong together.
    """
    # where each landmark lies along the contour of the template
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rim, axis=0), axis=1))])
    at = np.array([_foot(p, rim, along) for p in own])
    at[0], at[-1] = 0.0, along[-1]
    at = np.maximum.accumulate(at) + 1e-6 * np.arange(len(at))
    places = np.stack([np.interp(along, at, points[:, k]) for k in range(3)], axis=1)
    tangent = np.gradient(places, axis=0)
    return places, tangent / np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)


def _foot(point: np.ndarray, line: np.ndarray, along: np.ndarray) -> float:
    """Arc length of the point of a polyline nearest to `point`."""
    start, step = line[:-1], np.diff(line, axis=0)
    share = np.clip(((point - start) * step).sum(axis=1) / np.maximum((step**2).sum(axis=1), 1e-12), 0, 1)
    gap = np.linalg.norm(start + share[:, None] * step - point, axis=1)
    best = int(gap.argmin())
    return float(along[best] + share[best] * np.linalg.norm(step[best]))


def pins(
    template: Template, seen: Sightings, model: np.ndarray, landmark: float, rim: float, border: float, slide: float
) -> Pins:
    """
    Landmarks as points; lids, lips and brows as curves along which the skin may slide.

    model (n, 3) the morphable model's fit; standard deviations in mm: `landmark` of single landmarks, `rim` across lids
    and the seam of the lips, `border` across the lips' outer edge and the brows, `slide` along all of these. Detectors
    place rims well across the face and poorly in depth: of lips, which the cloud shows, the depth is left to it. Of
    lower lids they see the inner edge (`seen_line`). A border that the user has drawn counts like a rim.
    """
    n = template.parts["skin"].vertices.stop
    chains = (
        *LID_RIMS.values(),
        *LIP_BORDERS.values(),
        *SEAM.values(),
        *(edge for both in BROWS.values() for edge in both),
    )
    curved = {number for chain in chains for number in chain}
    single = np.isfinite(seen.points).all(axis=1) & ~template.landmark_sliding
    single[468:] = False
    single[sorted(curved)] = False
    index = np.flatnonzero(single)
    rows = [_rows(template, index, n)]
    places = [seen.points[index]]
    stiff = [seen.precision[index] / landmark**2]

    def along(name: str, at: np.ndarray, tangent: np.ndarray, sigma: float, depth: float | None) -> None:
        line = seen_line(template, name)
        sigma = min(sigma, rim) if name in seen.drawn else sigma
        spacing = 3.5 / max(len(line), 1) ** 0.5  # the more vertices a curve has, the less each counts
        sight = _sight(at, seen)
        up = np.cross(sight, tangent)
        up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
        out = np.cross(tangent, up)
        across = np.einsum("ca,cb->cab", up, up)
        if depth is not None:
            across = across + np.einsum("ca,cb->cab", out, out) * (sigma / depth) ** 2
        slides = np.full(len(line), slide)
        if name in seen.drawn and name in (*LID_RIMS, *LIP_BORDERS):
            slides[[0, -1]] = sigma  # a corner that the user has set
        H = across / sigma**2 + np.einsum("ca,cb->cab", tangent, tangent) / slides[:, None, None] ** 2
        rows.append(sp.csr_matrix((np.ones(len(line)), (np.arange(len(line)), line)), shape=(len(line), n)))
        places.append(at)
        stiff.append(H * min(1.0, spacing))

    own = template.landmarks(template.mean)
    read = lambda name, points, chain: curve(points, own[list(chain)], template.mean[template.contours[name]])  # noqa: E731
    for name, chain in LID_RIMS.items():
        along(name, *read(name, seen.points[list(chain)], chain), rim, _DEPTH)
    for name, chain in LIP_BORDERS.items():
        along(name, *read(name, seen.points[list(chain)], chain), border, None)
    for name, (top, bottom) in BROWS.items():
        middle = (seen.points[list(top)] + seen.points[list(bottom)]) / 2
        along(
            name,
            *curve(middle, (own[list(top)] + own[list(bottom)]) / 2, template.mean[template.contours[name]]),
            border,
            None,
        )
    upper, lower = (seen.points[list(chain)] for chain in SEAM.values())
    if float(np.nanmedian(np.abs((upper - lower)[2:-2] @ _upward(model, template)))) < _SEALED:
        for name, chain in SEAM.items():
            along(name, *read(name, (upper + lower) / 2, chain), rim, None)
        pair = sealed_pairs(template)
        count = len(pair)
        signs = np.tile([1.0, -1.0], count)
        rows.append(sp.csr_matrix((signs, (np.repeat(np.arange(count), 2), pair.ravel())), shape=(count, n)))
        places.append(model[pair[:, 0]] - model[pair[:, 1]])
        stiff.append(np.tile(_SEAL * np.eye(3), (count, 1, 1)))
    else:
        for name, chain in SEAM.items():
            along(name, *read(name, seen.points[list(chain)], chain), rim, None)
    return Pins(sp.vstack(rows).tocsr(), np.concatenate(places), np.concatenate(stiff))


def sealed_pairs(template: Template) -> np.ndarray:
    """(c, 2) vertices of the upper lip's inner rim and their neighbours on the lower's, on the mean."""
    upper, lower = template.contours["lips_inner_upper"], template.contours["lips_inner_lower"]
    gap = np.linalg.norm(template.mean[upper][:, None] - template.mean[lower][None], axis=2)
    nearest = gap.argmin(axis=1)
    keep = (gap.min(axis=1) < 1.0) & (upper != lower[nearest])
    return np.stack([upper[keep], lower[nearest[keep]]], axis=1)


def _rows(template: Template, index: np.ndarray, n: int) -> sp.csr_matrix:
    corners = template.triangles[template.landmark_triangles[index]]
    weights = template.landmark_barycentric[index]
    return sp.csr_matrix(
        (weights.ravel(), (np.repeat(np.arange(len(index)), 3), corners.ravel())), shape=(len(index), n)
    )


def _sight(places: np.ndarray, seen: Sightings) -> np.ndarray:
    """(3,) unit: from the middle of places (c, 3) towards the cameras, the mean of the lines of sight."""
    ray = seen.centres - places.mean(axis=0)
    total = (ray / np.linalg.norm(ray, axis=1, keepdims=True)).sum(axis=0)
    return total / np.linalg.norm(total)


def _upward(model: np.ndarray, template: Template) -> np.ndarray:
    eyes = model[template.contours["brow_left"]].mean(axis=0) + model[template.contours["brow_right"]].mean(axis=0)
    lips = model[template.contours["lips_outer_lower"]].mean(axis=0)
    up = eyes / 2 - lips
    return up / np.linalg.norm(up)
