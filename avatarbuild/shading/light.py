"""The video's light: second-order harmonics in the camera's axes, one for the clip, and each frame's exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatarbuild.energies import harmonics
from avatarbuild.shading.surface import Drawn

_ROUNDS = 3
_WIDTH = 0.1  # of the logarithm: beyond it a pixel counts linearly: shadows, highlights, what the mesh has wrong
_RIDGE = 1e-4
_SATURATED = 0.95
_DARK = 0.02
LEAST = 0.05
"""The least light that reaches any place of the face, as a share of the mean."""
_SOME = 20000  # pixels of a frame


@dataclass(frozen=True)
class Light:
    """y (9,) of equation (1), in camera axes; gains (f,) of the frames, their mean logarithm 0."""

    y: np.ndarray
    gains: np.ndarray

    def shade(self, normals: np.ndarray) -> np.ndarray:
        """s = max(y^T phi(n), LEAST): (…)."""
        return np.maximum(harmonics.basis(normals) @ self.y, LEAST)


def clip_light(frames: list[tuple[Drawn, np.ndarray, np.ndarray]]) -> Light:
    """
    y and g minimising sum w rho(log(g e^tone y^T phi(n)) - log c) over the face's pixels of all frames, in turns.

    frames: the drawn head, the picture c (h, w), and what is to be added to its tone (h, w).
    """
    parts = []
    for drawn, grey, more in frames:
        rows, columns = np.nonzero(drawn.on & (grey < _SATURATED))
        step = max(1, len(rows) // _SOME)
        at = rows[::step], columns[::step]
        tone = np.exp(drawn.tone[at] + more[at]).astype(np.float64)
        parts.append((harmonics.basis(drawn.normal[at].astype(np.float64)), tone, np.maximum(grey[at], _DARK)))
    gains, y = np.ones(len(parts)), np.zeros(9)
    ridge = np.array([0, 0, 0, 0, 1, 1, 1, 1, 1.0])
    for turn in range(_ROUNDS):
        left, right = np.zeros((9, 9)), np.zeros(9)
        for (basis, tone, grey), gain in zip(parts, gains, strict=True):
            weight = 1 / grey**2
            if turn:
                error = np.log(np.maximum(basis @ y, LEAST) * tone * gain / grey)
                weight = weight * np.minimum(1, _WIDTH / np.maximum(np.abs(error), 1e-9))
            A, b = harmonics.normal_equations(basis * (tone * gain)[:, None], grey, weight, np.zeros(9))
            left, right = left + A, right + b
        y = np.linalg.solve(left + _RIDGE * np.trace(left) / 9 * np.diag(ridge), right)
        gains = np.array([_exposure(np.maximum(basis @ y, LEAST) * tone, grey) for basis, tone, grey in parts])
        mean = np.exp(np.mean(np.log(gains)))
        y, gains = y * mean, gains / mean
    return Light(y, gains)


def exposure(light: Light, drawn: Drawn, grey: np.ndarray, more: np.ndarray) -> float:
    """The gain of one more frame under the clip's light."""
    at = np.nonzero(drawn.on & (grey < _SATURATED))
    expected = light.shade(drawn.normal[at]) * np.exp(drawn.tone[at] + more[at])
    return _exposure(expected, np.maximum(grey[at], _DARK))


def _exposure(expected: np.ndarray, grey: np.ndarray) -> float:
    return float(np.exp(np.median(np.log(grey / expected)))) if len(grey) else 1.0
