"""Clean-up of point clouds."""

from __future__ import annotations

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree


def nearest_distance(points: np.ndarray) -> np.ndarray:
    """(n,) distance of each point to its nearest neighbour."""
    return cKDTree(points).query(points, 2, workers=-1)[0][:, 1]


def lonely(points: np.ndarray, neighbours: int = 12, deviations: float = 4.0) -> np.ndarray:
    """
    (n,) bool: points whose mean distance to their nearest `neighbours` is beyond the usual one.

    The usual one is robust: median + `deviations` * 1.4826 * median absolute deviation, this at least a quarter of the
    median, as of points in a regular grid.
    """
    if len(points) <= neighbours:
        return np.zeros(len(points), bool)
    distance, _ = cKDTree(points).query(points, neighbours + 1, workers=-1)
    mean = distance[:, 1:].mean(axis=1)
    middle = np.median(mean)
    return mean > middle + deviations * max(1.4826 * np.median(np.abs(mean - middle)), 0.25 * middle)


def small_pieces(points: np.ndarray, gap: float, least: int) -> np.ndarray:
    """(n,) bool: points of pieces of fewer than `least` points; two pieces are more than about `gap` apart."""
    cells, cell = np.unique(np.floor(points / gap).astype(np.int64), axis=0, return_inverse=True)
    pairs = cKDTree(cells).query_pairs(1.8, output_type="ndarray")  # the 26 cells around
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (len(cells), len(cells)))
    piece = connected_components(graph, directed=False)[1][cell.ravel()]
    return np.bincount(piece)[piece] < least


def within_outlines(
    points: np.ndarray, normals: np.ndarray, P: list[np.ndarray], centres: np.ndarray, outlines: list[list[np.ndarray]]
) -> np.ndarray:
    """
    (n,) bool: points that lie within the outlines in most of the photos that they face.

    P: projections (3, 4) of the photos; centres (k, 3) of their cameras; outlines: a photo's polygons (m, 2), pixels.
    """
    inside = np.zeros(len(points), np.int32)
    facing = np.zeros(len(points), np.int32)
    for Pi, centre, polygons in zip(P, centres, outlines):
        to = centre - points
        front = (normals * to).sum(axis=1) > 0.3 * np.linalg.norm(to, axis=1)
        h = points @ Pi[:, :3].T + Pi[:, 3]
        at = h[:, :2] / np.where(h[:, 2:] > 0, h[:, 2:], np.nan)
        facing += front
        for polygon in polygons:
            low, high = polygon.min(axis=0), polygon.max(axis=0)
            with np.errstate(invalid="ignore"):
                near = np.flatnonzero(front & (at > low).all(axis=1) & (at < high).all(axis=1))
            outline = polygon.astype(np.float32)
            hit = [cv2.pointPolygonTest(outline, (float(x), float(y)), False) >= 0 for x, y in at[near]]
            inside[near[np.array(hit, bool)]] += 1
    return (facing > 0) & (2 * inside > facing)
