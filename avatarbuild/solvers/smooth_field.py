"""A smooth field through scattered residuals on a periodic grid: the second stage of equation (3), with a mask.

    min_d  sum_p m_p (d_p - e_p)^2 + l1 |d|^2 + l2 |G d|^2 + l3 |L d|^2

Without a mask (m = 1) the system is circulant and d = H e with H(w) = 1 / (1 + l1 + l2 |w|^2 + l3 |w|^4). With one it
is solved by conjugate gradients, preconditioned by the FFT solution for the mean of m. h rows, w columns; w is the
angular frequency of a texel, that is of the differences' symbol: |w|^2 = 4 sin^2(u/2) + 4 sin^2(v/2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft as fft


@dataclass(frozen=True)
class Smoothness:
    """l1 keeps the field small, l2 its gradient, l3 its Laplacian (texels^2, texels^4). The field's half that is the
    same on both sides of the picture's middle column and the half that is opposite may differ: `mirror` is the second's
    (l1, l2, l3), None the same."""

    small: float
    gradient: float
    laplacian: float
    mirror: tuple[float, float, float] | None = None


def cut_off(length: float) -> float:
    """l3 of a field that follows half of what has this wavelength (texels): l3 (2 pi / length)^4 = 1."""
    return float((length / (2 * np.pi)) ** 4)


def solve(
    residual: np.ndarray, mask: np.ndarray, weights: Smoothness, *, tolerance: float = 1e-4, steps: int = 200
) -> np.ndarray:
    """d (h, w) float64 of the module's docstring: residual e (h, w), mask m (h, w) >= 0."""
    m = np.asarray(mask, np.float64)
    b = m * np.where(m > 0, residual, 0.0)
    even = _symbol(b.shape, (weights.small, weights.gradient, weights.laplacian))
    odd = even if weights.mirror is None else _symbol(b.shape, weights.mirror)
    together = weights.mirror is None

    def filtered(x: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        if together:
            return fft.irfft2(fft.rfft2(x, workers=2) * one, s=x.shape, workers=2)
        half = (x + x[:, ::-1]) / 2
        return filtered_one(half, one) + filtered_one(x - half, other)

    def filtered_one(x: np.ndarray, symbol: np.ndarray) -> np.ndarray:
        return fft.irfft2(fft.rfft2(x, workers=2) * symbol, s=x.shape, workers=2)

    level = max(float(m.mean()), 1e-6)
    inverse_even, inverse_odd = 1 / (level + even), 1 / (level + odd)
    x = filtered(b, inverse_even, inverse_odd)
    r = b - m * x - filtered(x, even, odd)
    z = filtered(r, inverse_even, inverse_odd)
    p, rho = z.copy(), float((r * z).sum())
    goal = tolerance**2 * max(float((b * b).sum()), 1e-300)
    for _ in range(steps):
        if float((r * r).sum()) <= goal:
            break
        q = m * p + filtered(p, even, odd)
        alpha = rho / float((p * q).sum())
        x += alpha * p
        r -= alpha * q
        z = filtered(r, inverse_even, inverse_odd)
        rho, before = float((r * z).sum()), rho
        p = z + (rho / before) * p
    return x


def _symbol(shape: tuple[int, ...], weights: tuple[float, float, float]) -> np.ndarray:
    """(h, w // 2 + 1): l1 + l2 |w|^2 + l3 |w|^4."""
    v = 4 * np.sin(np.pi * fft.fftfreq(shape[0]))[:, None] ** 2
    u = 4 * np.sin(np.pi * fft.rfftfreq(shape[1]))[None, :] ** 2
    squared = u + v
    return weights[0] + weights[1] * squared + weights[2] * squared**2
