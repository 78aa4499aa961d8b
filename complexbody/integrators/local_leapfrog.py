# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Explicit local time stepping by leapfrog, recursive over octaves of cells and stabilised.

Nodes of level ℓ act 2^ℓ times per step Δt; P_ℓ selects those of level ≥ ℓ. From the even motion
z̈ = −M̂⁻¹Kz, z(0) = x_n, ż(0) = 0 follows x_{n+1} + x_{n−1} = 2z(Δt) if nothing is dissipated. Each
octave does two leapfrog steps of it, in which what coarser nodes give stays frozen:

.. math:: z(\Delta t) = \hat M^{-1/2} (I - S_0) \hat M^{1/2} x_n,\quad
    S_{\ell-1} = \gamma\,(4 S_\ell - 2 S_\ell P_\ell S_\ell),\quad
    S_L = \tfrac12 (\Delta t / r^L)^2\, \hat M^{-1/2} K \hat M^{-1/2},\quad r = 2\sqrt\gamma

(J. Diaz, M. J. Grote, SIAM J. Sci. Comput. 31, 2009, and CMAME 291, 2015 for many levels, with
γ = 1). The force of the whole step, f_Δt = −(2/Δt²) M̂^{1/2} S_0 M̂^{1/2} x_n, is linear and
symmetric again: that of a modified potential. So the outer step is :class:`SynchronousRun`'s, with
its effective mass M̂ for every dissipation scheme: a variational integrator, second order. Where
viscosity rules it tends to a Runge–Kutta–Chebyshev step of ην̇ = −∂V/∂ν.

*Stability.* Undamped it is stable iff 0 ≤ S_0 ≤ 2. With S = S_ℓ and Q = I − P_ℓ,

.. math:: 2 - S_{\ell-1} = 2\gamma\,\bigl[(I - S)^2 + \tfrac{1-\gamma}{\gamma} - S Q S\bigr].

For γ = 1 any eigenvalue 1 of S whose mode leaks into the coarse nodes Q makes this negative: the
method fails at scattered steps. γ = δ²/(2δ² − 1), δ = 1 + ν/4, is the Chebyshev filter for two
substeps (M. J. Grote, S. Michel, S. A. Sauter, Math. Comp. 90, 2021), here **at every level anew**.
Then S_{ℓ−1} ≥ 0 follows from S_ℓ ≤ 2, and the term in the middle is the same, about ν/2, at every
interface; with one filter for all 2^L substeps ν/4^ℓ would be left at level ℓ. Levels by
:mod:`complexbody.integrators.octaves` give ‖QS‖ ≤ α²/2γ, α the fraction of the critical step, so
that one interface is stable for certain if ν ≥ α⁴/2. The worst of 2·10⁴ scattered, graded and
heterogeneous meshes needed ν = 0.04, 0.08, 0.13 at α = 0.8, 0.9, 0.95. The filter makes r less than
2 (1.93 for ν = 0.15) and costs no accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import ufl

from complexbody import hessian
from complexbody.body import Body
from complexbody.errors import IntegratorError
from complexbody.given import is_finite, is_whole, short
from complexbody.integrators import octaves
from complexbody.integrators.local_leapfrog_run import LocalLeapfrogRun
from complexbody.integrators.stiffened import reach, stiffen
from complexbody.integrators.synchronous import Synchronous
from complexbody.problem import Problem
from complexbody.timesets import cell_steps, require_constant_inertia

#: α, the fraction of critical steps that is used unless another is given.
SAFETY = 0.9


