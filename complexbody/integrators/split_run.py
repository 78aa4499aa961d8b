# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A run in progress that is explicit in u and implicit in ν: ``Implicit(forces="implicit")``.

With x = (u, ν), V all stored and potential energy and f = −∂V plus loads, one step is

.. math:: \bar u = u_n + \tfrac h2 \dot u_n,\qquad
          M(w_{n+1}-w_n) + \eta\Delta = h f_\nu(\bar u, \nu_\vartheta, t_{n+1/2}),\qquad
          \rho(\dot u_{n+1}-\dot u_n) = h f_u(\bar u, \nu_\vartheta, t_{n+1/2}),\qquad
          u_{n+1} = \bar u + \tfrac h2\dot u_{n+1},

Δ = ν_{n+1} − ν_n, ν_ϑ = ν_n + ϑΔ and Δ = h(ϑw_{n+1} + (1−ϑ)w_n): Strang's splitting with the
implicit midpoint (ϑ = ½, order 2, symplectic where η = 0), or backward Euler (ϑ = 1, order 1, which
damps what it does not resolve).

*Stability.* For quadratic V ⪰ 0 a multiplier λ, |λ| > 1, with u-part z would satisfy
(2 − λ − 1/λ) z·ρz = h² z·(A − C G(λ)⁻¹Cᵀ)z, A = K_uu, C = K_uν, G = K_νν + (η/h)g + (M/h²)g², with
g = 2(λ−1)/(λ+1) or 1 − 1/λ. There Re g > 0, and the imaginary parts of the two sides have opposite
signs unless λ is real; then A − CG⁻¹Cᵀ ≻ 0 excludes λ > 1, and λ < −1 needs h²A above 4ρ. So the
step is that of u with ν held, 4ρ − h²K_uu ≻ 0, whatever the coupling, ρ̄ and η.

*Energy.* With the step's midpoints ν_m and r = Δ/h, for ϑ = ½ and linear forces

.. math:: E_h = \tfrac12\dot u\cdot(\rho-\tfrac{h^2}{4}A)\dot u + V(u_n,\nu_m) + \tfrac12 r\cdot Mr

changes by exactly −δ·ηδ/h, δ the difference of two neighbouring ν_m, and by the works.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.errors import SolverError
from complexbody.integrators.entries import Entries
from complexbody.integrators.force_run import ForceRun
from complexbody.integrators.nu_newton import NothingToSolve, NuNewton
from complexbody.integrators.snapshot import Snapshot
from complexbody.integrators.split_books import Books
from complexbody.masses import Masses, pencil_basis
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.implicit import Implicit

Array = npt.NDArray[np.float64]


