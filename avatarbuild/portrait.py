"""A face's skin laid flat, for telling one person from another and a picture from its mirror image.

There is no network for faces' identity that may be shipped. What tells people apart here is the fine structure of
brows, lid folds and skin, at the places that the landmarks give, with light and colour taken out. It serves to notice
that a person seems to be another one; it proves nothing.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import scipy.sparse as sp
from scipy.spatial import Delaunay

from avatarbuild.landmarks import canonical_face, crop, mirror, region_about

MAX_YAW = 25.0  # degrees: turned further, half the portrait is hidden

SIZE = 96  # pixels
_LEFT, _RIGHT, _TOP, _BOTTOM = -55.0, 55.0, 62.0, -78.0  # mm on the mean face
_CROP = 256
_FINE = 4.0  # portrait pixels: structure broader than this is light
_MOST = 0.3  # log luminance: a highlight or a shadow counts no more

# rings of landmarks, the subject's right side where they have a side
OVAL = [
    *(10, 338, 297, 332, 284, 251, 389, 356, 454, 323, 361, 288, 397, 365, 379, 378, 400, 377, 152, 148, 176, 149),
    *(150, 136, 172, 58, 132, 93, 234, 127, 162, 21, 54, 103, 67, 109),
]
EYE = [33, 246, 161, 160, 159, 158, 157, 173, 133, 155, 154, 153, 145, 144, 163, 7]
BROW = [70, 63, 105, 66, 107, 55, 65, 52, 53, 46]
LIPS = [61, 185, 40, 39, 37, 0, 267, 269, 270, 409, 291, 375, 321, 405, 314, 17, 84, 181, 91, 146]
CHEEK = [117, 118, 101, 36, 205, 187, 123]
_NOSTRILS = [98, 240, 64, 48, 115, 220, 45, 4, 275, 440, 344, 278, 294, 460, 327, 326, 2, 97]


def portrait(rgb: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(96, 96) float32: log luminance of the skin without its broad part, at fixed places of the mean face."""
    square, to_picture = crop(rgb, region_about(points), _CROP)
    local = np.linalg.solve(to_picture[:, :2], (points[:468, :2] - to_picture[:, 2]).T).T
    at = (_layout() @ local - 0.5).astype(np.float32).reshape(SIZE, SIZE, 2)
    grey = cv2.cvtColor(cv2.GaussianBlur(square, (0, 0), 1.0), cv2.COLOR_RGB2GRAY).astype(np.float32)
    flat = np.log(cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR) + 8.0)
    skin = _skin().astype(np.float32)
    broad = cv2.GaussianBlur(flat * skin, (0, 0), _FINE) / np.maximum(cv2.GaussianBlur(skin, (0, 0), _FINE), 1e-3)
    return np.asarray(np.clip(flat - broad, -_MOST, _MOST) * skin, np.float32)


def likeness(a: np.ndarray, b: np.ndarray) -> float:
    """The correlation of two portraits: about 0.6 to 1 for one person, below 0.6 for two."""
    return _correlation(a[_skin()], b[_skin()])


def handedness(a: np.ndarray, b: np.ndarray) -> float:
    """
    The correlation of two portraits' asymmetries: negative where one is of the other's mirror image.

    The nostrils, whose shade follows the light rather than the face, are left out.
    """
    skin = _skin() & ~_filled([_NOSTRILS], grow=6)
    return _correlation((a - a[:, ::-1])[skin], (b - b[:, ::-1])[skin])


def twin(ring: list[int]) -> list[int]:
    """The ring of the other side."""
    return [int(i) for i in mirror()[ring]]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / max(float(np.sqrt((a @ a) * (b @ b))), 1e-12))


@cache
def _layout() -> sp.csr_matrix:
    """(96 * 96, 468): each pixel's barycentric coordinates among the mean face's points, seen from the front."""
    step = (_RIGHT - _LEFT) / SIZE, (_BOTTOM - _TOP) / SIZE
    i, j = np.mgrid[:SIZE, :SIZE] + 0.5
    at = np.stack([_LEFT + j.ravel() * step[0], _TOP + i.ravel() * step[1]], -1)
    mesh = Delaunay(canonical_face().points[:, :2])
    triangle = mesh.find_simplex(at)
    inside = mesh.transform[triangle]
    two = np.einsum("nij,nj->ni", inside[:, :2], at - inside[:, 2])
    weight = np.c_[two, 1 - two.sum(1)] * (triangle >= 0)[:, None]
    rows = np.repeat(np.arange(SIZE * SIZE), 3)
    return sp.csr_matrix((weight.ravel(), (rows, mesh.simplices[triangle].ravel())), (SIZE * SIZE, 468))


@cache
def _skin() -> np.ndarray:
    """(96, 96) bool, symmetric: the face without eyes and lips."""
    skin = _filled([OVAL]) & ~_filled([EYE, twin(EYE), LIPS], grow=2)
    return skin & skin[:, ::-1] & (np.asarray(_layout().sum(1)).reshape(SIZE, SIZE) > 0.5)


def _filled(rings: list[list[int]], grow: int = 0) -> np.ndarray:
    mask = np.zeros((SIZE, SIZE), np.uint8)
    face = canonical_face().points
    for ring in rings:
        x = (face[ring, 0] - _LEFT) / (_RIGHT - _LEFT) * SIZE - 0.5
        y = (face[ring, 1] - _TOP) / (_BOTTOM - _TOP) * SIZE - 0.5
        cv2.fillPoly(mask, [np.round(np.stack([x, y], -1)).astype(np.int32)], (1,))
    return cv2.dilate(mask, np.ones((1 + grow, 1 + grow), np.uint8)).astype(bool)
