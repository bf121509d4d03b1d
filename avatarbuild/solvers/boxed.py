"""Small quadratic programs with bounds, by coordinate descent ("shooting")."""

from __future__ import annotations

import numba
import numpy as np


def boxed(
    A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, start: np.ndarray, sweeps: int = 200
) -> np.ndarray:
    """
    x (n,) = argmin  x^T A x / 2 - b^T x,  low <= x <= high, from `start`; A (n, n) symmetric, positive semidefinite.

    Each coordinate in turn goes to its best place, clipped, until none moves by more than 1e-7. With x >= 0 an l1 term
    g |x| is linear: it is taken off b. Source: Fu, Penalized regressions: the bridge versus the lasso, 1998.
    """
    x = np.clip(np.asarray(start, np.float64), low, high)
    _descend(np.ascontiguousarray(A, np.float64), np.asarray(b, np.float64), low, high, x, sweeps)
    return x


def reduced(A: np.ndarray, b: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """
    The system of the last n - k unknowns once the first k, which have no bounds, take their best values.

    Returns S (n - k, n - k), r (n - k,), and D (k, n - k), d (k,): the first k are d - D x.
    """
    inverse = np.linalg.inv(A[:k, :k])
    D, d = inverse @ A[:k, k:], inverse @ b[:k]
    return A[k:, k:] - A[k:, :k] @ D, b[k:] - A[k:, :k] @ d, D, d


@numba.njit(cache=True)
def _descend(A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray, x: np.ndarray, sweeps: int) -> None:
    n = len(x)
    slope = b - A @ x
    for _ in range(sweeps):
        largest = 0.0
        for i in range(n):
            if A[i, i] <= 0:
                continue
            value = min(max(x[i] + slope[i] / A[i, i], low[i]), high[i])
            step = value - x[i]
            if step != 0.0:
                for j in range(n):
                    slope[j] -= A[j, i] * step
                x[i] = value
                largest = max(largest, abs(step))
        if largest < 1e-7:
            break
