"""The video's camera, one for the whole clip."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Lens:
    """
    u = c + f (1 + k1 r^2) (x / z, y / z), r^2 = (x^2 + y^2) / z^2: focal length f and centre c = (w, h) / 2 in pixels,
    the first pixel's centre at 0.5.
    """

    focal: float
    k1: float
    size: tuple[int, int]

    @property
    def K(self) -> np.ndarray:
        """(3, 3) in OpenCV's pixels, whose first centre is at 0."""
        w, h = self.size
        return np.array([[self.focal, 0, w / 2 - 0.5], [0, self.focal, h / 2 - 0.5], [0, 0, 1.0]])

    @property
    def parameters(self) -> np.ndarray:
        """(4,) f, k1, cx, cy for compiled kernels."""
        return np.array([self.focal, self.k1, self.size[0] / 2, self.size[1] / 2])

    def project(self, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Pixels (..., 2) of points (..., 3) in camera axes, and their Jacobian (..., 2, 3).

        With p = (x, y) / z and d = 1 + k1 |p|^2:  du = f (d I + 2 k1 p p^T) dp,  dp = [I, -p] dx / z.
        """
        z = camera[..., 2:]
        p = camera[..., :2] / z
        r2 = (p * p).sum(axis=-1, keepdims=True)
        d = 1 + self.k1 * r2
        pixels = self.focal * d * p + np.array([self.size[0] / 2, self.size[1] / 2])
        turn = d[..., None] * np.eye(2) + 2 * self.k1 * p[..., :, None] * p[..., None, :]
        flat = np.concatenate([np.broadcast_to(np.eye(2), (*p.shape[:-1], 2, 2)), -p[..., None]], axis=-1)
        return pixels, self.focal * (turn @ flat) / z[..., None]
