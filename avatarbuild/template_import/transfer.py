"""A foreign head as a Template: its shapes carried to the shipped topology, eyes, mouth and missing shapes fitted in.

The Template keeps the shipped head's triangles, texture layout, regions, contours, landmarks and symmetry. Mean,
identity, and the expressions that the foreign head has, are its own.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.template import EYE_PARTS, MOUTH_PARTS, Template
from avatarbuild.template_import.foreign import ForeignHead
from avatarbuild.template_import.wrap import EXTENSION, Extension, Wrap, extension, wrap

BALL = (13.6, 18.0)  # mm from the eye's centre: the lids within keep their distance to the ball, beyond it nothing does
LID_WEIGHT = 0.2  # of the lids' mean motion against their distances, where an eye's centre is fitted
MOUTH_REACH = 38.0  # mm about the lips: skin whose similarity carries teeth, gums and tongue
CHIN_REACH = 22.0  # mm about the chin's landmark: skin whose motion carries the lower jaw
CHIN = 199  # landmark
JAW_MOTION = 0.2  # mm of the lower teeth from which an expression moves the jaw
BLINK_REACH = 22.0  # mm from the eye's centre: beyond it a blink's correction is zero


class Eye(NamedTuple):
    """An eye of the new mean: centre (3,), its motion (k, 3), `hold` (n,) 0..1 where lids keep their distance."""

    centre: np.ndarray
    basis: np.ndarray
    hold: np.ndarray
    rest_centre: np.ndarray


def to_template(head: ForeignHead, shipped: Template) -> Template:
    """The Template of a foreign head.

    Raises:
        InputError: the shipped head cannot be wrapped onto it, or the result is no valid template.
    """
    fit = wrap(shipped, head)
    carry = extension(shipped)
    skin = shipped.parts["skin"].vertices
    identity, posed = _carried(head, fit, carry, shipped, skin)
    mean = fit.skin
    eyes = []
    for side in ("left", "right"):
        eye, mean, identity = _eye(shipped, side, mean, identity)
        eyes.append(eye)
    posed = _lids(shipped, mean, posed, eyes, carry)

    whole = np.zeros_like(shipped.mean)
    basis = np.zeros((len(identity), *whole.shape))
    shapes = fit.scale * shipped.expressions
    whole[skin], basis[:, skin], shapes[:, skin] = mean, identity, posed
    for name, eye in zip(EYE_PARTS, eyes, strict=True):
        ball = shipped.parts[name].vertices
        whole[ball] = shipped.mean[ball] - eye.rest_centre + eye.centre
        basis[:, ball] = eye.basis[:, None]
    _mouth(shipped, head, whole, basis, shapes)
    centres = np.stack([eye.centre for eye in eyes])
    origin = centres.mean(axis=0)
    return replace(
        shipped,
        name=head.name,
        version="1",
        mean=whole - origin,
        identity=basis,
        sigma=np.sqrt((basis**2).sum(axis=2).mean(axis=1)),
        expressions=shapes,
        eye_centres=centres - origin,
        eye_centre_basis=np.stack([eye.basis for eye in eyes], axis=1),
        quads=np.zeros((0, 4), np.int32),
        subdivision=None,
        cage_mean=None,
        cage_identity=None,
        cage_expressions=None,
    )


def _carried(head: ForeignHead, fit: Wrap, carry: Extension, shipped: Template, skin: slice):
    """Identity (k, n, 3) and expressions (e, n, 3) on the shipped skin.

    Each is the foreign displacement at a vertex's counterpart; vertices without one follow smoothly.
    """
    names = [name for name in shipped.expression_names if name in head.expressions]
    fields = np.concatenate([head.identity, *(head.expressions[name][None] for name in names)])
    columns = fields.transpose(1, 0, 2).reshape(fields.shape[1], -1)
    known = fit.known.astype(float)
    solve = carry.factor(known, EXTENSION)
    count = len(head.identity)
    identity = _turned(solve(sp.diags(known) @ (fit.rows @ columns[:, : 3 * count])), fit.rotation)
    posed = fit.scale * shipped.expressions[:, skin]
    if names:
        # the lips part in an expression
        free = Extension(carry.edges, np.zeros((0, 2), np.int64)).factor(known, EXTENSION)
        own = _turned(free(sp.diags(known) @ (fit.rows @ columns[:, 3 * count :])), fit.rotation)
        posed[[shipped.expression_index[name] for name in names]] = own
    return identity, posed


def _turned(columns: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """(n, 3k) displacement columns to (k, n, 3) in the shipped head's axes."""
    return np.ascontiguousarray(columns.reshape(len(columns), -1, 3).transpose(1, 0, 2)) @ rotation


