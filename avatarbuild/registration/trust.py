"""How far the cloud is to be believed: skin is smooth and of one colour, hair and clothes are not."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from avatarbuild.formats.colour import decode_srgb
from avatarbuild.template import Template

_CELL = 2.5  # mm: cells whose normals are compared
_ROUGH, _SMOOTH = 0.70, 0.88  # length of a cell's mean normal: hair and noise below the first, skin above the second
_ROUGH_FACE, _SMOOTH_FACE = 0.45, 0.70  # on the face, whose creases are sharper
_ALIKE, _UNLIKE = 3.0, 6.0  # standard deviations of the face's colour
_COLOUR_SD = 0.08  # least standard deviation of a log ratio of channels
_BRIGHT_SD = 0.5  # of log luminance, which shading changes
_NEAR = 8.0  # mm from the model within which a point tells the skin's colour


def smoothness(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) in [0, 1] the length of the mean normal of the points in the same cell of space: 1 on a plane."""
    cell = np.floor(points / _CELL).astype(np.int64)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    key = (cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2]
    _, group = np.unique(key, return_inverse=True)
    group = group.reshape(-1)
    count = np.bincount(group)
    mean = np.stack([np.bincount(group, normals[:, k]) for k in range(3)], axis=1) / count[:, None]
    length = np.linalg.norm(mean, axis=1)
    # a cell with few points says little; one alone would look like a plane
    return (length * np.minimum(count / 6.0, 1.0))[group]


def cloud_trust(
    points: np.ndarray, normals: np.ndarray, colours: np.ndarray, model: np.ndarray, template: Template
) -> np.ndarray:
    """
    (n,) in [0, 1] for points, normals (n, 3) and colours (n, 3) uint8 sRGB about a fitted model (v, 3).

    On the face only roughness counts; on scalp, ears and neck also how far the colour is from the face's skin.
    """
    skin = template.parts["skin"].vertices
    r = template.regions
    near, vertex = cKDTree(model[skin]).query(points, workers=-1)
    plain = (r["face"] & ~(r["brows"] | r["lips"] | r["lids"] | r["mouth"] | r["sockets"]))[skin]
    other = (r["scalp"] | r["ears"] | r["neck"])[skin]
    smooth = smoothness(points, normals)
    low = np.where(other[vertex], _ROUGH, _ROUGH_FACE)
    high = np.where(other[vertex], _SMOOTH, _SMOOTH_FACE)
    trust = np.clip((smooth - low) / (high - low), 0, 1)

    log = np.log(decode_srgb(colours) + 0.004)
    features = np.stack([log[:, 0] - log[:, 1], log[:, 2] - log[:, 1], log.mean(axis=1)], axis=1)
    known = plain[vertex] & (near < _NEAR) & (smooth > _SMOOTH_FACE)
    if known.sum() < 100:
        return trust
    middle = np.median(features[known], axis=0)
    spread = 1.4826 * np.median(np.abs(features[known] - middle), axis=0)
    spread = np.maximum(spread, [_COLOUR_SD, _COLOUR_SD, _BRIGHT_SD])
    unlike = np.sqrt((((features - middle) / spread) ** 2).sum(axis=1))
    like = np.clip((_UNLIKE - unlike) / (_UNLIKE - _ALIKE), 0, 1)
    return trust * np.where(other[vertex], like, 1.0)
