"""Thin-shell non-rigid registration: every vertex of the skin free, held to the morphable model by a thin shell.

min_X  sum_v a_v w_v ( n_v^T (x_v - p_v) )^2  +  sum_c || B_c X - m_c ||^2_{H_c}  +  E_shell(X; model)

with a_v vertex areas, w_v robust weights of the cloud, B_c barycentric rows of landmarks and rims, E_shell of
energies/thin_shell.py. Weights anneal from stiff to soft. Source: method, section 2 (b).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from avatarbuild.energies.thin_shell import ThinShell
from avatarbuild.geometry import meshes
from avatarbuild.registration.counterparts import Counterparts, Target, counterparts
from avatarbuild.solvers.sparse import Factor, conjugate_gradients

_STEPS, _TOLERANCE = 60, 1e-4  # of conjugate gradients a round


@dataclass(frozen=True)
class Stiffness:
    """One line of the schedule: stretching (mm^2), bending (mm^4), reach of the cloud (mm), rounds."""

    stretching: float
    bending: float
    reach: float
    rounds: int


@dataclass(frozen=True)
class Pins:
    """Points on the surface that are drawn to places: rows (c, n) sparse, places (c, 3), stiffness (c, 3, 3) mm^0."""

    rows: sp.csr_matrix
    places: np.ndarray
    stiffness: np.ndarray


def register(
    model: np.ndarray,
    triangles: np.ndarray,
    target: Target,
    trust: np.ndarray,
    pins: Pins,
    schedule: list[Stiffness],
    told: Callable[[], object],
) -> tuple[np.ndarray, Counterparts]:
    """
    The registered skin (n, 3) and what the cloud said of it in the last round.

    model (n, 3) the rest shape and the start, triangles (m, 3), trust (n,) in [0, 1]: how far each vertex may listen to
    the cloud. `told` is called after every round.
    """
    shell = ThinShell.of(model, triangles)
    x = model.copy()
    pull = np.einsum("cii->c", pins.stiffness) / 3
    drawn = pins.rows.T @ sp.diags(pull) @ pins.rows
    to_places = pins.rows.T @ np.einsum("cij,cj->ci", pins.stiffness, pins.places)
    found = Counterparts(x, x, np.zeros(len(x)))
    for line in schedule:
        elastic = shell.matrix(line.stretching, line.bending)
        for round_ in range(line.rounds):
            normals = meshes.vertex_normals(x, triangles)
            found = counterparts(x, normals, target, line.reach)
            weight = shell.areas * trust * found.weight
            if round_ == 0:
                factor = Factor(elastic + drawn + sp.diags(weight + 1e-6 * shell.areas))

            def apply(v: np.ndarray) -> np.ndarray:
                across = np.einsum("ni,ni->n", found.normal, v)  # noqa: B023
                pinned = np.einsum("cij,cj->ci", pins.stiffness, pins.rows @ v)
                return elastic @ v + (weight * across)[:, None] * found.normal + pins.rows.T @ pinned  # noqa: B023

            across = np.einsum("ni,ni->n", found.normal, found.place)
            b = shell.right_side(shell.rotations(x), line.stretching, line.bending)
            b += (weight * across)[:, None] * found.normal + to_places
            x = conjugate_gradients(apply, b, x, factor.solve, _STEPS, _TOLERANCE)
            told()
    return x, found
