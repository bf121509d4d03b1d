"""
The video's light: how much comes from each direction, one for the clip, and each frame's exposure.

  s(n) = 4/D sum_d (V_d L_d + (1 - V_d) b) max(n^T d, 0)

over D directions d of the sphere, of which a point of the skin sees those with V_d = 1; L_d >= 0 comes from there, so
that L = 1 from everywhere makes s = 1; b >= 0 is what the skin that is in the way sends instead. The shadow that a nose
throws on a cheek moves with the head, which harmonics of the normal (equation 1) cannot tell from relief.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from scipy.spatial import cKDTree

from avatarbuild.energies import harmonics
from avatarbuild.parallel import each_alone
from avatarbuild.shading.sky import DIRECTIONS
from avatarbuild.shading.surface import Drawn
from avatarbuild.solvers.boxed import boxed

_SETS = 0.14  # sine of what a direction stands for, from its middle: 8 degrees
_ROUNDS = 3
_WIDTH = 0.1  # of the logarithm: beyond it a pixel counts linearly: highlights, what the mesh has wrong
_SMOOTH = 1e-4  # what the Laplacian of L is worth beside the data
_RIDGE = 1e-9
_BRIGHTEST = 1e4
_SWEEPS = 2000
_SATURATED = 0.95
_DARK = 0.02
LEAST = 0.05
"""The least light that reaches any place of the face, as a share of the mean."""
_SOME = 4000  # pixels of a frame


@dataclass(frozen=True)
class Field:
    """What comes from each direction to the pixels `on` (h, w) of a drawn head: come (p, D) float32, 4/D of it."""

    on: np.ndarray
    come: np.ndarray

    def change(self, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """s (h, w) and ds/dn (h, w, 3) at unit normals (h, w, 3); 1 and 0 beside the head."""
        s, slope = np.ones(self.on.shape), np.zeros(normals.shape)
        found = _shine(np.asarray(normals[self.on], np.float64), self.come, DIRECTIONS)
        s[self.on], slope[self.on] = found[:, 0], found[:, 1:]
        return s, slope

    def shade(self, normals: np.ndarray) -> np.ndarray:
        """max(s(n), LEAST): (h, w)."""
        return np.maximum(self.change(normals)[0], LEAST)


@dataclass(frozen=True)
class Light:
    """radiance L (D,), camera axes, and walls b, of a clip; gains (f,) of its frames, their mean logarithm 0."""

    radiance: np.ndarray
    walls: float
    gains: np.ndarray

    def field(self, drawn: Drawn) -> Field:
        """The light on a head."""
        L, share = self.radiance.astype(np.float32), np.float32(4 / len(DIRECTIONS))
        rows, columns = np.nonzero(drawn.on)
        free = drawn.sky_at((rows, columns))
        return Field(drawn.on, share * (np.float32(self.walls) + free * (L - np.float32(self.walls))))

    def shade(self, drawn: Drawn) -> np.ndarray:
        """(h, w) of the drawn head's own normals."""
        return self.field(drawn).shade(drawn.normal)

    def harmonics(self) -> np.ndarray:
        """y (9,) of equation (1) nearest to s where nothing is in the way."""
        facing = _ramp(DIRECTIONS @ DIRECTIONS.T) * (4 / len(DIRECTIONS))
        return np.asarray(np.linalg.lstsq(harmonics.basis(DIRECTIONS), facing @ self.radiance, rcond=None)[0])


