"""What a person's shapes need beside the skin's motion: contacts, the parts inside the mouth, shapes tied to others."""

from __future__ import annotations

import numpy as np

from avatarbuild.artefacts import Blendshapes
from avatarbuild.contacts import STILL, Contacts, Head
from avatarbuild.energies import jaw
from avatarbuild.geometry.similarity import similarity
from avatarbuild.template import COMBINATION_LIMITS, MOUTH_PARTS, Template
from avatarbuild.tracking.rig import Rig


def in_template_s_frame(t: Template, vertices: np.ndarray, eye_centres: np.ndarray) -> tuple[Head, float, np.ndarray]:
    """
    A person (n, 3) in the template's frame and size, by the face: x' = R^T (x - t) / s; and s, R (3, 3), with which
    displacements go back: d = s R d'.
    """
    face = t.regions["face"]
    size, turn, shift = similarity(t.mean[face], np.asarray(vertices, np.float64)[face])
    return Head((vertices - shift) @ turn / size, (eye_centres - shift) @ turn / size), size, turn


def limits_of(t: Template) -> dict[int, int]:
    """A limited shape's row -> its limit's: mouthClose -> jawOpen."""
    return {t.expression_index[a]: t.expression_index[b] for a, b in COMBINATION_LIMITS}


def poses_of(t: Template) -> np.ndarray:
    """(e, n, 3) the template's expressions as they are meant: a limited one together with its limit at 1."""
    poses = t.expressions.copy()
    for j, limit in limits_of(t).items():
        poses[j] += t.expressions[limit]
    return poses


def without_limits(t: Template, posed: np.ndarray) -> None:
    """Turn poses (e, n, 3) back into shapes: a limited one less its limit, where it moves anything."""
    for j, limit in limits_of(t).items():
        moving = np.linalg.norm(t.expressions[j], axis=1) > STILL
        posed[j] = np.where(moving[:, None], posed[j] - posed[limit], 0)


def kept(template: Template, blendshapes: Blendshapes, learnt: Rig) -> tuple[Rig, dict[str, float]]:
    """
    The shapes learnt from a video (a, n, 3), the transferred ones for the rest of the 52, with lids, lips, teeth, jaw
    as they must be; and what is left of the contacts in mm.
    """
    person, size, turn = in_template_s_frame(template, learnt.neutral, blendshapes.eye_centres)
    deltas = blendshapes.deltas.astype(np.float64)
    deltas[: len(learnt.deltas)] = learnt.deltas
    moved, figures = keep(template, person, deltas @ turn / size)
    figures = {key: round(size * value, 3) for key, value in figures.items()}
    return Rig(learnt.neutral, size * moved @ turn.T, learnt.triangles), figures


def keep(t: Template, person: Head, deltas: np.ndarray) -> tuple[np.ndarray, dict[str, float]]:
    """
    Shapes (e, n, 3) that came from elsewhere, such as a video, with the template's contacts and the mouth's parts, and
    what is left of the contacts in mm; all in the template's frame and size. Far from the skin that the template's
    shape moves they end (`Contacts.reach`).
    """
    contacts, poses = Contacts(t, person), poses_of(t)
    skin, limits = contacts.skin, limits_of(t)
    posed = deltas.copy()
    for j, limit in limits.items():
        posed[j] += deltas[limit]
    share = contacts.reach(poses[:, skin])
    posed[:, skin] = contacts.close_lips(share[..., None] * posed[:, skin], poses[:, skin])
    for j in range(len(posed)):
        if j not in limits:
            posed[j, skin] = contacts.lay_lids(j, posed[j, skin])
    shapes, figures = finish(t, contacts, poses, posed, cover=True)
    contacts.clear_eyes(shapes)
    return shapes, figures


def finish(
    t: Template, contacts: Contacts, poses: np.ndarray, posed: np.ndarray, *, cover: bool
) -> tuple[np.ndarray, dict[str, float]]:
    """
    The shapes (e, n, 3) of a skin's poses, and what is left of the contacts: `posed` (e, n, 3), where the template
    makes `poses`, gets the mouth's parts, with `cover` lips and cheeks off the teeth, limited shapes less their limits.
    """
    carry_parts(t, contacts.person, poses, posed)
    if cover:
        for j in range(len(posed)):
            posed[j] = contacts.cover_teeth(posed[j], poses[j])
    figures = contacts.figures(posed, poses)
    without_limits(t, posed)
    return posed, figures


def carry_parts(t: Template, person: Head, poses: np.ndarray, posed: np.ndarray) -> None:
    """Fill in posed (e, n, 3) for teeth, gums and tongue: with the jaw as one, and the tongue's own motion."""
    skin = t.parts["skin"].vertices
    names = [name for name in MOUTH_PARTS if name in t.parts]
    teeth = t.parts["teeth_lower"].vertices if "teeth_lower" in t.parts else slice(0, 0)
    for pose, moved in zip(poses, posed, strict=True):
        before = after = jaw.Rigid(np.eye(3), np.zeros(3))
        if np.abs(pose[teeth]).max(initial=0) > STILL:
            before, after = jaw.jaw_motion(
                t.mean[teeth], pose[teeth], t.mean[skin], pose[skin], person.vertices[skin], moved[skin]
            )
        for name in names:
            rows = np.arange(len(t.mean))[t.parts[name].vertices]
            rows = rows[np.linalg.norm(pose[rows], axis=1) > STILL]
            if len(rows):
                moved[rows] = jaw.carried(t.mean[rows], pose[rows], person.vertices[rows], before, after)
