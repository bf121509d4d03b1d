"""Eyeballs of 24 mm and the lids that lie on them, at every identity and expression as far as a linear head can.

The lid margin is a band of rings of fine vertices around the socket's texture border: ring 0 is that border, ring
CONTACT the line that touches the eye, the rings up to CREST the visible thickness of the lid, the rings below CONTACT
go on inside the eyeball, so that no gap can open. Radial corrections of the contact ring spread over the skin by the
biharmonic equation. Everything is computed for the left eye and mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from parts import eyeball_radius
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

AHEAD = (0.0, 0.0, 1.0)
# rings: where the lids touch the eye, the margin's edge, the end of what moves as one with it, the last one whose
# thickness is everybody's, the first free one, the end of all corrections
CONTACT, CREST, MARGIN, HELD, FREE, OUTER = 4, 7, 8, 10, 20, 26
DEPTHS = {3: 0.9, 2: 1.8, 1: 2.6, 0: 3.2}  # mm below the eye's surface of the rings inside the lid
SOCKET_DEPTH = 3.6
CLEARANCE, CLOSED_CLEARANCE = 1.0, 1.3  # mm of lid skin over the eye, open and closed
LEAST = 0.8  # mm of skin over the eye that the identity's variation leaves
SAMPLES, SEED = 1500, 5
RAISE = 0.4  # mm of the eyeball's centre above the middle of the opening
SHRINK = 0.6  # of the identity's sliding of the lids about the eye; the error off the sphere goes with its square
OVERLAP = 2.4  # mm by which the closed upper lid passes the lower lid's line
BULGE = 0.5  # mm of hover of the closed upper lid, so that half a blink cuts less into the eye
BLEND = (8, 20)  # rings between which the closed lid passes from its own shape to the source's
# the closed upper lid bulges forward so far that none of these heads' eyes comes nearer to its skin than SPARE mm, up
# to this ring, smoothed over SOFT mm, and as a dome that falls off by DOME mm across: a narrow one folds the line of
# the lids to a V
CLOSED_SAMPLES, SPARE, BULGING, SOFT, DOME = 300, 0.05, 15, 2.0, 6.0


@dataclass(frozen=True)
class LidBand:
    """ring (n,) of every skin vertex around the left eye, -9 far away, -1 ... inside the socket; contact (k,) vertices
    of ring CONTACT in order around the eye; column (n,) nearest contact vertex; spread (n, k) of their corrections."""

    ring: np.ndarray
    contact: np.ndarray
    column: np.ndarray
    spread: sp.csr_matrix


def lid_band(vertices: np.ndarray, triangles: np.ndarray, on_socket: np.ndarray) -> LidBand:
    """Rings around one eye; `on_socket` (m,) bool marks the triangles of that eye's socket."""
    n = len(vertices)
    edges = np.unique(
        np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1), axis=0
    )
    graph = sp.coo_matrix((np.ones(len(edges)), edges.T), shape=(n, n)).tocsr()
    graph = graph + graph.T
    inside = np.zeros(n, bool)
    inside[triangles[on_socket]] = True
    outside = np.zeros(n, bool)
    outside[triangles[~on_socket]] = True
    ring = np.full(n, 99)
    ring[inside & outside] = 0
    for k in range(1, OUTER + 1):
        grown = (graph @ (ring == k - 1)) > 0
        ring[grown & (ring == 99) & ~inside] = k
    ring[inside & ~outside] = -1
    contact = np.flatnonzero(ring == CONTACT)
    middle = vertices[contact].mean(axis=0)
    angle = np.arctan2(vertices[contact, 1] - middle[1], vertices[contact, 0] - middle[0])
    contact = contact[np.argsort(angle)]
    column = cKDTree(vertices[contact]).query(vertices)[1]
    return LidBand(ring, contact, column, _spread(graph, ring, contact, column))


def _spread(graph: sp.csr_matrix, ring: np.ndarray, contact: np.ndarray, column: np.ndarray) -> sp.csr_matrix:
    """(n, k): 1 along a contact vertex's column up to ring MARGIN, biharmonic outside, 0 far away."""
    n, k = len(ring), len(contact)
    degree = np.asarray(graph.sum(axis=1)).ravel()
    laplacian = sp.identity(n) - sp.diags(1 / np.maximum(degree, 1)) @ graph
    bilaplacian = (laplacian.T @ laplacian).tocsr()
    band = np.flatnonzero((ring <= MARGIN) & (ring >= -1))
    carried = sp.csr_matrix((np.ones(len(band)), (band, column[band])), shape=(n, k))
    near = np.flatnonzero((ring > MARGIN) & (ring <= OUTER - 2))
    right = -(bilaplacian[near] @ carried).toarray()
    weights = sp.lil_matrix((n, k))
    weights[near] = splu(bilaplacian[near][:, near].tocsc()).solve(right)
    return (weights.tocsr() + carried).tocsr()


