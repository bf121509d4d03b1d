"""Contours that the user has drawn on photos, in place of the detector's there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from avatarbuild.artefacts import Views
from avatarbuild.registration.pins import BROWS, LID_RIMS, LIP_BORDERS, SEAM
from avatarbuild.registration.sightings import Sightings
from avatarbuild.sfm.metric import Placed


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)


RIMS: dict[str, tuple[str, tuple[tuple[int, ...], ...]]] = {
    _camel(name): (name, chains)
    for name, chains in (
        *((name, (chain,)) for group in (LID_RIMS, LIP_BORDERS, SEAM) for name, chain in group.items()),
        *BROWS.items(),
    )
}
"""A contour's name in corrections.json -> the template's, and its landmarks: chains whose mean is the contour."""


def middle(points: np.ndarray, chains: tuple[tuple[int, ...], ...]) -> np.ndarray:
    """(c, d) the contour through landmarks (478, d)."""
    return np.mean([points[list(chain)] for chain in chains], axis=0)


def at_shares(line: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """(s, d) points of a polyline (q, d) at shares (s,) of its length."""
    along = shares_along(line)
    return np.stack([np.interp(shares, along, line[:, k]) for k in range(line.shape[1])], axis=1)


def shares_along(line: np.ndarray) -> np.ndarray:
    """(q,) in 0..1: where the corners of a polyline (q, d) lie by its length."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    return along / along[-1] if along[-1] > 0 else np.linspace(0, 1, len(line))


def as_drawn(
    seen: Sightings, placed: Placed, photos: Views, told: Mapping[str, Mapping[str, np.ndarray]]
) -> tuple[Sightings, list[str]]:
    """
    The sightings with the landmarks of drawn contours where the user sees them, and a warning for each photo that
    cannot serve.

    told: photo -> {contour: (q, 2) pixels}. A landmark's place X goes across the photo's line of sight to the curve, at
    its own share of the curve's length and at the depth that it has: X' = R^T (z ray(u) - t). Every trusted photo's
    picture of it goes along, since the detector errs alike in all. Of several photos the most frontal one counts.
    """
    points, drawn, warnings = seen.points.copy(), set(), []
    order = sorted(told, key=lambda name: (-_turned(photos, name), name))
    for name in order:
        rows = np.flatnonzero(placed.index == (photos.names.index(name) if name in photos.names else -1))
        if not len(rows):
            warnings.append(f"corrections.json has contours for {name}, which is no placed photo: they are not used")
            continue
        p = int(rows[0])
        for contour, curve in told[name].items():
            own, chains = RIMS[contour]
            at = middle(seen.points, chains)
            whole = np.isfinite(at).all(axis=1)
            if whole.sum() < 2:
                continue
            camera = at[whole] @ placed.rotation[p].T + placed.translation[p]
            shares = shares_along(np.asarray(placed.cameras[p].img_from_cam(camera)))
            rays = placed.rays(p, at_shares(curve, shares)) @ placed.rotation[p].T
            moved = (rays * (camera[:, 2] / rays[:, 2])[:, None] - placed.translation[p]) @ placed.rotation[p]
            for chain in chains:
                numbers = np.array(chain)[whole]
                points[numbers] = seen.points[numbers] + moved - at[whole]
            drawn.add(own)
    before, after = (
        np.einsum("kij,pj->kpi", seen.rotation, x) + seen.translation[:, None] for x in (seen.points, points)
    )
    way = after[..., :2] / after[..., 2:] - before[..., :2] / before[..., 2:]
    changed = (points != seen.points).any(axis=1) & np.isfinite(points).all(axis=1)
    pictures = seen.pictures + np.where(changed[None, :, None], way, 0.0)
    return replace(seen, points=points, pictures=pictures, drawn=frozenset(drawn)), warnings


def _turned(photos: Views, name: str) -> float:
    """Degrees from the front; a photo without a face comes first in the order, to be overruled."""
    yaw = abs(photos.pose[photos.names.index(name), 0]) if name in photos.names else np.inf
    return float(yaw) if np.isfinite(yaw) else np.inf
