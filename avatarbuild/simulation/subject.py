"""A person who is not in the template: a random identity bent by a smooth field, and expressions of their own.

x(w) = N + sum_j w_j E'_j + sum_c w_a w_b C_c: N is the template's neutral plus a field outside its linear space,
E'_j the generic shape with its own gain, turn and additive field, C_c correctives of pairs that no linear rig shows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.simulation.chart import softened
from avatarbuild.simulation.noise import fractal
from avatarbuild.template import Template

PAIRS = (
    ("mouthSmileLeft", "jawOpen"),
    ("mouthSmileRight", "jawOpen"),
    ("mouthFunnel", "jawOpen"),
    ("browDownLeft", "eyeSquintLeft"),
)


@dataclass(frozen=True)
class Subject:
    """
    neutral (n, 3) mm; eye_centres (2, 3); expressions (e, n, 3) this person's deltas; correctives
    (len(PAIRS), n, 3); identity (p,) the coefficients that the neutral started from.
    """

    template: Template
    identity: np.ndarray
    neutral: np.ndarray
    eye_centres: np.ndarray
    expressions: np.ndarray
    correctives: np.ndarray

    def deltas(self, weights: np.ndarray) -> np.ndarray:
        """(n, 3) displacement at weights (e,), without the turning of the eyeballs."""
        index = self.template.expression_index
        moved = np.tensordot(weights, self.expressions, 1)
        for corrective, (a, b) in zip(self.correctives, PAIRS, strict=True):
            both = weights[index[a]] * weights[index[b]]
            if both > 1e-4:
                moved += both * corrective
        return moved

    def posed(self, weights: np.ndarray) -> np.ndarray:
        """(n, 3) the head at weights (e,), eyeballs turned."""
        x = self.neutral + self.deltas(weights)
        self.template.turn_eyes(x, weights, self.eye_centres)
        return x


def random_subject(
    template: Template, rng: np.random.Generator, *, spread: float = 0.875, deviation: float = 1.0
) -> Subject:
    """Coefficients ~ N(0, spread^2); `deviation` scales all that leaves the template's space (1: about 0.8 mm)."""
    p = len(template.identity)
    coefficients = spread * np.clip(rng.standard_normal(p), -2.2, 2.2)
    neutral = template.neutral(coefficients)
    eyes = template.eye_positions(coefficients)
    still = _rigid_share(template)
    field = deviation * _field(template.mean, rng, ((55.0, 0.8), (28.0, 0.42), (14.0, 0.2)))
    field -= _symmetric_lids(template, field)
    neutral = neutral + field * (1 - still)[:, None]
    # Squares of the identity's own displacement leave its span where a random field might not.
    bend = (neutral - template.mean) / 12.0
    neutral = neutral + deviation * 0.2 * np.sign(bend) * bend**2 * (1 - still)[:, None]
    origin = eyes.mean(axis=0)
    neutral, eyes = neutral - origin, eyes - origin
    return Subject(
        template, coefficients, neutral, eyes, *_expressions_of(template, rng, deviation * (1 - still[:, None]))
    )


def _expressions_of(template: Template, rng: np.random.Generator, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """This person's shapes: gain and turn of each generic one, plus a field where it moves; and the correctives."""
    shapes = np.empty_like(template.expressions)
    lids = np.minimum(softened(template, template.regions["lids"].astype(float), 3) * 1.5, 1)[:, None]
    for j, (name, generic) in enumerate(zip(template.expression_names, template.expressions, strict=True)):
        size = np.linalg.norm(generic, axis=1)
        if size.max() < 1e-6:
            shapes[j] = 0
            continue
        # A blink must still close, and a jaw that is not the lower teeth's would part from them.
        exact = name.startswith("eye") or name in ("jawOpen", "mouthClose", "jawLeft", "jawRight", "jawForward")
        gain = np.exp((0.04 if exact else 0.16) * rng.standard_normal())
        axis = (0.03 if exact else 0.14) * rng.standard_normal(3)
        turned = generic + np.cross(axis, generic)
        reach = np.minimum(size / max(0.35 * np.quantile(size[size > 0.05 * size.max()], 0.9), 1e-6), 1)
        amount = (0.02 if exact else 0.13) * np.quantile(size, 0.995)
        field = amount * _field(template.mean, rng, ((32.0, 1.0), (16.0, 0.4))) * reach[:, None]
        own = gain * turned + field * (1 - lids)
        shapes[j] = generic + (own - generic) * free
    correctives = np.empty((len(PAIRS), *template.mean.shape))
    index = template.expression_index
    for c, (a, b) in enumerate(PAIRS):
        size = np.sqrt(
            np.linalg.norm(template.expressions[index[a]], axis=1)
            * np.linalg.norm(template.expressions[index[b]], axis=1)
        )
        reach = np.minimum(size / max(size.max() * 0.5, 1e-6), 1)[:, None]
        correctives[c] = 1.4 * _field(template.mean, rng, ((36.0, 1.0),)) * reach * (1 - lids) * free
    return shapes, correctives


def _field(points: np.ndarray, rng: np.random.Generator, waves: tuple[tuple[float, float], ...]) -> np.ndarray:
    """(n, 3) mm: smooth random displacement, a sum of waves of (length mm, standard deviation mm)."""
    total = np.zeros(points.shape)
    for length, amplitude in waves:
        for c in range(3):
            total[:, c] += amplitude * fractal(points, length, 1, int(rng.integers(1 << 20)))
    return total


def _rigid_share(template: Template) -> np.ndarray:
    """(n,) 1 on eyeballs, teeth, gums, tongue, lid rims and the mouth's inside, where deviations would tear; else 0."""
    share = np.zeros(len(template.mean))
    for name in ("sockets", "mouth"):
        share[template.regions[name]] = 1
    inner = [
        *("lips_inner_upper", "lips_inner_lower", "lid_upper_left", "lid_lower_left"),
        *("lid_upper_right", "lid_lower_right"),
    ]
    share[np.concatenate([template.contours[name] for name in inner])] = 1
    share = np.minimum(softened(template, share, 4) * 1.6, 1)
    skin = template.parts["skin"].vertices
    outside = np.ones(len(share), bool)
    outside[skin] = False
    share[outside] = 1
    return share


def _symmetric_lids(template: Template, field: np.ndarray) -> np.ndarray:
    """The part of the field about the eyes that would carry the lids off the balls: its own mean there."""
    weight = softened(template, template.regions["lids"].astype(float), 6)[:, None]
    return field * np.minimum(weight * 1.5, 1) * 0.85
