"""Nostrils that are hollow: the source's end in a shallow dint just behind their rim.

The vestibule, a passage of about 15 mm, leads up and back behind a person's nostrils; no camera sees its end. The rings
of the cage within the rim move along it, so that the rim stays and what is in it is dark for the reason that it is in
people.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from cage import Cage
from identity import FLIP

BOTTOM = (7153, 7154, 7155, 7156, 7157, 7158)  # the source's vertices at the bottom of the left nostril's dint


@dataclass(frozen=True)
class Section:
    """Where a ring comes to lie: mm `up`, `back` and `aside`, to the septum, of the rim's middle; its extent times
    `wide`, turned by degrees `tilt` from lying flat."""

    up: float
    back: float
    aside: float
    wide: float
    tilt: float


SECTIONS = (Section(11.0, 9.0, 3.5, 3.2, 35.0), Section(7.5, 6.0, 3.0, 2.6, 30.0), Section(2.5, 1.2, 0.5, 1.15, 12.0))
"""Of the bottom, the ring about it and the one about that; the next is the rim."""


def hollowed(mean: np.ndarray, cage: Cage) -> np.ndarray:
    """(c, 3) mm by which the cage's vertices mean (c, 3) move."""
    rows = sp.csr_matrix(cage.matrix)[: cage.skin]
    bottom = np.flatnonzero(np.isin(rows.indices[rows.indptr[:-1]], BOTTOM) & (np.diff(rows.indptr) == 1))
    rings, inside = [bottom], bottom
    for _ in SECTIONS:
        wider = np.unique(cage.quads[np.isin(cage.quads, inside).any(axis=1)])
        rings.append(np.setdiff1d(wider, inside))
        inside = wider
    rim = mean[rings[-1]].mean(axis=0)
    move = np.zeros_like(mean)
    for ring, section in zip(rings, SECTIONS, strict=False):
        offset = (mean[ring] - mean[ring].mean(axis=0)) * section.wide
        c, s = np.cos(np.radians(section.tilt)), np.sin(np.radians(section.tilt))
        offset = offset @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
        move[ring] = rim + (-section.aside, section.up, -section.back) + offset - mean[ring]
    return move + move[cage.mirror[: len(mean)]] * FLIP
