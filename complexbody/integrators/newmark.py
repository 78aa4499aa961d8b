# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Newmark's method (1959) in progress, with the assembled matrix.

With a the accelerations, x* = x + hv + (½ − β)h²a and v* = v + (1 − γ)ha a step solves

.. math:: M a^+ + D(v^* + \gamma h a^+) + r(x^* + \beta h^2 a^+) = F(t^+)

for a⁺: by one KSP whose matrix is built once where r is affine, else by SNES.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from complexbody import _compat
from complexbody.integrators.global_newton import REASONS
from complexbody.integrators.peer_run import PeerRun
from complexbody.integrators.snapshot import Snapshot
from complexbody.integrators.solvers import KRYLOV, Operator, options, unsolved
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.peers import Newmark

Array = npt.NDArray[np.float64]

PREFIX = "cb_newmark_"


class NewmarkRun(PeerRun):
    """A run of Newmark's method.

    Attributes:
        a: Accelerations at t_n, owned unknowns.
        newton: Iterations of SNES so far.
    """

    def __init__(self, problem: Problem, method: Newmark, step: float, critical: float) -> None:
        linear = problem.kernels.densities.linear
        super().__init__(problem, step, critical, "aij" if linear else "")
        self.method, self.newton = method, 0
        system, h = self.system, step
        system.residual()
        self.a = self.accelerations(0.0, self.v)
        self._factors = 1.0, method.gamma * h, method.beta * h * h
        self.operator = Operator(self)
        self.vector = _compat.petsc_vector(system.q).duplicate()
        self.right = self.vector.duplicate()
        self._start, self._fixed_v = np.zeros(system.size), np.zeros(system.size)
        self._t = 0.0
        self.ksp: Any = None
        self.snes: Any = None
        given = method.options
        if linear:
            self.operator.build(*self._factors)
            self.ksp = PETSc.KSP().create(problem.comm)
            self.ksp.setOptionsPrefix(PREFIX)
            self.ksp.setOperators(self.operator.matrix)
            self.ksp.setInitialGuessNonzero(True)
            with options(PREFIX, KRYLOV | {"ksp_rtol": str(method.tolerance)}, given):
                self.ksp.setFromOptions()
                self.ksp.setUp()
        else:
            self.snes = PETSc.SNES().create(problem.comm)
            self.snes.setOptionsPrefix(PREFIX)
            self.snes.setFunction(self._function, self.right)
            self.snes.setJacobian(self._jacobian, self.operator.matrix)
            with options(PREFIX, KRYLOV | {"ksp_rtol": "1e-6"}, given):
                self.snes.setFromOptions()

    def _step(self) -> str:
        h, system, method = self.step, self.system, self.method
        beta, gamma, a = method.beta, method.gamma, self.a
        self._start[:] = system.x + h * self.v + (0.5 - beta) * h * h * a
        self._fixed_v[:] = self.v + (1 - gamma) * h * a
        self._t = self.time + h
        self.vector.array[:] = a
        if self.ksp is not None:
            self._place(0.0)
            right = self.right.array
            right[:] = system.force(self._t) - system.residual()
            if self.damping is not None:
                right -= self.damping.times(self._fixed_v, self._one)
            right[system.fixed] = 0.0
            self.ksp.solve(self.right, self.vector)
            self.linear += self.ksp.getIterationNumber()
            reason = self.ksp.getConvergedReason()
            why = unsolved(reason) if reason < 0 else ""
        else:
            why = self._newton()
        if why:
            return why
        new = self.vector.array_r
        self._place(beta * h * h, new)
        self.v = self._fixed_v + gamma * h * new
        self.a = new.copy()
        return ""

    def _add(self, saved: Snapshot) -> None:
        saved.nodes["a"] = self._record(self.a)
        saved.numbers["newton"] = self.newton

    def _refresh(self, saved: Snapshot) -> None:
        self.a, self.newton = self.system.owned(saved.nodes["a"]), int(saved.numbers["newton"])

    def _place(self, factor: float, a: Array | None = None) -> None:
        """Q = x* + factor a, ghosts included."""
        system = self.system
        system.x[:] = self._start
        if a is not None:
            system.x += factor * a
        system.q.x.scatter_forward()

    # --- nonlinear -------------------------------------------------------------------------------

    def _newton(self) -> str:
        """SNES from the last accelerations; why not, in words."""
        self._place(0.0)
        system, comm = self.system, self.problem.comm
        loose = system.force(self._t) - system.residual()
        loose[system.fixed] = 0.0
        self._function(self.snes, self.vector, self.right)
        first = self.right.norm()
        scale = max(np.sqrt(comm.allreduce(float(loose @ loose))), first)
        self.snes.setTolerances(
            rtol=0.0, atol=max(self.method.tolerance * scale, 1e-300), stol=1e-14
        )
        self.snes.solve(None, self.vector)
        self.linear += self.snes.getLinearSolveIterations()
        self.newton += self.snes.getIterationNumber()
        reason = int(self.snes.getConvergedReason())
        return f"SNES: {REASONS.get(reason, f'reason {reason}')}" if reason < 0 else ""

    def _function(self, snes: Any, a: Any, out: Any) -> None:
        h, system, values = self.step, self.system, a.array_r
        self._place(self.method.beta * h * h, values)
        result = out.array
        result[:] = self.mass.times(values, self._one)
        if self.damping is not None:
            rate = self._fixed_v + self.method.gamma * h * values
            result += self.damping.times(rate, self._one)
        result += system.residual()
        result -= system.force(self._t)
        result[system.fixed] = self.operator.diagonal * values[system.fixed]

    def _jacobian(self, snes: Any, a: Any, J: Any, P: Any) -> None:
        self._place(self.method.beta * self.step**2, a.array_r)
        self.operator.build(*self._factors)

    def summary(self) -> str:
        """What solving took, in words; collective."""
        text = f"{self.linear / max(self.steps, 1):.1f} linear iterations per step"
        return text + (f", {self.newton / max(self.steps, 1):.2f} of SNES" if self.snes else "")

    def close(self) -> None:
        """Free PETSc's objects."""
        super().close()
        self.operator.close()
        for thing in (self.ksp, self.snes, self.vector, self.right):
            if thing is not None:
                thing.destroy()
