# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The implicit synchronous integrator, as the user says it: any kinetic co-energy χ(ν, ν̇).

Discrete Lagrangian L_d = h χ(ν + s h v, v) − potential, v = (ν⁺ − ν)/h: s = 0 is the paper's scheme
(§5, (Discr-dAL2s) with the dissipation's sign corrected, order 1), s = ½ the midpoint rule with
potentials by the trapezoidal rule (order 2). Forces stay explicit, and so does u; or, for constant
inertia (also none), those on ν are implicit (:mod:`complexbody.integrators.split_run`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from mpi4py import MPI

from complexbody.dampers import refuse_dampers
from complexbody.errors import IntegratorError, StepError
from complexbody.given import is_whole
from complexbody.integrators.implicit_run import ImplicitRun
from complexbody.integrators.options import chosen_step, flags, one_of, petsc_options, positive
from complexbody.integrators.split_run import SplitRun
from complexbody.integrators.synchronous import Synchronous
from complexbody.integrators.synchronous_run import SynchronousRun
from complexbody.periodicity import require_unrepeated
from complexbody.problem import Problem
from complexbody.stiffness import require_explicit_self_action
from complexbody.timesets import HELD, critical_step, require_constant_inertia


@dataclass(frozen=True)
class Implicit:
    r"""Synchronous integrator for ``inertia=f(nu, nu_dot)``, or for a ν too stiff to be explicit.

    With p = ∂χ/∂ν̇ and q = ∂χ/∂ν at (ν + s h v, v) a step solves

    .. math:: p - (1-s)\,h q + (1-s)\,h\eta v = \pi - h\,\partial V/\partial\nu,\qquad
              \pi^+ = p + s h q - s h\eta v,\quad \nu^+ = \nu + h v.

    Where all bodies of a scene have a constant inertia (or a χ recognised as such) and masses are
    lumped nothing needs solving: the run is the one of :class:`Synchronous` ("symmetric", or
    "forward" for order 1). Without inertia order 2 has no limit, and the run is that of "exact":
    ν += (h/η) f, of order 1.

    ``forces="implicit"`` is for a stiff ν, above all one that diffuses, ην̇ = Div S − z + β: ν is
    solved for with all its forces at frozen u, by SNES, and u stays explicit with lumped masses.
    The step is then limited by u alone, whatever ν's stiffness, its coupling to u, η and ρ̄ (also
    0). Order 2 is Strang's splitting with the implicit midpoint: symplectic where η = 0, A-stable;
    what it does not resolve it neither damps nor amplifies much, so that rough initial data of ν
    alternate from step to step. Order 1 is backward Euler for ν: L-stable, it damps what it does
    not resolve, as diffusion does (and waves of ν as well).

    Attributes:
        step: Step h [s]; by default ``safety`` times the critical step of the explicit forces, at
            most half of T₀.
        order: 2 (midpoint) or 1 (the paper's, or backward Euler).
        quadrature: "vertex": χ by the vertex rule, a k×k Newton at each node; "consistent": χ
            integrated in full, a global SNES (options with prefix ``cb_implicit_``).
        safety: Fraction of the critical step to use.
        solve: "needed", or "always": also where χ is quadratic.
        tolerance: Residual of a step, relative to its largest term.
        iterations: Newton iterations allowed per step.
        monitor: Print SNES's residuals.
        options: More PETSc options, without the prefix.
        unstable_ok: Run even with a step above the critical one or T₀.
        forces: "explicit", or "implicit": those on ν are solved for (constant inertia, may be 0).

    Raises:
        IntegratorError: for options that do not exist.
        StepError: for a step, safety or tolerance that is not positive.
    """

    step: float | None = None
    order: int = 2
    quadrature: str = "vertex"
    safety: float = 0.9
    solve: str = "needed"
    tolerance: float = 1e-12
    iterations: int = 50
    monitor: bool = False
    options: Mapping[str, str] = field(default_factory=dict)
    unstable_ok: bool = False
    forces: str = "explicit"

    explicit: ClassVar[bool] = False
    asynchronous: ClassVar[bool] = False
    symplectic: ClassVar[bool] = True
    inertia: ClassVar[str] = (
        "number, k×k matrix, or f(nu, nu_dot) convex in nu_dot; 0 where viscosity is positive"
    )

    def __post_init__(self) -> None:
        one_of(self, "order", (1, 2))
        one_of(self, "quadrature", ("vertex", "consistent"))
        one_of(self, "solve", ("needed", "always"))
        one_of(self, "forces", ("explicit", "implicit"))
        positive(self, "step", "safety", "tolerance", "iterations")
        if not is_whole(self.iterations):
            raise StepError(f"Implicit: iterations is {self.iterations}. Give a whole number.")
        flags(self, "monitor", "unstable_ok")
        petsc_options(self)
        if self.forces == "implicit" and self.quadrature == "consistent":
            raise IntegratorError(
                "Implicit: forces='implicit' has lumped inertia and viscosity. Use "
                "quadrature='vertex', or forces='explicit'."
            )

    def prepare(self, problem: Problem, until: float) -> ImplicitRun | SynchronousRun | SplitRun:
        """Choose the step and set up the run; collective.

        Raises:
            StepError: if the step is above the critical one or T₀ and ``unstable_ok`` is False.
            IntegratorError: for a scene this integrator cannot take.
        """
        if self.forces == "implicit":
            return self._split(problem, until)
        massless = bool(np.any(np.linalg.eigvalsh(problem.masses.inertia) <= 0))
        massless = problem.comm.allreduce(massless, op=MPI.LOR)
        scheme, start = ("forward", "one-sided")
        if self.order == 2:
            scheme, start = "exact" if massless else "symmetric", "trapezoidal"
        general = problem.convexity is not None
        if not general and self.solve == "needed" and self.quadrature == "vertex":
            same = Synchronous(self.step, self.safety, scheme, start, unstable_ok=self.unstable_ok)
            return same.prepare(problem, until)
        require_explicit_self_action(problem.scene, "solving for momenta")
        refuse_dampers(problem, "Implicit's solving for momenta")
        if massless:
            raise IntegratorError(
                "Implicit solves for momenta, which a descriptor without inertia does not have. "
                "Use forces='implicit', or Synchronous() or AVI() with dissipation='exact'."
            )
        critical = self._critical(problem, scheme)
        if self.quadrature == "consistent":
            require_unrepeated(problem.scene, "Implicit(quadrature='consistent')")
            # A cell's consistent mass is at least its lumped one over d + 2.
            critical /= float(np.sqrt(problem.disc.dim + 2))
        limit = problem.kinetic_range.limit(self.order)
        step = self.step
        if step is None:
            step = min(self.safety * critical, 0.5 * limit, until)
            step = until / np.ceil(until / step * (1 - 1e-12))
        for bound, what in ((critical, "the critical step"), (limit, "T₀ = γ/Ξ of the inertia")):
            if step > bound * (1 + 1e-9) and not self.unstable_ok:
                raise StepError(
                    f"The step {step:.6g} s is larger than {what}, {bound:.6g} s at the initial "
                    "state. Give a smaller step, or unstable_ok=True to see what happens."
                )
        return ImplicitRun(problem, self, float(step), float(critical))

    def _split(self, problem: Problem, until: float) -> SplitRun:
        """The run that is implicit in ν: its step is that of u with ν held."""
        require_constant_inertia(problem, "Implicit(forces='implicit')")
        refuse_dampers(problem, "Implicit(forces='implicit')")
        critical = self._critical(problem, HELD)
        step = chosen_step(self, critical, until, "critical step of u, which stays explicit,")
        return SplitRun(problem, self, step, critical)

    def _critical(self, problem: Problem, scheme: str) -> float:
        try:
            return critical_step(problem, scheme, given=self.step)
        except StepError:
            # A body without stiffness has no critical step; one that the user gives will do.
            if self.step is None:
                raise
            return float("inf")
