# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A uniform bar that rings: a scalar pair of u and ν, coupled, with its exact solution.

.. math:: \rho e = \tfrac12 A u'^2 + \tfrac12 K\nu'^2 + R\,u'\nu' + \tfrac12 k_0\nu^2, \qquad
          \ddot u = Au'' + R\nu'', \quad
          \ddot\nu + \eta\dot\nu = Ru'' + K\nu'' - k_0\nu

on (0, 1), u = ν = 0 at both ends, at rest at t = 0. Each sin jπx keeps its shape, so that the
amplitudes (u, ν, u̇, ν̇) of each mode are a 4 × 4 matrix exponential of t. A uniform mesh: there is
nothing to gain by local steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg

import complexbody as cb
from complexbody import meshes

A, K, R, K0, ETA = 1.0, 0.6, 0.3, 3.0, 0.2
#: Amplitudes of u and ν at t = 0 by mode: a hump that is not one mode alone.
MODES = {1: (1.0, 0.5), 2: (-0.4, 0.2), 3: (0.2, 0.0)}

DEFAULTS = {"until": 2.0}


def hump(field: int) -> Any:
    """Initial values of u (0) or ν (1) at points x (3, npts)."""
    return lambda x: sum(a[field] * np.sin(j * np.pi * x[:1]) for j, a in MODES.items())


def scene(comm: Any, cells: int = 100) -> cb.Scene:
    """The bar.

    Args:
        comm: Communicator.
        cells: Number of cells.
    """

    def energy(U: Any, nu: Any, N: Any) -> Any:
        a, b = U[0, 0], N[0, 0]
        return 0.5 * A * a**2 + 0.5 * K * b**2 + R * a * b + 0.5 * K0 * nu[0] ** 2

    return cb.Scene(
        meshes.interval(comm, 0.0, 1.0, cells),
        cb.Body(1, energy, 1.0, 1.0, viscosity=ETA, displacement=1, name="pair"),
        supports=[cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")],
        initial=cb.Initial(u=hump(0), nu=hump(1)),
        name="uniform bar, a coupled pair",
    )


def exact(t: float) -> dict[str, Any]:
    """u, ν and rates at t, as functions of x (3, npts)."""
    found = {}
    for j, start in MODES.items():
        q2 = (j * np.pi) ** 2
        stiffness = np.array([[A * q2, R * q2], [R * q2, K * q2 + K0]])
        system = np.block([[np.zeros((2, 2)), np.eye(2)], [-stiffness, -np.diag([0.0, ETA])]])
        found[j] = scipy.linalg.expm(system * t) @ [*start, 0.0, 0.0]

    def field(i: int) -> Any:
        return lambda x: sum(a[i] * np.sin(j * np.pi * x[:1]) for j, a in found.items())

    return dict(zip(("u", "nu", "u_dot", "nu_dot"), map(field, range(4)), strict=True))
