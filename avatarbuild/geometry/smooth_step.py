"""The smooth step from 0 to 1."""

from __future__ import annotations

import numpy as np


def smooth_step(x: np.ndarray, low: float = 0.0, high: float = 1.0) -> np.ndarray:
    """0 below `low`, 1 above `high`, 3 s^2 - 2 s^3 between; falling where low > high."""
    s = np.clip((np.asarray(x) - low) / (high - low), 0, 1)
    return np.asarray(s * s * (3 - 2 * s))