def surface(
    points: np.ndarray, centre: np.ndarray, gaze: tuple[float, float, float] = AHEAD
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points (..., 3) about `centre` (..., 3): distance, unit direction, and the radius in that direction of an eye
    that looks along `gaze` (3,) unit."""
    offset = points - centre
    r = np.linalg.norm(offset, axis=-1)
    direction = offset / r[..., None]
    return r, direction, eyeball_radius(np.arccos(np.clip(direction @ np.array(gaze), -1, 1)))


def fit_centres(contact: np.ndarray) -> np.ndarray:
    """(..., 3) centres whose eye touches the contact rings (..., k, 3) on average, a little above their middle."""
    low, high = contact.min(axis=-2), contact.max(axis=-2)
    centre = (low + high) / 2
    centre[..., 1] = (contact[..., 1].min(axis=-1) + contact[..., 1].max(axis=-1)) / 2 + RAISE
    centre[..., 2] = contact[..., 2].mean(axis=-1) - 10.0
    front = contact[..., 2].mean(axis=-1)
    for _ in range(30):
        r, _, radius = surface(contact, centre[..., None, :])
        # openings wider than the eye have no centre that fits: keep it behind them
        centre[..., 2] = np.clip(centre[..., 2] + (r - radius).mean(axis=-1), front - 11.5, front - 6.0)
    return centre


def fit_identity(
    mean: np.ndarray, components: np.ndarray, band: LidBand
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lids on the eye for random identities, as the nearest linear model.

    Returns corrections of the mean (n, 3) and of the components (p, n, 3), and the eye's centre (3,) and its basis
    (p, 3). argmin sum_i |correction(a_i) - wanted_i|^2 over standard normal a_i.
    """
    p = len(components)
    a = np.random.default_rng(SEED).standard_normal((SAMPLES, p))
    design = np.concatenate([np.ones((SAMPLES, 1)), a], axis=1)

    def linear(values: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(design, values.reshape(SAMPLES, -1), rcond=None)[0].reshape(p + 1, *values.shape[1:])

    near = np.flatnonzero((band.ring >= -1) & (band.ring <= CONTACT))
    rings = mean[near] + np.tensordot(a, components[:, near], 1)
    contact = np.searchsorted(near, band.contact)
    centres = linear(fit_centres(rings[:, contact]))
    centre = np.tensordot(design, centres, 1)[:, None]
    held = rings[:, contact] - centre
    held = centre + held + (SHRINK - 1) * (held - held.mean(axis=0))
    slide = held - rings[:, contact]
    r, direction, radius = surface(held, centre)
    # a line tangent to the sphere leaves it outwards: aim inside by half of what the linear model will miss
    target = radius + 0.05
    for _ in range(2):
        wanted = slide + (target - r)[..., None] * direction
        model = linear(wanted)
        got = rings[:, contact] + np.tensordot(design, model, 1)
        r_got, _, radius_got = surface(got, centre)
        miss = np.quantile(r_got - radius_got, 0.99, axis=0) + np.quantile(r_got - radius_got, 0.01, axis=0)
        target = target - 0.5 * miss
    spread = band.spread
    corrections = np.stack([spread @ model[k] for k in range(p + 1)])
    deep = near[band.ring[near] < CONTACT]
    moved = mean[deep] + corrections[0][deep] + np.tensordot(a, components[:, deep] + corrections[1:, deep], 1)
    r, direction, radius = surface(moved, centre)
    depth = np.array([DEPTHS.get(int(k), SOCKET_DEPTH) for k in band.ring[deep]])
    corrections[:, deep] += linear((radius - depth - r)[..., None] * direction)
    # the lid's thickness: the same for everybody at the margin, free again at ring FREE
    skin = np.flatnonzero((band.ring > CONTACT) & (band.ring < OUTER))
    moved = mean[skin] + corrections[0][skin] + np.tensordot(a, components[:, skin] + corrections[1:, skin], 1)
    r, direction, radius = surface(moved, centre)
    usual = np.maximum((r - radius).mean(axis=0), floor(band.ring[skin]))
    hold = np.clip((FREE - band.ring[skin]) / (FREE - HELD), 0, 1)
    # and nowhere so uneven among people that the eye shows through
    lowest = np.quantile(r - radius, 0.0007, axis=0)
    room = np.where(lowest < LEAST, (usual - LEAST) / np.maximum(usual - lowest, 1e-9), 1)
    hold = np.where(direction[..., 2].mean(axis=0) > 0, np.maximum(hold, 1 - np.clip(room, 0, 1)), 0)
    corrections[:, skin] += linear((hold * (radius + usual - r))[..., None] * direction)
    return corrections[0], corrections[1:], centres[0], centres[1:]


def floor(ring: np.ndarray) -> np.ndarray:
    """Least mm of skin over the eye at each ring of the lid."""
    return CLEARANCE * np.clip((ring - CONTACT) / (CREST - 1 - CONTACT), 0, 1)


def fit_expression(
    mean: np.ndarray,
    delta: np.ndarray,
    band: LidBand,
    centre: np.ndarray,
    gaze: tuple[float, float, float] = AHEAD,
) -> np.ndarray:
    """(n, 3) delta whose lids lie at weight 1 on the eye that looks along `gaze`."""
    posed = mean + delta
    at = posed[band.contact]
    r, direction, radius = surface(at, centre, gaze)
    moved = posed + band.spread @ ((radius + 0.05 - r)[:, None] * direction)
    return _clear(moved, band, centre, CLEARANCE, gaze) - mean


def _clear(
    posed: np.ndarray,
    band: LidBand,
    centre: np.ndarray,
    clearance: float,
    gaze: tuple[float, float, float] = AHEAD,
) -> np.ndarray:
    """Set the inner rings to their depths and lift lid skin that comes too near the eye."""
    out = posed.copy()
    for k, depth in {**DEPTHS, -1: SOCKET_DEPTH}.items():
        at = band.ring == k
        _, direction, radius = surface(out[at], centre)
        out[at] = centre + (radius - depth)[:, None] * direction
    skin = np.flatnonzero((band.ring > CONTACT) & (band.ring < OUTER))
    r, direction, radius = surface(out[skin], centre, gaze)
    lift = np.where(
        direction[:, 2] > 0.2, np.maximum(0, radius + clearance * floor(band.ring[skin]) / CLEARANCE - r), 0
    )
    out[skin] += lift[:, None] * direction
    return out


def close_lids(
    mean: np.ndarray,
    delta: np.ndarray,
    band: LidBand,
    centre: np.ndarray,
    components: np.ndarray,
    basis: np.ndarray,
) -> np.ndarray:
    """(n, 3) blink: the upper lid's contact line comes down to the lower lid's line and passes it by OVERLAP; the
    lids' skin bulges as much as keeps the eye of hardly any identity from showing through."""
    contact = mean[band.contact]
    posed = contact + delta[band.contact]
    low, high = contact[:, 0].min(), contact[:, 0].max()
    inner, outer = contact[np.argmin(contact[:, 0])], contact[np.argmax(contact[:, 0])]
    share = np.clip((contact[:, 0] - low) / (high - low), 0, 1)
    upper = contact[:, 1] > inner[1] + (outer[1] - inner[1]) * share
    lower = np.flatnonzero(~upper)
    order = lower[np.argsort(posed[lower, 0])]
    line = np.polynomial.Polynomial.fit(posed[order, 0], posed[order, 1], 6)
    taper = np.clip(4 * share * (1 - share), 0, 1) ** 0.3
    target = contact.copy()
    height = line(np.clip(contact[:, 0], posed[lower, 0].min(), posed[lower, 0].max()))
    target[:, 1] = height - np.where(upper, OVERLAP * taper, 0)
    offset = target - centre
    planar = np.minimum(np.hypot(offset[:, 0], offset[:, 1]), 11.5)
    offset[:, 2] = np.sqrt(12.0**2 - planar**2)
    _, direction, radius = surface(centre + offset, centre)
    target = centre + (radius + 0.05 + np.where(upper, BULGE * taper, 0))[:, None] * direction
    # near the margin the lids only follow their contact line: the source's own blink frays at the outer corner
    near = np.clip((BLEND[1] - band.ring) / (BLEND[1] - BLEND[0]), 0, 1)[:, None]
    near = near * near * (3 - 2 * near)
    carried = band.spread @ (target - contact)
    corrected = delta + band.spread @ (target - posed)
    moved = mean + near * carried + (1 - near) * corrected
    closed = _clear(moved, band, centre, CLOSED_CLEARANCE) - mean
    over = upper[band.column] & (band.ring > CONTACT) & (band.ring <= BULGING)
    skin = np.flatnonzero(over)
    fade = np.clip((BULGING + 1 - band.ring[skin]) / 4, 0, 1)
    a = np.random.default_rng(SEED + 1).standard_normal((CLOSED_SAMPLES, len(components)))
    heads = mean[skin] + np.tensordot(a, components[:, skin], 1)
    centres = centre + (a @ basis)[:, None]
    x, y, z = (axis[:, None] - axis for axis in (mean + closed)[skin].T)
    smooth = np.exp(-(x * x + y * y + z * z) / SOFT**2 / 2)
    smooth /= smooth.sum(axis=1, keepdims=True)
    wide = np.exp(-((x / DOME) ** 2 + (y / SOFT) ** 2) / 2)
    for _ in range(6):
        for weight, spare in ((0.6, -0.5), (0.8, -0.3), (1.0, SPARE)):
            r, direction, radius = surface(heads + weight * closed[skin], centres)
            lack = np.max(np.where(direction[..., 2] > 0.2, radius + spare - r, 0), axis=0)
            closed[skin, 2] += 0.6 * fade * (smooth @ (wide * np.maximum(0, lack)).max(axis=1)) / weight
    return closed
