# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The semi-discrete equations as PETSc's time steppers want them.

"alpha2" takes Mq̈ + Dq̇ + r(q) = F itself; "rk4", "cn", "theta" take

.. math:: \dot x = v,\qquad M\dot v + Dv + r(x) = F(t),

the implicit ones with x eliminated from Newton's equations: σ²M + σD + ∂r/∂q is left, σ the shift.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from complexbody import _compat
from complexbody.integrators.solvers import KRYLOV, Operator, options

if TYPE_CHECKING:
    from complexbody.integrators.petsc_ts import PetscRun

Array = npt.NDArray[np.float64]

INNER = "cb_ts_inner_"


class SecondOrder:
    """Mq̈ + Dq̇ + r(q) − F for "alpha2"."""

    failed = 0

    def __init__(self, run: PetscRun, defaults: dict[str, str]) -> None:
        self.given: Mapping[str, str] = run.method.options
        self.run, self.operator, self._seen = run, Operator(run), 0
        run.ts.setType("alpha2")
        defaults |= KRYLOV | {"ts_alpha_radius": str(run.method.radius)}
        if run.system.linear:
            # Rates follow from the fields where the residual is: it must be seen at the solution.
            tolerance = run.method.tolerance
            defaults |= {
                "snes_type": "newtonls", "snes_linesearch_type": "basic",
                "snes_rtol": str(tolerance), "ksp_rtol": str(0.5 * tolerance),
            }  # fmt: skip
        self.x, self.v, self.out = (
            _compat.petsc_vector(run.system.q).duplicate() for _ in range(3)
        )  # fmt: skip
        self.x.array[:], self.v.array[:] = run.system.x, run.v
        run.ts.setI2Function(self._function, self.out)
        run.ts.setI2Jacobian(self._jacobian, self.operator.matrix)
        run.ts.setSolution2(self.x, self.v)

    def _function(self, ts: Any, t: float, x: Any, v: Any, a: Any, out: Any) -> None:
        run, result = self.run, out.array
        run.forces(t, x.array_r, result)
        result += run.mass.times(a.array_r, run._one)
        if run.damping is not None:
            result += run.damping.times(v.array_r, run._one)
        fixed = run.system.fixed
        result[fixed] = self.operator.diagonal * (x.array_r[fixed] - run.given)

    def _jacobian(
        self, ts: Any, t: float, x: Any, v: Any, a: Any, sv: float, sa: float, J: Any, P: Any
    ) -> None:
        if not self.run.system.linear:
            self.run.system.x[:] = x.array_r
            self.run.system.q.x.scatter_forward()
        self.operator.build(sa, sv, 1.0)

    def read(self) -> None:
        """Take x and v from PETSc."""
        self.run.system.x[:] = self.x.array_r
        self.run.v = self.v.array_r.copy()

    def iterations(self) -> int:
        """Linear iterations since the last call."""
        before, self._seen = self._seen, self.run.ts.getKSPIterations()
        return int(self._seen - before)

    def close(self) -> None:
        """Free PETSc's objects."""
        self.operator.close()
        for vector in (self.x, self.v, self.out):
            vector.destroy()


class FirstOrder:
    """(x, v) in one vector, x first, for "rk4"."""

    failed = 0

    def __init__(self, run: PetscRun, defaults: dict[str, str]) -> None:
        self.given: Mapping[str, str] = run.method.options
        self.run, self.size = run, run.system.size
        self.y = PETSc.Vec().createMPI((2 * self.size, None), comm=run.problem.comm)
        self.y.array[: self.size], self.y.array[self.size :] = run.system.x, run.v
        self.out = self.y.duplicate()
        self._set_up(defaults)
        run.ts.setSolution(self.y)

    def _set_up(self, defaults: dict[str, str]) -> None:
        self.run.ts.setType("rk")
        defaults["ts_rk_type"] = "4"
        self.run.ts.setRHSFunction(self._right, self.out)

    def _right(self, ts: Any, t: float, y: Any, out: Any) -> None:
        run, (x, v) = self.run, self.parts(y.array_r)
        rate = out.array
        rate[: self.size] = v
        force = run.forces(t, x, run._two)
        if run.damping is not None:
            force += run.damping.times(v, run._one)
        run.inverse_mass.times(force, rate[self.size :])
        rate[self.size :] *= -1.0

    def parts(self, y: Array) -> tuple[Array, Array]:
        """Views of x and v in an array."""
        return y[: self.size], y[self.size :]

    def read(self) -> None:
        """Take x and v from PETSc."""
        x, v = self.parts(self.y.array_r)
        self.run.system.x[:] = x
        self.run.v = v.copy()

    def iterations(self) -> int:
        """Linear iterations since the last call."""
        return 0

    def close(self) -> None:
        """Free PETSc's objects."""
        self.y.destroy()
        self.out.destroy()


