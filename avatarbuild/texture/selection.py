"""One photo for every node: the best, in patches as large as the differences between photos allow.

min over labels l of  sum_n D_n(l_n) + sum_nm lambda_nm [l_n != l_m],    D_n(i) = -log(score_in / max_j score_jn),

over the edges nm of the nodes' mesh, which run across the chart's seams. score = cosine^2, resolution, sharpness, share
of unsaturated pixels, agreement with the photos' common colour, and how frontal the photo is where lids, lips and brows
are. Solved by loopy belief propagation (min-sum, synchronous, damped), then by sweeps of single changes.

Sources: Felzenszwalb, Huttenlocher, Efficient belief propagation for early vision, 2006 (the linear-time message);
Lempitsky, Ivanov, Seamless mosaicing of image-based texture maps, 2007 (photos as labels of a surface).
"""

from __future__ import annotations

import numba
import numpy as np

from avatarbuild.texture.observations import Nodes, Observations
from avatarbuild.texture.photos import Photo

_WORST = 8.0  # D of a photo that sees a node as badly as any
_HIDDEN = 40.0  # D of a photo that does not see it
_DAMPING = 0.3
_BRIGHTER, _OTHER = 0.06, 0.12  # of log colour: highlights count more than what is darker
_FRONT = 18.0  # degrees of yaw and pitch at which a photo's score halves on lids, lips and brows


