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
    design: np.ndarray, target: np.ndarray, weight: np.ndarray, ridge: np.ndarray, width: float, rounds: int = 8
) -> np.ndarray:
    """y = argmin sum_i w_i rho((B y - t)_i) + y^T diag(ridge) y, (9,).

    B (k, 9), the harmonics times what multiplies them; t, w (k,); ridge (9,); rho(e) = e^2 / 2 up to `width`, linear
    beyond (Huber), by iteratively reweighted least squares: 9 x 9 systems.
    """
    y, w = np.zeros(design.shape[1]), weight
    for _ in range(rounds):
        y = np.linalg.solve(*normal_equations(design, target, w, ridge))
        size = np.abs(design @ y - target)
        w = weight * np.minimum(1, width / np.maximum(size, _TINY))
    return y


def shading(normals: np.ndarray, y: np.ndarray) -> np.ndarray:
    """s(n) = y^T phi(n): (…, 3), y (9, 3)."""
    return basis(normals) @ y