class Theta(FirstOrder):
    """The same implicitly, for "cn" and "theta": Newton's equations with x eliminated.

    σδx − δv = a and K δx + (σM + D)δv = b give (σ²M + σD + K) δx = b + (σM + D)a.
    """

    def _set_up(self, defaults: dict[str, str]) -> None:
        run, ts = self.run, self.run.ts
        self.operator, self.shift, self._count = Operator(run), 0.0, 0
        ts.setType("cn" if run.method.kind == "cn" else "theta")
        if run.method.kind == "theta":
            ts.setTheta(0.5)
            ts.setThetaEndpoint(False)
        comm = run.problem.comm
        sizes = (2 * self.size, None), (2 * self.size, None)
        self.shell = PETSc.Mat().createPython(sizes, self, comm=comm)
        self.shell.setUp()
        self.inner = PETSc.KSP().create(comm)
        self.inner.setOptionsPrefix(INNER)
        self.inner.setOperators(self.operator.matrix)
        # Every equation is solved by the inner solver: the outer one has nothing left to do.
        tolerance, given = defaults.pop("ksp_rtol"), run.method.options
        self.given = {n: v for n, v in given.items() if n.startswith(("ts_", "snes_"))}
        within = {n: v for n, v in given.items() if n not in self.given}
        with options(INNER, KRYLOV | {"ksp_rtol": tolerance}, within):
            self.inner.setFromOptions()
        self.b, self.dx = (_compat.petsc_vector(run.system.q).duplicate() for _ in range(2))
        ts.setIFunction(self._function, self.out)
        ts.setIJacobian(self._jacobian, self.shell)
        outer = ts.getSNES().getKSP()
        outer.setType("preonly")
        outer.getPC().setType("python")
        outer.getPC().setPythonContext(self)

    def _function(self, ts: Any, t: float, y: Any, rate: Any, out: Any) -> None:
        run, (x, v), (dx, dv) = self.run, self.parts(y.array_r), self.parts(rate.array_r)
        first, second = self.parts(out.array)
        first[:] = dx - v
        run.forces(t, x, second)
        second += run.mass.times(dv, run._one)
        if run.damping is not None:
            second += run.damping.times(v, run._one)
        fixed = run.system.fixed
        second[fixed] = self.operator.diagonal * dv[fixed]

    def _jacobian(self, ts: Any, t: float, y: Any, rate: Any, shift: float, J: Any, P: Any) -> None:
        system, self.shift = self.run.system, shift
        if not system.linear:
            system.x[:] = y.array_r[: self.size]
            system.q.x.scatter_forward()
        self.operator.build(shift**2, shift, 1.0)

    def _inertia(self, rate: Array) -> Array:
        """(σM + D) times rates."""
        run = self.run
        product = self.shift * run.mass.times(rate, run._one)
        if run.damping is not None:
            product += run.damping.times(rate, run._one)
        return product

    def apply(self, pc: Any, right: Any, out: Any) -> None:
        """Solve for (δx, δv)."""
        (a, b), (dx, dv) = self.parts(right.array_r), self.parts(out.array)
        values = self.b.array
        values[:] = b + self._inertia(a)
        values[self.run.system.fixed] = 0.0
        self.inner.solve(self.b, self.dx)
        self._count += self.inner.getIterationNumber()
        if self.inner.getConvergedReason() < 0:
            # SNES does not look here: the run does.
            self.failed = self.inner.getConvergedReason()
        dx[:] = self.dx.array_r
        dv[:] = self.shift * dx - a

    def mult(self, matrix: Any, y: Any, out: Any) -> None:
        """The Jacobian times a vector, for line searches."""
        (dx, dv), (first, second) = self.parts(y.array_r), self.parts(out.array)
        first[:] = self.shift * dx - dv
        # K = (σ²M + σD + K) − σ(σM + D).
        self.dx.array[:] = dx
        self.operator.matrix.mult(self.dx, self.b)
        second[:] = self.b.array_r - self.shift * self._inertia(dx) + self._inertia(dv)
        fixed = self.run.system.fixed
        second[fixed] = self.operator.diagonal * self.shift * dv[fixed]

    def iterations(self) -> int:
        """Linear iterations since the last call."""
        count, self._count = self._count, 0
        return count

    def close(self) -> None:
        """Free PETSc's objects."""
        super().close()
        self.operator.close()
        for thing in (self.shell, self.inner, self.b, self.dx):
            thing.destroy()
