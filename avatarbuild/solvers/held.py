"""Many right-hand sides of one positive definite system, each with unknowns of its own that are held at zero."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from avatarbuild.solvers.sparse import Factor


def solve_held(
    A: sp.csr_matrix, factor: Factor, b: np.ndarray, free: np.ndarray, tolerance: float, steps: int = 100
) -> np.ndarray:
    """
    x (n, k) with (A x - b)_i = 0 where free_i and x_i = 0 elsewhere, column by column.

    A (n, n), `factor` its factor, b (n, k), free (n, k) bool. Conjugate gradients in every column apart,
    preconditioned by the whole matrix's factor, which is exact where nothing is held; a column leaves when its residual
    in the preconditioner's norm is `tolerance` of b's, or after `steps`.
    """
    x = factor.solve(b)
    goal = tolerance**2 * np.einsum("ik,ik->k", b, x)
    x = np.where(free, x, 0.0)
    columns, mask = np.arange(b.shape[1]), free
    r = np.where(mask, b - A @ x, 0.0)
    z = np.where(mask, factor.solve(r), 0.0)
    p = z.copy()
    rho = np.einsum("ik,ik->k", r, z)
    out = x.copy()
    for _ in range(steps):
        open_ = rho > goal
        if not open_.all():
            out[:, columns] = x
            columns, goal, rho = columns[open_], goal[open_], rho[open_]
            x, r, p, mask = (np.ascontiguousarray(a[:, open_]) for a in (x, r, p, mask))
        if not len(columns):
            break
        q = np.where(mask, A @ p, 0.0)
        step = rho / np.einsum("ik,ik->k", p, q)
        x += step * p
        r -= step * q
        z = np.where(mask, factor.solve(r), 0.0)
        rho, before = np.einsum("ik,ik->k", r, z), rho
        p = z + (rho / before) * p
    out[:, columns] = x
    return out
