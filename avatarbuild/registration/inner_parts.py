"""Eyeballs, teeth, gums and tongue of the template put into a registered head."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np

from avatarbuild.registration.eye_shape import eye_shape
from avatarbuild.template import EYE_PARTS, MOUTH_PARTS, Template

# landmark -> weight: what a mouth's inside is fitted to. Lips' corners, inner and outer rims, base of the nose, chin;
# cheeks, jaw and the skin before the ears, which alone tell how deep a head is
FEATURES = {
    **dict.fromkeys((61, 291, 78, 308, 13, 14, 0, 17), 1.0),
    **dict.fromkeys((2, 164, 98, 327, 18, 200, 199, 152), 0.7),
    **dict.fromkeys((57, 287, 205, 425, 214, 434, 172, 397, 58, 288, 132, 361, 234, 454), 0.4),
}
_SCALES = (0.75, 1.3)  # a head's parts are not smaller or larger
_ROUNDS = 30
_COVER, _STEP, _MOST = 1.0, 0.3, 12  # mm of lip before any tooth; mm by which teeth give way, so many times at most
_REACH, _SPARE, _ROUNDS_OF_ROOM = 3.0, 0.15, 8  # mm: how far the bag's wall yields around a tooth, and beyond it


@dataclass(frozen=True)
class Stretch:
    """x -> rotation (scale * (x - middle)) + place; scale (3,) along the template's axes."""

    rotation: np.ndarray
    scale: np.ndarray
    middle: np.ndarray
    place: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """(n, 3)"""
        return ((points - self.middle) * self.scale) @ self.rotation.T + self.place


@dataclass(frozen=True)
class InnerParts:
    """
    vertices (n, 3): the skin as given, but for the mouth's unseen bag where it made room, and all parts placed; stretch
    of the mouth's inside; back mm by which it was set back; lips mm of skin before the foremost tooth or tongue, at the
    least, negative where one stands out; poke mm by which a tooth or the tongue stands in the bag's wall.
    """

    vertices: np.ndarray
    stretch: Stretch
    back: float
    lips: float
    poke: float


