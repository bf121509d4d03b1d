"""
Ambient occlusion of a displaced surface in its texture, by the discs that its texels are.

ao(p) = 1 - g sum_{k in S_p} (1 - 1/sqrt(A_k / (pi |v_pk|^2) + 1)) clamp(v_pk . n_p) clamp(-v_pk . n_k)   (15)

with the direction v_pk from p to k and, instead of the mean over S_p, every texel counted by its area A_k, so that no
unit of length enters and, for small discs, each is the share of the sky that it hides. S_p is the whole chart: near
texels count alone, far ones in blocks that grow with the distance. Discs shadow from their fronts: a ray that a closed
surface stops meets a front first and leaves through a back, so that either side may be counted; but a head is open at
the neck and the eyes, and the fronts of a wrinkle's walls are nearer than the backs beyond its ridges.

Source: Bunnell, Dynamic ambient occlusion and indirect lighting, GPU Gems 2, chapter 14, 2005; the partition into
blocks: Greengard, Rokhlin, A fast algorithm for particle simulations, 1987. s texels along a side.
"""

from __future__ import annotations

import numba
import numpy as np

GAIN = 2.0
_NEAR = 2  # blocks on each side that are left to the finer level
_SHARP = 2  # levels of blocks beyond the texels themselves that every texel looks at on its own
_LEAST_SIDE = 16
_ONE, _PI = np.float32(1), np.float32(np.pi)


def ambient_occlusion(
    positions: np.ndarray,
    normals: np.ndarray,
    mask: np.ndarray,
    wanted: np.ndarray | None = None,
    gain: float = GAIN,
) -> np.ndarray:
    """
    (s, s) float32 in [0, 1], 1 open and outside the mask: of positions (s, s, 3) mm with their displacement, unit
    normals (s, s, 3) outward and mask (s, s) bool. s is a multiple of 16. Only the texels of `wanted` (s, s) bool,
    where it is given, are found; the others are 1 as well.
    """
    asked = mask if wanted is None else mask & wanted
    assert mask.shape[0] == mask.shape[1]
    assert mask.shape[0] % _LEAST_SIDE == 0
    place = np.where(mask[..., None], positions, 0).astype(np.float32)
    facing = np.where(mask[..., None], normals, 0).astype(np.float32)
    levels = [(place, facing, np.where(mask, texel_areas(place, mask), 0).astype(np.float32))]
    while levels[-1][2].shape[0] % 2 == 0 and levels[-1][2].shape[0] > _LEAST_SIDE:
        levels.append(_halved(*levels[-1]))
    top = len(levels) - 1
    hidden = np.zeros_like(levels[top][2])
    for at in range(max(top - _SHARP, 0), -1, -1):
        hidden = _doubled(hidden, levels[at][2]) if hidden.shape != levels[at][2].shape else hidden
        first = 0 if at == 0 else at + _SHARP
        for level in range(first, min(at + _SHARP, top) + 1):
            seekers = levels[at][2] if at else np.where(asked, levels[0][2], 0)
            _gather(*levels[at][:2], seekers, *levels[level], level - at, level == 0, level == top, hidden)
    return np.where(asked, np.clip(1 - gain * hidden, 0, 1), 1).astype(np.float32)


