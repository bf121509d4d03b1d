"""The whites of the eyes in the photos: a grey card that everybody carries, whatever the skin's tone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.artefacts import Neutral, Views
from avatarbuild.registration.eye_shape import eye_shape
from avatarbuild.registration.eyes import Eyeballs
from avatarbuild.registration.iris_patches import MOST_TURNED, frontal_photos, iris_patch
from avatarbuild.registration.iris_sightings import Photos
from avatarbuild.sfm.metric import Placed
from avatarbuild.template import Template

_PHOTOS = 3  # the most frontal sharp ones
_PRESENCE = 0.9  # of a face, from which its landmarks are believed


@dataclass(frozen=True)
class White:
    """colour (3,) linear, of the white of `eye` (0 left, 1 right) in the placed photo `placed`."""

    colour: np.ndarray
    eye: int
    placed: int


def eye_whites(views: Views, placed: Placed, neutral: Neutral, template: Template) -> list[White]:
    """
    The whites in the most frontal sharp photos, without lashes, veins and highlights; [] where none shows.

    The eyes are taken to look ahead, which a frontal photo cannot tell from eyes that look into it.
    """
    shape = eye_shape(template)
    if shape is None:
        return []
    trusted = views.trusted(_PRESENCE, MOST_TURNED)
    photos = Photos(
        placed, views.landmarks, trusted, views.pose[:, 0], views.sharpness, lambda i: views.images[i].rgb()
    )
    to_cloud = np.linalg.inv(neutral.head_from_cloud)
    turn, shift = to_cloud[:3, :3], to_cloud[:3, 3]
    centres, skin = (x @ turn.T + shift for x in (neutral.eye_centres, neutral.vertices))
    ahead = np.tile(turn[:, 2], (2, 1))
    eyes = Eyeballs(centres, neutral.eye_radius, ahead, 0.0)
    found = []
    for p in frontal_photos(photos, eyes)[:_PHOTOS]:
        for eye in range(2):
            patch = iris_patch(photos, p, eye, eyes, skin, template, shape)
            if patch is not None:
                found.append(White(np.median(patch.window[patch.white], axis=0), eye, p))
    return found
