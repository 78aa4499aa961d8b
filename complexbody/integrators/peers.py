# SPDX-License-Identifier: LGPL-3.0-or-later
"""Integrators that one would otherwise take, as the user says them: on dolfinx's own assembly.

They step the same semi-discrete equations with the same lumped masses and supports as ours, so that
charts compare integrators and nothing else. What they do once they run is in
:mod:`~complexbody.integrators.assembled`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from complexbody.errors import IntegratorError, StepError
from complexbody.integrators.assembled import AssembledRun
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
