"""The photos' colours in the template's UV, with the light still in them, and where each texel lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Fused:
    """
    s texels along a side, row 0 on top (v = 1).

    colour    (s, s, 3) float32 linear light; in charts of parts that no photo shows, whatever stands for them
    seen      (s, s) float32 in [0, 1]: how well the chosen photo sees the texel, 0 where none does
    label     (s, s) int16 row of the chosen photo among the placed ones, -1 for none
    position  (s, s, 3) float32 mm in the head frame, 0 outside the charts
    normal    (s, s, 3) float32 unit, smooth across triangles, 0 outside the charts
    chart     (s, s) bool: the texel's centre lies in a triangle
    part      (s, s) uint8: 0 none, k the k-th part of the template, skin = 1
    low       (s, s, 3) float32 a lower quantile of the colours in all photos that see the texel, after gains; smooth,
              since it is found on a coarser grid; or None
    """

    colour: np.ndarray
    seen: np.ndarray
    label: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    chart: np.ndarray
    part: np.ndarray
    low: np.ndarray | None = None
