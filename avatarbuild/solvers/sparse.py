"""Sparse symmetric positive definite systems: factored once and used often, and conjugate gradients on top."""

from __future__ import annotations

from collections.abc import Callable

import cholespy
import numpy as np
import scipy.sparse as sp


class Factor:
    """
    The Cholesky factor of a sparse symmetric positive definite matrix: A = L L^T, ordered by nested dissection.

    Repeats bit for bit. Raises ArithmeticError where A is not positive definite.
    """

    def __init__(self, A: sp.spmatrix) -> None:
        matrix = sp.csc_matrix(A)
        matrix.sort_indices()
        self._n = matrix.shape[0]
        start, row = matrix.indptr.astype(np.int32), matrix.indices.astype(np.int32)
        data = matrix.data.astype(np.float64)
        try:
            self._solver = cholespy.CholeskySolverD(self._n, start, row, data, cholespy.MatrixType.CSC)
        except ValueError as error:
            raise ArithmeticError(f"the matrix is not positive definite: {error}") from None

    def solve(self, b: np.ndarray) -> np.ndarray:
        """x (n,) or (n, k) with A x = b."""
        flat = np.ascontiguousarray(b, np.float64).reshape(self._n, -1)
        x = np.zeros_like(flat)
        for first in range(0, flat.shape[1], 96):  # the solver's right-hand sides are limited in number
            part = np.ascontiguousarray(flat[:, first : first + 96])
            out = np.zeros_like(part)
            self._solver.solve(part, out)
            x[:, first : first + 96] = out
        return x.reshape(b.shape)


def conjugate_gradients(
    apply: Callable[[np.ndarray], np.ndarray],
    b: np.ndarray,
    x: np.ndarray,
    precondition: Callable[[np.ndarray], np.ndarray],
    steps: int,
    tolerance: float,
) -> np.ndarray:
    """
    x with A x = b for a symmetric positive definite A known by `apply`, from the start x, by preconditioned conjugate
    gradients: at most `steps` of them, until ||r||_M^-1 <= tolerance ||b||_M^-1.

    b, x: arrays of one shape, whatever it is. Source: Hestenes and Stiefel 1952.
    """
    r = b - apply(x)
    z = precondition(r)
    p = z.copy()
    rho = float(np.vdot(r, z))
    goal = tolerance**2 * float(np.vdot(b, precondition(b)))
    for _ in range(steps):
        if rho <= goal:
            break
        q = apply(p)
        step = rho / float(np.vdot(p, q))
        x = x + step * p
        r = r - step * q
        z = precondition(r)
        rho, before = float(np.vdot(r, z)), rho
        p = z + (rho / before) * p
    return x
