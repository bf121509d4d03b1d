"""
Tracking and modelling in turn [Ichim et al. 2015, section 5.1].

A round fits the shapes to all frames (equation 8) with the tracking fixed, then every frame (equation 4) with the
shapes fixed. The first rounds live on points: the detector's, and those that dense flow finds from the drawn head;
they reach far. The later ones add the texture's differences (equation 6), which are finer. It ends when a round moves
the posed skin by less than `settled` mm, or after `rounds`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from avatarbuild.geometry.head_pose import head_pose
from avatarbuild.geometry.mipmap import Mipmap
from avatarbuild.landmarks import canonical_face
from avatarbuild.parallel import each_alone
from avatarbuild.template import ARKIT_NAMES, Template
from avatarbuild.tracking import body, dense, fit, gaze, lens_fit, lids, neck
from avatarbuild.tracking.fit import Face, Pinned, State, Weights
from avatarbuild.tracking.frames import Frame
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.modelling import Freedom, Space, gauge, learn
from avatarbuild.tracking.rig import Rig

log = logging.getLogger(__name__)

FINEST = (1, 0)  # levels of the pyramid for equation (6)
FROM_AFAR, FROM_NEAR = ((), (1,), FINEST), (FINEST,)
"""Schedules of rounds, for frames that points alone have tracked and for frames whose texture has been met before."""
_STEPS = 3
BLINKS = [ARKIT_NAMES.index(name) for name in ("eyeBlinkLeft", "eyeBlinkRight")]
_DOWNS = [ARKIT_NAMES.index(name) for name in ("eyeLookDownLeft", "eyeLookDownRight")]
_WIDES = [ARKIT_NAMES.index(name) for name in ("eyeWideLeft", "eyeWideRight")]
_CHIN, _BRIDGE = 8, 27  # of the 68 landmarks
_MOSTLY = 0.5  # of the frames
_SURE = 0.6  # quality from which a frame may tell about the lens
_LENS_FRAMES = 6
_ALIKE = 0.02  # of a point's square: neighbouring points err alike, fifty of them count as one
_HIDDEN, _LEAST_TRUST = 0.3, 0.05  # where flow finds less of the skin, the detector guesses; what is left of its worth
_HARDLY, _WELL = 0.25, 0.6  # of the evidence
_WORSE = 0.35  # quality below which a frame teaches nothing


@dataclass(frozen=True)
class Skin:
    """What dense flow draws: those of the face's triangles that have a texture (m,) bool, and the texture."""

    region: np.ndarray
    texture: tuple[Mipmap, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Eyes:
    """
    centres (2, 3) and radius (2,) mm of the eyeballs; rest (2, 2) radians, yaw and pitch of each eye's usual gaze, from
    which the eyeLook shapes count; opened (2,) how much of them shows when they are open, NaN unknown; iris (2,) mm the
    radii of the irises, NaN unknown; by_rims (2,) bool: the clip mostly shows the iris' rim, so that frames without it
    tell nothing of where that eye looks.
    """

    centres: np.ndarray
    radius: np.ndarray
    rest: np.ndarray
    opened: np.ndarray
    iris: np.ndarray
    by_rims: np.ndarray


@dataclass(frozen=True)
class Tracked:
    """
    A frame as it was tracked: its state, its points, its quality in 0..1; irises (2, 2) and rims (2,) pixels, their
    middles and the radii of their rims, NaN where none is seen; gaze (2, 2) radians, the eyes' turn from their rest,
    NaN unknown.
    """

    frame: Frame
    state: State
    pinned: list[Pinned]
    quality: float
    irises: np.ndarray
    rims: np.ndarray
    gaze: np.ndarray


def first_state(frame: Frame, lens: Lens, a: int) -> State:
    """A pose from the detector's points alone, as if seen from afar, and no expression."""
    face = canonical_face()
    seen = head_pose(face.points, face.rigidity, frame.marks[: len(face.points)])
    depth = lens.focal / seen.scale
    middle = face.rigidity @ face.points / face.rigidity.sum()
    off = (seen.middle - np.array(lens.size) / 2) * depth / lens.focal
    t = np.array([off[0], off[1], depth]) - seen.rotation @ middle
    return State(seen.rotation, t, np.clip(np.zeros(a), frame.low, frame.high))


def aim(face: Face, frame: Frame, w: Weights) -> Tracked:
    """A frame's pose by the detector's points, without an expression."""
    pinned = fit.detected(face, frame, w)
    start = first_state(frame, face.lens, len(face.rig.deltas))
    state = fit.fit_points(face, frame, pinned, start, w, rigid=4, steps=0)
    return Tracked(frame, state, pinned, 0.0, *gaze.irises(frame), np.full((2, 2), np.nan))


def settle(face: Face, aimed: Tracked, template: Template, eyes: Eyes, w: Weights) -> Tracked:
    """The frame with weights by the detector's points, those of the eyes held as the picture shows them."""
    aimed = regard(face, aimed, template, eyes)
    pinned = fit.detected(face, aimed.frame, w)
    start = replace(aimed.state, weights=np.clip(0, aimed.frame.low, aimed.frame.high))
    return replace(aimed, pinned=pinned, state=fit.fit_points(face, aimed.frame, pinned, start, w, rigid=0, steps=4))


def regard(face: Face, one: Tracked, template: Template, eyes: Eyes) -> Tracked:
    """
    The frame with its gaze at its present pose, and the eyes' own weights held: the eyeLook shapes' where they look
    from their rest, and blinks where the picture shows how far the lids are shut, unless the user has set points.
    """
    frame = one.frame
    seen = lids.shut(frame.shown, eyes.opened)
    shut = np.nan_to_num(np.where(np.isfinite(seen), seen, frame.scores[BLINKS]))
    turned = gaze.yoked(_looking(face, one, eyes) - eyes.rest, shut)
    held = neck.padded(gaze.look_weights(template, turned), 0.0)
    fixed = neck.padded(gaze.turning(template), False).astype(bool)
    shut = lids.shut(frame.shown, eyes.opened, held[_DOWNS])
    known = np.isfinite(shut) & (frame.clicks is None)
    fixed[BLINKS] = known
    held[BLINKS] = shut = np.where(known, shut, 0.0)
    low, high = (np.where(fixed, held, bound) for bound in neck.bounds())
    high[_WIDES] = 1 - shut
    state = replace(one.state, weights=np.clip(one.state.weights, low, high))
    return replace(one, frame=replace(frame, low=low, high=high, shut=shut), state=state, gaze=turned)


def _looking(face: Face, one: Tracked, eyes: Eyes) -> np.ndarray:
    """(2, 2) where each eye looks, NaN where that is not to be believed."""
    state = one.state
    angles = gaze.gaze(one.irises, eyes.centres, eyes.radius, face.lens, state.R, state.t)
    seen = gaze.believed(gaze.at_eye(one.rims, eyes.centres, face.lens, state.R, state.t), eyes.iris)
    angles[eyes.by_rims & ~seen] = np.nan
    return angles


def looking_ahead(face: Face, tracked: list[Tracked], eyes: Eyes) -> Eyes:
    """
    The eyes with their rest, the median of the clip's gaze, and what open eyes show. The detector's irises lie off by
    degrees, in a way of each face's own, and who is filmed mostly looks ahead, with open eyes.
    """
    lens, c = face.lens, eyes.centres
    radii = np.array([gaze.at_eye(one.rims, c, lens, one.state.R, one.state.t) for one in tracked])
    by_rims = np.isfinite(radii).mean(axis=0) >= _MOSTLY
    usual = [np.median(found[np.isfinite(found)]) if k else np.nan for found, k in zip(radii.T, by_rims, strict=True)]
    eyes = replace(eyes, by_rims=by_rims, iris=np.array(usual))
    rest = np.nan_to_num(np.nanmedian([_looking(face, one, eyes) for one in tracked], axis=0))
    return replace(eyes, rest=rest, opened=lids.usually_open(np.array([one.frame.shown for one in tracked])))


def seek(
    face: Face, skin: Skin, tracked: Tracked, w: Weights, levels: tuple[int, ...], at: int = dense.LEVEL
) -> Tracked:
    """The frame again: its points where the head, drawn as it was tracked, is found in it; then the texture."""
    tracked = pulled(face, tracked)
    frame, state = tracked.frame, tracked.state
    posed = face.rig.posed(state.weights)
    found = dense.targets(frame, posed, face.skin, skin.region, skin.texture, face.lens, state.R, state.t, at)
    seen = face.lens.project((face.marker_rider.at(state.weights) + face.markers.offset) @ state.R.T + state.t)[0]
    marks = fit.detected(face, frame, w, np.clip(found.covered(seen) / _HIDDEN, _LEAST_TRUST, 1))
    pinned = marks + fit.found(face, found, w)
    w = w.beside(found.density)
    state = fit.fit_points(face, frame, pinned, state, w, rigid=0, steps=_STEPS)
    if levels:
        state = fit.fit(face, frame, pinned, state, w, levels, _STEPS)
    worth = quality(face, frame, marks[0], state, found) if marks else 0.0
    return replace(tracked, state=state, pinned=pinned, quality=worth)


def pulled(face: Face, one: Tracked) -> Tracked:
    """The frame with the neck's pulls held where the torso, if it is known, has them at the frame's present pose."""
    if face.torso is None:
        return one
    frame, state = _with_body(face.torso.patch, one).frame, one.state
    weights, low, high = state.weights.copy(), frame.low.copy(), frame.high.copy()
    for values in (weights, low, high):
        values[neck.SHAPES :] = face.torso.weights(state.R, state.t, frame.moved)
    return replace(one, frame=replace(frame, low=low, high=high), state=replace(state, weights=weights))


def quality(face: Face, frame: Frame, marks: Pinned, state: State, found: dense.Targets) -> float:
    """
    presence * shown * near: how much of the skin that the drawn head turns to the camera dense flow found again (0.6
    of it is full marks), and how near the detector's points, `marks`, lie (from 2 to 8 mm).
    """
    r, _, _ = marks.rows(face, state)
    off = float(np.median(np.hypot(r[0::2], r[1::2])))
    shown = min(1.0, found.share / 0.6)
    return float(frame.presence) * shown * float(np.clip((8 - off) / 6, 0, 1))


def begin(
    template: Template, face: Face, skin: Skin, frames: list[Frame], eyes: Eyes, w: Weights
) -> tuple[Face, Eyes, list[Tracked]]:
    """Frames of a clip tracked by points, the face with the clip's lens and torso, the eyes with their usual gaze."""
    aimed = list(each_alone(lambda f: aim(face, f, w), frames))
    eyes = looking_ahead(face, aimed, eyes)
    tracked = list(each_alone(lambda one: settle(face, one, template, eyes, w), aimed))
    for _ in range(2):
        tracked = list(each_alone(lambda one: seek(face, skin, one, w, ()), tracked))
    face, tracked = _lens(face, tracked)
    face, tracked = _with_torso(template, face, tracked)
    tracked = [pulled(face, one) for one in tracked]
    # the pose by the detector alone nods where the jaw drops, and the gaze with it
    eyes = looking_ahead(face, tracked, eyes)
    return face, eyes, [regard(face, one, template, eyes) for one in tracked]


def alternate(
    template: Template,
    face: Face,
    skin: Skin,
    tracked: list[Tracked],
    teaching: np.ndarray,
    w: Weights,
    freedom: Freedom,
    schedule: tuple[tuple[int, ...], ...],
    rounds: int,
    settled: float,
    advance: Callable[[float], None],
) -> tuple[Face, list[Tracked], list[dict[str, float]]]:
    """
    The face with the person's own shapes near those that it has, the frames tracked with it, and each round's figures.

    teaching (F,) bool: frames that may take part in modelling. schedule: levels of the pyramid for equation (6), round
    by round; the last ones go on. `advance` hears shares of the work.
    """
    base = face.rig
    share = 1 / max(rounds, 1)
    history: list[dict[str, float]] = []
    good = _teachers(tracked, teaching)
    if not good:
        return face, tracked, history
    axis = np.mean([-one.state.R.T @ one.state.t / np.linalg.norm(one.state.t) for one in good], axis=0)
    space = Space(template, base, axis / np.linalg.norm(axis), freedom)
    before = _posed(face, tracked)
    for number in range(rounds):
        levels = schedule[min(number, len(schedule) - 1)]
        good = _teachers(tracked, teaching)
        shown = ([g.frame for g in good], [g.pinned for g in good], [g.state for g in good])
        rig = learn(space, face, base, *shown, levels, w, freedom)
        rig, states = gauge(rig, base, [one.state for one in tracked])
        tracked = [replace(one, state=state) for one, state in zip(tracked, states, strict=True)]
        face = fit.wearing(face, rig)
        tracked = list(each_alone(lambda one: seek(face, skin, one, w, levels), tracked))  # noqa: B023
        now = _posed(face, tracked)
        moved = float(np.sqrt(((now - before) ** 2).sum(axis=-1).mean()))
        before = now
        history.append({"round": number + 1, "moved_mm": round(moved, 4), "frames": len(good)})
        log.info("round %d: %d frames teach, the posed skin moves by %.3f mm", number + 1, len(good), moved)
        advance(share)
        if number + 1 >= len(schedule) and moved < settled:
            advance(share * (rounds - 1 - number))
            break
    return face, tracked, history


def again(template: Template, face: Face, skin: Skin, tracked: list[Tracked], eyes: Eyes, w: Weights) -> list[Tracked]:
    """The tracked frames with the face as it has become, its shapes no longer in question."""

    def look(one: Tracked) -> Tracked:
        return regard(face, seek(face, skin, one, w, FINEST), template, eyes)

    return list(each_alone(look, tracked))


def _lens(face: Face, tracked: list[Tracked]) -> tuple[Face, list[Tracked]]:
    """The face with the clip's own focal length and distortion, from the frames nearest to rest, and their poses."""
    order = sorted((i for i, one in enumerate(tracked) if one.quality >= _SURE), key=lambda i: _size(tracked[i]))
    chosen = order[: max(_LENS_FRAMES, len(order) // 3)]
    if len(chosen) < _LENS_FRAMES:
        return face, tracked
    lens, states = lens_fit.refined(
        face, [tracked[i].state for i in chosen], [tracked[i].pinned for i in chosen], _ALIKE
    )
    log.info("the clip's lens: %.1f px, k1 %.4f (%.1f px by its metadata)", lens.focal, lens.k1, face.lens.focal)
    ratio = lens.focal / face.lens.focal
    moved = dict(zip(chosen, states, strict=True))
    for i, one in enumerate(tracked):
        state = moved.get(i, replace(one.state, t=one.state.t * np.array([1, 1, ratio])))
        tracked[i] = replace(one, state=state)
    return replace(face, lens=lens), tracked


def _with_torso(template: Template, face: Face, tracked: list[Tracked]) -> tuple[Face, list[Tracked]]:
    """The face with the torso that the good frames tell of, whose pulls were free, and the frames with the body's."""
    good = [one for one in tracked if one.quality >= _WORSE]
    if not good:
        return face, tracked
    middle = np.median([one.state.t for one in good], axis=0)
    usual = min(good, key=lambda one: float(np.linalg.norm(one.state.t - middle)))
    marks = template.landmarks(face.rig.neutral)[template.landmarks68] @ usual.state.R.T + usual.state.t
    pixels = face.lens.project(marks)[0]
    patch = body.patch(usual.frame.whole, pixels[_CHIN], pixels[_BRIDGE], float(marks[_CHIN, 2]), face.lens)
    tracked = list(each_alone(lambda one: _with_body(patch, one), tracked))
    good = [one for one in tracked if one.quality >= _WORSE]
    poses, seen = [(s.state.R, s.state.t) for s in good], np.array([s.state.weights[neck.SHAPES :] for s in good])
    moved = [one.frame.moved for one in good]
    torso = neck.torso(template, face.rig.neutral, poses, moved, patch, seen)
    found = sum(one is not None for one in moved)
    log.info("the body found in %d of %d frames; the chin makes %.2f of its motion", found, len(good), torso.share)
    return replace(face, torso=torso), tracked


def _with_body(patch: body.Patch | None, one: Tracked) -> Tracked:
    """The frame with the body's motion."""
    if patch is None or one.frame.moved is not None:
        return one
    return replace(one, frame=replace(one.frame, moved=patch.find(one.frame.whole)))


def _size(one: Tracked) -> float:
    return float(one.state.weights[: neck.SHAPES].sum())


def _teachers(tracked: list[Tracked], teaching: np.ndarray) -> list[Tracked]:
    return [one for one, may in zip(tracked, teaching, strict=True) if may and one.quality >= _WORSE]


def _posed(face: Face, tracked: list[Tracked]) -> np.ndarray:
    """(F, p, 3) the detector's points on the posed head."""
    return np.stack([face.marker_rider.at(one.state.weights) for one in tracked])


def as_shown(learnt: Rig, base: Rig, found: np.ndarray) -> Rig:
    """
    B*_j + s_j (B_j - B*_j), s of `learnt_share`: what the video hardly shows stays as it was transferred, `base`.
    Below, learnt shapes were farther from the truth than these.
    """
    shapes = base.deltas[: neck.SHAPES]
    change = learnt.deltas[: neck.SHAPES] - shapes
    return replace(learnt, deltas=shapes + learnt_share(found)[:, None, None] * change)


def learnt_share(found: np.ndarray) -> np.ndarray:
    """
    (a,) from 0 to 1 where the evidence `found` (a,) goes from _HARDLY to _WELL. Blinks have 0: lids close on the
    eyeball as they were made to, and the detector does not see them close.
    """
    share = np.clip((found - _HARDLY) / (_WELL - _HARDLY), 0, 1)
    share[BLINKS] = 0
    return share


def evidence(tracked: list[Tracked], teaching: np.ndarray, base: Rig) -> np.ndarray:
    """
    (a,) in 0..1: x / (1 + x) with x = 4 sum over the teaching frames of q w^2, less what other shapes could explain:
    one frame at half weight, alone, gives 0.5.

    Of the matrix sum_f q w_fi w_fj cos(B_i, B_j), the Schur complement of a shape's own entry: shapes that move other
    parts of the face take nothing away, however often they act together.
    """
    good = _teachers(tracked, teaching)
    a = len(base.deltas)
    if not good:
        return np.zeros(a)
    W = np.array([one.state.weights for one in good]) * np.sqrt([one.quality for one in good])[:, None]
    flat = base.deltas.reshape(a, -1)
    size = np.maximum(np.linalg.norm(flat, axis=1), 1e-9)
    alike = (flat @ flat.T) / np.outer(size, size)
    least = 0.02
    matrix = (W.T @ W) * alike + least * np.eye(a)
    alone = np.maximum(1 / np.diag(np.linalg.inv(matrix)) - least, 0)
    x = np.where(W.max(axis=0) > 0.05, 4 * alone, 0)
    return x / (1 + x)
