"""
Lids on eyeballs: what the source's lids do about its eyeballs, the target's do about its own.

c(x) = |x - o| - r(angle between x - o and the gaze) is a point's clearance over the eye with its cornea, o the ball's
centre. A vertex of the lids keeps c_target(posed) - c_target(rest) = k (c_source(posed) - c_source(rest)), k the ratio
of the balls' radii. In a shape that closes the source's eye, the lids' edges lie at c_target = k c_source, and the
upper edge passes the lower one by the source's angle about the eye. Where target and source are equal nothing changes.
n vertices of the skin, b of a lid band; millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry import rings
from avatarbuild.geometry.smooth_step import smooth_step

EDGE, FADE, REACH = 9, 20, 25  # rings: the lid's edge ends; radial corrections end; all corrections end
MIDDLE = 0.1  # radians about the eye over which the lower lid passes into the upper one
FRONT = 0.2  # cosine to the gaze of what lies before the eye
SKIN = 0.4  # mm of skin over the eye at least, where the source has so much
CLEAR = 0.1  # mm that a lid passes over the eye on its straight way, where the source's does so
WAY = (0.25, 0.5, 0.75)
_LIFTS, _SPREAD = 12, 60  # times that skin is lifted, each smoothed by so many means of neighbours
CLOSED = 0.5  # share of the upper edge that passes the lower one in a shape that closes the eye


@dataclass(frozen=True)
class Eye:
    """centre (3,); gaze (3,) unit; angles (k,) radians from the gaze, rising, and the surface's radii (k,) there."""

    centre: np.ndarray
    gaze: np.ndarray
    angles: np.ndarray
    radii: np.ndarray

    def looking(self, turn: np.ndarray) -> Eye:
        """The eye turned by a rotation (3, 3)."""
        return Eye(self.centre, turn @ self.gaze, self.angles, self.radii)

    def clearance(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """c (n,) of points (n, 3), and their unit directions (n, 3) from the centre."""
        offset = points - self.centre
        r = np.linalg.norm(offset, axis=1)
        direction = offset / np.maximum(r, 1e-9)[:, None]
        angle = np.arccos(np.clip(direction @ self.gaze, -1, 1))
        return r - np.interp(angle, self.angles, self.radii), direction


def eye_of(ball: np.ndarray, centre: np.ndarray) -> Eye:
    """The eye of a ball's vertices (k, 3); its gaze goes through the vertex farthest from the centre."""
    offset = ball - centre
    r = np.linalg.norm(offset, axis=1)
    gaze = offset[np.argmax(r)] / r.max()
    angle, first = np.unique(np.round(np.arccos(np.clip(offset @ gaze / r, -1, 1)), 6), return_index=True)
    return Eye(centre, gaze, angle, r[first])


def eye_like(ball: np.ndarray, centre: np.ndarray, source: Eye, source_ball: np.ndarray) -> Eye:
    """The eye of a ball (k, 3) in the topology of `source_ball` (k, 3): the source's surface scaled by their ratio."""
    offset = ball - centre
    r = np.linalg.norm(offset, axis=1)
    r_source = np.linalg.norm(source_ball - source.centre, axis=1)
    apex = int(np.argmax(r_source))
    return Eye(centre, offset[apex] / r[apex], source.angles, source.radii * float(np.median(r / r_source)))


@dataclass(frozen=True)
class LidBand:
    """
    The lids of one eye. vertices (b,) ids; ring (b,) from the socket's border outwards, -1 within; touch: the ring that
    touches the eye; upper, lower: its ids from x low to high, corners in both; along (b,) 0 at one corner, 1 at the
    other; over (b,) in [0, 1]: how far a vertex belongs to the upper lid; average (b, b): mean of the neighbours.
    """

    vertices: np.ndarray
    ring: np.ndarray
    touch: int
    upper: np.ndarray
    lower: np.ndarray
    along: np.ndarray
    over: np.ndarray
    average: sp.csr_matrix


def lid_band(
    vertices: np.ndarray, triangles: np.ndarray, graph: sp.csr_matrix, socket: np.ndarray, eye: Eye
) -> LidBand:
    """The band about one eye of the source: skin vertices (n, 3), triangles (m, 3), its adjacency `graph` (n, n), and
    socket (n,) bool of that eye."""
    ring = rings.rings_of_opening(graph, triangles, socket, REACH)
    clear, _ = eye.clearance(vertices)
    touch = min(range(1, EDGE), key=lambda k: float(np.abs(clear[ring == k]).mean()))
    contact = np.flatnonzero(ring == touch)
    x, y = vertices[contact, 0], vertices[contact, 1]
    first, last = contact[np.argmin(x)], contact[np.argmax(x)]
    chord = np.interp(x, vertices[[first, last], 0], vertices[[first, last], 1])
    lines = [np.union1d(half, [first, last]) for half in (contact[y >= chord], contact[y <= chord])]
    upper, lower = (line[np.argsort(vertices[line, 0], kind="stable")] for line in lines)
    ids = np.flatnonzero((ring >= -1) & (ring <= REACH))
    along = (vertices[ids, 0] - x.min()) / (x.max() - x.min())
    middle = vertices[first] + np.clip(along, 0, 1)[:, None] * (vertices[last] - vertices[first])
    over = smooth_step(0.5 + (_elevation(vertices[ids], eye.centre) - _elevation(middle, eye.centre)) / MIDDLE)
    average = rings.neighbour_mean(graph[ids][:, ids])
    return LidBand(ids, ring[ids], touch, upper, lower, along, over, average)


@dataclass(frozen=True)
class LidPose:
    """What a source's lids do in one shape: rest (b,), posed (b,) clearances, half-way ones way (3, b), the eye's turn
    (3, 3), and overlap (len(upper),) radians by which the upper edge passes the lower one."""

    rest: np.ndarray
    posed: np.ndarray
    way: np.ndarray
    turn: np.ndarray
    overlap: np.ndarray

    @property
    def closes(self) -> bool:
        """Whether the eye is shut."""
        return bool((self.overlap[1:-1] > 0).mean() > CLOSED)


def lid_pose(band: LidBand, rest: np.ndarray, posed: np.ndarray, eye: Eye, turn: np.ndarray) -> LidPose:
    """The pose of lids rest (n, 3) -> posed (n, 3) about `eye`, which turns by `turn` (3, 3)."""
    a, b = rest[band.vertices], posed[band.vertices]
    way = np.stack([eye.clearance(a + w * (b - a))[0] for w in WAY])
    overlap = overlap_angles(band, posed, eye.centre)
    return LidPose(eye.clearance(a)[0], eye.looking(turn).clearance(b)[0], way, turn, overlap)


def overlap_angles(band: LidBand, posed: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(len(upper),) radians about the eye by which each vertex of the upper contact line lies below the lower line."""
    low, high = posed[band.lower], posed[band.upper]
    order = np.argsort(low[:, 0], kind="stable")
    return np.interp(high[:, 0], low[order, 0], _elevation(low, centre)[order]) - _elevation(high, centre)


def lay_on(
    band: LidBand, rest: np.ndarray, posed: np.ndarray, eye: Eye, source: LidPose, source_eye: Eye
) -> np.ndarray:
    """posed (n, 3) with its lids on `eye`, as the source's lie on theirs; rest (n, 3) the same head at rest."""
    out = posed.copy()
    ids, ring = band.vertices, band.ring
    k = float(eye.radii[0] / source_eye.radii[0])
    edge = np.zeros(len(ids))
    if source.closes:
        edge = smooth_step((EDGE + 5 - ring) / 5)
        change = overlap_angles(band, out, eye.centre) - source.overlap
        out[ids] = _raised(band, out, eye.centre, change)
    looking = eye.looking(source.turn)
    kept = eye.clearance(rest[ids])[0] + k * (source.posed - source.rest)
    now, direction = looking.clearance(out[ids])
    fade = smooth_step((FADE - ring) / (FADE - EDGE))
    wanted = now + fade * (edge * k * source.posed + (1 - edge) * kept - now)
    before = (ring > band.touch) & (ring <= FADE) & (direction @ looking.gaze > FRONT)
    least = k * np.minimum(SKIN * np.clip((ring - band.touch) / 2, 0, 1), source.posed)
    wanted = np.where(before, np.maximum(wanted, least), wanted)
    out[ids] += (wanted - now)[:, None] * direction
    if source.closes:
        out[ids] = _bulged(band, rest[ids], out[ids], eye, k * source.way)
    return out


def lifted(band: LidBand, rest: np.ndarray, deltas: np.ndarray, moving: np.ndarray, eye: Eye) -> np.ndarray:
    """
    Shapes deltas (k, n, 3) of a head rest (n, 3) whose sum keeps the skin about the lids before the eye: where it is
    nearer to it than CLEAR, and than half of what it is at rest, it is lifted by l, the smallest l >= lack that is at
    least the mean of its neighbours', and each shape takes its share of l by how far it moves the skin inwards there.

    moving (k, n) bool: where the shapes may move at all.
    """
    out = deltas.copy()
    ids, free = band.vertices, (band.ring > band.touch) & (band.ring < REACH)
    least = np.minimum(CLEAR, 0.5 * eye.clearance(rest[ids])[0])
    for _ in range(_LIFTS):
        clear, direction = eye.clearance(rest[ids] + out[:, ids].sum(axis=0))
        lack = np.where(free & (direction @ eye.gaze > FRONT), np.maximum(least - clear, 0), 0)
        if lack.max() <= 0:
            break
        lift = lack
        for _ in range(_SPREAD):
            lift = np.where(free, np.maximum(lack, band.average @ lift), 0)
        inwards = np.maximum(-np.einsum("kbx,bx->kb", out[:, ids], direction), 1e-6) * moving[:, ids]
        share = inwards / np.maximum(inwards.sum(axis=0), 1e-9)
        out[:, ids] += (share * lift)[..., None] * direction
    return out


def misfit(
    band: LidBand, rest: np.ndarray, delta: np.ndarray, eye: Eye, source: LidPose, source_eye: Eye
) -> tuple[float, float]:
    """
    Of a shape that closes the eye, mm: how far the contact lines are off where the source's lie, and how deep the lids'
    skin sinks into the eye on the way or at the end. rest, delta (n, 3) of the skin.
    """
    ids = band.vertices
    k = float(eye.radii[0] / source_eye.radii[0])
    line = np.isin(ids, np.concatenate([band.upper, band.lower]))
    clear, _ = eye.clearance(rest[ids] + delta[ids])
    skin = (band.ring > band.touch + 1) & (band.ring <= FADE)
    sunk = 0.0
    for w in (*WAY, 1.0):
        c, direction = eye.clearance(rest[ids] + w * delta[ids])
        sunk = max(sunk, float(-np.where(skin & (direction @ eye.gaze > FRONT), c, 0).min()))
    return float(np.abs(clear - k * source.posed)[line].max()), sunk


def _raised(band: LidBand, posed: np.ndarray, centre: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """(b, 3) the band with its upper lid turned upwards about the eye by angles (len(upper),), less towards its end."""
    points = posed[band.vertices]
    place = np.searchsorted(band.vertices, band.upper)
    taper = np.clip(8 * band.along * (1 - band.along), 0, 1)
    fade = smooth_step((REACH - 1 - band.ring) / (REACH - 1 - EDGE))
    turn = np.interp(band.along, band.along[place], angles) * taper * band.over * fade
    y, z = points[:, 1] - centre[1], points[:, 2] - centre[2]
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([points[:, 0], centre[1] + c * y + s * z, centre[2] + c * z - s * y], axis=1)


def _bulged(band: LidBand, rest: np.ndarray, posed: np.ndarray, eye: Eye, way: np.ndarray) -> np.ndarray:
    """posed (b, 3) lifted where the straight way there from rest (b, 3) is nearer to the eye than way (3, b), CLEAR.

    All is lifted away from the eye as seen half-way: there the eye is in the way, and away from it at the end would be
    down the cheek as well.
    """
    out = posed
    rim = np.clip((band.ring - band.touch) / 2, 0, 1)  # the line that touches the eye goes on doing so
    skin = (band.ring > band.touch + 1) & (band.ring <= FADE)
    _, away = eye.clearance((rest + posed) / 2)
    for _ in range(3):
        lack = np.zeros(len(rest))
        for w, source in zip(WAY, way, strict=True):
            clear, direction = eye.clearance(rest + w * (out - rest))
            short = np.minimum(source, CLEAR) - clear
            helps = w * np.maximum((direction * away).sum(axis=1), 0.5)
            lack = np.maximum(lack, np.where(skin & (direction @ eye.gaze > FRONT), short, 0) / helps)
        if lack.max() <= 0:
            break
        for _ in range(3):
            lack = np.maximum(lack, band.average @ lack)
        out = out + (rim * lack)[:, None] * away
    return out


def _elevation(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    return np.arctan2(points[:, 1] - centre[1], points[:, 2] - centre[2])
