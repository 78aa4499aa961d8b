# SPDX-License-Identifier: LGPL-3.0-or-later
"""What peers have in common before they run: what they refuse, and how a step is chosen."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.linalg
from mpi4py import MPI

from complexbody.errors import IntegratorError, StepError
from complexbody.integrators.options import divided
from complexbody.periodicity import require_unrepeated
from complexbody.problem import Problem
from complexbody.stiffness import require_explicit_self_action
from complexbody.timesets import critical_step, require_constant_inertia


def require(method: Any, problem: Problem) -> str:
    """Refuse what no peer takes; the peer's name.

    Raises:
        IntegratorError: for periodic scenes, general χ, and self-action not integrated in full.
    """
    name = type(method).__name__
    require_unrepeated(problem.scene, name)
    require_constant_inertia(problem, name)
    require_explicit_self_action(problem.scene, name)
    if problem.scene.lumped:
        raise IntegratorError(
            f"{name} assembles energies in full, but the scene has self_action='lumped'. Use "
            "Synchronous(), AVI() or LocalLeapfrog(), or self_action='consistent' in the scene."
        )
    return name


def require_momenta(method: Any, problem: Problem) -> None:
    """Refuse what no peer but the leapfrog takes: missing inertia, moving supports; collective.

    Raises:
        IntegratorError: naming integrators that take it.
    """
    name = require(method, problem)
    for body in problem.inertias:
        if np.any(np.linalg.eigvalsh(body.inertia_matrix) <= 0):
            raise IntegratorError(
                f"{name} needs accelerations, which the descriptor of {body.name} has not: it has "
                "no inertia. Use Synchronous(), AVI() or AssembledLeapfrog()."
            )
    if problem.comm.allreduce(bool(problem.supports.moving.any()), op=MPI.LOR):
        raise IntegratorError(
            f"{name} does not move supports, and one of this scene has a history. Use "
            "Synchronous(), AVI() or AssembledLeapfrog()."
        )


def given_step(method: Any, until: float) -> float:
    """The step of an implicit peer, whose stability asks for none.

    Raises:
        StepError: if there is none.
    """
    if method.step is None:
        raise StepError(
            f"{type(method).__name__}: stability limits no step here, so there is no default. Give "
            "step= in seconds."
        )
    return divided(method.step, until)


def limit_rk4(problem: Problem) -> float:
    """Critical step of the classical Runge–Kutta method [s], from that of the leapfrog.

    Its region of stability holds the left half of the disc of radius 2.615 and the real axis down
    to −2.785. Eigenvalues are in that disc (underdamped, |λ| ≤ ω ≤ 2/critical) or real and not
    below −max η/ρ̄ (overdamped).
    """
    critical = critical_step(problem, "symmetric")
    rates = [
        scipy.linalg.eigvalsh(body.viscosity_matrix, body.inertia_matrix)[-1]
        for body in problem.whole.bodies
    ]
    masses = problem.masses
    if masses.absorbing:
        # Relative to inertia, in which u and ν have the same unit; no inertia is refused before.
        root = np.linalg.inv(np.linalg.cholesky(masses.full(masses.inertia, masses.density)))
        own = np.linalg.eigvalsh(root @ masses.damping @ root.transpose(0, 2, 1)).max(initial=0.0)
        rates.append(problem.comm.allreduce(float(own), op=MPI.MAX))
    largest = float(max(rates))
    limit = 2.615 / 2 * critical
    return min(limit, 2.785 / largest) if largest > 0 else limit
