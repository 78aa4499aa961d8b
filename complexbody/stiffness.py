# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Stiff self-action: the node-local implicit midpoint, as an inertia that grows with the step.

The self-action ½ν·Sν, lumped at the nodes, may be thousands of times faster than waves across a
cell. Its implicit midpoint within kick–drift–kick is leapfrog with the inertia Ω + h²S/4 and the
total force at x_n,

.. math:: (M + \tfrac{h^2}{4}S)\,\delta^2x_n = -h^2Kx_n,

stable iff 4M + h²S − h²K ≻ 0: S drops out of K. What stays is the coupling of ν to gradients
(bν tr ε of voids), which with a tiny inertia would limit the step to a fraction of the gradients'
own. For coercive energies K ⪯ (1+δ)K_∇ + (1+1/δ)S (Young), so (1+1/δ)S in the place of S leaves the
gradient step but for a factor 1/√(1+δ): δ = 0.21 costs a tenth. Slow motions see an error of
(1+1/δ)(ωh)²/4. Where cells have their own steps each node has its own h
(:mod:`complexbody.integrators.stiffened`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.errors import IntegratorError
from complexbody.masses import pencil_basis
from complexbody.scene import Scene

Array = npt.NDArray[np.float64]

#: δ of Young's inequality above: what coupling may cost of the gradient step, squared.
DELTA = 0.21


def self_stiffness(scene: Scene, densities: Any) -> Array:
    """S per body, shape (bodies, k, k), such that the inertia Ω + h²S/4 takes the self-action in.

    It dominates ∂²(ρe + ρw)/∂ν∂ν (times 1 + 1/δ where ν couples to anything else), and is diagonal
    in the basis in which inertia and viscosity are: there, a sum of magnitudes by row.

    Raises:
        IntegratorError: where the self-action varies within a body.
    """
    n, n_u, k = scene.components, scene.displacement, scene.descriptor
    out = np.zeros((len(scene.bodies), k, k))
    first = 3 * n + n_u
    for r, body in enumerate(scene.bodies):
        coupled, S = False, np.zeros((k, k))
        for (i, j), values in densities.total(r).items():
            if min(i, j) < first <= max(i, j):
                coupled = True
            if min(i, j) < first:
                continue
            if not all(isinstance(v, float) for v in values):
                raise IntegratorError(
                    f"self_action='implicit' needs a self-action of {body.name} that does not vary "
                    "in space. Use bodies on tagged regions, or self_action='lumped'."
                )
            S[i - first, j - first] = sum(values)
        basis, _, _ = pencil_basis(body.inertia_matrix, body.viscosity_matrix)
        own = np.abs(basis.T @ S @ basis).sum(axis=1) * (1 + 1 / DELTA if coupled else 1.0)
        back = np.linalg.inv(basis)
        out[r] = back.T @ np.diag(own) @ back
    return out


def require_explicit_self_action(scene: Scene, integrator: str) -> None:
    """Refuse ``self_action="implicit"`` for an integrator that cannot take it.

    Raises:
        IntegratorError: naming integrators that can.
    """
    if scene.self_action == "implicit":
        raise IntegratorError(
            f"self_action='implicit' is not for {integrator}. Use Synchronous(), AVI() or "
            "LocalLeapfrog(), or self_action='lumped' in the scene."
        )
