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
from typing import Any, ClassVar

import numpy as np
import scipy.linalg
from mpi4py import MPI

from complexbody.errors import IntegratorError, StepError
from complexbody.integrators.assembled import AssembledRun
from complexbody.integrators.newmark import NewmarkRun
from complexbody.integrators.petsc_ts import FORMS, PetscRun
from complexbody.masses import SCHEMES
from complexbody.problem import Problem
from complexbody.stiffness import require_explicit_self_action
from complexbody.timesets import critical_step, require_constant_inertia


def _require(method: Any, problem: Problem) -> str:
    """Refuse what no peer takes; the peer's name.

    Raises:
        IntegratorError: for general χ, and self-action that is not integrated in full.
    """
    name = type(method).__name__
    require_constant_inertia(problem, name)
    require_explicit_self_action(problem.scene, name)
    if problem.scene.lumped:
        raise IntegratorError(
            f"{name} assembles energies in full, but the scene has self_action='lumped'. Use "
            "Synchronous(), AVI() or LocalLeapfrog(), or self_action='consistent' in the scene."
        )
    return name


def _require_momenta(method: Any, problem: Problem) -> None:
    """Refuse what no peer but the leapfrog takes: missing inertia, moving supports; collective.

    Raises:
        IntegratorError: naming integrators that take it.
    """
    name = _require(method, problem)
    for body in problem.inertias:
        if np.linalg.eigvalsh(body.inertia_matrix)[0] <= 0:
            raise IntegratorError(
                f"{name} needs accelerations, which the descriptor of {body.name} has not: it has "
                "no inertia. Use Synchronous(), AVI() or AssembledLeapfrog()."
            )
    if problem.comm.allreduce(bool(problem.supports.moving.any()), op=MPI.LOR):
        raise IntegratorError(
            f"{name} does not move supports, and one of this scene has a history. Use "
            "Synchronous(), AVI() or AssembledLeapfrog()."
        )


def _given_step(method: Any, until: float) -> float:
    """The step of an implicit peer, whose stability asks for none.

    Raises:
        StepError: if there is none.
    """
    if method.step is None:
        raise StepError(
            f"{type(method).__name__}: stability limits no step here, so there is no default. Give "
            "step= in seconds."
        )
    return _divided(method.step, until)


def _positive(method: Any, *names: str) -> None:
    for name in names:
        value = getattr(method, name)
        if value is not None and not (np.isfinite(value) and value > 0):
            raise StepError(f"{type(method).__name__}: {name} is {value}. Give a positive number.")


def _one_of(method: Any, name: str, allowed: tuple[str, ...]) -> None:
    value = getattr(method, name)
    if value not in allowed:
        raise IntegratorError(
            f"{type(method).__name__}: {name}={value!r} is not known. Give one of "
            f"{', '.join(allowed)}."
        )


def _divided(step: float, until: float) -> float:
    """The step, shortened so that the end of the run falls on one."""
    return float(until / np.ceil(until / min(step, until) * (1 - 1e-12)))


def _explicit_step(method: Any, critical: float, until: float) -> float:
    """The step of an explicit integrator.

    Raises:
        StepError: if it is above the critical one and ``unstable_ok`` is False.
    """
    step = _divided(method.safety * critical if method.step is None else method.step, until)
    if step > critical * (1 + 1e-9) and not method.unstable_ok:
        raise StepError(
            f"The step {step:.6g} s is larger than the critical step {critical:.6g} s, so the "
            "run would be unstable. Give a smaller step, or unstable_ok=True to see it happen."
        )
    return step


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
        _one_of(self, "force", ("assembly", "matrix"))
        _one_of(self, "dissipation", SCHEMES)
        _positive(self, "step", "safety")

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
        _require(self, problem)
        if self.force == "matrix" and not problem.kernels.densities.linear:
            raise IntegratorError(
                "AssembledLeapfrog: force='matrix' needs energies with a constant Hessian, and one "
                "of these is not. Use force='assembly'."
            )
        critical = critical_step(problem, self.dissipation)
        step = _explicit_step(self, critical, until)
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
        _positive(self, "step", "tolerance")
        if not (self.gamma >= 0.5 and 2 * self.beta >= self.gamma and np.isfinite(self.beta)):
            raise IntegratorError(
                f"Newmark: beta={self.beta}, gamma={self.gamma} is not stable for all steps. Give "
                "2·beta ≥ gamma ≥ ½, or use AssembledLeapfrog()."
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
        _require_momenta(self, problem)
        return NewmarkRun(problem, self, _given_step(self, until), float("inf"))


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
        _one_of(self, "kind", tuple(FORMS))
        _positive(self, "step", "safety", "tolerance")
        if not 0 <= self.radius <= 1:
            raise IntegratorError(f"PetscTS: radius is {self.radius}. Give a number from 0 to 1.")

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
        _require_momenta(self, problem)
        if not self.explicit:
            return PetscRun(problem, self, _given_step(self, until), float("inf"))
        critical = _limit_rk4(problem)
        return PetscRun(problem, self, _explicit_step(self, critical, until), critical)


def _limit_rk4(problem: Problem) -> float:
    """Critical step of the classical Runge–Kutta method [s], from that of the leapfrog.

    Its region of stability holds the left half of the disc of radius 2.615 and the real axis down
    to −2.785. Eigenvalues are in that disc (underdamped, |λ| ≤ ω ≤ 2/critical) or real and not
    below −max η/ρ̄ (overdamped).
    """
    critical = critical_step(problem, "symmetric")
    rates = [
        scipy.linalg.eigvalsh(body.viscosity_matrix, body.inertia_matrix)[-1]
        for body in problem.inertias
    ]
    largest = float(max(rates))
    limit = 2.615 / 2 * critical
    return min(limit, 2.785 / largest) if largest > 0 else limit
