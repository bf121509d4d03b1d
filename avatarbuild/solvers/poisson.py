"""The screened Poisson equation on a masked image, with ties between texels that are neighbours though not in it.

For texels p of a mask, their four-neighbours in it and ties (p, q) from a list, all taken as pairs pq,

    min_x  sum_pq (x_q - x_p - g_pq)^2 + screen sum_p (x_p - t_p)^2,    that is  A x = div(g) + screen t,

by conjugate gradients in float32 with float64 sums, preconditioned by a symmetric multigrid V-cycle: aggregates of
2 x 2 texels, whose pairs weigh half the sum of the texels' pairs, red-black Gauss-Seidel. It repeats bit for bit,
whatever the number of threads. Letters: h rows, w columns, l ties.

Sources: Perez, Gangnet, Blake, Poisson image editing, 2003; Braess, Towards algebraic multigrid for elliptic problems
of second order, 1995 (the halved coarse operator); Tatebe, The multigrid preconditioned conjugate gradient method,
1993.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

_COARSEST = 8  # cells on the longer side
_COARSEST_SWEEPS = 30
_SWEEPS = 1  # before and after, on the finest level; twice as many on each coarser one up to four


@dataclass(frozen=True)
class _Level:
    """right, down (h, w) float32 weights of the pairs; diagonal (h, w) float32 of A, 0 outside; ties grouped by row:
    rows (r,), starts (r + 1,), others and weights (2 l,)."""

    right: np.ndarray
    down: np.ndarray
    diagonal: np.ndarray
    rows: np.ndarray
    starts: np.ndarray
    others: np.ndarray
    weights: np.ndarray


class Grid:
    """
    A for a mask (h, w) bool, `screen` > 0 in texels^-2, and ties (l, 2) flat indices of texels of the mask.

    A wanted difference across a tie enters b like any other: `divergence`.
    """

    def __init__(self, mask: np.ndarray, screen: float, ties: np.ndarray | None = None) -> None:
        assert screen > 0
        pairs = np.zeros((0, 2), np.int64) if ties is None else np.asarray(ties, np.int64).reshape(-1, 2)
        right, down = np.zeros(mask.shape, np.float32), np.zeros(mask.shape, np.float32)
        right[:, :-1] = mask[:, :-1] & mask[:, 1:]
        down[:-1] = mask[:-1] & mask[1:]
        mass = mask.astype(np.float32) * np.float32(screen)
        weight = np.ones(len(pairs))
        self.shape = mask.shape
        self._levels: list[_Level] = []
        while True:
            self._levels.append(_level(right, down, mass, pairs, weight))
            if max(mass.shape) <= _COARSEST:
                break
            pairs, weight = _coarse_ties(pairs, weight, mass.shape)
            right, down, mass = _coarse(right, down, mass)

    def solve(self, b: np.ndarray, tolerance: float = 1e-3, steps: int = 60) -> tuple[np.ndarray, int]:
        """x (h, w) float32 with A x = b (h, w), zero outside the mask, until ||r|| <= tolerance ||b||; and steps."""
        fine = self._levels[0]
        r = np.where(fine.diagonal > 0, b, 0).astype(np.float32)
        x, q = np.zeros_like(r), np.empty_like(r)
        goal = tolerance**2 * _dot(r, r)
        if goal == 0:
            return x, 0
        z = self._cycle(0, r)
        p = z.copy()
        rho = _dot(r, z)
        for step in range(1, steps + 1):
            _apply(p, fine.right, fine.down, fine.diagonal, q)
            _add_ties(p, q, fine.rows, fine.starts, fine.others, fine.weights, -1.0)
            alpha = np.float32(rho / _dot(p, q))
            if _advance(x, r, p, q, alpha) <= goal:
                return x, step
            z = self._cycle(0, r)
            rho, before = _dot(r, z), rho
            _turn(p, z, np.float32(rho / before))
        return x, steps

    def _cycle(self, k: int, b: np.ndarray) -> np.ndarray:
        """An approximate A_k^-1 b by one V-cycle from zero."""
        level = self._levels[k]
        x = np.zeros_like(b)
        if k == len(self._levels) - 1:
            for _ in range(_COARSEST_SWEEPS):
                _smooth(level, x, b, (0, 1))
            for _ in range(_COARSEST_SWEEPS):
                _smooth(level, x, b, (1, 0))
            return x
        sweeps = min(_SWEEPS << k, 4)
        for _ in range(sweeps):
            _smooth(level, x, b, (0, 1))
        r = np.empty_like(b)
        _apply(x, level.right, level.down, level.diagonal, r)
        _add_ties(x, r, level.rows, level.starts, level.others, level.weights, -1.0)
        coarse = np.zeros(((b.shape[0] + 1) // 2, (b.shape[1] + 1) // 2), np.float32)
        _restrict(b, r, coarse)
        _prolong(x, self._cycle(k + 1, coarse), level.diagonal)
        for _ in range(sweeps):
            _smooth(level, x, b, (1, 0))
        return x


def divergence(pairs: np.ndarray, differences: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """b (h, w) float32 = div(g): +g_pq at q and -g_pq at p, for pairs (l, 2) of flat indices, differences (l,)."""
    n = shape[0] * shape[1]
    total = np.bincount(pairs[:, 1], differences, n) - np.bincount(pairs[:, 0], differences, n)
    return total.astype(np.float32).reshape(shape)


def _level(right: np.ndarray, down: np.ndarray, mass: np.ndarray, pairs: np.ndarray, weight: np.ndarray) -> _Level:
    diagonal = mass + right + down
    diagonal[:, 1:] += right[:, :-1]
    diagonal[1:] += down[:-1]
    both = np.concatenate([pairs, pairs[:, ::-1]])
    order = np.lexsort((both[:, 1], both[:, 0]))
    both, weights = both[order], np.concatenate([weight, weight])[order]
    rows, starts = np.unique(both[:, 0], return_index=True)
    np.add.at(diagonal.reshape(-1), both[:, 0], weights.astype(np.float32))
    return _Level(
        *(right, down, diagonal, rows, np.append(starts, len(both)), both[:, 1].copy(), weights.astype(np.float32))
    )


def _coarse_ties(pairs: np.ndarray, weight: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    half = (shape[1] + 1) // 2
    parents = np.sort(pairs // shape[1] // 2 * half + pairs % shape[1] // 2, axis=1)
    parents, where = np.unique(parents, axis=0, return_inverse=True)
    total = np.bincount(where.reshape(-1), weight / 2, len(parents))
    apart = parents[:, 0] != parents[:, 1]
    return parents[apart], total[apart]


def _coarse(right: np.ndarray, down: np.ndarray, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    h, w = mass.shape
    even = lambda a: np.pad(a, ((0, h % 2), (0, w % 2)))  # noqa: E731
    r, d, m = even(right), even(down), even(mass)
    return (
        (r[0::2, 1::2] + r[1::2, 1::2]) / 2,
        (d[1::2, 0::2] + d[1::2, 1::2]) / 2,
        m[0::2, 0::2] + m[0::2, 1::2] + m[1::2, 0::2] + m[1::2, 1::2],
    )


def _smooth(level: _Level, x: np.ndarray, b: np.ndarray, colours: tuple[int, int]) -> None:
    """Two half sweeps; values across ties are those from before the half sweep, so that no thread waits for another."""
    for colour in colours:
        pull = _pulls(x, level.rows, level.starts, level.others, level.weights)
        _half_sweep(x, b, level.right, level.down, level.diagonal, colour)
        _pull_tied(x, pull, level.rows, level.diagonal, colour)


@numba.njit(cache=True)
def _pulls(x: np.ndarray, rows: np.ndarray, starts: np.ndarray, others: np.ndarray, weights: np.ndarray) -> np.ndarray:
    flat = x.reshape(-1)
    out = np.zeros(len(rows), np.float32)
    for i in range(len(rows)):
        for k in range(starts[i], starts[i + 1]):
            out[i] += weights[k] * flat[others[k]]
    return out


@numba.njit(cache=True)
def _pull_tied(x: np.ndarray, pull: np.ndarray, rows: np.ndarray, diagonal: np.ndarray, colour: int) -> None:
    w = x.shape[1]
    for i in range(len(rows)):
        r, c = rows[i] // w, rows[i] % w
        if (r + c) % 2 == colour:
            x[r, c] += pull[i] / diagonal[r, c]


@numba.njit(cache=True, parallel=True)
def _half_sweep(
    x: np.ndarray, b: np.ndarray, right: np.ndarray, down: np.ndarray, diagonal: np.ndarray, colour: int
) -> None:
    h, w = x.shape
    for i in numba.prange(h):
        for j in range((i + colour) % 2, w, 2):
            d = diagonal[i, j]
            if d > 0:
                total = b[i, j]
                if j + 1 < w:
                    total += right[i, j] * x[i, j + 1]
                if j > 0:
                    total += right[i, j - 1] * x[i, j - 1]
                if i + 1 < h:
                    total += down[i, j] * x[i + 1, j]
                if i > 0:
                    total += down[i - 1, j] * x[i - 1, j]
                x[i, j] = total / d


@numba.njit(cache=True, parallel=True)
def _apply(x: np.ndarray, right: np.ndarray, down: np.ndarray, diagonal: np.ndarray, out: np.ndarray) -> None:
    h, w = x.shape
    for i in numba.prange(h):
        for j in range(w):
            total = diagonal[i, j] * x[i, j]
            if diagonal[i, j] > 0:
                if j + 1 < w:
                    total -= right[i, j] * x[i, j + 1]
                if j > 0:
                    total -= right[i, j - 1] * x[i, j - 1]
                if i + 1 < h:
                    total -= down[i, j] * x[i + 1, j]
                if i > 0:
                    total -= down[i - 1, j] * x[i - 1, j]
            out[i, j] = total


@numba.njit(cache=True)
def _add_ties(
    x: np.ndarray,
    out: np.ndarray,
    rows: np.ndarray,
    starts: np.ndarray,
    others: np.ndarray,
    weights: np.ndarray,
    sign: float,
) -> None:
    flat, to = x.reshape(-1), out.reshape(-1)
    for i in range(len(rows)):
        for k in range(starts[i], starts[i + 1]):
            to[rows[i]] += np.float32(sign) * weights[k] * flat[others[k]]


@numba.njit(cache=True, parallel=True)
def _restrict(b: np.ndarray, applied: np.ndarray, out: np.ndarray) -> None:
    """out = sums over 2 x 2 of b - A x."""
    h, w = b.shape
    for i in numba.prange(out.shape[0]):
        for j in range(out.shape[1]):
            total = np.float32(0)
            for r in range(2 * i, min(2 * i + 2, h)):
                for c in range(2 * j, min(2 * j + 2, w)):
                    total += b[r, c] - applied[r, c]
            out[i, j] = total


@numba.njit(cache=True, parallel=True)
def _prolong(x: np.ndarray, coarse: np.ndarray, diagonal: np.ndarray) -> None:
    h, w = x.shape
    for i in numba.prange(h):
        for j in range(w):
            if diagonal[i, j] > 0:
                x[i, j] += coarse[i // 2, j // 2]


@numba.njit(cache=True, parallel=True)
def _row_dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    h, w = a.shape
    out = np.zeros(h)
    for i in numba.prange(h):
        total = 0.0
        for j in range(w):
            total += np.float64(a[i, j]) * np.float64(b[i, j])
        out[i] = total
    return out


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return float(_row_dots(a, b).sum())


@numba.njit(cache=True, parallel=True)
def _step_rows(x: np.ndarray, r: np.ndarray, p: np.ndarray, q: np.ndarray, alpha: np.float32) -> np.ndarray:
    h, w = x.shape
    out = np.zeros(h)
    for i in numba.prange(h):
        total = 0.0
        for j in range(w):
            x[i, j] += alpha * p[i, j]
            r[i, j] -= alpha * q[i, j]
            total += np.float64(r[i, j]) * np.float64(r[i, j])
        out[i] = total
    return out


def _advance(x: np.ndarray, r: np.ndarray, p: np.ndarray, q: np.ndarray, alpha: np.float32) -> float:
    """x += alpha p, r -= alpha q; returns r.r"""
    return float(_step_rows(x, r, p, q, alpha).sum())


@numba.njit(cache=True, parallel=True)
def _turn(p: np.ndarray, z: np.ndarray, beta: np.float32) -> None:
    """p = z + beta p"""
    h, w = p.shape
    for i in numba.prange(h):
        for j in range(w):
            p[i, j] = z[i, j] + beta * p[i, j]
