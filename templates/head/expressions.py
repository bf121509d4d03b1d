"""The 52 expressions: the Face Units on the cage, made symmetric and cleaned.

Left and right shapes become mirror images of each other's mean, the others symmetric. The neck stays still when the jaw
moves. Creases that come from single displaced vertices are smoothed away. Lids are refitted in `lids`.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from identity import FLIP
from source import Source

SMOOTHED = {"cheekSquintLeft": 6, "cheekSquintRight": 6, "eyeBlinkLeft": 2, "eyeBlinkRight": 2, "mouthFunnel": 2}
SMOOTHED |= {"mouthSmileLeft": 5, "mouthSmileRight": 5, "cheekPuff": 6, "mouthDimpleLeft": 3, "mouthDimpleRight": 3}
STILL_NECK = ("jawOpen", "jawForward", "jawLeft", "jawRight", "mouthClose", "mouthFunnel", "cheekPuff")


def face_units(source: Source, matrix: sp.csr_matrix, mirror: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """(e, c, 3) mm deltas on the cage, symmetric."""
    raw = {name: matrix @ source.units[name] for name in names}
    return np.stack([(raw[name] + raw[other_side(name)][mirror] * FLIP) / 2 for name in names])


def other_side(name: str) -> str:
    """The name of the mirrored shape."""
    if name.endswith("Left"):
        return name[: -len("Left")] + "Right"
    if name.endswith("Right"):
        return name[: -len("Right")] + "Left"
    return name


def clean(
    deltas: np.ndarray, names: tuple[str, ...], quads: np.ndarray, neck: np.ndarray, lips: np.ndarray
) -> np.ndarray:
    """(e, c, 3): smoothed where creased (not on the `lips` (c,) bool), and zero where `neck` (c,) is 1."""
    average = neighbour_mean(quads, deltas.shape[1])
    out = deltas.copy()
    for i, name in enumerate(names):
        keep = lips | (np.abs(deltas[i]).max(axis=1) == 0)
        for _ in range(SMOOTHED.get(name, 0)):
            blended = 0.5 * out[i] + 0.5 * (average @ out[i])
            out[i] = np.where(keep[:, None], out[i], blended)
        if name in STILL_NECK:
            out[i] *= (1 - neck)[:, None]
    return out


def neighbour_mean(quads: np.ndarray, count: int) -> sp.csr_matrix:
    """(count, count) rows average the vertices at the other end of each edge."""
    a = np.concatenate([quads.ravel(), np.roll(quads, -1, axis=1).ravel()])
    b = np.concatenate([np.roll(quads, -1, axis=1).ravel(), quads.ravel()])
    graph = sp.coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)).tocsr()
    graph.data[:] = 1
    degree = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)
    return sp.diags(1 / degree) @ graph
