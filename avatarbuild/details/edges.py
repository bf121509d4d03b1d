"""The feature edges of a face and their strain: what the details of an expression depend on."""

from __future__ import annotations

import numpy as np

from avatarbuild.template import Template

# Landmarks on the subject's right side; each pair has a mirrored one.
_PAIRS = (
    *((109, 107), (67, 66), (103, 105), (54, 70)),  # hairline to brow
    *((55, 6), (105, 159), (70, 33)),  # brow to the root of the nose, to the lid, to the corner of the eye
    *((159, 145), (145, 101), (33, 117), (33, 123)),  # the lids; lower lid and corner of the eye to the cheek
    *((133, 129), (4, 129)),  # wing of the nose to the inner corner of the eye, to the tip
    *((129, 61), (50, 61), (187, 61)),  # corner of the mouth to wing and cheek
    *((61, 0), (61, 17), (98, 37), (61, 149)),  # lips; wing to upper lip; corner of the mouth to the jaw
)
_ACROSS = (107, 61)  # to their own mirror image: between the brows, from one corner of the mouth to the other
_MIDDLE = ((0, 17), (17, 199))  # over the mouth, from the lower lip to the chin


def feature_edges(template: Template) -> np.ndarray:
    """
    (44, 2) int64 vertices e1, e2 of E: those nearest to pairs of landmarks of the face, right and left in turn, then
    those of the middle. Symmetric: `template.symmetry` takes an edge of the right to the next one.
    """
    corner = template.landmark_barycentric.argmax(axis=1)
    vertex = template.triangles[template.landmark_triangles, corner].astype(np.int64)
    right = vertex[np.array(_PAIRS)]
    sides = np.stack([right, template.symmetry[right]], axis=1).reshape(-1, 2)
    across = vertex[np.array(_ACROSS)]
    return np.concatenate([sides, np.stack([across, template.symmetry[across]], axis=1), vertex[np.array(_MIDDLE)]])


def lengths(vertices: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """|e1 - e2|: (…, e) mm of edges (e, 2) on vertices (…, n, 3)."""
    x = np.asarray(vertices, np.float64)
    return np.linalg.norm(x[..., edges[:, 0], :] - x[..., edges[:, 1], :], axis=-1)


def strain(vertices: np.ndarray, rest: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """f_e = (|e1 - e2| - l_e) / l_e: (…, e) of vertices (…, n, 3), rest lengths l (e,) mm."""
    return (lengths(vertices, edges) - rest) / rest