def texel_areas(positions: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(s, s) float32 mm^2 that each texel of the mask stands for: |dx/du x dx/dv|, differences within the mask."""
    down, right = (_difference(positions, mask, axis) for axis in (0, 1))
    return np.linalg.norm(np.cross(down, right), axis=-1).astype(np.float32)


def surface_normals(positions: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(s, s, 3) float32 unit dx/du x dx/dv of positions (s, s, 3), row 0 on top (v = 1); (0, 0, 1) where none is."""
    down, right = (_difference(positions, mask, axis) for axis in (0, 1))
    n = np.cross(down, right)
    n = np.where(mask[..., None], n, 0).astype(np.float32)
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    return np.where(length > 1e-12, n / np.maximum(length, 1e-12), np.array([0, 0, 1], np.float32)).astype(np.float32)


def _difference(positions: np.ndarray, mask: np.ndarray, axis: int) -> np.ndarray:
    """(s, s, 3) change of the position from one texel to the next: the mean of those on both sides that are known."""
    step = np.diff(positions, axis=axis)
    both = np.take(mask, np.arange(1, len(mask)), axis) & np.take(mask, np.arange(len(mask) - 1), axis)
    step = np.where(both[..., None], step, 0)
    ends: list[tuple[int, int]] = [(0, 0)] * 3
    before, after = list(ends), list(ends)
    before[axis], after[axis] = (1, 0), (0, 1)
    total = np.pad(step, before) + np.pad(step, after)
    count = np.pad(both, before[:2]).astype(np.float32) + np.pad(both, after[:2])
    return total / np.maximum(count, 1)[..., None]


def _halved(place: np.ndarray, facing: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blocks of 2 x 2: mean place and mean normal (unit), both by area, and the sum of areas."""
    half = area.shape[0] // 2

    def block(x: np.ndarray) -> np.ndarray:
        return x.reshape(half, 2, half, 2, -1).sum(axis=(1, 3), dtype=np.float64)

    total = block(area[..., None])
    known = np.maximum(total, 1e-12)
    normal = block(facing * area[..., None])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    place = block(place * area[..., None]) / known
    return place.astype(np.float32), normal.astype(np.float32), total[..., 0].astype(np.float32)


def _doubled(coarse: np.ndarray, area: np.ndarray) -> np.ndarray:
    """A quantity (h, h) of blocks for the texels of the next finer level, bilinear, zero where area (2h, 2h) is."""
    out = np.zeros_like(area)
    _spread(coarse, area, out)
    return out


@numba.njit(cache=True, parallel=True)
def _spread(coarse: np.ndarray, area: np.ndarray, out: np.ndarray) -> None:
    h = coarse.shape[0]
    for row in numba.prange(2 * h):
        i = row // 2
        near_i = i - 1 if row % 2 == 0 else i + 1
        for column in range(2 * h):
            if area[row, column] <= 0:
                continue
            j = column // 2
            near_j = j - 1 if column % 2 == 0 else j + 1
            total, weight = 0.0, 0.0
            for a in range(2):
                ii = i if a == 0 else near_i
                if ii < 0 or ii >= h:
                    continue
                for b in range(2):
                    jj = j if b == 0 else near_j
                    # blocks without surface hold a negative number
                    if jj < 0 or jj >= h or coarse[ii, jj] < 0:
                        continue
                    w = (0.75 if a == 0 else 0.25) * (0.75 if b == 0 else 0.25)
                    total += w * coarse[ii, jj]
                    weight += w
            out[row, column] = total / weight if weight > 0 else 0.0


@numba.njit(cache=True, parallel=True, error_model="numpy", fastmath={"contract"})
def _gather(
    place: np.ndarray,
    facing: np.ndarray,
    area: np.ndarray,
    far_place: np.ndarray,
    far_facing: np.ndarray,
    far_area: np.ndarray,
    coarser: int,
    finest: bool,
    coarsest: bool,
    hidden: np.ndarray,
) -> None:
    """
    Adds to hidden (h, h) what blocks `coarser` levels above hide of every texel: those whose parents are near its own
    and that are not near themselves; the finest level has the near ones too, the coarsest has all others.
    """
    h, far = area.shape[0], far_area.shape[0]
    for row in numba.prange(h):
        i = row >> coarser
        low_i, high_i = 2 * ((i >> 1) - _NEAR), 2 * ((i >> 1) + _NEAR) + 2
        if coarsest:
            low_i, high_i = 0, far
        low_i, high_i = max(low_i, 0), min(high_i, far)
        for column in range(h):
            if area[row, column] <= 0:
                hidden[row, column] = -1.0
                continue
            j = column >> coarser
            low_j, high_j = 2 * ((j >> 1) - _NEAR), 2 * ((j >> 1) + _NEAR) + 2
            if coarsest:
                low_j, high_j = 0, far
            low_j, high_j = max(low_j, 0), min(high_j, far)
            px, py, pz = place[row, column, 0], place[row, column, 1], place[row, column, 2]
            nx, ny, nz = facing[row, column, 0], facing[row, column, 1], facing[row, column, 2]
            total = np.float32(0)
            for a in range(low_i, high_i):
                near_row = abs(a - i) <= _NEAR
                for b in range(low_j, high_j):
                    if near_row and abs(b - j) <= _NEAR and (not finest or (a == i and b == j)):
                        continue
                    vx, vy, vz = far_place[a, b, 0] - px, far_place[a, b, 1] - py, far_place[a, b, 2] - pz
                    above = vx * nx + vy * ny + vz * nz
                    if above <= 0:
                        continue
                    front = -(vx * far_facing[a, b, 0] + vy * far_facing[a, b, 1] + vz * far_facing[a, b, 2])
                    if front <= 0 or far_area[a, b] <= 0:
                        continue
                    square = vx * vx + vy * vy + vz * vz
                    ratio = far_area[a, b] / (_PI * square)
                    disc = _ONE - _ONE / np.sqrt(ratio + _ONE)
                    total += disc * above * front / square
            hidden[row, column] += total
