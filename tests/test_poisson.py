"""The screened Poisson equation: against a direct solution, by identities, by hand."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as sparse_linear

from avatarbuild.solvers.poisson import Grid, divergence


def pairs_of(mask: np.ndarray) -> np.ndarray:
    n = np.arange(mask.size).reshape(mask.shape)
    right, down = mask[:, :-1] & mask[:, 1:], mask[:-1] & mask[1:]
    across = np.stack([n[:, :-1][right], n[:, 1:][right]], axis=1)
    return np.concatenate([across, np.stack([n[:-1][down], n[1:][down]], axis=1)])


def direct(mask: np.ndarray, screen: float, ties: np.ndarray, b: np.ndarray) -> np.ndarray:
    pairs = np.concatenate([pairs_of(mask), ties])
    rows = np.repeat(np.arange(len(pairs)), 2)
    D = sp.csr_matrix((np.tile([-1.0, 1.0], len(pairs)), (rows, pairs.ravel())), shape=(len(pairs), mask.size))
    A = D.T @ D + screen * sp.identity(mask.size)
    return sparse_linear.spsolve(A.tocsc(), np.where(mask, b, 0).ravel()).reshape(mask.shape)


@pytest.mark.parametrize("screen", [1e-3, 1e-1])
def test_it_solves_what_a_direct_solver_solves(screen: float) -> None:
    rng = np.random.default_rng(5)
    mask = rng.random((23, 31)) > 0.15
    ties = rng.choice(np.flatnonzero(mask), (12, 2), replace=False)
    b = rng.normal(size=mask.shape)
    x, _ = Grid(mask, screen, ties).solve(b, 1e-6, 200)
    wanted = direct(mask, screen, ties, b)
    assert np.abs(x - wanted).max() < 1e-4 * np.abs(wanted).max()
    assert not x[~mask].any()


def test_a_function_is_found_again_from_its_gradients() -> None:
    rng = np.random.default_rng(6)
    mask = np.ones((40, 37), bool)
    mask[10:20, 12:30] = False
    f = rng.normal(size=mask.shape) * mask
    pairs = pairs_of(mask)
    b = divergence(pairs, f.ravel()[pairs[:, 1]] - f.ravel()[pairs[:, 0]], mask.shape) + 0.01 * f
    x, _ = Grid(mask, 0.01).solve(b, 1e-6, 200)
    assert np.abs(x - f)[mask].max() < 1e-3


def test_few_steps_are_enough_whatever_the_size() -> None:
    for side in (64, 512):
        y, x = np.mgrid[:side, :side]
        mask = (y - side / 2) ** 2 + (x - side / 2) ** 2 < (0.48 * side) ** 2
        pairs = pairs_of(mask)
        label = (x // (side // 5)).ravel()
        border = pairs[label[pairs[:, 0]] != label[pairs[:, 1]]]
        grid = Grid(mask, (20 / side) ** 2)
        _, steps = grid.solve(divergence(border, np.ones(len(border)), mask.shape), 1e-3)
        assert steps <= 10


def test_a_tie_makes_neighbours_of_texels_far_apart() -> None:
    mask = np.ones((1, 9), bool)
    mask[0, 4] = False  # two islands, tied at their far ends
    ties = np.array([[0, 8]])
    step = divergence(ties, np.array([1.0]), mask.shape)
    x, _ = Grid(mask, 1e-4, ties).solve(step, 1e-7, 100)
    assert x[0, 8] - x[0, 0] == pytest.approx(1.0, abs=2e-3)
    assert x[0, :4] == pytest.approx(np.full(4, -0.5), abs=2e-3)


def test_it_repeats_bit_for_bit_whatever_the_threads() -> None:
    import numba

    rng = np.random.default_rng(7)
    mask = rng.random((130, 140)) > 0.1
    ties = rng.choice(np.flatnonzero(mask), (30, 2), replace=False)
    b = rng.normal(size=mask.shape)
    first, _ = Grid(mask, 1e-3, ties).solve(b)
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    again, _ = Grid(mask, 1e-3, ties).solve(b)
    numba.set_num_threads(before)
    assert np.array_equal(first, again)
