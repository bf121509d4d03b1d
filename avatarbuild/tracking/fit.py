"""
Pose and weights of one frame: equation (4) of the method, min E_feature + E_flow + E_sparse [Ichim et al. 2015].

Gauss-Newton, coarse to fine; in each step the pose and the weights alternate to convergence on one quadratic, the
weights by coordinate descent within their bounds. a active shapes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avatarbuild.energies import texture_flow
from avatarbuild.geometry.rotations import rotation
from avatarbuild.solvers.boxed import boxed, reduced
from avatarbuild.tracking import dense
from avatarbuild.tracking.frames import Frame
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.lids import RIMS
from avatarbuild.tracking.markers import SKIN, Markers
from avatarbuild.tracking.markers import rows as marker_rows
from avatarbuild.tracking.neck import SHAPES, Torso
from avatarbuild.tracking.rig import Places, Rider, Rig
from avatarbuild.tracking.samples import Samples, visible

LEAST_ROWS = 20  # differences of the texture, fewer of which say nothing


@dataclass(frozen=True)
class Weights:
    """
    Of the energies, each normalised: squares of points in (sd mm)^2, robust from `reach` mm on; of flow in its own
    robust spread, `flow` being the worth of a level's samples altogether, in points of 1 mm; `sparse` (l1), `ridge`
    and `score` (the detector's opinion) are worths of a unit of a shape's weight, where dense flow has `density` points
    to a square millimetre of skin. Neighbouring points err alike: a finer picture has more of them, and they say
    little more (`beside`).
    """

    marker_sd: float = 1.5
    marker_reach: float = 10.0
    click_sd: float = 0.4
    target_sd: float = 0.4
    target_reach: float = 1.5
    flow: float = 3000.0
    sparse: float = 100.0
    ridge: float = 10.0
    score: float = 400.0
    density: float = 0.03

    def beside(self, density: float) -> Weights:
        """The same beside `density` points of dense flow to a square millimetre of skin."""
        k = density / self.density
        return replace(
            self, sparse=k * self.sparse, ridge=k * self.ridge, score=k * self.score, density=k * self.density
        )


@dataclass(frozen=True)
class State:
    """x_cam = R x + t; weights (a,)."""

    R: np.ndarray
    t: np.ndarray
    weights: np.ndarray


@dataclass(frozen=True)
class Face:
    """
    What all frames share: the rig with its a active shapes, the lens, markers and samples as riders on that rig, the
    skin's triangles (m, 3), limits: pairs (i, j) of active shapes with w_i <= w_j, and shape_sizes (a,): how much a
    shape moves beside the usual one, at most 1, so that the l1 term does not silence the small ones.
    """

    rig: Rig
    lens: Lens
    markers: Markers
    marker_rider: Rider
    samples: list[Samples]
    sample_riders: list[Rider]
    skin: np.ndarray
    limits: tuple[tuple[int, int], ...]
    shape_sizes: np.ndarray
    torso: Torso | None = None


@dataclass(frozen=True)
class Pinned:
    """Points of a face that a frame shows: markers on a rider, their pictures (q, 2), what each is worth (q,) mm^-2,
    and the distance in mm from which it counts less."""

    markers: Markers
    rider: Rider
    pictures: np.ndarray
    worth: np.ndarray
    reach: float

    def rows(self, face: Face, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """r (2 q,) mm, J (2 q, 6 + a) and robust worths (2 q,) at a state."""
        r, J = marker_rows(self.rider, self.markers, state.weights, self.pictures, face.lens, state.R, state.t)
        worth = self.worth / (1 + (np.hypot(r[0::2], r[1::2]) / self.reach) ** 2)
        return r, J, np.repeat(worth, 2)


def face_of(
    rig: Rig,
    lens: Lens,
    markers: Markers,
    samples: list[Samples],
    skin: np.ndarray,
    limits: tuple[tuple[int, int], ...],
) -> Face:
    riders = [rig.rider(level.places) for level in samples]
    size = np.linalg.norm(rig.deltas.reshape(len(rig.deltas), -1), axis=1)
    relative = np.minimum(size / max(float(np.median(size)), 1e-9), 1.0)
    relative[SHAPES:] = 0
    return Face(rig, lens, markers, rig.rider(markers.places), samples, riders, skin, limits, relative)


def wearing(face: Face, rig: Rig) -> Face:
    """The face with another rig of the same topology."""
    return replace(face_of(rig, face.lens, face.markers, face.samples, face.skin, face.limits), torso=face.torso)


def detected(face: Face, frame: Frame, w: Weights, trust: np.ndarray | float = 1.0) -> list[Pinned]:
    """
    The detector's points, if it found any, each with its `trust` (468,), the rims of lids that are shut left out, then
    the user's, if there are some.
    """
    if not np.isfinite(frame.presence):
        return []
    m, clicks = face.markers, frame.clicks
    worth = m.weight * trust * frame.presence / w.marker_sd**2
    for rim, shut in zip(RIMS, frame.shut, strict=True):
        worth[rim] *= 1 - shut
    points = [Pinned(m, face.marker_rider, frame.marks[:SKIN, :2], worth, w.marker_reach)]
    if clicks is not None:
        at = clicks.points
        places = Places(m.places.triangle[at], m.places.barycentric[at])
        still = Markers(places, np.zeros((len(at), 3)), np.ones(len(at)), m.sliding[at])
        worth = clicks.confidence / w.click_sd**2
        points.append(Pinned(still, face.rig.rider(places), clicks.pixels, worth, w.marker_reach))
    return points


def found(face: Face, targets: dense.Targets, w: Weights) -> list[Pinned]:
    """The points that dense flow found, if any."""
    q = len(targets.pictures)
    if not q:
        return []
    still = Markers(targets.places, np.zeros((q, 3)), np.ones(q), np.zeros(q, bool))
    worth = np.full(q, 1 / w.target_sd**2)
    return [Pinned(still, face.rig.rider(targets.places), targets.pictures, worth, w.target_reach)]


def seen_samples(face: Face, level: int, state: State) -> np.ndarray:
    """(S,) bool: which samples of a level the camera sees at a state."""
    posed = face.rig.posed(state.weights)
    rider = face.sample_riders[level]
    points = rider.at(state.weights).reshape(-1, 3, 3)
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return visible(points[:, 0], normal, posed, face.skin, face.lens, state.R, state.t)


def flow(face: Face, frame: Frame, level: int, state: State, seen: np.ndarray) -> texture_flow.Sight:
    """What the frame shows where a level's samples `seen` (S,) are at a state."""
    points = face.sample_riders[level].at(state.weights).reshape(-1, 3, 3)
    scale = float(1 << level)
    picture = frame.pyramid[level]
    return texture_flow.sight(points, seen, picture, frame.corner, scale, face.lens.parameters, state.R, state.t)


def flow_worth(r: np.ndarray, known: np.ndarray, w: Weights) -> np.ndarray:
    """(S, 2) worths of residuals r (S, 2): w.flow altogether for perfect ones, less beyond twice their spread."""
    if known.sum() < LEAST_ROWS:
        return np.zeros(r.shape)
    sd = spread(r[known])
    return np.where(known, w.flow / known.sum() / sd**2 / (1 + (r / (2 * sd)) ** 2) ** 2, 0)


def spread(r: np.ndarray) -> float:
    """The standard deviation of the bulk of residuals: 1.4826 times the median of their size."""
    return max(1.4826 * float(np.median(np.abs(r))), 1e-4) if len(r) else 1.0


def system(
    face: Face,
    frame: Frame,
    pinned: list[Pinned],
    state: State,
    level: int | None,
    seen: np.ndarray | None,
    w: Weights,
) -> tuple[np.ndarray, np.ndarray]:
    """A (6 + a, 6 + a) and b of a Gauss-Newton step; level None: without flow."""
    a = len(state.weights)
    A, b = np.zeros((6 + a, 6 + a)), np.zeros(6 + a)
    for points in pinned:
        r, J, worth = points.rows(face, state)
        A += J.T @ (worth[:, None] * J)
        b -= J.T @ (worth * r)
    if level is not None and seen is not None:
        sight = flow(face, frame, level, state, seen)
        r, known = texture_flow.residuals(face.samples[level].rho, sight)
        worth = flow_worth(r, known, w).ravel()
        rows = np.flatnonzero(worth)
        a3 = face.sample_riders[level].moves.reshape(len(r), 3, 3, -1)
        J = texture_flow.jacobian(a3, sight)[rows]
        A += J.T @ (worth[rows, None] * J)
        b -= J.T @ (worth[rows] * r.ravel()[rows])
    return A, b


def step(A: np.ndarray, b: np.ndarray, state: State, frame: Frame, face: Face, w: Weights) -> State:
    """The state after one Gauss-Newton step with bounds, l1, ridge and the pull to the detector's opinion."""
    a = len(state.weights)
    A = A.copy()
    # written in the weights themselves, not in their change
    b = b + A[:, 6:] @ state.weights
    b[6:] -= w.sparse * face.shape_sizes
    pull = np.where(np.isfinite(frame.scores), w.score, 0.0)
    A[range(6, 6 + a), range(6, 6 + a)] += w.ridge + pull
    b[6:] += pull * np.nan_to_num(frame.scores)
    A[range(6), range(6)] += 1e-9
    S, r, D, d = reduced(A, b, 6)
    found = boxed(S, r, frame.low, frame.high, state.weights)
    for i, j in face.limits:
        found[i] = min(found[i], found[j])
    pose = d - D @ found
    return State(rotation(pose[:3]) @ state.R, state.t + pose[3:], found)


def fit_points(
    face: Face, frame: Frame, pinned: list[Pinned], start: State, w: Weights, *, rigid: int, steps: int
) -> State:
    """The state by points alone: in the first `rigid` steps the pose, then the weights as well."""
    state = start
    for i in range(rigid + steps):
        A, b = system(face, frame, pinned, state, None, None, w)
        if i < rigid:
            still = np.linalg.solve(A[:6, :6] + 1e-9 * np.eye(6), b[:6])
            state = replace(state, R=rotation(still[:3]) @ state.R, t=state.t + still[3:])
        else:
            state = step(A, b, state, frame, face, w)
    return state


def fit(
    face: Face,
    frame: Frame,
    pinned: list[Pinned],
    start: State,
    w: Weights,
    levels: tuple[int, ...],
    steps: int,
) -> State:
    """The state by points and flow, over the `levels` of the pyramid in that order."""
    state = start
    for level in levels:
        seen = seen_samples(face, level, state)
        for _ in range(steps):
            A, b = system(face, frame, pinned, state, level, seen, w)
            state = step(A, b, state, frame, face, w)
    return state
