"""Sparse solvers: against dense algebra, and bit for bit again."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from avatarbuild.solvers.sparse import Factor, conjugate_gradients


def system(n: int = 300) -> tuple[sp.csc_matrix, np.ndarray]:
    rng = np.random.default_rng(5)
    B = sp.random(n, n, 0.02, random_state=rng, format="csr")
    A = (B @ B.T + sp.identity(n)).tocsc()
    return A, rng.standard_normal((n, 100))


def test_a_factor_solves() -> None:
    A, b = system()
    x = Factor(A).solve(b)
    assert np.abs(A @ x - b).max() < 1e-9
    assert np.array_equal(x, Factor(A).solve(b))
    assert np.allclose(Factor(A).solve(b[:, 0]), x[:, 0])


def test_a_matrix_that_is_not_definite_is_refused() -> None:
    with pytest.raises(ArithmeticError):
        Factor(sp.diags([1.0, -1.0, 2.0]).tocsc())


def test_conjugate_gradients_solve_with_a_rough_preconditioner() -> None:
    A, b = system()
    near = Factor(A + 0.1 * sp.identity(A.shape[0]))
    x = conjugate_gradients(lambda v: A @ v, b, np.zeros_like(b), near.solve, steps=60, tolerance=1e-12)
    assert np.abs(A @ x - b).max() < 1e-8
