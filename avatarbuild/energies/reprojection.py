"""Points of the model against their pictures (method: (a) of the registration, and equation 5)."""

from __future__ import annotations

import numpy as np


def residual(
    points: np.ndarray, rotation: np.ndarray, translation: np.ndarray, focal: np.ndarray, pictures: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """
    r_ij = f_i (pi(R_i x_j + t_i) - m_ij) in pixels, pi(x, y, z) = (x / z, y / z), and its Jacobian by x_j.

    points (p, 3); k cameras: rotation (k, 3, 3), translation (k, 3), focal (k,) pixels; pictures (k, p, 2) on the plane
    z = 1, the lens's distortion taken off. Returns r (k, p, 2) and J (k, p, 2, 3).
    """
    camera = np.einsum("kij,pj->kpi", rotation, points) + translation[:, None]
    z = camera[..., 2]
    flat = camera[..., :2] / z[..., None]
    r = focal[:, None, None] * (flat - pictures)
    scale = (focal[:, None] / z)[..., None, None]
    J = scale * (rotation[:, None, :2, :] - flat[..., :, None] * rotation[:, None, 2:, :])
    return r, J
