"""The lids about the eyeballs: rings of vertices round each eye, and how they are laid onto the balls."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from avatarbuild.geometry import meshes
from avatarbuild.geometry.rings import rings
from avatarbuild.registration.eye_shape import EyeShape, eye_shape, offsets
from avatarbuild.solvers.sparse import Factor
from avatarbuild.template import EYE_PARTS, Template

HELD, OUTER = 2, 11  # rings outside the rim: the last that moves as the ball says, and the first that stays
TOUCHING = 0.3  # mm from the template's eyeball of the vertices that touch it
FAR = 99
_FRONT = 0.2  # cosine to the gaze beyond which skin is looked at for poking through
_CLEAR = 0.25  # mm of skin that stay between the eyeball and the outside of the lids
_ROUNDS = 3
_CLOSE = 0.01  # worth of a vertex's staying beside the smoothness: about three rings for what the rim has moved to fade


@dataclass(frozen=True)
class LidBand:
    """
    The skin about one eye of the template.

    ring (v,) int of every skin vertex: 0 on the lids' rim, growing outwards, -1 inside (the lids' back and the socket),
    FAR far away; gap (v,) mm between the template's mean skin and its eyeball, positive outside; contact (k,) the
    vertices that touch the eyeball in the mean; triangles (m, 3) of rings -1 … OUTER.
    """

    ring: np.ndarray
    gap: np.ndarray
    contact: np.ndarray
    triangles: np.ndarray

    @property
    def rim(self) -> np.ndarray:
        """(k,) vertices of ring 0 and of those outside it that move as one with it."""
        return np.flatnonzero((self.ring >= 0) & (self.ring <= HELD))


def lid_bands(template: Template) -> tuple[LidBand, LidBand]:
    """The bands of the left and the right eye of a template that has eyeballs."""
    return _lid_bands(_Same(template))


def seen_line(template: Template, name: str) -> np.ndarray:
    """
    The vertices at which photos show a contour of the template: its own, but of the lower lids.

    A lid's contour is the rim's outer edge, where the lashes stand. Seen from before, the upper lid ends there; below
    the eye the rim, about 1 mm thick, is turned up, and the white ends at its inner edge: the vertices of the contact
    line beside the contour's, the corners left as they are.
    """
    line = template.contours[name]
    side = name.removeprefix("lid_lower_")
    if side == name or eye_shape(template) is None:
        return line
    contact = lid_bands(template)[EYE_PARTS.index(f"eye_{side}")].contact
    off = np.linalg.norm(template.mean[line][:, None] - template.mean[contact], axis=2)
    return np.concatenate([line[:1], contact[off.argmin(axis=1)][1:-1], line[-1:]])


class _Same:
    """A template as a key: the same object, since its arrays have no hash."""

    def __init__(self, template: Template) -> None:
        self.template = template

    def __hash__(self) -> int:
        return id(self.template)

    def __eq__(self, other: Any) -> bool:
        return self.template is other.template


@lru_cache(maxsize=2)
def _lid_bands(key: _Same) -> tuple[LidBand, LidBand]:
    template = key.template
    shape = eye_shape(template)
    assert shape is not None
    skin = template.parts["skin"]
    triangles = template.triangles[skin.triangles]
    points = template.mean[skin.vertices]
    graph = meshes.adjacency(len(points), triangles)
    bands = []
    for k, name in enumerate(EYE_PARTS):
        side = name.removeprefix("eye_")
        rim = np.unique(
            np.concatenate([template.contours[f"lid_upper_{side}"], template.contours[f"lid_lower_{side}"]])
        )
        r, _, cosine = offsets(points, template.eye_centres[k], np.array([0.0, 0.0, 1.0]))
        gap = r - shape.surface(cosine, shape.radius)
        ring = rings(graph, rim, OUTER)
        ring[ring > OUTER] = FAR
        ring[_inside(graph, rim, r)] = -1
        near = (np.abs(gap) < TOUCHING) & (ring <= 0)
        band = triangles[(ring[triangles] < OUTER).all(axis=1)]
        bands.append(LidBand(ring, gap, np.flatnonzero(near), band))
    return bands[0], bands[1]


def _inside(graph: sp.csr_matrix, rim: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """(v,) bool: what the rim cuts off from the face; nothing where the rim is not closed."""
    free = np.ones(graph.shape[0], bool)
    free[rim] = False
    kept = np.flatnonzero(free)
    _, label = connected_components(graph[kept][:, kept], directed=False)
    beside = np.flatnonzero(free & (np.asarray(graph[rim].sum(axis=0)).ravel() > 0))
    inside = np.zeros(len(free), bool)
    largest = np.argmax(np.bincount(label))
    for one in np.unique(label[np.searchsorted(kept, beside)]):
        if one != largest:
            inside[kept[label == one]] = True
    return inside & (distance < 40.0)


def settle_lids(
    vertices: np.ndarray,
    centres: np.ndarray,
    radius: np.ndarray,
    template: Template,
    ahead: np.ndarray | None = None,
    seen: np.ndarray | None = None,
) -> np.ndarray:
    """
    min sum_v || (L d)_v ||^2 + _CLOSE s_v || d_v ||^2 over the lids' outside, d_v = (R(direction_v) + gap_v -
    |x_v - c|) direction_v on the rim, on what moves as one with it and on all that lies inside, 0 beyond the band: the
    lids laid onto the eyeballs, their thickness at the rim the template's, the skin around following smoothly, and the
    less the better it is known (s). Then what lies too near is lifted.

    vertices (>= v, 3) skin first, centres (2, 3), radius (2,) mm, in one frame; ahead (3,) where the eyeballs look,
    +z if None; seen (>= v,) in 0..1: how far the cloud has told where the skin is, nowhere if None. Returns the
    vertices with the skin about the eyes moved.
    """
    shape = eye_shape(template)
    if shape is None:
        return vertices.copy()
    ahead = np.array([0.0, 0.0, 1.0]) if ahead is None else ahead
    out = vertices.astype(np.float64)
    for band, centre, size in zip(lid_bands(template), centres, radius):
        v = len(band.ring)
        known = np.zeros(v) if seen is None else seen[:v]
        out[:v] = _settle(out[:v], centre, float(size), band, shape, ahead, known)
    return out


def _settle(
    skin: np.ndarray,
    centre: np.ndarray,
    radius: float,
    band: LidBand,
    shape: EyeShape,
    ahead: np.ndarray,
    seen: np.ndarray,
) -> np.ndarray:
    ring = band.ring
    held = np.flatnonzero(ring <= HELD)
    free = np.flatnonzero((ring > HELD) & (ring < OUTER))
    r, direction, cosine = offsets(skin[held], centre, ahead)
    moved = (shape.surface(cosine, radius) + band.gap[held] - r)[:, None] * direction
    band_rows = np.flatnonzero(ring <= OUTER + 1)
    number = np.full(len(ring), -1)
    number[band_rows] = np.arange(len(band_rows))
    graph = meshes.adjacency(len(band_rows), number[band.triangles])
    degree = np.asarray(graph.sum(axis=1)).ravel()
    laplacian = sp.identity(len(band_rows)) - sp.diags(1 / np.maximum(degree, 1)) @ graph
    bilaplacian = (laplacian.T @ laplacian + sp.diags(_CLOSE * seen[band_rows])).tocsr()
    f, h = number[free], number[held]
    right = -(bilaplacian[f][:, h] @ moved)
    out = skin.copy()
    out[held] += moved
    out[free] += Factor(bilaplacian[f][:, f]).solve(right)
    mean = sp.diags(1 / np.maximum(degree, 1)) @ graph
    front = np.flatnonzero((ring > 0) & (ring < OUTER))
    for _ in range(_ROUNDS):
        r, direction, cosine = offsets(out[front], centre, ahead)
        least = np.minimum(_CLEAR, np.maximum(band.gap[front], 0))
        lack = np.where(cosine > _FRONT, np.maximum(shape.surface(cosine, radius) + least - r, 0), 0)
        if lack.max() <= 0:
            break
        lift = np.zeros(len(band_rows))
        lift[number[front]] = lack
        spread = np.maximum(lift, 0.5 * (mean @ lift))
        out[front] += spread[number[front], None] * direction
    return out


@dataclass(frozen=True)
class LidFit:
    """
    Of both eyes, mm: `contact` the largest distance between the ball and the vertices that touch it, `rim` the largest
    departure of the rim's height over the ball from the template's, `poke` how far the ball stands through the skin.
    """

    contact: float
    rim: float
    poke: float


def lid_fit(
    vertices: np.ndarray, centres: np.ndarray, radius: np.ndarray, template: Template, ahead: np.ndarray | None = None
) -> LidFit:
    """How the lids lie on the eyeballs; arguments as of `settle_lids`. Looks at vertices, edges and triangles."""
    shape = eye_shape(template)
    ahead = np.array([0.0, 0.0, 1.0]) if ahead is None else ahead
    contact = rim = poke = 0.0
    if shape is None:
        return LidFit(contact, rim, poke)
    for band, centre, size in zip(lid_bands(template), centres, radius):
        height = _height(vertices, centre, float(size), shape, ahead)
        contact = max(contact, float(np.abs(height[band.contact] - band.gap[band.contact]).max(initial=0)))
        rim = max(rim, float(np.abs(height[band.rim] - band.gap[band.rim]).max(initial=0)))
        outside = band.triangles[(band.ring[band.triangles] >= 0).all(axis=1)]
        a, b, c = (vertices[outside[:, k]] for k in range(3))
        samples = np.concatenate([a, b, c, (a + b) / 2, (b + c) / 2, (c + a) / 2, (a + b + c) / 3])
        ahead_of = offsets(samples, centre, ahead)[2] > _FRONT
        poke = max(poke, float(-_height(samples[ahead_of], centre, float(size), shape, ahead).min(initial=0)))
    return LidFit(contact, rim, poke)


def _height(points: np.ndarray, centre: np.ndarray, radius: float, shape: EyeShape, ahead: np.ndarray) -> np.ndarray:
    """(n,) mm of points over the eyeball's surface."""
    r, _, cosine = offsets(points, centre, ahead)
    return r - shape.surface(cosine, radius)
