"""The placed photos in the head frame, and their pictures in linear light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numba
import numpy as np

from avatarbuild.artefacts import StoredImage, Views
from avatarbuild.formats.colour import decode_srgb, srgb_from_linear
from avatarbuild.sfm.metric import Placed

if TYPE_CHECKING:
    import pycolmap

# COLMAP's models -> where fx, fy, cx, cy, k1, k2, p1, p2 stand among their parameters, -1 for zero
_PARAMETERS = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2, -1, -1, -1, -1),
    "PINHOLE": (0, 1, 2, 3, -1, -1, -1, -1),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1, -1, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4, -1, -1),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}


@dataclass(frozen=True)
class Photo:
    """
    A photo with its camera in the head frame: x_cam = R x + t, millimetres, pixels by K (3, 3) with centres at +0.5 and
    dist (5,) k1, k2, p1, p2, k3; size (w, h). `photo` is its row among the capture's, `placed` among the placed ones.
    """

    name: str
    photo: int
    placed: int
    image: StoredImage
    size: tuple[int, int]
    K: np.ndarray
    dist: np.ndarray
    R: np.ndarray
    t: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """(3,) the camera's position."""
        return -self.R.T @ self.t

    @property
    def yaw(self) -> float:
        """Degrees from straight ahead of the face, positive on the subject's left."""
        return float(np.degrees(np.arctan2(self.centre[0], self.centre[2])))

    def lens(self) -> np.ndarray:
        """(21,) float64: R row by row, t, fx, fy, cx, cy, k1, k2, p1, p2, k3, for compiled kernels."""
        K = self.K
        return np.concatenate([self.R.reshape(-1), self.t, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], self.dist])


def placed_in_head(views: Views, placed: Placed, head_from_cloud: np.ndarray) -> list[Photo]:
    """The placed photos, in order."""
    turn, shift = head_from_cloud[:3, :3], head_from_cloud[:3, 3]
    photos = []
    for p, i in enumerate(placed.index):
        K, dist = lens_of(placed.cameras[p])
        R = placed.rotation[p] @ turn.T
        size = (int(views.size[i, 0]), int(views.size[i, 1]))
        photos.append(
            Photo(views.names[i], int(i), p, views.images[i], size, K, dist, R, placed.translation[p] - R @ shift)
        )
    return photos


def lens_of(camera: pycolmap.Camera) -> tuple[np.ndarray, np.ndarray]:
    """K (3, 3) and dist (5,) of a COLMAP camera."""
    where = _PARAMETERS[camera.model.name]
    fx, fy, cx, cy, k1, k2, p1, p2 = (float(camera.params[i]) if i >= 0 else 0.0 for i in where)
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array([k1, k2, p1, p2, 0.0])


@lru_cache
def _linear_table() -> np.ndarray:
    """(256,) float32 linear light of sRGB bytes."""
    return decode_srgb(np.arange(256)).astype(np.float32)


def linear_picture(rgb: np.ndarray) -> np.ndarray:
    """(h, w, 3) float32 linear light of sRGB bytes."""
    return _linear_table()[rgb]


@lru_cache
def _byte_table() -> np.ndarray:
    """(16385,) uint8: sRGB of linear light (i / 16384)^2; the square keeps the dark end fine."""
    return np.rint(255 * srgb_from_linear((np.arange(16385) / 16384.0) ** 2)).astype(np.uint8)


def srgb_picture(linear: np.ndarray) -> np.ndarray:
    """uint8 sRGB of linear light (h, w, 3), clipped to 0..1."""
    out = np.empty(linear.shape, np.uint8)
    _encode(np.ascontiguousarray(linear, np.float32), _byte_table(), out)
    return out


@numba.njit(cache=True, parallel=True)
def _encode(linear: np.ndarray, table: np.ndarray, out: np.ndarray) -> None:
    h, w, channels = linear.shape
    for i in numba.prange(h):
        for j in range(w):
            for c in range(channels):
                v = min(max(linear[i, j, c], np.float32(0)), np.float32(1))
                out[i, j, c] = table[int(np.sqrt(v) * np.float32(16384) + np.float32(0.5))]


def shrunk(picture: np.ndarray, factor: int) -> np.ndarray:
    """Means over factor x factor pixels; a last row or column that is not full is dropped."""
    if factor == 1:
        return picture
    h, w = picture.shape[0] // factor, picture.shape[1] // factor
    return cv2.resize(picture[: h * factor, : w * factor], (w, h), interpolation=cv2.INTER_AREA)
