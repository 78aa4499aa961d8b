# SPDX-License-Identifier: LGPL-3.0-or-later
"""PETSc's time steppers (TS) in progress, on the semi-discrete equations; steps are not adapted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from complexbody.integrators.global_newton import REASONS
from complexbody.integrators.peer_run import PeerRun
from complexbody.integrators.petsc_forms import FirstOrder, SecondOrder, Theta
from complexbody.integrators.solvers import options, unsolved
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.peers import PetscTS

Array = npt.NDArray[np.float64]

PREFIX = "cb_ts_"


class Form(Protocol):
    """The equations as a stepper wants them, and the vectors it works on.

    Attributes:
        given: PETSc options of the user that are the stepper's own.
        failed: Reason of a linear solver that failed and that SNES does not see, or 0.
    """

    given: Mapping[str, str]
    failed: int

    def read(self) -> None:
        """Take x and v from PETSc."""

    def iterations(self) -> int:
        """Linear iterations since the last call."""

    def close(self) -> None:
        """Free PETSc's objects."""


class PetscRun(PeerRun):
    """A run of one of PETSc's time steppers.

    Attributes:
        ts: PETSc's object.
        form: The equations as the stepper wants them.
        unsaved: Why there are no snapshots of it.
    """

    unsaved = "PETSc's time steppers keep what a step needs of the last ones to themselves"

    def __init__(self, problem: Problem, method: PetscTS, step: float, critical: float) -> None:
        linear, explicit = problem.kernels.densities.linear, method.explicit
        matrix = ("baij" if explicit else "aij") if linear else ""
        super().__init__(problem, step, critical, matrix)
        self.method, self.simpson = method, explicit
        self.given = self.system.x[self.system.fixed].copy()
        self.ts = ts = PETSc.TS().create(problem.comm)
        ts.setOptionsPrefix(PREFIX)
        defaults = {"ts_adapt_type": "none", "snes_stol": "1e-12"}
        tolerance = str(method.tolerance)
        if linear:
            defaults |= {"snes_type": "ksponly", "ksp_rtol": tolerance}
        else:
            defaults |= {"snes_type": "newtonls", "snes_rtol": tolerance, "ksp_rtol": "1e-6"}
        self.form = FORMS[method.kind](self, defaults)
        ts.setTimeStep(step)
        ts.setMaxSteps(2**30)
        ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
        ts.setErrorIfStepFails(False)
        with options(PREFIX, defaults, self.form.given):
            ts.setFromOptions()
            ts.setUp()

    def _step(self) -> str:
        ts = self.ts
        ts.setTime(self.time)  # never summed up
        ts.step()
        self.linear += self.form.iterations()
        if int(ts.getConvergedReason()) < 0:
            reason = int(ts.getSNES().getConvergedReason())
            return f"SNES: {REASONS.get(reason, f'reason {reason}')}"
        if self.form.failed:
            return unsolved(self.form.failed)
        self.form.read()
        self.system.q.x.scatter_forward()
        return ""

    def forces(self, t: float, x: Array, out: Array) -> Array:
        """Out = r(x) − F(t), q being left at x; collective."""
        system = self.system
        system.x[:] = x
        system.q.x.scatter_forward()
        np.subtract(system.residual(), system.force(t), out=out)
        return out

    def summary(self) -> str:
        """What solving took, in words; collective."""
        if self.method.explicit:
            return ""
        return f"{self.linear / max(self.steps, 1):.1f} linear iterations per step"

    def close(self) -> None:
        """Free PETSc's objects."""
        super().close()
        self.form.close()
        self.ts.destroy()


FORMS: dict[str, Callable[[PetscRun, dict[str, str]], Form]] = {
    "alpha2": SecondOrder, "rk4": FirstOrder, "cn": Theta, "theta": Theta,
}  # fmt: skip
