"""
What touches in a face: lids and eyeballs, upper and lower lip, lips and teeth; kept by shapes that came from elsewhere.

In every contact the person's shapes do what the template's do, so that nothing changes where the two heads are equal.
Skin vertices come first in all arrays. n vertices, e expressions; millimetres in the template's frame and size.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from avatarbuild.energies import lid_contact, lip_contact, tooth_cover
from avatarbuild.energies.lid_contact import Eye, LidBand
from avatarbuild.energies.lip_contact import LipBand
from avatarbuild.energies.tooth_cover import Mouth
from avatarbuild.geometry import meshes
from avatarbuild.geometry.smooth_step import smooth_step
from avatarbuild.solvers.sparse import Factor
from avatarbuild.template import EYE_PARTS, Template

TOGETHER = (
    ("cheekSquint", "eyeSquint"),
    ("cheekSquint", "mouthSmile"),
    ("eyeSquint", "mouthSmile"),
    ("cheekSquint", "eyeSquint", "mouthSmile"),
)
"""Shapes of a side that act together in a smile, and whose sum must not let the eyeball through the skin below it."""
STILL = 1e-7  # mm: less is no motion
REACH = 20.0  # mm from the skin that a template's shape moves, over which a person's may still move
HELD = 8.0  # mm from lids and lips that a template's shape holds still, over which a person's motion begins
LIMITS = (
    ("lid_gap_mm", 0.3, "closed lids are {} mm off their place on the eyeballs: look at eyeBlink"),
    ("lid_sunk_mm", 0.6, "eyeballs show through closing lids by {} mm: look at eyeBlink"),
    ("lips_off_mm", 0.5, "closed lips part or cross by {} mm: look at the mouth shapes"),
    ("teeth_out_mm", 1.0, "teeth stand {} mm before lips or cheeks: look at the mouth shapes"),
    ("inside_out_mm", 1.0, "the mouth's inside stands {} mm before the skin: look at the mouth shapes"),
    ("teeth_out_at_rest_mm", 1.0, "teeth stand {} mm before the closed lips of the neutral head"),
)


@dataclass(frozen=True)
class Head:
    """A head at rest: vertices (n, 3) of all parts, eyeball centres (2, 3)."""

    vertices: np.ndarray
    eye_centres: np.ndarray


@dataclass(frozen=True)
class Lids:
    """One eye: its side (0 left, 1 right), its band, the template's eye and the person's."""

    side: int
    band: LidBand
    source: Eye
    own: Eye


class Contacts:
    """The contacts of a template and of a person in its topology."""

    def __init__(self, t: Template, person: Head) -> None:
        self.template, self.person = t, person
        self.skin = t.parts["skin"].vertices
        triangles = t.triangles[t.parts["skin"].triangles].astype(np.int64)
        mean = t.mean[self.skin]
        graph = meshes.adjacency(len(mean), triangles)
        upper, lower = t.contours["lips_inner_upper"], t.contours["lips_inner_lower"]
        self.lips: LipBand = lip_contact.lip_band(mean, graph, upper, lower)
        self._lip_factor = Factor(self.lips.system)
        self.lids = [lids for side in (0, 1) if (lids := self._lids(side, triangles, graph)) is not None]
        rows = [
            t.triangles[t.parts[name].triangles] for name in ("teeth_upper", "teeth_lower", "gums") if name in t.parts
        ]
        self.mouth: Mouth | None = None
        if rows and t.regions["mouth"].any():
            teeth = np.concatenate(rows)
            inside, face = t.regions["mouth"], t.regions["face"]
            self.mouth = tooth_cover.mouth_of(t.mean, triangles, graph, inside, face, teeth)

    def _lids(self, side: int, triangles: np.ndarray, graph: np.ndarray) -> Lids | None:
        t, person = self.template, self.person
        mean, sockets = t.mean[self.skin], t.regions["sockets"][self.skin]
        if EYE_PARTS[side] not in t.parts or not sockets.any():
            return None
        ball = t.parts[EYE_PARTS[side]].vertices
        eye = lid_contact.eye_of(t.mean[ball], t.eye_centres[side])
        own = lid_contact.eye_like(person.vertices[ball], person.eye_centres[side], eye, t.mean[ball])
        other = t.eye_centres[1 - side]
        near = np.linalg.norm(mean - eye.centre, axis=1) < np.linalg.norm(mean - other, axis=1)
        return Lids(side, lid_contact.lid_band(mean, triangles, graph, sockets & near, eye), eye, own)

    def close_lips(self, deltas: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """deltas (k, s, 3) of the s skin vertices, their lips as closed as the template's in its poses (k, s, 3)."""
        band = self.lips
        wanted = np.stack([lip_contact.corrections(band, d, p) for d, p in zip(deltas, poses, strict=True)])
        columns = wanted.transpose(1, 0, 2).reshape(len(band.held), -1)
        spread = np.zeros((deltas.shape[1], columns.shape[1]))
        spread[band.held] = columns
        spread[band.free] = self._lip_factor.solve(band.coupling @ columns)
        moving = np.linalg.norm(poses, axis=2) > STILL
        return deltas + spread.reshape(-1, *deltas.shape[::2]).transpose(1, 0, 2) * moving[..., None]

    def lay_lids(self, j: int, delta: np.ndarray) -> np.ndarray:
        """delta (s, 3) of the skin in shape j, its lids laid onto the person's eyes."""
        t, rest = self.template, self.person.vertices[self.skin]
        source, motion = t.mean[self.skin], t.expressions[j, self.skin]
        moving = np.linalg.norm(motion, axis=1) > STILL
        turns = t.eye_rotation_matrices(np.eye(len(t.expressions))[j])
        for lids in self.lids:
            if moving[lids.band.vertices].any():
                pose = lid_contact.lid_pose(lids.band, source, source + motion, lids.source, turns[lids.side])
                laid = lid_contact.lay_on(lids.band, rest, rest + delta, lids.own, pose, lids.source)
                delta = np.where(moving[:, None], laid - rest, delta)
        return delta

    def reach(self, poses: np.ndarray) -> np.ndarray:
        """
        (k, s) how much of a motion that came from elsewhere the skin keeps in each of the template's poses (k, s, 3):
        1 where the template moves it; farther out a smooth step down to 0 over REACH mm, so that a person's nose can
        follow the cheeks; and 0, reached within HELD mm, on lids, lips' lines and the mouth's inside that the template
        holds still.
        """
        t, mean = self.template, self.template.mean[self.skin]
        held = (t.regions["mouth"] | t.regions["sockets"])[self.skin]
        held[self.lips.held] = True
        for lids in self.lids:
            held[lids.band.vertices] = True
        share = np.zeros(poses.shape[:2])
        for one, moving in zip(share, np.linalg.norm(poses, axis=2) > STILL, strict=True):
            if not moving.any():
                continue
            one[moving] = 1
            still, free = np.flatnonzero(held & ~moving), np.flatnonzero(~held & ~moving)
            off = _distances(mean[free], mean[moving], REACH)
            near, off = free[off < REACH], off[off < REACH]
            one[near] = smooth_step(1 - off / REACH) * smooth_step(_distances(mean[near], mean[still], HELD) / HELD)
        return share

    def clear_eyes(self, deltas: np.ndarray) -> None:
        """deltas (e, n, 3), in place, with the skin about the eyes before the eyeballs in every sum of TOGETHER's."""
        t, rest, skin = self.template, self.person.vertices[self.skin], self.skin
        for lids in self.lids:
            side = ("Left", "Right")[lids.side]
            for names in TOGETHER:
                rows = [t.expression_index[name + side] for name in names if name + side in t.expression_index]
                moving = np.linalg.norm(t.expressions[rows][:, skin], axis=2) > STILL
                deltas[rows, skin] = lid_contact.lifted(lids.band, rest, deltas[rows, skin], moving, lids.own)

    def cover_teeth(self, delta: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """delta (n, 3) with lips and cheeks off the teeth that stand out farther than in the template's pose (n, 3)."""
        if self.mouth is None or np.abs(pose[self.mouth.lips]).max() < STILL:
            return delta
        rest = self.person.vertices
        covered = self.mouth.covered(rest + delta, lambda: self._allowed(pose)) - rest
        return np.where((np.linalg.norm(pose, axis=1) > STILL)[:, None], covered, delta)

    def _allowed(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n,) mm that teeth, and the mouth's inside, are out in the template's pose or in the person at rest."""
        assert self.mouth is not None
        heads = (self.template.mean + pose, self.person.vertices)
        teeth = np.maximum(*(self.mouth.teeth_out(head) for head in heads))
        return teeth, np.maximum(*(self.mouth.bag_out(head) for head in heads))

    def figures(self, deltas: np.ndarray, poses: np.ndarray) -> dict[str, float]:
        """
        What is left of each contact in mm, in the worst place of all shapes; deltas (e, n, 3) the person's, poses the
        template's.

        lid_gap    closed lids' contact lines off where the template's lie on its eyeball
        lid_sunk   the eyeball through the skin of closing lids, at a quarter, half, three quarters, all of the way
        lips_off   lips that should move as one, apart or crossed
        teeth_out  teeth before the outer skin, beyond the template's in that pose; teeth_out_at_rest: in the neutral
        inside_out the mouth's inside before the outer skin, likewise
        """
        mean, rest, skin = self.template.mean, self.person.vertices, self.skin
        worst = dict.fromkeys(("lid_gap_mm", "lid_sunk_mm", "lips_off_mm"), 0.0)
        if self.mouth is not None:
            worst |= {"teeth_out_mm": 0.0, "inside_out_mm": 0.0}
            worst["teeth_out_at_rest_mm"] = float(self.mouth.teeth_out(rest).max())
        for delta, pose in zip(deltas, poses, strict=True):
            errors = lip_contact.lip_errors(self.lips, delta[skin], pose[skin])
            found = {"lips_off_mm": max(float(np.abs(e).max()) for e in errors)}
            for lids in self.lids:
                closing = lid_contact.lid_pose(lids.band, mean[skin], (mean + pose)[skin], lids.source, np.eye(3))
                if closing.closes:
                    gap, sunk = lid_contact.misfit(lids.band, rest[skin], delta[skin], lids.own, closing, lids.source)
                    found |= {"lid_gap_mm": gap, "lid_sunk_mm": sunk}
            if self.mouth is not None and np.abs(pose[self.mouth.lips]).max() > STILL:
                teeth, bag = self.mouth.teeth_out(rest + delta), self.mouth.bag_out(rest + delta)
                if teeth.max() + bag.max() > 0:
                    allowed = self._allowed(pose)
                    found["teeth_out_mm"] = float((teeth - allowed[0]).max())
                    found["inside_out_mm"] = float((bag - allowed[1]).max())
            worst |= {key: max(worst[key], value) for key, value in found.items()}
        return worst


def _distances(points: np.ndarray, others: np.ndarray, most: float) -> np.ndarray:
    """(n,) from points (n, 3) to the nearest of others (m, 3), infinite from `most` on."""
    return cKDTree(others).query(points, distance_upper_bound=most)[0]