def stretch_between(a: np.ndarray, b: np.ndarray, weights: np.ndarray) -> Stretch:
    """
    argmin_{R, s, t} sum_i w_i || R diag(s) a_i + t - b_i ||^2 with s within _SCALES, by turns: R for s [Kabsch 1976],
    then s for R.

    a, b (n, 3) not in a plane, weights (n,).
    """
    w = weights / weights.sum()
    middle, place = w @ a, w @ b
    x, y = a - middle, b - place
    spread = w @ x**2
    scale = np.full(3, np.sqrt((w @ y**2).sum() / spread.sum()))
    rotation = np.eye(3)
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd((y * w[:, None]).T @ (x * scale))
        rotation = (u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
        scale = np.clip(w @ (x * (y @ rotation)) / spread, *_SCALES)
    return Stretch(rotation, scale, middle, place)


def inner_parts(
    template: Template,
    coefficients: np.ndarray | None,
    skin: np.ndarray,
    centres: np.ndarray,
    radius: np.ndarray,
    turn: np.ndarray | None = None,
) -> InnerParts:
    """
    The whole head: `skin` (>= v, 3) registered, eyeballs as balls of radius (2,) at centres (2, 3), turned like the
    template's axes by `turn` (3, 3), not at all if None, and the mouth's inside, of the model with `coefficients` (p,),
    moved by the stretch between the model's feature points and the person's. Where less than _COVER mm of skin would
    stand before a tooth, the mouth's inside moves back; where one would stand in the wall of the mouth's bag, the wall,
    which nobody sees, makes room.
    """
    model = template.neutral(coefficients)
    count = template.parts["skin"].vertices.stop
    vertices = np.ascontiguousarray(model, np.float64).copy()
    vertices[:count] = skin[:count]
    shape, turn = eye_shape(template), np.eye(3) if turn is None else turn
    if shape is not None:
        for k, name in enumerate(EYE_PARTS):
            ball = template.parts[name].vertices
            own = (template.mean[ball] - template.eye_centres[k]) * (radius[k] / shape.radius)
            vertices[ball] = own @ turn.T + centres[k]
    stretch = _of_mouth(template, model, vertices)
    here = [template.parts[name].vertices for name in MOUTH_PARTS if name in template.parts]
    if not len(_hard(template)):
        return InnerParts(vertices, stretch, 0.0, np.inf, 0.0)
    inside = np.concatenate([np.arange(r.start, r.stop) for r in here])
    vertices[inside] = stretch.apply(model[inside])
    back, cover = 0.0, _cover(template, vertices)
    for _ in range(_MOST):
        if cover >= _COVER:
            break
        vertices[inside] -= _STEP * stretch.rotation[:, 2]
        back, cover = back + _STEP, _cover(template, vertices)
    poke = _make_room(template, vertices)
    return InnerParts(vertices, stretch, back, cover, poke)


def _of_mouth(template: Template, model: np.ndarray, person: np.ndarray) -> Stretch:
    marks = list(FEATURES)
    weights = np.array([FEATURES[m] for m in marks])
    return stretch_between(template.landmarks(model)[marks], template.landmarks(person)[marks], weights)


def _hard(template: Template) -> np.ndarray:
    """(k,) vertices of teeth and tongue."""
    here = [
        template.parts[name].vertices for name in ("teeth_upper", "teeth_lower", "tongue") if name in template.parts
    ]
    return np.concatenate([np.zeros(0, int), *(np.arange(r.start, r.stop) for r in here)])


def _skin_triangles(template: Template) -> tuple[np.ndarray, np.ndarray]:
    """(m, 3) the skin's triangles, and of them those that the outside shows."""
    skin = np.ascontiguousarray(template.triangles[template.parts["skin"].triangles], np.int64)
    hidden = template.regions["mouth"] | template.regions["sockets"]
    return skin, np.ascontiguousarray(skin[~hidden[skin].all(axis=1)])


def _cover(template: Template, vertices: np.ndarray) -> float:
    """Least mm of skin before teeth and tongue, negative outdoors."""
    _, outer = _skin_triangles(template)
    points = vertices[_hard(template)]
    squared, _, _ = igl.point_mesh_squared_distance(points, vertices, outer)
    indoors = np.asarray(igl.fast_winding_number(vertices, outer, points)) > 0.5
    return float((np.sqrt(squared) * np.where(indoors, 1, -1)).min())


def _make_room(template: Template, vertices: np.ndarray) -> float:
    """
    Moves the wall of the mouth's bag, in place, off the teeth and the tongue, until none stands in it:
    x_j += max_i exp((a_i - |x_j - q_i|^2) / 2 r^2) (p_i - q_i) (1 + spare / |p_i - q_i|) over the points p_i in flesh,
    q_i the wall's nearest points, a_i = min_j |x_j - q_i|^2.

    Returns the mm by which a point still stands in the wall.
    """
    skin, outer = _skin_triangles(template)
    bag = template.regions["mouth"].copy()
    bag[outer] = False
    bag = np.flatnonzero(bag)
    hard = _hard(template)
    if not len(bag):
        return 0.0
    for _ in range(_ROUNDS_OF_ROOM):
        points, offset, nearest = _in_flesh(vertices, skin, hard)
        if not len(points):
            return 0.0
        size = np.linalg.norm(offset, axis=1)
        push = offset * (1 + _SPARE / np.maximum(size, 1e-6))[:, None]
        away = ((vertices[bag][:, None] - nearest) ** 2).sum(axis=2)
        strength = np.exp((away.min(axis=0) - away) / (2 * _REACH**2))
        strongest = np.argmax(strength * size, axis=1)
        vertices[bag] += strength[np.arange(len(bag)), strongest, None] * push[strongest]
    return float(np.linalg.norm(_in_flesh(vertices, skin, hard)[1], axis=1).max(initial=0))


def _in_flesh(vertices: np.ndarray, skin: np.ndarray, hard: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (k, 3) among the vertices `hard` that lie in flesh, their offsets from the skin, and the skin nearest."""
    points = vertices[hard]
    points = np.ascontiguousarray(points[np.asarray(igl.fast_winding_number(vertices, skin, points)) > 0.5])
    if not len(points):
        return points, points, points
    _, _, nearest = igl.point_mesh_squared_distance(points, vertices, skin)
    nearest = np.asarray(nearest).reshape(-1, 3)
    return points, points - nearest, nearest
