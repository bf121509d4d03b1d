"""Where the parts sit: teeth, gums and tongue in the mouth, as affine frames that follow identity and jaw.

Each moving piece hangs on four control points (an affine frame), so that a piece of any size needs four vertices of the
cage. The source's own rough teeth and tongue, which its targets move, guide the frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from parts import fit_rigid

INCISORS = np.array([0.0, -1.2, 0.3])  # mm from the front of the guide's upper edge to the upper incisors' edge
FRAME = 40.0  # mm from a frame's origin to its other control points


@dataclass(frozen=True)
class Frame:
    """Control points (4, 3) mm of the mean and their deltas: identity (p, 4, 3), expressions (e, 4, 3)."""

    points: np.ndarray
    identity: np.ndarray
    expressions: np.ndarray

    def weights(self, vertices: np.ndarray) -> np.ndarray:
        """(n, 4) affine weights of vertices (n, 3): they reproduce each vertex and sum to 1."""
        system = np.concatenate([self.points.T, np.ones((1, 4))])
        return np.linalg.solve(system, np.concatenate([vertices.T, np.ones((1, len(vertices)))])).T


def guided_frame(guide: np.ndarray, identity: np.ndarray, expressions: np.ndarray) -> Frame:
    """A frame around the guide's vertices (g, 3): affine in identity (p, g, 3), rigid in expressions (e, g, 3)."""
    origin = guide.mean(axis=0)
    points = origin + FRAME * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    centred = guide - origin
    # a light pull to a plain shift keeps directions that the guide hardly shows from running away
    system = np.concatenate(
        [np.concatenate([centred, np.ones((len(guide), 1))], axis=1), np.diag([9.0, 9.0, 9.0, 0.0])]
    )
    solve = np.linalg.pinv(system)[:, : len(guide)]
    at = np.concatenate([points - origin, np.ones((4, 1))], axis=1)
    moved = np.einsum("ij,jg,pgx->pix", at, solve, identity)
    posed = np.zeros((len(expressions), 4, 3))
    for i, delta in enumerate(expressions):
        if np.abs(delta).max() > 1e-3:
            posed[i] = fit_rigid(guide, guide + delta).displacement(points)
    return Frame(points, moved, posed)


def shifted_frame(centre: np.ndarray, basis: np.ndarray, expressions: int) -> Frame:
    """A frame that only shifts: centre (3,), identity basis (p, 3); still in every expression."""
    points = centre + FRAME * np.concatenate([np.zeros((1, 3)), np.eye(3)])
    return Frame(points, np.repeat(basis[:, None], 4, axis=1), np.zeros((expressions, 4, 3)))


def gather(pieces: list[tuple], rows: int, columns: int) -> sp.csr_matrix:
    """(rows, columns) sparse sum of pieces (row numbers or the first row, first column, matrix)."""
    i, j, values = [], [], []
    for row, column, matrix in pieces:
        m = sp.coo_matrix(matrix)
        i.append(m.row + row if np.isscalar(row) else np.asarray(row)[m.row])
        j.append(m.col + column)
        values.append(m.data)
    return sp.csr_matrix((np.concatenate(values), (np.concatenate(i), np.concatenate(j))), shape=(rows, columns))
