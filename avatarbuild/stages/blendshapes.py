"""The person's 52 expressions: the head template's, transferred triangle by triangle, contacts kept."""

from __future__ import annotations

import logging

import numpy as np

from avatarbuild.artefacts import Blendshapes, Neutral
from avatarbuild.contacts import LIMITS, STILL, Contacts, Head
from avatarbuild.energies.deformation_transfer import displacement_gradients, gradient_rows, transfer_system
from avatarbuild.errors import InputError
from avatarbuild.options import BlendshapesOptions
from avatarbuild.progress import Progress, Task
from avatarbuild.rigging import finish, in_template_s_frame, limits_of, poses_of
from avatarbuild.solvers.held import solve_held
from avatarbuild.solvers.sparse import Factor
from avatarbuild.template import Template

log = logging.getLogger(__name__)

TOLERANCE = 1e-5  # of the solver: about 1e-4 mm


def run(neutral: Neutral, options: BlendshapesOptions, progress: Progress, template: Template) -> Blendshapes:
    """
    The person's rig: displacements of the template's expressions, in ARKit's order.

    All is done in the template's frame and size, that is, after the similarity that takes the person's face to the
    template's mean; hence the result turns and grows with the person.

    Raises InputError where the neutral head is of another topology than the template.
    """
    t = template
    if neutral.vertices.shape != t.mean.shape:
        raise InputError(
            f"the neutral head has {len(neutral.vertices)} vertices and the template '{t.name}' {t.vertex_count}: "
            "run stage neutral again with this template"
        )
    person, size, turn = in_template_s_frame(t, neutral.vertices, neutral.eye_centres)
    with progress.task("expressions", len(t.expressions)) as task:
        deltas, figures = transferred(t, person, options, task)
    if options.contacts:
        Contacts(t, person).clear_eyes(deltas)
    figures = {key: round(size * value, 3) for key, value in figures.items()}
    log.info("52 expressions: %s", ", ".join(f"{key} {value}" for key, value in figures.items()))
    warnings = [sentence.format(figures[key]) for key, limit, sentence in LIMITS if figures.get(key, 0) > limit]
    moved = (size * deltas @ turn.T).astype(np.float32)
    return Blendshapes(neutral.vertices, moved, neutral.eye_centres, figures, warnings)


def transferred(
    t: Template, person: Head, options: BlendshapesOptions, task: Task
) -> tuple[np.ndarray, dict[str, float]]:
    """
    (e, n, 3) the displacements of a person of the template's frame and size, and what is left of the contacts in mm.

    A limited shape (mouthClose) is transferred in the pose that it is meant for, its limit (jawOpen) at 1 as well, less
    the limit.
    """
    contacts, transfer = Contacts(t, person), Transfer(t, person)
    skin, e = contacts.skin, len(t.expressions)
    limits, poses = limits_of(t), poses_of(t)
    alone = np.setdiff1d(np.arange(e), list(limits))
    posed = np.zeros_like(poses)
    posed[alone, skin] = transfer.displacements(alone, poses)
    task.advance(e / 4)
    if options.contacts:
        posed[alone, skin] = contacts.close_lips(posed[alone, skin], poses[alone, skin])
        for j in alone:
            posed[j, skin] = contacts.lay_lids(j, posed[j, skin])
    task.advance(e / 4)
    for j, limit in limits.items():
        one = np.array([j])
        posed[j, skin] = posed[limit, skin] + transfer.displacements(one, poses, posed[limit, skin][None])[0]
        if options.contacts:
            posed[j, skin] = contacts.close_lips(posed[one, skin], poses[one, skin])[0]
    shapes = finish(t, contacts, poses, posed, cover=options.contacts)
    task.advance(e / 2)
    return shapes


class Transfer:
    """Deformation transfer from the template's mean onto the person's skin, factored once for all expressions."""

    def __init__(self, t: Template, person: Head) -> None:
        part = t.parts["skin"]
        self._skin = part.vertices
        self._source = t.mean[part.vertices]
        self._triangles = t.triangles[part.triangles].astype(np.int64)
        self._moving = np.linalg.norm(t.expressions[:, part.vertices], axis=2) > STILL
        self._free = np.flatnonzero(self._moving.any(axis=0))
        normal, self._divergence, gradient = transfer_system(person.vertices[part.vertices], self._triangles)
        inside = (t.regions["mouth"] | t.regions["sockets"])[part.vertices]
        self._inner = np.flatnonzero(np.tile(inside[self._triangles].all(axis=1), 3))
        self._inner_gradient = gradient[self._inner]
        self._rows = normal[self._free]
        self._normal = self._rows[:, self._free].tocsr()
        self._factor = Factor(self._normal)

    def displacements(self, which: np.ndarray, poses: np.ndarray, already: np.ndarray | None = None) -> np.ndarray:
        """
        (k, s, 3) of the s skin vertices for the expressions `which` (k,), where the template makes `poses` (e, n, 3).

        `already` (k, s, 3) is the part of each pose that is there, to which the result adds. Fixed where the
        expression itself does not move. The mouth's bag and the sockets crumple and nobody sees them: they follow the
        template's displacements instead of its deformation, and what the lips and lids do differently fades inwards.
        """
        wanted = poses[which][:, self._skin]
        k, s = len(which), len(self._source)
        rows = gradient_rows(displacement_gradients(self._source, wanted, self._triangles))
        rows[self._inner] = self._inner_gradient @ wanted.transpose(1, 0, 2).reshape(s, 3 * k)
        right = (self._divergence @ rows)[self._free]
        if already is not None:
            right -= self._rows @ already.transpose(1, 0, 2).reshape(s, 3 * k)
        free = np.repeat(self._moving[which][:, self._free].T, 3, axis=1)
        found = solve_held(self._normal, self._factor, right, free, TOLERANCE)
        out = np.zeros((k, s, 3))
        out[:, self._free] = found.reshape(len(self._free), k, 3).transpose(1, 0, 2)
        return out
