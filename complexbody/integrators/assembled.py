# SPDX-License-Identifier: LGPL-3.0-or-later
"""The leapfrog that one writes by hand on dolfinx: the recursion of Synchronous on its vectors.

Forces are assembled by dolfinx from ``ufl.derivative`` at each step, or are a product with the
PETSc matrix assembled once. Masses, dissipation, first kick and books are those of
:class:`~complexbody.integrators.synchronous_run.SynchronousRun`: so are results, to round-off.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from complexbody.integrators.entries import Entries, energies, half_quadratic
from complexbody.integrators.peer_run import PeerRun
from complexbody.integrators.snapshot import Snapshot
from complexbody.integrators.synchronous_run import refuse_partial
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.peers import AssembledLeapfrog

Array = npt.NDArray[np.float64]


class AssembledRun(PeerRun):
    """A hand-written leapfrog in progress: its state is (x_n, v_{n−½}), as that of Synchronous.

    Attributes:
        support_work: Of moving supports so far [J].
        ready: Whether ``system.r`` is r(x_n) − F(t_n).
    """

    def __init__(
        self, problem: Problem, method: AssembledLeapfrog, step: float, critical: float
    ) -> None:
        if not problem.masses.diagonal:
            refuse_partial(problem)
        # Blocks of all components: what PETSc multiplies fastest.
        super().__init__(problem, step, critical, "baij" if method.force == "matrix" else "")
        masses, disc, system = problem.masses, problem.disc, self.system
        self._recursion = rec = masses.recursion(step, method.dissipation)
        self._mean = np.ascontiguousarray(rec.mean)
        klass, volume = masses.classes[:-1], disc.volume[:, None, None]
        self._alpha = system.blocks(rec.alpha[klass])
        self._beta = system.blocks(rec.beta[klass] / volume)
        self._to_rate = system.blocks(rec.to_rate[klass])
        self._force_to_rate = system.blocks(rec.force_to_rate[klass] / volume)
        self._supports()
        self.v0 = system.owned(problem.rates_at_start(1e-3 * step))
        self.v, self._new, self._both = (np.zeros(system.size) for _ in range(3))
        self.support_work, self.ready = 0.0, False

    def _supports(self) -> None:
        """Moving components of owned nodes, and M̂ and D of those nodes."""
        problem, system, n = self.problem, self.system, self.system.n
        supports = problem.supports
        self._rows, self._columns = np.nonzero(supports.moving[: system.nodes])
        self._flat = self._rows * n + self._columns
        self.moves = problem.comm.allreduce(len(self._flat)) > 0
        if not self.moves:
            return
        klass, volume = problem.masses.classes[:-1], problem.disc.volume[:, None, None]

        def rows(matrices: Array) -> Array:
            """Row of a node's matrix for each moving component, shape (moving, n)."""
            each = [system.owned(matrices[:, :, j]).reshape(-1, n) for j in range(n)]
            return np.stack([e[self._rows, self._columns] for e in each], axis=1)

        self._mean_rows, self._mass_rows, self._damping_rows = (
            rows(m[klass] * volume)
            for m in (self._recursion.mean, self._recursion.mass, self._recursion.viscosity)
        )

    def _moved(self, rows: Array, rates: Array) -> Array:
        """Rows of moving components times rates of which only those components count."""
        masked = np.zeros_like(rates)
        masked[self._flat] = rates[self._flat]
        return np.einsum("ij,ij->i", rows, masked.reshape(-1, self.system.n)[self._rows])

    # --- steps -----------------------------------------------------------------------------------

    def forces(self) -> None:
        """Bring r to r(x_n) − F(t_n); once per step at most; collective."""
        if not self.ready:
            self.system.residual()
            if self.system.loaded:
                self.system.r -= self.system.force(self.time)
            self.ready = True

    def advance(self, steps: int) -> None:
        """Do ``steps`` steps; collective."""
        h, system = self.step, self.system
        for _ in range(steps):
            self.forces()
            old, new = (self.v, self._new) if self.steps else (self.v0, self._new)
            kick = self._beta.times(system.r, self._one)
            if self.steps:
                self._alpha.times(old, new)
            else:
                klass = self.problem.masses.classes[:-1]
                new[:] = system.blocks(self._recursion.from_rate[klass]).times(old, self._two)
                kick *= 0.5
            new -= kick
            if self.moves:
                new[self._flat] = self._towards(self.time + h)
            if self.damping is not None or system.loaded or self.moves:
                np.add(old, new, out=self._both)
                self._account(old, new)
            self.v, self._new = new, self.v
            system.x += np.multiply(new, h, out=self._one)
            system.q.x.scatter_forward()
            self.steps += 1
            self.ready = False

    def _towards(self, t: float) -> Array:
        """Rates that bring moving components from where they are to their targets at t."""
        targets = self.problem.supports.targets(self._rows, self._columns, t)
        return (targets - self.system.x[self._flat]) / self.step

    def _account(self, old: Array, new: Array) -> None:
        """Work of loads and supports and dissipation of a kick, drifts old and new beside it."""
        h, system, both, first = self.step, self.system, self._both, self.steps == 0
        # The first kick is half of one, behind it half a drift.
        weight = 0.5 if first else 1.0
        if system.loaded:
            self.work += 0.5 * weight * h * float(system.force(self.time) @ both)
        if self.damping is not None:
            product = self.damping.times(both, self._two)
            self.lost += 0.25 * h * float(product @ (new if first else both))
            if first:
                klass, volume = self.problem.masses.classes[:-1], self.problem.disc.volume
                extra = (self._recursion.mean - self._recursion.mass)[klass]
                extra = system.blocks(extra * volume[:, None, None]).times(new, self._two)
                self.lost += 0.5 * float(extra @ old)
        if self.moves:
            if first:
                impulse = self._moved(self._mean_rows, new) - self._moved(self._mass_rows, old)
                impulse += 0.5 * h * self._moved(self._damping_rows, new)
            else:
                impulse = self._moved(self._mean_rows, new - old)
                impulse += 0.5 * h * self._moved(self._damping_rows, both)
            impulse += weight * h * system.r[self._flat]
            self.support_work += 0.5 * float(impulse @ both[self._flat])

    def _add(self, saved: Snapshot) -> None:
        saved.sums["support"] = np.array([self.support_work])
        saved.numbers["ready"] = self.ready

    def _refresh(self, saved: Snapshot) -> None:
        self.support_work, self.ready = float(saved.sums["support"][0]), False
        if saved.numbers["ready"]:
            self.forces()

    # --- what a user sees at t_n -----------------------------------------------------------------

    def rates(self) -> Array:
        """Rates at t_n: half the kick there is done; collective."""
        self.forces()
        kick = self._force_to_rate.times(self.system.r, self._one)
        if self.steps == 0:
            # Components without inertia have the rate that forces give them.
            at = self._massless()
            return np.where(at, -kick, self.v0)
        rates = self._to_rate.times(self.v, self._two)
        rates -= kick
        if self.moves:
            after = self._towards(self.time + self.step)
            rates[self._flat] = 0.5 * (self.v[self._flat] + after)
        return rates

    def _massless(self) -> npt.NDArray[np.bool_]:
        masses = self.problem.masses
        none = (np.einsum("cii->ci", self._recursion.mass) == 0) & ~masses.fixed
        return self.system.owned(none[masses.classes[:-1]].astype(np.float64)) > 0.5

    def entries(self) -> Entries:
        """Energies, works and the discrete energy E_h at t_n; collective."""
        problem, system, h = self.problem, self.system, self.step
        _, records = self.sample()
        common = energies(problem, self.mass_by_class, records)
        work, support, lost = self.work, self.support_work, self.lost
        flows = work + support - lost
        system.write(self.v, problem.kernels.v)
        drift = half_quadratic(problem, self._mean, problem.kernels.v, 0, system.n)
        if self.steps:
            # The half step before t_n, which the next kick would complete.
            both = self.v + self.rates()
            if system.loaded:
                work += 0.25 * h * float(system.force(self.time) @ both)
            if self.damping is not None:
                lost += 0.125 * h * float(self.damping.times(both, self._one) @ both)
            if self.moves:
                support += self._half_work()
        discrete = size = 0.0
        if self.steps and system.linear:
            inner = system.r + system.force(self.time)
            inner = float(inner @ (system.x - h * self.v))
            if system.affine is not None:
                inner += float(system.affine @ system.x)
            discrete, size = drift + 0.5 * inner, abs(drift) + 0.5 * abs(inner)
        return Entries(
            **common, work=work, support_work=support, dissipated=lost,
            surplus=drift + common["stored"] + common["potential"] - flows,
            discrete=discrete, flows=flows if size else 0.0, size=size,
            variation_u=float("nan"), variation_nu=float("nan"),
        )  # fmt: skip

    def _half_work(self) -> float:
        """Work of moving supports in the half step before t_n [J]."""
        h, v = self.step, self.v
        jump, both = np.zeros_like(v), np.zeros_like(v)
        after = self._towards(self.time + h)
        jump[self._flat], both[self._flat] = after - v[self._flat], after + v[self._flat]
        impulse = self._moved(self._mean_rows, jump)
        impulse += 0.5 * h * self._moved(self._damping_rows, both) + h * self.system.r[self._flat]
        return 0.25 * float(impulse @ (v + 0.5 * both)[self._flat])