def photo_sharpness(detail: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """
    (p,) sharpness of each photo beside the others on the same nodes, 1 for the median one, from detail (p, n) (log
    contrast) and weight (p, n): medians of d_in - t_n, alternating with t_n.
    """
    use = weight > 0
    level = np.zeros(len(detail))
    d = np.where(use, detail, np.nan)
    known = use.any(axis=1)
    nodes = use.sum(axis=0) >= 3
    if not nodes.any():
        return np.ones(len(detail))
    d = d[:, nodes]
    for _ in range(4):
        centre = np.nanmedian(d - level[:, None], axis=0)
        for i in np.flatnonzero(known):
            off = (d[i] - centre)[use[i][nodes]]
            level[i] = np.median(off) if len(off) else 0.0
        level[known] -= np.median(level[known])
    return np.exp(level)


def scores(
    seen: Observations, photos: list[Photo], nodes: Nodes, excess: np.ndarray, sharpness: np.ndarray, still: np.ndarray
) -> np.ndarray:
    """
    (p, n) float32 >= 0, 0 where a photo does not see a node.

    excess (p, n): log of the photo's colour over the common one; sharpness (p,); still (p,) bool: the photo has the
    common expression.
    """
    value = seen.cosine.astype(np.float32) ** 2
    relative = seen.scale / np.maximum(np.median(seen.scale[seen.scale > 0]) if (seen.scale > 0).any() else 1, 1e-6)
    value *= np.clip(relative, 0.3, 1.6)
    value *= np.clip(sharpness, 0.05, 1.25)[:, None].astype(np.float32) ** 2
    value *= np.clip(1 - 1.5 * seen.clipped, 0.01, 1)
    value *= np.exp(-0.5 * np.where(excess > 0, excess / _BRIGHTER, excess / _OTHER) ** 2).clip(0.02)
    centres = np.array([photo.centre for photo in photos])
    away = np.degrees(np.arccos(np.clip(centres[:, 2] / np.linalg.norm(centres, axis=1), -1, 1)))
    frontal = (0.5 ** ((away / _FRONT) ** 2)).clip(1e-4)[:, None]
    value *= (frontal**nodes.front).astype(np.float32)
    value *= np.where(still, 1.0, 0.05)[:, None].astype(np.float32) ** (0.3 + 0.7 * nodes.front).astype(np.float32)
    return value.astype(np.float32)


def few(score: np.ndarray, area: np.ndarray, most: int, least_gain: float) -> np.ndarray:
    """
    Rows of the photos that serve nearly as well as all: greedily, the one whose addition lowers

    sum_n area_n min(D_n(i), WORST) / sum_n area_n

    most, until it lowers it by less than `least_gain`, or `most` are taken. score (p, n), area (n,) of the nodes.
    """
    data = costs(score)
    known = score.max(axis=0) > 0
    w = np.where(known, area, 0) / max(float(area[known].sum()), 1e-12)
    now = np.full(score.shape[1], 2 * _WORST, np.float32)
    taken: list[int] = []
    data = np.minimum(data, 2 * _WORST)
    while len(taken) < most:
        gain = np.maximum(now - data, 0) @ w
        best = int(np.argmax(gain))
        if gain[best] < least_gain:
            break
        taken.append(best)
        now = np.minimum(now, data[best])
    return np.sort(np.array(taken, int))


def costs(score: np.ndarray) -> np.ndarray:
    """D (p, n) float32 of scores (p, n)."""
    relative = score / np.maximum(score.max(axis=0), 1e-12)
    seen = relative > 0
    data = np.full(score.shape, _HIDDEN, np.float32)
    data[seen] = np.minimum(-np.log(np.maximum(relative[seen], 1e-6)), _WORST)
    return data


def choose(score: np.ndarray, edges: np.ndarray, length: np.ndarray, rounds: int) -> np.ndarray:
    """
    (n,) int16 labels, -1 where no photo sees a node. score (p, n), edges (e, 2), length (e,) = lambda_nm.
    """
    best = score.max(axis=0)
    known = best > 0
    keep = known[edges].all(axis=1)
    data = np.ascontiguousarray(costs(score).T)
    one = edges[keep]
    ends = np.concatenate([one, one[:, ::-1]]).astype(np.int64)  # message k runs from ends[k, 0] to ends[k, 1]
    weight = np.concatenate([length[keep], length[keep]]).astype(np.float32)
    order = np.argsort(ends[:, 1], kind="stable")
    ends, weight = ends[order], weight[order]
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    reverse = place[(order + len(one)) % max(len(order), 1)]
    starts = np.searchsorted(ends[:, 1], np.arange(score.shape[1] + 1))
    messages = np.zeros((len(ends), score.shape[0]), np.float32)
    belief = data.copy()
    for _ in range(rounds):
        _send(belief, messages, ends, weight, reverse)
        _believe(data, messages, starts, belief)
    label = belief.argmin(axis=1)
    for _ in range(8):
        if not _single_changes(label, data, ends, weight, starts):
            break
    return np.where(known, label, -1).astype(np.int16)


@numba.njit(cache=True, parallel=True)
def _send(belief: np.ndarray, messages: np.ndarray, ends: np.ndarray, weight: np.ndarray, reverse: np.ndarray) -> None:
    """m_nm(l) = min(h(l), min h + lambda) - min h,  h = belief_n - m_mn. In place, by pairs."""
    labels = messages.shape[1]
    for k in numba.prange(len(ends)):
        r = reverse[k]
        if k > r:
            continue
        a, b = ends[k, 0], ends[k, 1]
        low_a, low_b = np.float32(1e30), np.float32(1e30)
        for i in range(labels):
            low_a = min(low_a, belief[a, i] - messages[r, i])
            low_b = min(low_b, belief[b, i] - messages[k, i])
        for i in range(labels):
            from_a = min(belief[a, i] - messages[r, i] - low_a, weight[k])
            from_b = min(belief[b, i] - messages[k, i] - low_b, weight[k])
            messages[k, i] += np.float32(1 - _DAMPING) * (from_a - messages[k, i])
            messages[r, i] += np.float32(1 - _DAMPING) * (from_b - messages[r, i])


@numba.njit(cache=True, parallel=True)
def _believe(data: np.ndarray, messages: np.ndarray, starts: np.ndarray, belief: np.ndarray) -> None:
    for n in numba.prange(len(data)):
        for i in range(data.shape[1]):
            total = data[n, i]
            for k in range(starts[n], starts[n + 1]):
                total += messages[k, i]
            belief[n, i] = total


@numba.njit(cache=True)
def _single_changes(
    label: np.ndarray, data: np.ndarray, ends: np.ndarray, weight: np.ndarray, starts: np.ndarray
) -> int:
    changed = 0
    for n in range(len(data)):
        best, best_cost, own_cost = label[n], np.float32(1e30), np.float32(0)
        for i in range(data.shape[1]):
            cost = data[n, i]
            for k in range(starts[n], starts[n + 1]):
                if label[ends[k, 0]] != i:
                    cost += weight[k]
            if i == label[n]:
                own_cost = cost
            if cost < best_cost:
                best, best_cost = i, cost
        if best_cost < own_cost - 1e-6:
            label[n] = best
            changed += 1
    return changed
