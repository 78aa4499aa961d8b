# SPDX-License-Identifier: LGPL-3.0-or-later
r"""An overdamped phason on a square: u rings, ν creeps, with the exact solution.

The antiplane pair of a one-dimensional hexagonal quasicrystal in scaled units, u the phonon and ν
the phason, with a viscosity so large that ν does not oscillate (damping ratio about η/30):

.. math:: \ddot u = A\Delta u + R\Delta\nu, \qquad
          \bar\rho\ddot\nu + \eta\dot\nu = R\Delta u + K\Delta\nu

on the unit square, u = ν = 0 on its boundary, at rest at t = 0. Modes sin jπx sin mπy keep their
shape: the exact solution is a 4 × 4 matrix exponential for each. Rates of ν decay in ρ̄/η, which is
shorter than any step here: a scheme must get through that layer without seeing it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg

import complexbody as cb
from complexbody import meshes

A, K, R = 1.0, 0.6, 0.5
#: Amplitudes of u and ν at t = 0 by mode (j, m).
MODES = {(1, 1): (1.0, 0.5), (2, 1): (-0.3, 0.3), (2, 3): (0.1, 0.1)}

DEFAULTS = {"until": 1.5}


def _shape(j: int, m: int, x: Any) -> Any:
    return (np.sin(j * np.pi * x[0]) * np.sin(m * np.pi * x[1]))[None]


def _start(field: int) -> Any:
    return lambda x: sum(a[field] * _shape(*mode, x) for mode, a in MODES.items())


def scene(
    comm: Any, cells: int = 40, inertia: float = 1.0, viscosity: float = 200.0
) -> cb.Scene:
    """The square.

    Args:
        comm: Communicator.
        cells: Squares per side, each cut into two triangles.
        inertia: ρ̄ of the phason, > 0.
        viscosity: η.
    """

    def energy(U: Any, nu: Any, N: Any) -> Any:
        pairs = [(U[0, i], N[0, i]) for i in range(2)]
        return sum(0.5 * A * a**2 + 0.5 * K * b**2 + R * a * b for a, b in pairs)

    return cb.Scene(
        meshes.rectangle(comm, (0.0, 0.0), (1.0, 1.0), cells),
        cb.Body(1, energy, 1.0, inertia, viscosity=viscosity, displacement=1, name="pair"),
        supports=[cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")],
        initial=cb.Initial(u=_start(0), nu=_start(1)),
        name="overdamped phason on a square",
    )


def exact(t: float, inertia: float = 1.0, viscosity: float = 200.0) -> dict[str, Any]:
    """u, ν and rates at t, as functions of x (3, npts)."""
    found = {}
    for (j, m), start in MODES.items():
        q2 = (j * j + m * m) * np.pi**2
        forces = -q2 * np.array([[A, R], [R / inertia, K / inertia]])
        system = np.block([[np.zeros((2, 2)), np.eye(2)],
                           [forces, -np.diag([0.0, viscosity / inertia])]])  # fmt: skip
        found[j, m] = scipy.linalg.expm(system * t) @ [*start, 0.0, 0.0]

    def field(i: int) -> Any:
        return lambda x: sum(a[i] * _shape(*mode, x) for mode, a in found.items())

    return dict(zip(("u", "nu", "u_dot", "nu_dot"), map(field, range(4)), strict=True))
