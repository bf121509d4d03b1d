"""Rotations by their vectors."""

from __future__ import annotations

import numpy as np


def rotation(turn: np.ndarray) -> np.ndarray:
    """(3, 3) exp([turn]_x) by Rodrigues' formula: about turn (3,), by its length in radians."""
    angle = float(np.linalg.norm(turn))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = turn / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)
