# SPDX-License-Identifier: LGPL-3.0-or-later
"""Integrators that one would otherwise take, as the user says them: on dolfinx's own assembly.

They step the same semi-discrete equations with the same lumped masses and supports as ours, so that
charts compare integrators and nothing else. What they do once they run is in
:mod:`~complexbody.integrators.assembled`, :mod:`~complexbody.integrators.newmark` and
:mod:`~complexbody.integrators.petsc_ts`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

from complexbody.errors import IntegratorError
from complexbody.given import is_finite, short
from complexbody.integrators.assembled import AssembledRun
from complexbody.integrators.newmark import NewmarkRun
from complexbody.integrators.options import chosen_step, flags, one_of, petsc_options, positive
from complexbody.integrators.peer_checks import (
    given_step,
    limit_rk4,
    require,
    require_momenta,
)
from complexbody.integrators.petsc_ts import FORMS, PetscRun
from complexbody.masses import SCHEMES
from complexbody.problem import Problem
from complexbody.timesets import critical_step


@dataclass(frozen=True)
class AssembledLeapfrog:
    """The leapfrog that one writes by hand: Synchronous, with forces by dolfinx or PETSc.

    Attributes:
        force: "assembly": ``assemble_vector`` of ``ufl.derivative``'s residual at each step;
            "matrix": a product with PETSc's block matrix, assembled once (energies with a constant
            Hessian only).
        step: Step h [s]; by default ``safety`` times the critical one. Shortened so that the end of
            the run falls on a step.
        safety: Fraction of the critical step to use.
        dissipation: As of Synchronous.
        unstable_ok: Run even with a step above the critical one.

    Raises:
        IntegratorError: for options that do not exist.
        StepError: for a step or safety factor that is not positive.
    """

    force: str = "assembly"
    step: float | None = None
    safety: float = 0.9
    dissipation: str = "exact"
    unstable_ok: bool = False

    explicit: ClassVar[bool] = True
    asynchronous: ClassVar[bool] = False
    symplectic: ClassVar[bool] = True
    inertia: ClassVar[str] = "number or k×k matrix; 0 where viscosity is positive"

    def __post_init__(self) -> None:
        one_of(self, "force", ("assembly", "matrix"))
        one_of(self, "dissipation", SCHEMES)
        positive(self, "step", "safety")
        flags(self, "unstable_ok")

    @property
    def order(self) -> int:
        """Order of convergence in the step."""
        return 1 if self.dissipation == "forward" else 2

    def prepare(self, problem: Problem, until: float) -> AssembledRun:
        """Choose the step and set up the run; collective.

        Raises:
            StepError: if the step is above the critical one and ``unstable_ok`` is False.
            IntegratorError: for a scene this integrator cannot take.
        """
        require(self, problem)
        if self.force == "matrix" and not problem.kernels.densities.linear:
            raise IntegratorError(
                "AssembledLeapfrog: force='matrix' needs energies with a constant Hessian, and one "
                "of these is not. Use force='assembly'."
            )
        critical = critical_step(problem, self.dissipation, given=self.step)
        step = chosen_step(self, critical, until, divide=True)
        return AssembledRun(problem, self, step, critical)


@dataclass(frozen=True)
class Newmark:
    """Newmark's implicit method (1959) with lumped masses and the assembled stiffness.

    β = ¼, γ = ½ (trapezoidal rule) keeps the energy of linear scenes, β = 0 would be the leapfrog
    (not offered: it needs no solve). A variational integrator if γ = ½ (Kane, Marsden, Ortiz, West
    2000). Where forces are affine one linear solver (PETSc prefix ``cb_newmark_``) is built once,
    else SNES solves each step.

    Attributes:
        step: Step h [s], shortened so that the end of the run falls on a step. Not limited by
            stability if 2β ≥ γ ≥ ½.
        beta, gamma: Newmark's.
        tolerance: Of the linear solver, relative to the right side; of SNES, relative to forces.
        options: More PETSc options, without the prefix.

    Raises:
        IntegratorError: for β or γ out of range.
        StepError: for a step or tolerance that is not positive.
    """

    step: float | None = None
    beta: float = 0.25
    gamma: float = 0.5
    tolerance: float = 1e-10
    options: Mapping[str, str] = field(default_factory=dict)

    explicit: ClassVar[bool] = False
    asynchronous: ClassVar[bool] = False
    inertia: ClassVar[str] = "number or k×k matrix, positive definite"

    def __post_init__(self) -> None:
        positive(self, "step", "tolerance")
        petsc_options(self)
        known = is_finite(self.beta) and is_finite(self.gamma)
        if not (known and self.gamma >= 0.5 and 2 * self.beta >= self.gamma):
            raise IntegratorError(
                f"Newmark: beta={short(self.beta)}, gamma={short(self.gamma)} is not stable for "
                "all steps. Give 2·beta ≥ gamma ≥ ½, or use AssembledLeapfrog()."
            )

    @property
    def order(self) -> int:
        """Order of convergence in the step."""
        return 2 if self.gamma == 0.5 else 1

    @property
    def symplectic(self) -> bool:
        """Whether it is a variational integrator."""
        return self.gamma == 0.5

    def prepare(self, problem: Problem, until: float) -> NewmarkRun:
        """Set up the run; collective.

        Raises:
            StepError: if there is no step.
            IntegratorError: for a scene this integrator cannot take.
        """
        require_momenta(self, problem)
        return NewmarkRun(problem, self, given_step(self, until), float("inf"))


@dataclass(frozen=True)
class PetscTS:
    """One of PETSc's time steppers, on the same semi-discrete equations, steps never adapted.

    Where forces are affine they are products with the stiffness assembled once, else assembled by
    dolfinx. PETSc options have the prefix ``cb_ts_``; those of the linear solver inside "cn" and
    "theta" ``cb_ts_inner_``.

    Attributes:
        kind: "alpha2": generalised-α (Chung, Hulbert 1993); "rk4": the classical Runge–Kutta
            method; "cn": trapezoidal rule; "theta": implicit midpoint rule.
        step: Step h [s], shortened so that the end of the run falls on a step; of "rk4" by default
            ``safety`` times its critical one.
        radius: Of "alpha2": spectral radius at infinite frequency, 1 (no damping) to 0. PETSc 3.18
            starts from twice the acceleration, which 1 does not see; else it costs an order.
        safety: Fraction of the critical step to use.
        tolerance: Of solvers, relative to the first residual of a step.
        options: More PETSc options, without the prefix (in "cn" and "theta" for the solver inside
            as well).
        unstable_ok: Run "rk4" even with a step above the critical one.

    Raises:
        IntegratorError: for options that do not exist.
        StepError: for a step, safety factor or tolerance that is not positive.
    """

    kind: str = "alpha2"
    step: float | None = None
    radius: float = 1.0
    safety: float = 0.9
    tolerance: float = 1e-10
    options: Mapping[str, str] = field(default_factory=dict)
    unstable_ok: bool = False

    asynchronous: ClassVar[bool] = False
    inertia: ClassVar[str] = "number or k×k matrix, positive definite"

    def __post_init__(self) -> None:
        one_of(self, "kind", tuple(FORMS))
        positive(self, "step", "safety", "tolerance")
        flags(self, "unstable_ok")
        petsc_options(self)
        if not (is_finite(self.radius) and 0 <= self.radius <= 1):
            raise IntegratorError(
                f"PetscTS: radius is {short(self.radius)}. Give a number from 0 to 1."
            )

    @property
    def order(self) -> int:
        """Order of convergence in the step; of "alpha2" see ``radius``."""
        if self.kind == "rk4":
            return 4
        return 1 if self.kind == "alpha2" and self.radius < 1 else 2

    @property
    def explicit(self) -> bool:
        """Whether a step needs no solve."""
        return self.kind == "rk4"

    @property
    def symplectic(self) -> bool:
        """Whether the flow of a step is symplectic without viscosity."""
        return self.kind == "theta"

    def prepare(self, problem: Problem, until: float) -> PetscRun:
        """Choose the step and set up the run; collective.

        Raises:
            StepError: if there is no step, or that of "rk4" is above its critical one and
                ``unstable_ok`` is False.
            IntegratorError: for a scene this integrator cannot take.
        """
        require_momenta(self, problem)
        if not self.explicit:
            return PetscRun(problem, self, given_step(self, until), float("inf"))
        critical = limit_rk4(problem)
        return PetscRun(problem, self, chosen_step(self, critical, until, divide=True), critical)