def clip_light(frames: list[tuple[Drawn, np.ndarray, np.ndarray]]) -> Light:
    """
    L, b and g minimising sum w rho(log(g e^tone s(n)) - log c) over the face's pixels of all frames, in turns, L
    smooth.

    frames: the drawn head, the picture c (h, w), and what is to be added to its tone (h, w).
    """
    parts = list(each_alone(lambda one: _rows(*one), frames))
    count = len(DIRECTIONS) + 1
    gains, x = np.ones(len(parts)), np.zeros(count)
    for turn in range(_ROUNDS):

        def asked(k: int, now: np.ndarray = x, turn: int = turn, gains: np.ndarray = gains) -> tuple[np.ndarray, ...]:
            rows, tone, grey = parts[k]
            weight = 1 / grey**2
            if turn:
                error = np.log(np.maximum(rows @ now, LEAST) * tone * gains[k] / grey)
                weight = weight * np.minimum(1, _WIDTH / np.maximum(np.abs(error), 1e-9))
            design = rows * (tone * gains[k])[:, None]
            weighted = design * weight[:, None]
            return weighted.T @ design, weighted.T @ grey

        left, right = np.zeros((count, count)), np.zeros(count)
        for A, b in each_alone(asked, range(len(parts))):
            left, right = left + A, right + b
        mean = np.trace(left) / len(DIRECTIONS)
        left[:-1, :-1] += _SMOOTH * mean * _roughness()
        left += _RIDGE * mean * np.eye(count)
        x = boxed(left, right, np.zeros(count), np.full(count, _BRIGHTEST), x, _SWEEPS)
        gains = np.array([_exposure(np.maximum(rows @ x, LEAST) * tone, grey) for rows, tone, grey in parts])
        level = np.exp(np.mean(np.log(gains)))
        x, gains = x * level, gains / level
    return Light(x[:-1], float(x[-1]), gains)


def exposure(light: Light, drawn: Drawn, grey: np.ndarray, more: np.ndarray) -> float:
    """The gain of one more frame under the clip's light."""
    at = np.nonzero(drawn.on & (grey < _SATURATED))
    expected = light.shade(drawn)[at] * np.exp(drawn.tone[at] + more[at])
    return _exposure(expected, np.maximum(grey[at], _DARK))


def _rows(drawn: Drawn, grey: np.ndarray, more: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """s = rows (p, D + 1) (L, b), tone and picture (p,) of some of a frame's pixels."""
    rows, columns = np.nonzero(drawn.on & (grey < _SATURATED))
    step = max(1, len(rows) // _SOME)
    at = rows[::step], columns[::step]
    facing = _ramp(drawn.normal[at] @ DIRECTIONS.T) * (4 / len(DIRECTIONS))
    free = drawn.sky_at(at)
    made = np.concatenate([facing * free, (facing * (1 - free)).sum(axis=1, keepdims=True)], axis=1)
    return made, np.exp(drawn.tone[at] + more[at]).astype(np.float64), np.maximum(grey[at], _DARK)


def _roughness() -> np.ndarray:
    """(D, D) R^T R, R L being what L is beside the mean of its neighbours."""
    neighbours = cKDTree(DIRECTIONS).query(DIRECTIONS, 7)[1][:, 1:]
    R = np.eye(len(DIRECTIONS))
    np.put_along_axis(R, neighbours, -1 / 6, axis=1)
    return R.T @ R


def _exposure(expected: np.ndarray, grey: np.ndarray) -> float:
    return float(np.exp(np.median(np.log(grey / expected)))) if len(grey) else 1.0


def _ramp(cosine: np.ndarray) -> np.ndarray:
    """max(n^T d, 0), the mean over the part of the sphere that d stands for: smooth where it sets."""
    return np.where(np.abs(cosine) < _SETS, (cosine + _SETS) ** 2 / (4 * _SETS), np.maximum(cosine, 0))


@numba.njit(cache=True)
def _shine(normals: np.ndarray, come: np.ndarray, directions: np.ndarray) -> np.ndarray:
    out = np.empty((len(normals), 4))
    for i in range(len(normals)):
        x, y, z = normals[i]
        s = right = down = away = 0.0
        for k in range(len(directions)):
            u, v, w = directions[k]
            cosine = x * u + y * v + z * w
            if cosine > -_SETS:
                up = min((cosine + _SETS) / (2 * _SETS), 1.0)
                s += come[i, k] * (cosine if up == 1.0 else up * up * _SETS)
                share = come[i, k] * up
                right += share * u
                down += share * v
                away += share * w
        out[i] = s, right, down, away
    return out
