"""Compiled loops of the synthesis: sums and small systems of many texels at once.

Everywhere: flat (t,) indices into maps of all texels; corners (t, 3) into phi (u, k) and barycentric (t, 3): the
distances to the keyframes are linear over a triangle; four layers; terms = k + 1, the first one constant. Blocks of
texels belong to one thread each and add up in their order: everything repeats bit for bit.
"""

from __future__ import annotations

import numba
import numpy as np

_BLOCK = 4096  # texels


@numba.njit(cache=True, nogil=True, parallel=True)
def evaluate(
    flat: np.ndarray,
    corners: np.ndarray,
    barycentric: np.ndarray,
    phi: np.ndarray,
    weights: np.ndarray,
    out: np.ndarray,
) -> None:
    """out[flat] = l_0 + sum_k eta_k phi_k of weights (t, terms, 4), normal made unit, occlusion held in [0, 1]."""
    keys = phi.shape[1]
    for texel in numba.prange(len(flat)):
        a, b, c = corners[texel, 0], corners[texel, 1], corners[texel, 2]
        wa, wb, wc = barycentric[texel, 0], barycentric[texel, 1], barycentric[texel, 2]
        x, y = weights[texel, 0, 0], weights[texel, 0, 1]
        z, o = weights[texel, 0, 2], weights[texel, 0, 3]
        for k in range(keys):
            p = wa * phi[a, k] + wb * phi[b, k] + wc * phi[c, k]
            x += p * weights[texel, k + 1, 0]
            y += p * weights[texel, k + 1, 1]
            z += p * weights[texel, k + 1, 2]
            o += p * weights[texel, k + 1, 3]
        length = max(np.sqrt(x * x + y * y + z * z), np.float32(1e-6))
        at = flat[texel]
        out[at, 0], out[at, 1], out[at, 2] = x / length, y / length, z / length
        out[at, 3] = min(max(o, np.float32(0)), np.float32(1))


@numba.njit(cache=True, nogil=True, parallel=True)
def gather(
    flat: np.ndarray,
    corners: np.ndarray,
    barycentric: np.ndarray,
    phi: np.ndarray,
    maps: np.ndarray,
    sure: np.ndarray,
    left: np.ndarray,
    right: np.ndarray,
) -> None:
    """
    One frame's share of the normal equations: left (t, terms (terms + 1) / 2) += c v v^T, its lower triangle row by
    row, right (t, terms, 4) += c v l^T, with v = (1, phi_1 … phi_k), maps (s s, 4), confidence sure (s s,).
    """
    keys = phi.shape[1]
    for block in numba.prange((len(flat) + _BLOCK - 1) // _BLOCK):
        v = np.empty(keys + 1)
        for texel in range(block * _BLOCK, min((block + 1) * _BLOCK, len(flat))):
            at = flat[texel]
            c = sure[at]
            if c <= 0:
                continue
            v[0] = 1.0
            for k in range(keys):
                v[k + 1] = 0.0
                for i in range(3):
                    v[k + 1] += barycentric[texel, i] * phi[corners[texel, i], k]
            place = 0
            for i in range(keys + 1):
                cv = c * v[i]
                for j in range(i + 1):
                    left[texel, place] += cv * v[j]
                    place += 1
                for layer in range(4):
                    right[texel, i, layer] += cv * maps[at, layer]


@numba.njit(cache=True, nogil=True, parallel=True)
def solve(left: np.ndarray, right: np.ndarray, prior: np.ndarray, weights: np.ndarray) -> None:
    """
    weights (t, terms, 4) = (left + diag(prior))^-1 (right + prior_0 e_0 (0, 0, 1, 1)^T), by Cholesky: the prior draws
    eta to nil and l_0 to flat, open skin.
    """
    terms = len(prior)
    for block in numba.prange((len(left) + _BLOCK - 1) // _BLOCK):
        a, b = np.empty((terms, terms)), np.empty((terms, 4))
        for texel in range(block * _BLOCK, min((block + 1) * _BLOCK, len(left))):
            place = 0
            for i in range(terms):
                for j in range(i + 1):
                    a[i, j] = left[texel, place]
                    place += 1
                a[i, i] += prior[i]
                for layer in range(4):
                    b[i, layer] = right[texel, i, layer]
            b[0, 2] += prior[0]
            b[0, 3] += prior[0]
            for i in range(terms):
                for j in range(i + 1):
                    total = a[i, j]
                    for k in range(j):
                        total -= a[i, k] * a[j, k]
                    a[i, j] = np.sqrt(max(total, 1e-30)) if i == j else total / a[j, j]
                for layer in range(4):
                    total = b[i, layer]
                    for k in range(i):
                        total -= a[i, k] * b[k, layer]
                    b[i, layer] = total / a[i, i]
            for i in range(terms - 1, -1, -1):
                for layer in range(4):
                    total = b[i, layer]
                    for k in range(i + 1, terms):
                        total -= a[k, i] * b[k, layer]
                    b[i, layer] = total / a[i, i]
                    weights[texel, i, layer] = b[i, layer]


@numba.njit(cache=True, nogil=True, parallel=True)
def misfit(
    flat: np.ndarray,
    corners: np.ndarray,
    barycentric: np.ndarray,
    phi: np.ndarray,
    weights: np.ndarray,
    maps: np.ndarray,
    sure: np.ndarray,
) -> np.ndarray:
    """(blocks,) parts of sum_t c |l - l_0 - sum_k eta_k phi_k|^2 over the texels of one frame."""
    keys = phi.shape[1]
    blocks = (len(flat) + _BLOCK - 1) // _BLOCK
    out = np.zeros(blocks)
    for block in numba.prange(blocks):
        total = 0.0
        for texel in range(block * _BLOCK, min((block + 1) * _BLOCK, len(flat))):
            at = flat[texel]
            if sure[at] <= 0:
                continue
            square = 0.0
            for layer in range(4):
                apart = maps[at, layer] - weights[texel, 0, layer]
                for k in range(keys):
                    p = 0.0
                    for i in range(3):
                        p += barycentric[texel, i] * phi[corners[texel, i], k]
                    apart -= p * weights[texel, k + 1, layer]
                square += apart * apart
            total += sure[at] * square
        out[block] = total
    return out
