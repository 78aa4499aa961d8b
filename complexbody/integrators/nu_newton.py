# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The change Δ of ν in one step at frozen u, with all forces on ν taken implicitly, by SNES.

Residual, nodal matrices by the vertex rule and V a node's lumped volume,

.. math:: V\Big(\frac{\Omega}{\vartheta h^2} + \frac{\eta}{h}\Big)\Delta - \frac{\pi}{\vartheta h}
          - f_\nu(\bar u, \nu + \vartheta\Delta) = 0,

ϑ = ½ (midpoint) or 1 (backward Euler). Forces come from the scene's kernels. Where they are linear
the matrix and its preconditioner are made once, and one Newton step solves it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from complexbody.integrators.global_newton import PREFIX, REASONS
from complexbody.integrators.nu_stiffness import NuStiffness

if TYPE_CHECKING:
    from complexbody.integrators.split_run import SplitRun

Array = npt.NDArray[np.float64]

DEFAULTS = {"snes_type": "newtonls", "snes_linesearch_type": "bt", "ksp_type": "cg",
            "ksp_norm_type": "unpreconditioned"}  # fmt: skip

#: Stiffness over inertia and viscosity from which multigrid beats symmetric Gauss–Seidel.
STIFF = 200.0


class NuNewton:
    """SNES for Δ; what :class:`SplitRun` asks of a solver.

    Args:
        run: The run; its forces are evaluated at the trial state.
    """

    def __init__(self, run: SplitRun) -> None:
        self.run, self.problem = run, run.problem
        self.stiffness = NuStiffness(run.problem)
        h, theta, masses = run.step, run.theta, run.problem.masses
        klass = masses.classes[:-1]
        nodal = masses.inertia / (theta * h * h) + masses.viscosity / h
        self.nodal = nodal[klass] * run.problem.disc.volume[:, None, None]
        self.delta = np.zeros((run.problem.disc.nodes, self.stiffness.k))
        self._known: Array | None = None
        self.stiffness.assemble(theta, self.nodal, run.problem.kernels.x)
        # Sizes of the terms that cancel in a residual, for its tolerance.
        self._whole = np.abs(self.stiffness.matrix.getDiagonal().array) * self.stiffness.free
        own = self.stiffness.local(np.einsum("aii->ai", self.nodal))
        self._own = np.abs(self._whole - own) * self.stiffness.free / theta
        self._set_up()

    def _set_up(self) -> None:
        method, size = self.run.method, self.stiffness.size
        linear = self.stiffness.constant
        self.vector = PETSc.Vec().createMPI((size, None), comm=self.problem.comm)
        self._residual = self.vector.duplicate()
        self.snes = PETSc.SNES().create(self.problem.comm)
        self.snes.setOptionsPrefix(PREFIX)
        self.snes.setFunction(self._function, self._residual)
        self.snes.setJacobian(self._jacobian, self.stiffness.matrix)
        options = PETSc.Options(PREFIX)
        wanted = dict(DEFAULTS)
        wanted["pc_type"] = "gamg" if self._stiffness_ratio() > STIFF else "sor"
        wanted["ksp_rtol"] = "1e-13" if linear else "1e-6"
        wanted["snes_max_it"] = str(method.iterations)
        if method.monitor:
            wanted["snes_monitor"] = ""
        # What the user gives on PETSc's command line comes before our defaults.
        mine = {name: v for name, v in wanted.items() if not options.hasName(name)}
        mine |= dict(method.options)
        for name, value in mine.items():
            options.setValue(name, value)
        self.snes.setFromOptions()
        self._ksp_rtol = self.snes.getKSP().getTolerances()[0]
        for name in mine:
            options.delValue(name)

    def _stiffness_ratio(self) -> float:
        """Largest ratio of a diagonal entry's stiffness to its inertia and viscosity."""
        stiff = self.run.theta * self._own
        free = self.stiffness.free & (self._whole > stiff)
        ratio = float((stiff[free] / (self._whole - stiff)[free]).max(initial=0.0))
        return float(self.problem.comm.allreduce(ratio, op=MPI.MAX))

    # --- callbacks -----------------------------------------------------------------------------

    def _evaluate(self, local: Array) -> Array:
        """Residual of this rank's unknowns; the run's forces are then those at the trial state."""
        self.delta[:] = self.stiffness.spread(local)
        run = self.run
        run.evaluate(self.delta)
        k = self.stiffness.k
        f = self.problem.kernels.f[:-1, self.problem.disc.n - k : self.problem.disc.n]
        out = np.einsum("aij,aj->ai", self.nodal, self.delta) - f
        out -= run.momentum / (run.theta * run.step)
        self._at = local.copy()
        return np.where(self.stiffness.free, self.stiffness.local(out), 0.0)

    def _function(self, snes: Any, x: Any, out: Any) -> None:
        # The first state that SNES asks for is the guess, where the residual is known.
        known, self._known = self._known, None
        out.array[:] = self._evaluate(x.array_r) if known is None else known

    def _jacobian(self, snes: Any, x: Any, J: Any, P: Any) -> None:
        if not self.stiffness.constant:
            # The run stands at the trial state: SNES has evaluated the residual there.
            self.stiffness.assemble(self.run.theta, self.nodal, self.problem.kernels.x)

    # --- what the run asks ---------------------------------------------------------------------

    def solve(self, guess: Array) -> str:
        """Fill ``delta`` and the run's forces from the guess (nodes, k); why it failed, or "".

        Prescribed entries of the guess stay. Collective.
        """
        run, stiffness = self.run, self.stiffness
        start = stiffness.local(guess)
        first = self._known = self._evaluate(start)
        nu = stiffness.local(run.start[:, self.problem.disc.n - stiffness.k :])
        terms = (first, self._whole * start, self._own * nu)
        squares = np.array([np.sum(t * t) for t in terms])
        scale = np.sqrt(self.problem.comm.allreduce(squares).max())
        tolerance = max(run.method.tolerance * scale, 1e-300)
        self.snes.setTolerances(rtol=0.0, atol=tolerance, stol=1e-15)
        self.snes.getKSP().setTolerances(rtol=self._ksp_rtol, atol=0.2 * tolerance)
        self.vector.array[:] = start
        self.snes.solve(None, self.vector)
        iterations = self.snes.getIterationNumber()
        count = run.count
        count[:] = count[0] + iterations, max(count[1], iterations), count[2] + 1
        run.linear += self.snes.getLinearSolveIterations()
        reason = int(self.snes.getConvergedReason())
        if reason < 0:
            return f"SNES: {REASONS.get(reason, f'reason {reason}')}"
        # Some line searches end with another state than the solution.
        if self.problem.comm.allreduce(not np.array_equal(self._at, self.vector.array_r)):
            self._evaluate(self.vector.array_r)
        return ""

    def close(self) -> None:
        """Free PETSc's objects."""
        for thing in (self.snes, self._residual, self.vector):
            thing.destroy()
        self.stiffness.close()


class NothingToSolve:
    """The solver of a scene in which ν was left out, since it stays zero."""

    def __init__(self, run: SplitRun) -> None:
        self.run, self.delta = run, np.zeros((run.problem.disc.nodes, 0))

    def solve(self, guess: Array) -> str:
        """Evaluate the forces; collective."""
        self.run.evaluate(self.delta)
        return ""

    def close(self) -> None:
        """Nothing to free."""
