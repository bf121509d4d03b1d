"""For every vertex of the head, the piece of the cloud that it belongs to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

NEIGHBOURS = 16  # points that are averaged: takes the cloud's noise down by half and more


@dataclass(frozen=True)
class Target:
    """A cloud ready for queries: points, normals (n, 3), weight (n,) in [0, 1], spacing mm."""

    points: np.ndarray
    normals: np.ndarray
    weight: np.ndarray
    spacing: float
    tree: cKDTree

    @staticmethod
    def of(points: np.ndarray, normals: np.ndarray, weight: np.ndarray) -> Target:
        """points, normals (n, 3), weight (n,): how far each point is to be believed."""
        p = points.astype(np.float64)
        tree = cKDTree(p)
        sample = p[:: max(1, len(p) // 20000)]
        gap = tree.query(sample, k=2, workers=-1)[0][:, 1]
        return Target(p, normals.astype(np.float64), weight.astype(np.float64), float(np.median(gap)), tree)


@dataclass(frozen=True)
class Counterparts:
    """place, normal (n, 3), weight (n,): 0 where the cloud has nothing to say."""

    place: np.ndarray
    normal: np.ndarray
    weight: np.ndarray


def counterparts(
    vertices: np.ndarray, normals: np.ndarray, target: Target, reach: float, least_cosine: float = 0.6
) -> Counterparts:
    """
    The weighted mean p_v, n_v of the cloud's points nearest to each vertex that face alike.

    A vertex counts with Tukey's weight (1 - (d / reach)^2)^2 of its distance d to their plane; none where fewer than a
    third of the points face its way, nor at the border of the cloud, where p_v lies sideways of the vertex.
    """
    gap, near = target.tree.query(vertices, k=NEIGHBOURS, distance_upper_bound=3 * reach, workers=-1)
    found = np.isfinite(gap)
    near = np.where(found, near, 0)
    alike = np.einsum("nkj,nj->nk", target.normals[near], normals)
    # farther neighbours count less, on the scale of the nearest one's distance and the cloud's spacing
    width = gap[:, :1] + 2 * target.spacing
    with np.errstate(invalid="ignore", over="ignore"):
        share = np.where(found & (alike > least_cosine), target.weight[near] * np.exp(-((gap / width) ** 2)), 0.0)
    total = share.sum(axis=1)
    safe = np.maximum(total, 1e-12)[:, None]
    place = np.einsum("nk,nkj->nj", share, target.points[near]) / safe
    normal = np.einsum("nk,nkj->nj", share, target.normals[near])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    offset = vertices - place
    d = np.einsum("nj,nj->n", offset, normal)
    sideways = np.linalg.norm(offset - d[:, None] * normal, axis=1)
    agreeing = (found & (alike > least_cosine)).sum(axis=1) * 3 >= np.maximum(found.sum(axis=1), 1)
    inside = sideways < 3 * target.spacing + 0.15 * np.abs(d)
    weight = np.where(agreeing & inside & (total > 0), np.clip(1 - (d / reach) ** 2, 0, None) ** 2, 0.0)
    belief = np.einsum("nk,nk->n", share, target.weight[near]) / safe[:, 0]
    return Counterparts(place, normal, weight * belief)
