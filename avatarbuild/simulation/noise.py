"""Solid noise: random functions of a point in space, so that textures have no seams and no repeats."""

from __future__ import annotations

import numba
import numpy as np

_LATTICE = 1 << 20  # lattice coordinates are wrapped to stay positive


@numba.njit(cache=True, inline="always")
def _hash(x: int, y: int, z: int, seed: int) -> int:
    """A 32-bit integer hash of a lattice point (multiply and shift, as in Wang 2007)."""
    h = (x * 374761393 + y * 668265263 + z * 2147483647 + seed * 974634721) & 0xFFFFFFFF
    h = ((h ^ (h >> 15)) * 2246822519) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 3266489917) & 0xFFFFFFFF
    return h ^ (h >> 16)


@numba.njit(cache=True, inline="always")
def _slope(h: int, x: float, y: float, z: float) -> float:
    """Dot product with one of the 12 directions to the edges of a cube."""
    k = h & 15
    u = x if k < 8 else y
    v = y if k < 4 else (x if k in (12, 14) else z)
    return (u if (k & 1) == 0 else -u) + (v if (k & 2) == 0 else -v)


@numba.njit(cache=True)
def _gradient_noise(x: float, y: float, z: float, seed: int) -> float:
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = int(fx) + _LATTICE, int(fy) + _LATTICE, int(fz) + _LATTICE
    x, y, z = x - fx, y - fy, z - fz
    u, v, w = (
        x * x * x * (x * (x * 6 - 15) + 10),
        y * y * y * (y * (y * 6 - 15) + 10),
        z * z * z * (z * (z * 6 - 15) + 10),
    )
    total = 0.0
    for c in range(2):
        for b in range(2):
            for a in range(2):
                weight = (u if a else 1 - u) * (v if b else 1 - v) * (w if c else 1 - w)
                total += weight * _slope(_hash(i + a, j + b, k + c, seed), x - a, y - b, z - c)
    return total


@numba.njit(cache=True, parallel=True)
def _fractal(points: np.ndarray, wavelength: float, octaves: int, gain: float, seed: int, out: np.ndarray) -> None:
    for i in numba.prange(len(points)):
        total, amplitude, frequency, power = 0.0, 1.0, 1.0 / wavelength, 0.0
        for octave in range(octaves):
            total += amplitude * _gradient_noise(
                points[i, 0] * frequency, points[i, 1] * frequency, points[i, 2] * frequency, seed + octave
            )
            power += amplitude * amplitude
            amplitude *= gain
            frequency *= 2.03
        out[i] = total / np.sqrt(power) * 3.2


@numba.njit(cache=True, inline="always")
def _beyond(x: float, step: int) -> float:
    """Square of the distance from x in [0, 1] to the cell `step` = -1, 0, 1 away."""
    if step == 0:
        return 0.0
    gap = x if step < 0 else 1.0 - x
    return gap * gap


@numba.njit(cache=True, parallel=True)
def _cells(points: np.ndarray, size: float, seed: int, distance: np.ndarray, label: np.ndarray) -> None:
    for n in numba.prange(len(points)):
        x, y, z = points[n, 0] / size, points[n, 1] / size, points[n, 2] / size
        i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
        best, which = 1e9, 0
        # Own cell first: most of the others then lie farther off than the best point so far.
        for a in (0, -1, 1):
            away_x = _beyond(x - i, a)
            if away_x >= best:
                continue
            for b in (0, -1, 1):
                away_y = away_x + _beyond(y - j, b)
                if away_y >= best:
                    continue
                for c in (0, -1, 1):
                    if away_y + _beyond(z - k, c) >= best:
                        continue
                    h = _hash(i + a + _LATTICE, j + b + _LATTICE, k + c + _LATTICE, seed)
                    g = _hash(h & 0xFFFFF, (h >> 12) & 0xFFFFF, 7, seed + 1)
                    dx = i + a + (h & 1023) / 1023.0 - x
                    dy = j + b + ((h >> 10) & 1023) / 1023.0 - y
                    dz = k + c + (g & 1023) / 1023.0 - z
                    d = dx * dx + dy * dy + dz * dz
                    if d < best:
                        best, which = d, g >> 10
        distance[n] = np.sqrt(best) * size
        label[n] = (which & 0xFFFF) / 65535.0


def fractal(points: np.ndarray, wavelength: float, octaves: int, seed: int, gain: float = 0.55) -> np.ndarray:
    """(…,) float32 about N(0, 1): sum_k gain^k noise(2.03^k x / wavelength), points (…, 3) in the wavelength's unit.

    Source: Perlin, Improving noise, 2002.
    """
    flat = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
    out = np.empty(len(flat), np.float32)
    _fractal(flat, wavelength, octaves, gain, seed, out)
    return out.reshape(points.shape[:-1])


def cells(points: np.ndarray, size: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance (…,) to the nearest of randomly scattered points, about one per cube of edge `size`, and that point's
    own number (…,) in [0, 1]. Source: Worley, A cellular texture basis function, 1996.
    """
    flat = np.ascontiguousarray(points, np.float32).reshape(-1, 3)
    distance, label = np.empty(len(flat), np.float32), np.empty(len(flat), np.float32)
    _cells(flat, size, seed, distance, label)
    return distance.reshape(points.shape[:-1]), label.reshape(points.shape[:-1])


def plane(h: int, w: int, step: float = 1.0) -> np.ndarray:
    """(h, w, 3) float32 points of a plane `step` apart, off the lattice's own planes."""
    y, x = np.meshgrid(np.arange(h, dtype=np.float32), np.arange(w, dtype=np.float32), indexing="ij")
    return np.stack([x * step, y * step, np.full_like(x, 0.37)], axis=-1)
