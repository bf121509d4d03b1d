"""Numbers as files of text hold them."""

from __future__ import annotations

from typing import Any

import numpy as np


def rounded(values: np.ndarray, digits: int) -> Any:
    """The array as lists of floats with so many decimals, never -0.0."""
    return (np.round(np.asarray(values, np.float64), digits) + 0.0).tolist()