def _eye(shipped: Template, side: str, mean: np.ndarray, identity: np.ndarray):
    """The 24 mm ball under the new lids: its centre

    argmin_c sum_i (|x_i - c| - r_i)^2 + a |c - c_0|^2,    r_i the shipped lids' distances, c_0 moved as the lids are,

    and, linear in the identity, likewise its motion. The lids are then moved along the radius to keep r_i.
    """
    k = 0 if side == "left" else 1
    rest, rest_centre = shipped.mean[: len(mean)], shipped.eye_centres[k]
    rim = np.unique(np.concatenate([shipped.contours[f"lid_{part}_{side}"] for part in ("upper", "lower")]))
    distance = np.linalg.norm(rest - rest_centre, axis=1)
    start = rest_centre + (mean[rim] - rest[rim]).mean(axis=0)
    centre = start.copy()
    for _ in range(15):
        ray = mean[rim] - centre
        length = np.linalg.norm(ray, axis=1)
        u = ray / length[:, None]
        normal = u.T @ u + LID_WEIGHT * len(rim) * np.eye(3)
        centre = centre + np.linalg.solve(
            normal, u.T @ (length - distance[rim]) + LID_WEIGHT * len(rim) * (start - centre)
        )
    hold = smooth_step(distance, BALL[1], BALL[0])
    ray = mean - centre
    length = np.linalg.norm(ray, axis=1)
    u = ray / np.maximum(length, 1e-9)[:, None]
    fitted = mean + (hold * (distance - length))[:, None] * u
    lids = u[rim]
    normal = lids.T @ lids + LID_WEIGHT * len(rim) * np.eye(3)
    radial = np.einsum("ix,kix->ki", lids, identity[:, rim])
    basis = np.linalg.solve(normal, (radial @ lids + LID_WEIGHT * len(rim) * identity[:, rim].mean(axis=1)).T).T
    away = np.einsum("ix,kix->ki", u, identity - basis[:, None])
    return (
        Eye(centre, basis, hold, rest_centre),
        fitted,
        identity - (hold * away)[:, :, None] * u,
    )


def _lids(shipped: Template, mean: np.ndarray, posed: np.ndarray, eyes: list[Eye], carry: Extension) -> np.ndarray:
    """Expressions (e, n, 3) in which lids keep the shipped ones' distance to the ball, and a blink closes the eye."""
    rest, posed = shipped.mean[: len(mean)], posed.copy()
    for side, eye in zip(("left", "right"), eyes, strict=True):
        name = "eyeBlink" + side.capitalize()
        i = shipped.expression_index[name]
        upper, lower = (shipped.contours[f"lid_{part}_{side}"] for part in ("upper", "lower"))
        closed, shut = mean + posed[i], rest + shipped.expressions[i, : len(mean)]
        want = _beside(shut[upper], shut[lower])
        have = _beside(closed[upper], closed[lower])
        far = np.linalg.norm(rest - eye.rest_centre, axis=1) > BLINK_REACH
        weights = far.astype(float)
        weights[lower] = weights[upper] = 1
        right = np.zeros_like(mean)
        right[upper] = want - have
        posed[i] += Extension(carry.edges, carry.springs[:0]).factor(weights, 0.2)(right * weights[:, None])
        held = np.flatnonzero(eye.hold > 0)
        moving = np.abs(posed[:, held]).max(axis=(1, 2)) > 0.02
        for j in np.flatnonzero(moving):
            target = np.linalg.norm(rest[held] + shipped.expressions[j, held] - eye.rest_centre, axis=1)
            ray = mean[held] + posed[j, held] - eye.centre
            length = np.linalg.norm(ray, axis=1)
            posed[j, held] += (eye.hold[held] * (target - length) / np.maximum(length, 1e-9))[:, None] * ray
    return posed


