# SPDX-License-Identifier: LGPL-3.0-or-later
"""The synchronous explicit variational integrator, as the user says it: one step for all cells.

Kick–drift–kick with lumped masses (paper (Discr-dAL1s), (Discr-dAL2s) with the dissipation's sign
corrected). What it does once it runs is in :mod:`complexbody.integrators.synchronous_run`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from complexbody.integrators.options import chosen_step, flags, one_of, positive
from complexbody.integrators.synchronous_run import SynchronousRun
from complexbody.masses import SCHEMES
from complexbody.problem import Problem
from complexbody.stiffness import require_explicit_self_action
from complexbody.timesets import critical_step, require_constant_inertia


@dataclass(frozen=True)
class Synchronous:
    """Explicit variational integrator with one step for the whole body.

    Attributes:
        step: Step h [s]; by default ``safety`` times the critical one, shortened so that the end
            of the run falls on a step.
        safety: Fraction of the critical step to use.
        dissipation: "exact" (order 2), "symmetric" (order 2, paper (dissdiscr1)) or "forward"
            (order 1, the paper's (dissdiscr)).
        start: "trapezoidal" (first kick of weight h/2, order 2) or "one-sided" (the paper's).
        critical: "cells" bounds the critical step by the cells' own pencils; "global" computes it
            by SLEPc (linear forces only), at the cost of an eigenvalue solve.
        unstable_ok: Run even with a step above the critical one.

    Raises:
        IntegratorError: for options that do not exist.
        StepError: for a step or safety factor that is not positive.
    """

    step: float | None = None
    safety: float = 0.9
    dissipation: str = "exact"
    start: str = "trapezoidal"
    critical: str = "cells"
    unstable_ok: bool = False

    explicit: ClassVar[bool] = True
    asynchronous: ClassVar[bool] = False
    symplectic: ClassVar[bool] = True
    inertia: ClassVar[str] = "number or k×k matrix; 0 where viscosity is positive"

    def __post_init__(self) -> None:
        one_of(self, "dissipation", SCHEMES)
        one_of(self, "start", ("trapezoidal", "one-sided"))
        one_of(self, "critical", ("cells", "global"))
        positive(self, "step", "safety")
        flags(self, "unstable_ok")

    @property
    def order(self) -> int:
        """Order of convergence in the step."""
        return 1 if self.dissipation == "forward" or self.start == "one-sided" else 2

    def prepare(self, problem: Problem, until: float) -> SynchronousRun:
        """Choose the step and set up the run; collective.

        Raises:
            StepError: if the step is above the critical one and ``unstable_ok`` is False.
            IntegratorError: if the body does not fit the dissipation scheme.
        """
        require_constant_inertia(problem, "Synchronous")
        if self.critical == "global":
            require_explicit_self_action(problem.scene, "critical='global'")
        critical = critical_step(problem, self.dissipation, self.critical, self.step)
        step = chosen_step(self, critical, until)
        problem.stiffen(step)
        run = SynchronousRun(problem, self, step, critical)
        run.watch()
        return run
