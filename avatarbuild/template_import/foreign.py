"""What a reader hands over: a linear head of any topology, in millimetres, upright and looking along +z."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp

from avatarbuild.errors import InputError

COMPONENTS = 100  # of the identity at most; the rest of a longer basis is finer than the surface fit
_UNITS = {"millimetres": 1.0, "centimetres": 10.0, "metres": 1000.0, "micrometres": 0.001}
_WIDTH = (100.0, 320.0)  # mm from ear to ear, or from shoulder to shoulder of a bust


@dataclass(frozen=True)
class ForeignHead:
    """A linear head that is no Template yet: x(a, w) = mean + sum_k a_k identity_k + sum_j w_j expression_j."""

    name: str
    mean: np.ndarray
    """(v, 3) float mm; x to the subject's left, y up, z out of the face"""
    triangles: np.ndarray
    """(m, 3) int32, of either orientation"""
    skin: np.ndarray
    """(m,) bool: triangles of the outer skin, which the shipped head is wrapped onto"""
    identity: np.ndarray
    """(k, v, 3) float mm per standard deviation"""
    expressions: dict[str, np.ndarray] = field(default_factory=dict)
    """ARKit name -> (v, 3) float mm at weight 1; names that are missing are taken from the shipped head"""


def millimetres(vertices: np.ndarray, source: str) -> float:
    """The factor to millimetres, told from the width of the head: 100–320 mm fits one of mm, cm, m and µm only
    if it is not between two of them.

    Raises:
        InputError: no unit makes this a head.
    """
    width = float(np.ptp(vertices[:, 0]))
    for factor in _UNITS.values():
        if _WIDTH[0] <= width * factor <= _WIDTH[1]:
            return factor
    raise InputError(
        f"{source}: the head is {width:.4g} units wide, which is {_WIDTH[0]:.0f}–{_WIDTH[1]:.0f} mm in none of "
        f"{', '.join(_UNITS)}; scale the model to millimetres"
    )


def _components(vertex_count: int, triangles: np.ndarray) -> np.ndarray:
    """(v,) int: the connected component of every vertex."""
    edges = triangles[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = sp.coo_matrix((np.ones(len(edges)), edges.T), shape=(vertex_count, vertex_count))
    return sp.csgraph.connected_components(graph, directed=False)[1]


def largest_component(vertex_count: int, triangles: np.ndarray) -> np.ndarray:
    """(m,) bool: the triangles of the component with most vertices: the skin, without eyeballs."""
    label = _components(vertex_count, triangles)
    used = np.bincount(label[np.unique(triangles)])
    return label[triangles[:, 0]] == used.argmax()
