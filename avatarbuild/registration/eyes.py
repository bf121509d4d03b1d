"""The eyeballs: where they are, how large, and where they look, from irises, lids and the morphable model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from avatarbuild.geometry.similarity import similarity
from avatarbuild.registration.eye_shape import EyeShape, eye_shape, offsets
from avatarbuild.registration.iris_sightings import IrisSightings, Photos, iris_sightings
from avatarbuild.registration.lids import LidBand, lid_bands
from avatarbuild.template import Template

RADIUS, RADIUS_SD = 12.0, 0.5  # mm, of adults
LIDS_SD, LIDS_COUNT = 1.0, 4.0  # mm by which the rim errs; how many such errors an eye's rim is worth
MODEL_SD = np.array([2.0, 2.0, 2.5])  # mm by which the model's eye misses, across and along the gaze
IRIS_SD, IRIS_COUNT = 0.4, 4.0  # mm, as above
GAZE_SD = np.radians(3.0)  # by which a neutral gaze departs from straight ahead
APART_SD = np.radians(2.0)  # by which two eyes differ
_AROUND = 35.0  # mm about an eye: the skin that carries the model's eye along


@dataclass(frozen=True)
class Eyeballs:
    """
    In the cloud's frame: centres (2, 3) of the left and right eye, radius (2,) mm; gaze (2, 3) unit where they look at
    rest; follow in [0, 1]: 0 where they look ahead in all photos, 1 where they follow the camera.
    """

    centres: np.ndarray
    radius: np.ndarray
    gaze: np.ndarray
    follow: float

    def gaze_to(self, eye: int, camera: np.ndarray) -> np.ndarray:
        """(3,) unit: where an eye looks in a photo taken from `camera` (3,)."""
        return _blend(self.gaze[eye], self.centres[eye], camera[None], self.follow)[0]


def eyeballs(
    photos: Photos,
    skin: np.ndarray,
    template: Template,
    coefficients: np.ndarray | None,
    ahead: np.ndarray | None = None,
) -> Eyeballs | None:
    """
    min over c_l, c_r, r, gaze, follow of
      sum_v N/n ((|x_v - c| - R(v) - gap_v) / s_lids)^2    rim of the registered lids on the ball, as in the template
    + sum_i N/n rho(|across ray_i (c + D g_i - o_i)| / s_iris)^2     irises D before the centres, where they look
    + |(c - c_model) / s_model|^2 + ((r - 12) / s_radius)^2
    + |gaze - ahead|^2 / s_gaze^2 + |gaze_l - gaze_r|^2 / s_apart^2

    with g_i between the gaze at rest and the direction to the camera by `follow`, and c_model the model's eye carried
    along by the skin around it. One radius for both eyes.

    skin (>= v, 3) registered, in the cloud's frame; coefficients (p,) of the morphable model; ahead (3,) where the face
    looks, from the model's skin if None. None where the template has no eyeballs.
    """
    shape = eye_shape(template)
    if shape is None:
        return None
    bands = lid_bands(template)
    model, face = _carried(skin, template, coefficients)
    ahead = face if ahead is None else ahead
    seen = iris_sightings(photos, ahead, shape.limbus_radius)
    at = _Problem(skin, bands, shape, seen, model, ahead)
    best = None
    for follow in (0.0, 1.0):
        start = np.concatenate([model.ravel(), [RADIUS], np.zeros(4), [follow]])
        low, high = np.full(12, -np.inf), np.full(12, np.inf)
        low[11], high[11] = -1e-3, 1 + 1e-3
        found = least_squares(at.residuals, start, bounds=(low, high), x_scale=at.scale, loss="linear", method="trf")
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    centres, radius, gaze, follow = at.parts(best.x)
    return Eyeballs(centres, np.full(2, radius), gaze, follow)


class _Problem:
    """The residuals above of x = (c_l, c_r, r, two angles of gaze for each eye, follow)."""

    scale = np.array([*[1.0] * 6, 0.5, *[0.1] * 4, 0.3])

    def __init__(
        self,
        skin: np.ndarray,
        bands: tuple[LidBand, LidBand],
        shape: EyeShape,
        seen: IrisSightings,
        model: np.ndarray,
        ahead: np.ndarray,
    ) -> None:
        self.rims = [skin[band.rim] for band in bands]
        self.gaps = [band.gap[band.rim] for band in bands]
        self.shape, self.seen, self.model, self.ahead = shape, seen, model, ahead
        side = np.cross([0.0, 1.0, 0.0], ahead)
        side /= np.linalg.norm(side)
        self.frame = np.stack([side, np.cross(ahead, side), ahead])

    def parts(self, x: np.ndarray) -> tuple[np.ndarray, float, np.ndarray, float]:
        """Centres (2, 3), radius, gaze (2, 3) and follow."""
        turn = x[7:11].reshape(2, 2)
        gaze = np.column_stack([turn, np.ones(2)]) @ self.frame
        gaze /= np.linalg.norm(gaze, axis=1, keepdims=True)
        return x[:6].reshape(2, 3), float(x[6]), gaze, float(np.clip(x[11], 0, 1))

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """(k,) all terms, divided by their spreads."""
        centres, radius, gaze, follow = self.parts(x)
        shape, seen = self.shape, self.seen
        terms = [(radius - RADIUS) / RADIUS_SD, x[7:11] / GAZE_SD, (x[7:9] - x[9:11]) / APART_SD]
        terms.append((centres - self.model) @ self.frame.T / MODEL_SD)
        depth = shape.limbus_depth * radius / shape.radius
        for k in range(2):
            r, _, cosine = offsets(self.rims[k], centres[k], self.ahead)
            miss = r - shape.surface(cosine, radius) - self.gaps[k]
            terms.append(_robust(miss / LIDS_SD) * np.sqrt(LIDS_COUNT / len(miss)))
            own = seen.eye == k
            if own.any():
                iris = centres[k] + depth * _blend(gaze[k], centres[k], seen.centre[own], follow)
                off = iris - seen.centre[own]
                d = seen.direction[own]
                across = off - (off * d).sum(axis=1, keepdims=True) * d
                size = np.linalg.norm(across, axis=1, keepdims=True) / IRIS_SD
                weight = _robust(size) / np.maximum(size, 1e-9)
                terms.append(weight * across / IRIS_SD * np.sqrt(min(1.0, IRIS_COUNT / own.sum())))
        return np.concatenate([np.ravel(t) for t in terms])


def _robust(z: np.ndarray) -> np.ndarray:
    """sign(z) sqrt(rho(z)), rho = 2 (sqrt(1 + z^2) - 1), squared near 0, linear far away."""
    return np.sign(z) * np.sqrt(2 * z**2 / (np.sqrt(1 + z**2) + 1))


def _blend(gaze: np.ndarray, centre: np.ndarray, cameras: np.ndarray, follow: float) -> np.ndarray:
    """(n, 3) unit: between `gaze` and the directions to the cameras (n, 3)."""
    towards = cameras - centre
    towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    g = (1 - follow) * gaze + follow * towards
    return g / np.linalg.norm(g, axis=1, keepdims=True)


def _carried(skin: np.ndarray, template: Template, coefficients: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """(2, 3) the model's eye centres, each moved by the rigid motion and scale that takes the model's skin around it to
    the registered skin; (3,) unit: where the model looks, by the motion of the face."""
    model = template.neutral(np.zeros(0) if coefficients is None else coefficients)
    eyes = template.eye_positions(coefficients)
    count = template.parts["skin"].vertices.stop
    outside = ~(template.regions["sockets"] | template.regions["mouth"])[:count]
    centres = np.empty((2, 3))
    for k in range(2):
        near = np.flatnonzero(outside & (np.linalg.norm(model[:count] - eyes[k], axis=1) < _AROUND))
        s, rotation, t = similarity(model[near], skin[near])
        centres[k] = s * rotation @ eyes[k] + t
    face = np.flatnonzero(template.regions["face"][:count] & outside)
    _, rotation, _ = similarity(model[face], skin[face])
    return centres, rotation[:, 2]
