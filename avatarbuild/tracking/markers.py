"""The detector's points on the person's skin: E_feature of equation (5) [Ichim et al. 2015], free of its own bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.artefacts import Views
from avatarbuild.landmarks import IRIS_RIGHT
from avatarbuild.registration.pins import LID_RIMS, LIP_BORDERS, SEAM
from avatarbuild.template import Template
from avatarbuild.texture.photos import Photo
from avatarbuild.tracking.lens import Lens
from avatarbuild.tracking.rig import Places, Rider

SKIN = IRIS_RIGHT.start  # the points from here on lie on the irises
_FRONTAL = 30.0  # degrees of yaw up to which a photo tells where the detector sees its points
_LEAST = 3  # photos

# rims of the lids and the lips, whose points move most and count most
_RIMS = sorted({point for chains in (LID_RIMS, LIP_BORDERS, SEAM) for chain in chains.values() for point in chain})
_RIM_WEIGHT = 3.0


@dataclass(frozen=True)
class Markers:
    """
    places of the 468 points on the template's surface; offset (468, 3) mm in the head frame from there to where the
    detector sees them on this face at rest; weight (468,); sliding (468,) bool.
    """

    places: Places
    offset: np.ndarray
    weight: np.ndarray
    sliding: np.ndarray


@dataclass(frozen=True)
class Clicks:
    """q points that the user has set: which of the detector's (q,), their pixels (q, 2), confidence (q,) in 0..1."""

    points: np.ndarray
    pixels: np.ndarray
    confidence: np.ndarray


def markers(template: Template, neutral: np.ndarray, photos: list[Photo], views: Views, usable: np.ndarray) -> Markers:
    """
    The detector's points on a person: neutral (n, 3), photos with their cameras in the head frame, `usable` (k,) bool
    of the capture's photos: a face at rest, trusted.

    The offset is the mean over the most frontal photos of the missing distance across the line of sight, turned back
    into the head frame: the detector draws every face with a bias of its own, which expressions hardly change.
    """
    places = Places(template.landmark_triangles[:SKIN], template.landmark_barycentric[:SKIN])
    x = places.on(neutral, template.triangles)
    close = [p for p in photos if usable[p.photo] and abs(views.pose[p.photo, 0]) <= _FRONTAL]
    offset = np.zeros((SKIN, 3))
    if len(close) >= _LEAST:
        missing = []
        for p in close:
            camera = x @ p.R.T + p.t
            lens = Lens(float(p.K[0, 0]), float(p.dist[0]), p.size)
            shift = np.array([p.K[0, 2], p.K[1, 2]]) - np.array(p.size) / 2
            pixels = lens.project(camera)[0] + shift
            flat = (views.landmarks[p.photo, :SKIN, :2] - pixels) * camera[:, 2:] / lens.focal
            missing.append(np.c_[flat, np.zeros(SKIN)] @ p.R)
        offset = np.median(missing, axis=0)
    weight = np.ones(SKIN)
    weight[_RIMS] = _RIM_WEIGHT
    return Markers(places, offset, weight, template.landmark_sliding[:SKIN])


def rows(
    rider: Rider, m: Markers, weights: np.ndarray, pictures: np.ndarray, lens: Lens, R: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    r (2 q,) mm = (P(F_T(B_v, w)) - m_v) z / f and J (2 q, 6 + a) by (turn, shift, w), for the q points.

    pictures (q, 2) pixels. A sliding point counts only across the line through its neighbours' pictures:
    the part along it is taken off its rows.
    """
    x = rider.at(weights) + m.offset
    turned = x @ R.T
    camera = turned + t
    pixels, J = lens.project(camera)
    scale = (camera[:, 2] / lens.focal)[:, None]
    J = J * scale[..., None]
    r = (pixels - pictures) * scale
    cross = np.zeros((len(x), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = turned[:, 2], -turned[:, 1], turned[:, 0]
    cross -= cross.transpose(0, 2, 1)
    full = np.concatenate([J @ cross, J, (J @ R) @ rider.moves], axis=2)
    if m.sliding.any():
        s = np.flatnonzero(m.sliding)
        across = _across(pictures[s])
        r[s] = across * np.einsum("si,si->s", across, r[s])[:, None]
        full[s] = across[..., None] * np.einsum("si,sij->sj", across, full[s])[:, None]
    return r.ravel(), full.reshape(2 * len(x), -1)


def _across(points: np.ndarray) -> np.ndarray:
    """(s, 2) unit normals of the closed line through the points (s, 2), put in order about their middle."""
    middle = points.mean(axis=0)
    order = np.argsort(np.arctan2(*(points - middle).T[::-1]))
    line = points[order]
    along = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1)
    out = np.empty_like(points)
    out[order] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    return out