class SplitRun(ForceRun):
    """A run in progress, explicit in u and implicit in ν.

    Attributes:
        theta: ϑ.
        rate: Rates at t_n (nodes, n); where ν has no inertia: of the last drift.
        momentum: Mw at t_n, integrated over nodal volumes (nodes, k).
        start: (u, ν) at t_n; middle: (ū, ν_ϑ) of the step from there (nodes, n).
        moved: Change of (u, ν) in that step, where it has been solved for (``ahead``).
        count: Newton iterations in all, the most of one step, steps solved.
        linear: Iterations of SNES's linear solver.
    """

    def __init__(self, problem: Problem, method: Implicit, step: float, critical: float) -> None:
        super().__init__(problem, step, critical)
        self.method, self.theta = method, 0.5 if method.order == 2 else 1.0
        disc, kernels, masses = problem.disc, problem.kernels, problem.masses
        self.n, self.n_u, klass = disc.n, problem.scene.displacement, masses.classes[:-1]
        kernels.select(masses.diagonal, damped=False)
        kernels.sums[:] = 0.0
        kernels.x[:] = 0.0
        kernels.v[:] = 0.0
        kernels.x[:-1, : self.n] = problem.initial_fields
        self.fixed = masses.fixed[klass]
        self.mass = np.ascontiguousarray(masses.full(masses.inertia, masses.density))
        self.eta = masses.viscosity[klass] * disc.volume[:, None, None]
        self.inertia = masses.inertia[klass] * disc.volume[:, None, None]
        self.heavy = masses.density[klass] * disc.volume
        inverse, regular = _momentum_to_rate(masses)
        self._inverse = inverse[klass] / disc.volume[:, None, None]
        # Where ν has inertia in all free components, rates follow from momenta.
        self._inertial = regular[klass]
        self.start, self.middle, self.moved, self.force = (
            np.zeros((disc.nodes, self.n)) for _ in range(4)
        )  # fmt: skip
        self.rate = self._first_rates()
        self._rates = native.aligned(kernels.x.shape)
        nu = slice(self.n_u, self.n)
        self.momentum = np.einsum("aij,aj->ai", self.inertia, self.rate[:, nu])
        self.count, self.linear, self.ahead = np.zeros(3, np.int64), 0, False
        self._drifts = 0.0 * self.rate[:, nu], 0.0 * self.rate[:, nu]  # the last Δ, and before it
        self._drifts[0][:] = np.where(self._inertial[:, None], step * self.rate[:, nu], 0.0)
        self.books = Books(self)
        self.solver = NuNewton(self) if problem.scene.descriptor else NothingToSolve(self)

    def _first_rates(self) -> Array:
        """Initial rates; those of components without inertia follow from D q̇ = f."""
        problem, kernels, masses = self.problem, self.problem.kernels, self.problem.masses
        rates, klass = problem.rates_at_start(1e-3 * self.step), masses.classes[:-1]
        massless = np.einsum("cii->ci", self.mass) == 0
        self._forces_at(0.0)
        f = kernels.f[:-1, : self.n] / problem.disc.volume[:, None]
        first = masses.recursion(self.step, "forward").massless[klass]
        known = np.einsum("aij,aj->ai", first, f)
        return np.where(massless[klass] & ~self.fixed, known, rates)

    # --- forces --------------------------------------------------------------------------------

    def _forces_at(self, t: float) -> None:
        """f at kernels.x and the loads of time t, summed over ranks; collective."""
        problem = self.problem
        problem.kernels.reset_forces()
        problem.load_forces(self.amplitude(t))
        problem.kernels.c.cb_forces(ctypes.byref(problem.kernels.state))
        self.updates += problem.disc.count
        if problem.comm.size > 1:
            self._exchange_begin()
            self._exchange_end()

    def evaluate(self, delta: Array) -> None:
        """Forces at (ū, ν_n + ϑΔ) and mid-step; collective."""
        x = self.problem.kernels.x
        self.middle[:, self.n_u :] = self.start[:, self.n_u :] + self.theta * delta
        x[:-1, : self.n] = self.middle
        self._forces_at(self.time + 0.5 * self.step)

    # --- steps ---------------------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Do ``steps`` steps; collective.

        Raises:
            SolverError: if a step has no solution; the state is then that before the step.
        """
        for _ in range(steps):
            self._look()
            self._commit()

    def _look(self) -> None:
        """Solve for the step from t_n, leaving the state at t_n as it is."""
        if self.ahead:
            return
        problem, h, n, n_u = self.problem, self.step, self.n, self.n_u
        kernels = problem.kernels
        self.start[:] = kernels.x[:-1, :n]
        self.moved[:, :n_u] = 0.5 * h * self.rate[:, :n_u]
        guess = 2 * self._drifts[0] - self._drifts[1] if self.steps > 1 else self._drifts[0].copy()
        guess[self.fixed[:, n_u:]] = 0.0
        self.moved[:, n_u:] = guess
        rows, columns = problem.moving
        if len(rows):
            change = problem.targets(self.time + h) - self.start[rows, columns]
            self.moved[rows, columns] = np.where(columns < n_u, 0.5, 1.0) * change
        self.middle[:, :n_u] = self.start[:, :n_u] + self.moved[:, :n_u]
        why = self.solver.solve(self.moved[:, n_u:])
        self.force[:] = kernels.f[:-1, :n]
        kernels.x[:-1, :n] = self.start
        if problem.comm.allreduce(bool(why)):
            raise SolverError(
                f"The step from t = {self.time:.6g} s has no solution: {why}. Use a smaller step "
                f"than {h:.3g} s, or check the energy at large ν: the last state is kept."
            )
        self.moved[:, n_u:] = self.solver.delta
        kick = np.where(self.fixed[:, :n_u], 0.0, h * self.force[:, :n_u] / self.heavy[:, None])
        self.after = self.rate[:, :n_u] + kick
        # u's second half of the drift.
        half = np.where(self.fixed[:, :n_u], self.moved[:, :n_u], 0.5 * h * self.after)
        self.moved[:, :n_u] += half
        self.ahead = True

    def _commit(self) -> None:
        """Take the step that was solved for, and book it."""
        problem, h, n, n_u = self.problem, self.step, self.n, self.n_u
        kernels = problem.kernels
        delta = self.moved[:, n_u:]
        before = self.rate.copy()
        self.rate[:, :n_u] = self.after
        kernels.x[:-1, :n] = self.start + self.moved
        kernels.v[:-1, :n] = self.moved / h
        impulse = np.einsum("aij,aj->ai", self.inertia, delta) / (self.theta * h)
        self.momentum[:] = impulse - (1 / self.theta - 1) * self.momentum
        rates = np.einsum("aij,aj->ai", self._inverse, self.momentum)
        self.rate[:, n_u:] = np.where(self._inertial[:, None], rates, delta / h)
        rows, columns = problem.moving
        if len(rows):
            # The rate at a step's own time is the mean of both drifts beside it.
            target = problem.targets(self.time + h), problem.targets(self.time + 2 * h)
            kernels.x[rows, columns] = target[0]
            self.rate[rows, columns] = (target[1] - self.start[rows, columns]) / (2 * h)
        self._drifts = delta.copy(), self._drifts[0]
        self.books.step(before)
        self.steps += 1
        self.ahead = False

    # --- what the future depends on ------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """The run between two steps; arrays are views, valid until a step; collective."""
        saved = super().snapshot()
        saved.nodes |= {"rate": self.rate, "momentum": self.momentum}
        saved.nodes |= {"drift": self._drifts[0], "drift_before": self._drifts[1]}
        saved.numbers["ahead"] = self.ahead
        numbers = [*(int(c) for c in self.count), self.linear]
        saved.numbers |= dict(zip(("newton", "most", "solved", "linear"), numbers, strict=True))
        self.books.save(saved)
        return saved

    def _refresh(self, saved: Snapshot) -> None:
        self.rate[:], self.momentum[:] = saved.nodes["rate"], saved.nodes["momentum"]
        self._drifts = saved.nodes["drift"].copy(), saved.nodes["drift_before"].copy()
        self.books.restore(saved)
        self.ahead = False
        if saved.numbers["ahead"]:
            self._look()
        numbers = saved.numbers
        self.count[:] = numbers["newton"], numbers["most"], numbers["solved"]
        self.linear = int(numbers["linear"])

    # --- what a user sees at t_n ---------------------------------------------------------------

    def sample(self) -> tuple[Array, Array]:
        """(u, ν) and rates at t_n as node records: views, valid until a step; collective.

        Where ν has no inertia its rate is the mean of the drifts before and behind t_n (order 2:
        the next step is solved for), or that of the last drift (order 1).
        """
        kernels, n_u = self.problem.kernels, self.n_u
        self._rates[:-1, : self.n] = self.rate
        partial = not np.all(self._inertial)
        if self.theta < 1 and self.steps > 0 and self.problem.comm.allreduce(partial):
            self._look()
            both = (self._drifts[0] + self.moved[:, n_u:]) / (2 * self.step)
            free = ~self._inertial[:, None] & ~self.fixed[:, n_u:]
            self._rates[:-1, n_u : self.n] = np.where(free, both, self.rate[:, n_u:])
        return kernels.x, self._rates

    def entries(self) -> Entries:
        """Energies and works at t_n; for order 2 and linear forces with the discrete energy."""
        return self.books.entries()

    def summary(self) -> str:
        """What solving took, in words."""
        steps, newton = max(int(self.count[2]), 1), max(int(self.count[0]), 1)
        return (
            f"{self.count[0] / steps:.2f} Newton iterations per step, at most {self.count[1]}; "
            f"{self.linear / newton:.1f} linear ones per Newton"
        )

    def close(self) -> None:
        """Free what the solver holds."""
        self.solver.close()


def _momentum_to_rate(masses: Masses) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Per class Ω⁻¹ on free components (classes, k, k), and whether Ω is regular there."""
    out, regular = np.zeros_like(masses.inertia), np.ones(len(masses.density), bool)
    for c, fixed in enumerate(masses.fixed[:, masses.n_u :]):
        ix = np.ix_(~fixed, ~fixed)
        block = masses.inertia[c][ix]
        m = pencil_basis(block, masses.viscosity[c][ix])[1] if block.size else np.zeros(0)
        regular[c] = bool(np.all(m > 0))
        if regular[c]:
            out[c][ix] = np.linalg.inv(block)
    return out, regular