@dataclass(frozen=True)
class LocalLeapfrog:
    """Leapfrog with local steps: octaves of cells, stabilised, for any dissipation scheme.

    Symplectic and time-symmetric for quadratic densities. Others must at least be quadratic in the
    gradients, with a Hessian there that does not depend on ν: forces are then taken at the same
    split positions (fine nodes moving, coarse ones frozen), second order, time-symmetric, momentum
    kept, but of no exact potential. Where stiffness follows the state the step map is not symmetric
    and energy grows, at steps far below those stable for small motions: refused.

    Attributes:
        safety: α, the fraction of its critical step that a node may use.
        stabilisation: ν of the Chebyshev filter, at least α⁴/6; 0 is none, and fails sporadically.
        dissipation, start: As for Synchronous.
        step: Coarse step [s]; by default the one that needs the fewest updates.
        levels: Number of octaves, counted from the smallest critical step up; by default as many as
            the step needs.

    Raises:
        IntegratorError, StepError: for options that make no sense.
    """

    safety: float = SAFETY
    stabilisation: float = 0.15
    dissipation: str = "exact"
    start: str = "trapezoidal"
    step: float | None = None
    levels: int | None = None

    explicit: ClassVar[bool] = True
    asynchronous: ClassVar[bool] = True
    symplectic: ClassVar[bool] = True
    inertia: ClassVar[str] = Synchronous.inertia

    def __post_init__(self) -> None:
        Synchronous(self.step, self.safety, self.dissipation, self.start)  # refuses what it would
        if not (is_finite(self.stabilisation) and self.stabilisation >= 0):
            raise IntegratorError(
                f"LocalLeapfrog: stabilisation is {short(self.stabilisation)}. Give a number, "
                "0 or more."
            )
        levels = self.levels
        if levels is not None and not (is_whole(levels) and 0 <= levels <= octaves.MOST):
            raise IntegratorError(
                f"LocalLeapfrog: levels is {short(levels)}. Give 0 to {octaves.MOST}, or None."
            )

    @property
    def order(self) -> int:
        """Order of convergence in the step."""
        return Synchronous(dissipation=self.dissipation, start=self.start).order

    @property
    def gamma(self) -> float:
        """γ of the filter, 1 without."""
        delta = 1 + self.stabilisation / 4
        return delta**2 / (2 * delta**2 - 1)

    def prepare(self, problem: Problem, until: float) -> LocalLeapfrogRun:
        """Choose step and levels, regroup the cells, and set up the run; collective.

        Raises:
            StepError: if the levels do not reach the step, or the body has no stiffness.
            IntegratorError: if the body does not fit, or not the dissipation scheme.
        """
        require_constant_inertia(problem, "LocalLeapfrog")
        if self.levels != 0:
            for body, read in zip(
                problem.scene.bodies, problem.kernels.densities.stored, strict=True
            ):
                if read is None:  # else quadratic in everything
                    _require_semilinear(problem, body)
        ratio = 2 * np.sqrt(self.gamma)
        cells, safety = cell_steps(problem, self.dissipation), self.safety
        if problem.scene.self_action == "implicit":
            steps = np.minimum(safety * cells, self.step or np.inf)
            cells, safety = reach(cells, steps, SAFETY), max(safety, SAFETY)
        plan = octaves.plan(problem, until, cells, safety, ratio, self.step, self.levels)
        stiffen(problem, np.minimum(plan.cells, plan.step / SAFETY))
        outer = Synchronous(dissipation=self.dissipation, start=self.start)
        return LocalLeapfrogRun(problem, outer, self.gamma, plan)


def _require_semilinear(problem: Problem, body: Body) -> None:
    """Refuse densities whose second derivatives by gradients depend on the state."""
    mesh, n_u, k = problem.scene.mesh, problem.scene.displacement, problem.scene.descriptor
    seen: list[dict[tuple[int, int], Any]] = []
    for scale in (0.37, -1.21):
        nu = ufl.as_vector([scale * (i + 1) for i in range(k)]) if k else None
        frozen = hessian.read(lambda U, _, N, v=nu: body.energy(U, v, N), mesh, n_u, k, "gradients")
        seen.append({} if frozen is None else frozen.hessian)
    if not seen[0] or seen[0] != seen[1]:
        raise IntegratorError(
            f"LocalLeapfrog needs energies that are quadratic in the gradients, with coefficients "
            f"free of ν; that of {body.name} is not. Use Synchronous or AVI, or levels=0."
        )
