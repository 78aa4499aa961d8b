# SPDX-License-Identifier: LGPL-3.0-or-later
r"""χ integrated in full: the rates of all nodes together, by PETSc's SNES.

The residual ∫[p − (1−s)h q + (1−s)h ηv]·φ dx − b and its Jacobian are compiled once and SNES is
built once; between steps only ν, b and the guess change. With h = 0 the same forms give the rates
that belong to momenta at one time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import dolfinx.fem.petsc  # noqa: F401  (0.9 does not load it with dolfinx.fem)
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from complexbody import _compat
from complexbody.kinetics import derivatives

if TYPE_CHECKING:
    from complexbody.integrators.implicit_run import ImplicitRun

Array = npt.NDArray[np.float64]

PREFIX = "cb_implicit_"
DEFAULTS = {"snes_type": "newtonls", "snes_linesearch_type": "bt", "ksp_rtol": "1e-6",
            "pc_type": "sor"}  # fmt: skip

#: SNESConvergedReason below zero, in words.
REASONS = {
    -1: "a function had an argument outside its domain", -2: "too many function evaluations",
    -3: "the linear solve failed: the Jacobian may be singular", -4: "values are not finite",
    -5: "Newton does not converge within the allowed iterations", -6: "the line search failed",
    -8: "a local minimum of the residual is no solution", -9: "it diverges",
}  # fmt: skip


class GlobalNewton:
    """SNES for the momenta of an implicit run; what :class:`ImplicitRun` asks of a solver.

    Args:
        run: The run, whose arrays it works on.
    """

    def __init__(self, run: ImplicitRun) -> None:
        self.run, self.problem = run, run.problem
        scene, k = run.problem.scene, run.problem.scene.descriptor
        self.k, self.nu_columns = k, scene.components_of("nu")
        space = _compat.vector_space(scene.mesh, k)
        self.nu, self.rate = fem.Function(space), fem.Function(space)
        self.h = fem.Constant(scene.mesh, run.step)
        phi, s = ufl.TestFunction(space), run.s
        left = after = energy = loss = 0
        action = run.problem.action
        for r, body in enumerate(run.problem.inertias):
            dx = action.measure(r)
            chi, p, q = derivatives(body, self.nu + s * self.h * self.rate, self.rate)[:3]
            damping = ufl.dot(ufl.as_matrix(body.viscosity_matrix.tolist()), self.rate)
            left += ufl.inner(p + (1 - s) * self.h * (damping - q), phi) * dx
            after += ufl.inner(p + s * self.h * (q - damping), phi) * dx
            energy += (ufl.inner(p, self.rate) - chi) * dx
            loss += ufl.inner(damping, self.rate) * dx
        self._left, self._after = _compat.form(left), _compat.form(after)
        self._energy, self._loss = _compat.form(energy), _compat.form(loss)
        tangent = ufl.derivative(left, self.rate, ufl.TrialFunction(space))
        self._tangent = _compat.form(tangent)
        self.size = space.dofmap.index_map.size_local * k
        fixed = np.zeros((len(self.nu.x.array) // k, k), bool)
        fixed[run.problem.disc.dof] = run._fixed[:, self.nu_columns]
        self._fixed = np.flatnonzero(fixed.ravel()[: self.size]).astype(np.int32)
        self.b = np.zeros(self.size)
        self._given = np.zeros(len(self._fixed))
        self._set_up()

    def _set_up(self) -> None:
        method, comm = self.run.method, self.problem.comm
        self.matrix = fem.petsc.create_matrix(self._tangent)
        self._residual = fem.petsc.create_vector(self._left)
        self.vector = self._residual.duplicate()
        self.snes = PETSc.SNES().create(comm)
        self.snes.setOptionsPrefix(PREFIX)
        self.snes.setFunction(self._function, self._residual)
        self.snes.setJacobian(self._jacobian, self.matrix)
        options = PETSc.Options(PREFIX)
        wanted = dict(DEFAULTS, ksp_type="cg" if self.k == 1 else "gmres")
        wanted["snes_max_it"] = str(method.iterations)
        if method.monitor:
            wanted["snes_monitor"] = ""
        # What the user gives on PETSc's command line comes before our defaults.
        mine = {name: v for name, v in wanted.items() if not options.hasName(name)}
        mine |= dict(method.options)
        for name, value in mine.items():
            options.setValue(name, value)
        self.snes.setFromOptions()
        for name in mine:
            options.delValue(name)

    # --- callbacks -----------------------------------------------------------------------------

    def _take(self, x: Any) -> None:
        self.rate.x.array[: self.size] = x.array_r
        self.rate.x.scatter_forward()

    def _assemble(self, form: Any, out: Any) -> None:
        with out.localForm() as local:
            local.set(0.0)
        fem.petsc.assemble_vector(out, form)
        out.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)

    def _function(self, snes: Any, x: Any, out: Any) -> None:
        self._take(x)
        self._assemble(self._left, out)
        values = out.array
        values -= self.b
        values[self._fixed] = x.array_r[self._fixed] - self._given

    def _jacobian(self, snes: Any, x: Any, J: Any, P: Any) -> None:
        self._take(x)
        P.zeroEntries()
        fem.petsc.assemble_matrix(P, self._tangent)
        P.assemble()
        P.zeroRowsColumnsLocal(self._fixed, 1.0)

    # --- what the run asks ---------------------------------------------------------------------

    def _scatter(self, records: Array, function: Any) -> None:
        values = np.ascontiguousarray(records[: self.problem.disc.nodes])
        self.problem.disc.scatter(values, function)

    def _owned(self, records: Array) -> Array:
        """Values (nodes, k) in dolfinx's order of owned unknowns."""
        full = np.zeros((len(self.nu.x.array) // self.k, self.k))
        full[self.problem.disc.dof] = records
        return full.ravel()[: self.size]

    def _solve(self, right: Array, guess: Array, h: float) -> tuple[str, int]:
        """Solve for ``self.rate`` from the guess (nodes, k), whose prescribed entries stay."""
        self.h.value = h
        self._scatter(self.problem.kernels.x[:, self.nu_columns], self.nu)
        self._scatter(guess, self.rate)
        self.b[:] = self._owned(right)
        start = self.rate.x.array[: self.size].copy()
        self._given[:] = start[self._fixed]
        self.vector.array[:] = start
        self._function(self.snes, self.vector, self._residual)
        free = np.ones(self.size, bool)
        free[self._fixed] = False
        comm = self.problem.comm
        size = comm.allreduce(float(np.sum(self.b[free] ** 2)))
        first = comm.allreduce(float(np.sum((self._residual.array + self.b)[free] ** 2)))
        scale = np.sqrt(max(size, first))
        self.snes.setTolerances(rtol=0.0, atol=max(self.run.method.tolerance * scale, 1e-300),
                                stol=1e-15)  # fmt: skip
        self.snes.solve(None, self.vector)
        iterations = self.snes.getIterationNumber()
        count = self.run.count
        count[:] = count[0] + iterations, max(count[1], iterations), count[2] + 1
        self.run.linear += self.snes.getLinearSolveIterations()
        reason = int(self.snes.getConvergedReason())
        if reason < 0:
            return f"SNES: {REASONS.get(reason, f'reason {reason}')}", -1
        self._take(self.vector)
        return "", -1

    def _read(self, form: Any, out: Array) -> None:
        """Assemble a form at ``self.rate`` into nodal values (nodes, k)."""
        if not hasattr(self, "_buffer"):
            self._buffer = fem.Function(self.nu.function_space)
        vector = _compat.petsc_vector(self._buffer)
        self._assemble(form, vector)
        vector.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
        out[:] = self._buffer.x.array.reshape(-1, self.k)[self.problem.disc.dof]

    def solve(self) -> tuple[str, int]:
        """Next rates and momenta of the run."""
        run, kernels, disc = self.run, self.problem.kernels, self.problem.disc
        n_u, h, nu = self.problem.scene.displacement, run.step, self.nu_columns
        f, v, fixed = kernels.f[:-1], kernels.v[:-1], run._fixed
        free_u = v[:, :n_u] + h * f[:, :n_u] / run._masses[:, None]
        run.next[:-1, :n_u] = np.where(fixed[:, :n_u], run.next[:-1, :n_u], free_u)
        guess = np.where(fixed[:, nu], run.next[:-1, nu], 2 * v[:, nu] - run.previous[:-1, nu])
        right = run.momentum + h * f[:, nu]
        why = self._solve(right, guess, h)
        run.next[:-1, nu] = self.rate.x.array.reshape(-1, self.k)[disc.dof]
        if why[0]:
            return why
        self._read(self._after, run.after)
        if run.reaction is not None:
            run.reaction[:-1, :n_u] = run._masses[:, None] * (run.next[:-1, :n_u] - v[:, :n_u])
            run.reaction[:-1, :n_u] -= h * f[:, :n_u]
            left = np.zeros_like(run.after)
            self._read(self._left, left)
            run.reaction[:-1, nu] = left - right
        return why

    def commit(self) -> None:
        """Take the step that was solved for, and book it."""
        run, kernels, disc = self.run, self.problem.kernels, self.problem.disc
        n, n_u, h = disc.n, self.problem.scene.displacement, run.step
        jump = np.abs(run.next[:-1, :n] - kernels.v[:-1, :n]) * (disc.volume * disc.owned)[:, None]
        kernels.sums[0] += h * fem.assemble_scalar(self._loss)
        kernels.sums[1] += jump[:, :n_u].sum()
        kernels.sums[2] += jump[:, n_u:].sum()
        run.previous[:] = kernels.v
        kernels.v[:] = run.next
        kernels.x[:-1, :n] += h * run.next[:-1, :n]
        run.momentum[:] = run.after

    def momenta(self, rates: Array, out: Array) -> None:
        """∫∂χ/∂ν̇ φ dx at (ν, rates), shape (nodes, k)."""
        self.h.value = 0.0
        self._scatter(self.problem.kernels.x[:, self.nu_columns], self.nu)
        self._scatter(rates[:, self.nu_columns], self.rate)
        self._read(self._left, out)

    def rates(self, momentum: Array, rates: Array) -> tuple[str, int]:
        """Rates of given momenta at this time, from the guess in ``rates``."""
        why = self._solve(momentum, rates[:-1, self.nu_columns], 0.0)
        rates[:-1, self.nu_columns] = self.rate.x.array.reshape(-1, self.k)[self.problem.disc.dof]
        return why

    def kinetic(self, rates: Array) -> float:
        """∫∂χ/∂ν̇·ν̇ − χ of this rank [J]."""
        self.h.value = 0.0
        self._scatter(self.problem.kernels.x[:, self.nu_columns], self.nu)
        self._scatter(rates[:, self.nu_columns], self.rate)
        return float(fem.assemble_scalar(self._energy))

    def close(self) -> None:
        """Free PETSc's objects."""
        for thing in (self.snes, self.matrix, self._residual, self.vector):
            thing.destroy()
        if hasattr(self, "_buffer"):
            _compat.free_vector(self._buffer)
