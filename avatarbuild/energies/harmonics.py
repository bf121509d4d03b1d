"""Second-order spherical harmonics of a normal, and the light whose harmonics explain colours best (equations 1-3)."""

from __future__ import annotations

import numpy as np

_TINY = 1e-9


def basis(normals: np.ndarray) -> np.ndarray:
    """phi(n) = [1, nx, ny, nz, nx ny, nx nz, ny nz, nx^2 - ny^2, 3 nz^2 - 1]  (2): (…, 9) of unit normals (…, 3)."""
    x, y, z = np.moveaxis(np.asarray(normals), -1, 0)
    return np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x - y * y, 3 * z * z - 1], axis=-1)


def normal_equations(
    design: np.ndarray, target: np.ndarray, weight: np.ndarray, ridge: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A = B^T W B + diag(ridge) (9, 9) and b = B^T W t (9,): B (k, 9), t and w (k,), ridge (9,)."""
    weighted = design * weight[:, None]
    return weighted.T @ design + np.diag(ridge), weighted.T @ target


def fit(
    normals: np.ndarray,
    shadow: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray,
    *,
    ridge: float = 1e-4,
    huber: float = 0.1,
    rounds: int = 12,
) -> np.ndarray:
    """y = argmin sum_i w_i rho(a_i y^T phi(n_i) - t_i) + ridge sum_i w_i |y_2|^2, for each channel: (9, 3).

    normals (k, 3) unit; shadow a (k,) or (k, 3), the share of the light that is not hidden; target t (k, 3) = colour
    over reflectance; weight (k,); y_2 the five coefficients of second order, which few normals determine; rho Huber's
    function of width `huber` times the median target, by iteratively reweighted least squares.
    """
    phi = basis(np.asarray(normals, np.float64))
    hidden = np.asarray(shadow, np.float64)
    hidden = np.broadcast_to(hidden[:, None] if hidden.ndim == 1 else hidden, (len(phi), 3))
    total = float(weight.sum())
    damping = total * ridge * np.array([0, 0, 0, 0, 1.0, 1, 1, 1, 1])
    y = np.zeros((9, 3))
    for c in range(3):
        design, t = phi * hidden[:, c : c + 1], np.asarray(target[:, c], np.float64)
        width = huber * float(np.median(np.abs(t))) + _TINY
        w = np.asarray(weight, np.float64)
        for _ in range(rounds):
            y[:, c] = np.linalg.solve(*normal_equations(design, t, w, damping + _TINY * total))
            residual = np.abs(design @ y[:, c] - t)
            w = weight * np.minimum(1.0, width / np.maximum(residual, _TINY))
    return y


def shading(normals: np.ndarray, y: np.ndarray) -> np.ndarray:
    """s(n) = y^T phi(n): (…, 3), y (9, 3)."""
    return basis(normals) @ y
