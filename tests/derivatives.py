"""Jacobians against central differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def numerical(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """(r, p): of function(x) -> any shape with r entries, by x with p entries."""
    columns = []
    for k in range(x.size):
        move = np.zeros(x.size)
        move[k] = step
        move = move.reshape(x.shape)
        columns.append((function(x + move) - function(x - move)).ravel() / (2 * step))
    return np.stack(columns, axis=1)