def _beside(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    """(k, 3): from the lower rim to the upper, at the upper rim's share of the arc length."""

    def share(line: np.ndarray) -> np.ndarray:
        step = np.linalg.norm(np.diff(line[:, [0, 2]], axis=0), axis=1)
        return np.concatenate([[0], np.cumsum(step)]) / max(step.sum(), 1e-9)

    at = share(upper)
    return upper - np.stack([np.interp(at, share(lower), lower[:, k]) for k in range(3)], axis=1)


def _mouth(shipped: Template, head: ForeignHead, mean: np.ndarray, identity: np.ndarray, posed: np.ndarray) -> None:
    """Teeth, gums and tongue, in place: the motion about the lips carries them, that of the chin the lower jaw's."""
    skin = shipped.parts["skin"].vertices
    rest = shipped.mean
    lips = rest[: skin.stop][shipped.regions["lips"][skin]].mean(axis=0)
    usable = shipped.regions["face"] & ~shipped.regions["mouth"] & ~shipped.regions["sockets"]
    about = np.flatnonzero(usable & (np.linalg.norm(rest - lips, axis=1) < MOUTH_REACH))
    inner = np.concatenate(
        [np.arange(shipped.parts[name].vertices.start, shipped.parts[name].vertices.stop)
         for name in MOUTH_PARTS if name in shipped.parts]
    )  # fmt: skip
    if not len(inner):
        return
    mean[inner] = rest[inner] + _affine(rest[about], (mean - rest)[about][None], rest[inner], scaled=True)[0]
    identity[:, inner] = _affine(mean[about], identity[:, about], mean[inner], scaled=True)

    chin_at = shipped.landmarks(rest)[CHIN]
    chin = np.flatnonzero(usable & (np.linalg.norm(rest - chin_at, axis=1) < CHIN_REACH))
    jaw = np.abs(shipped.expressions[shipped.expression_index["jawOpen"], inner]).max(axis=1)
    lower = np.clip(jaw / max(jaw.max() / 2, 1e-9), 0, 1)[:, None]
    teeth = shipped.parts["teeth_lower"].vertices if "teeth_lower" in shipped.parts else slice(0, 0)
    for name in head.expressions:
        i = shipped.expression_index[name]
        if np.abs(shipped.expressions[i, teeth]).max(initial=0) > JAW_MOTION:
            change = posed[i, chin] - shipped.expressions[i, chin]
            posed[i, inner] += lower * _affine(mean[chin], change[None], mean[inner], scaled=False)[0]


def _affine(points: np.ndarray, moves: np.ndarray, at: np.ndarray, *, scaled: bool) -> np.ndarray:
    """(k, j, 3): at points (j, 3), the linearised rigid motion or similarity closest to `moves` (k, i, 3) of (i, 3).

    argmin_{t, w, s} sum_i |t + w x p_i + s p_i - d_i|^2, p about the points' centroid.
    """
    centre = points.mean(axis=0)

    def design(p: np.ndarray) -> np.ndarray:
        """(3 i, 6 or 7)"""
        zero = np.zeros(len(p))
        x, y, z = p.T
        columns = [np.repeat(np.eye(3)[None], len(p), 0)]
        turns = np.stack([np.stack([zero, -z, y]), np.stack([z, zero, -x]), np.stack([-y, x, zero])])
        columns.append(turns.transpose(2, 1, 0))
        if scaled:
            columns.append(p[:, :, None])
        return np.concatenate(columns, axis=2).reshape(3 * len(p), -1)

    found = np.linalg.lstsq(design(points - centre), moves.reshape(len(moves), -1).T, rcond=None)[0]
    return (design(at - centre) @ found).T.reshape(len(moves), len(at), 3)
