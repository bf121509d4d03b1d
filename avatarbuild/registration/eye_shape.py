"""The template's eyeball as a profile about its gaze: how far its surface, with the cornea, lies from its centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.template import EYE_PARTS, Template

_RIMS = ((474, 475, 476, 477), (469, 470, 471, 472))  # landmarks on the limbus, left and right eye
_GRAIN = 0.5  # degrees: vertices at the same angle from the gaze within so much are one sample of the profile


@dataclass(frozen=True)
class EyeShape:
    """
    angle (k,) radians from the gaze, ascending, and distance (k,) mm of the surface there; radius mm of the sclera;
    the limbus circle's depth before the centre and its own radius, mm.
    """

    angle: np.ndarray
    distance: np.ndarray
    radius: float
    limbus_depth: float
    limbus_radius: float

    def surface(self, cosine: np.ndarray, radius: float) -> np.ndarray:
        """Distance of the surface of an eyeball of `radius` from its centre, `cosine` to the gaze; shape kept."""
        angle = np.arccos(np.clip(cosine, -1, 1))
        return np.interp(angle, self.angle, self.distance) * (radius / self.radius)


def eye_shape(template: Template) -> EyeShape | None:
    """The mean of both eyeballs' profiles, the gaze along +z; None where the template has no eyeballs."""
    if not all(name in template.parts for name in EYE_PARTS):
        return None
    offset = np.concatenate(
        [template.mean[template.parts[name].vertices] - template.eye_centres[k] for k, name in enumerate(EYE_PARTS)]
    )
    distance = np.linalg.norm(offset, axis=1)
    angle = np.arccos(np.clip(offset[:, 2] / distance, -1, 1))
    _, ring = np.unique(np.round(np.degrees(angle) / _GRAIN), return_inverse=True)
    count = np.bincount(ring)
    rim = template.landmarks(template.mean)
    rims = np.concatenate([rim[list(ids)] - template.eye_centres[k] for k, ids in enumerate(_RIMS)])
    return EyeShape(
        np.bincount(ring, angle) / count,
        np.bincount(ring, distance) / count,
        float(np.median(distance[angle > np.radians(60)])),
        float(rims[:, 2].mean()),
        float(np.hypot(rims[:, 0], rims[:, 1]).mean()),
    )


def offsets(points: np.ndarray, centre: np.ndarray, ahead: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of points (n, 3) about a centre: distance (n,), unit direction (n, 3) and cosine (n,) to `ahead`."""
    d = points - centre
    r = np.linalg.norm(d, axis=1)
    direction = d / np.maximum(r, 1e-12)[:, None]
    return r, direction, direction @ ahead
