# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Elastic material with voids: displacement u, descriptor ν the change of the volume fraction.

.. math:: \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2 + \mu|\varepsilon|^2
          + \tfrac12\alpha|\nabla\nu|^2 + \tfrac12\xi\nu^2 + b\nu\,\mathrm{tr}\,\varepsilon,
          \qquad \chi = \tfrac12\bar\rho\dot\nu^2.

Coercive iff μ, α, ξ > 0 and (λ + 2μ/3)ξ > b². The void's own frequency √(ξ/ρ̄) does not depend on
the mesh: with the constants of magnesium it is 6.95e10 rad/s, thousands of times what waves across
a millimetre need; a scene with ``self_action="implicit"`` steps over it. Sources (constants
recalled, not re-read: (r)): Nunziato and Cowin 1979; Cowin and Nunziato 1983.
"""

from __future__ import annotations

import math
from typing import Any

import ufl

from complexbody.body import Body
from complexbody.forms._admissible import finite, require, require_positive


def elastic_voids(
    lambda_: float = 2.17e10,
    mu: float = 3.278e10,
    alpha: float = 3.688e-5,
    xi: float = 1.475e10,
    b: float = 1.13849e10,
    density: float = 1740.0,
    inertia: float = 1740.0 * 1.753e-15,
    viscosity: float = 0.0,
    d: int = 3,
    name: str = "material with voids",
) -> Body:
    """Material with voids (``displacement=d``, ``descriptor=1``); the defaults are magnesium's (r).

    Args:
        lambda_: λ [Pa].
        mu: μ [Pa].
        alpha: α [N], of the gradient of ν.
        xi: ξ [Pa], of ν.
        b: b [Pa], coupling of ν to the volume strain.
        density: ρ [kg/m³].
        inertia: ρ̄ [kg/m].
        viscosity: η [Pa·s].
        d: Number of components of u, 1 to 3; at least the dimension of the mesh.
        name: What to call it.

    Raises:
        CoercivityError: unless μ, α, ξ > 0 and (λ + 2μ/3)ξ > b².
        BodyError: for constants that are not finite numbers, or masses no body can have.
    """
    family = "elastic_voids"
    constants = finite(family, {"lambda_": lambda_, "mu": mu, "alpha": alpha, "xi": xi, "b": b})
    require_positive(family, constants, ("mu", "alpha", "xi"))
    bulk = lambda_ + 2 * mu / 3
    remedy = f"Choose |b| < {math.sqrt(max(bulk * xi, 0.0)):.9g}, or a larger xi."
    require(family, "(lambda_ + 2*mu/3)*xi > b**2", bulk * xi, b**2, remedy)

    def energy(U: Any, nu: Any, N: Any) -> Any:
        # A missing component of u does not move; missing columns of U are zero.
        full = ufl.as_tensor([[U[i, j] if i < d else 0.0 for j in range(3)] for i in range(3)])
        strain = ufl.sym(full)
        trace = ufl.tr(strain)
        own = 0.5 * lambda_ * trace**2 + mu * ufl.inner(strain, strain)
        void = 0.5 * alpha * ufl.inner(N, N) + 0.5 * xi * nu[0] ** 2
        return own + void + b * nu[0] * trace

    return Body(
        1, energy, density, inertia, viscosity, displacement=d, name=name, constants=constants,
        parity="even",
    )  # fmt: skip
