"""Points in space from their pictures in several photos."""

from __future__ import annotations

import numpy as np


def triangulate(
    centres: np.ndarray, directions: np.ndarray, weights: np.ndarray, tolerance: float = 0.003, rounds: int = 10
) -> tuple[np.ndarray, np.ndarray]:
    """
    argmin_x sum_k w_k rho( || (I - d_k d_k^T) (x - c_k) || / || x - c_k || ) for each of p points, by reweighted least
    squares; rho is Cauchy's with scale `tolerance` (radians).

    centres (k, 3), directions (p, k, 3) unit, weights (p, k), 0 where a photo does not show the point.
    Returns x (p, 3), NaN where fewer than two photos show the point, and the angles (p, k) in radians between the rays
    and x, NaN where the weight is 0.
    """
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
    seen = weights > 0
    robust = np.where(seen, weights, 0.0)
    x = np.full((len(directions), 3), np.nan)
    angles = np.full(weights.shape, np.nan)
    enough = seen.sum(axis=1) >= 2
    if not enough.any():
        return x, angles
    for _ in range(rounds):
        normal = np.einsum("pk,pkij->pij", robust[enough], across[enough])
        right = np.einsum("pk,pkij,kj->pi", robust[enough], across[enough], centres)
        x[enough] = np.linalg.solve(normal, right[..., None])[..., 0]
        ray = x[:, None] - centres
        length = np.linalg.norm(ray, axis=2)
        off = np.linalg.norm(np.einsum("pkij,pkj->pki", across, ray), axis=2) / length
        angles = np.where(seen, off, np.nan)
        robust = np.where(seen, weights / (1 + (off / tolerance) ** 2) / length**2, 0.0)
    return x, angles
