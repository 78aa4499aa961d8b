# SPDX-License-Identifier: LGPL-3.0-or-later
"""A synchronous run in progress: forces, kicks and drifts, exchange between ranks, samples.

Every force acts at the step's time, every node drifts between. The state kept is (x_n, v_{n−½});
what a user sees at t_n follows from it without disturbing it.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import native
from complexbody.errors import IntegratorError
from complexbody.integrators.entries import Entries
from complexbody.integrators.force_run import ForceRun
from complexbody.integrators.synchronous_books import entries
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.synchronous import Synchronous

Array = npt.NDArray[np.float64]


def refuse_partial(problem: Problem) -> None:
    """Refuse moving supports of some of the components that inertia or damping couples.

    Raises:
        IntegratorError: on all ranks.
    """
    n_u, (rows, columns) = problem.scene.displacement, problem.moving
    masses, nodes = problem.masses, rows[columns >= n_u]
    bad = not np.all(masses.fixed[masses.classes[nodes], n_u:])
    # Dampers couple components of u, too, and more of some nodes than of others.
    klass = masses.classes[rows]
    linked = masses.damping[klass, columns] != 0
    linked[np.arange(len(rows)), columns] = False
    open_ = bool(np.any(linked & ~masses.fixed[klass]))
    if problem.comm.allreduce(open_, op=MPI.LOR) and masses.absorbing:
        raise IntegratorError(
            "A moving support prescribes some of the components that an absorbing boundary "
            "couples there. Prescribe all of them, or let the two not overlap."
        )
    if problem.comm.allreduce(bool(bad), op=MPI.LOR) and not masses.only_dampers_couple:
        raise IntegratorError(
            "A moving support prescribes some components of a descriptor whose inertia or "
            "viscosity couples them. Prescribe all components there, or diagonalise the matrix."
        )


class SynchronousRun(ForceRun):
    """A synchronous run in progress.

    Attributes:
        time: t_n [s]; steps: n; step: h [s]; critical: the critical step [s].
        support_work: Work of this rank's moving supports in the half step before a sample [J].
    """

    def __init__(self, problem: Problem, method: Synchronous, step: float, critical: float) -> None:
        super().__init__(problem, step, critical)
        self.method = method
        disc, kernels, masses = problem.disc, problem.kernels, problem.masses
        if not masses.diagonal:  # the same on all ranks, unlike what moves there
            refuse_partial(problem)
        kernels.select(masses.diagonal, masses.damped, masses.whole)
        self.c = kernels.c
        rec = masses.recursion(step, method.dissipation)
        if method.start == "one-sided":
            # Kicks sit at the left ends of intervals: momenta at t_n are those before the kick.
            rec.force_to_rate = rec.massless
        self.recursion = rec

        def pack(matrices: Array) -> Array:
            return masses.pack(matrices, disc.record)

        self._tables = [pack(m) for m in (rec.alpha, rec.beta, rec.viscosity)]
        self._to_rate, self._force_to_rate = pack(rec.to_rate), pack(rec.force_to_rate)
        self.mean = np.ascontiguousarray(rec.mean)
        self.eta = np.ascontiguousarray(rec.viscosity)
        self.mass = np.ascontiguousarray(rec.mass)
        s = kernels.state
        s.step = step
        off = ~np.eye(disc.n, dtype=bool)
        coupled = [np.any(m[:, off], axis=1) for m in (rec.alpha, rec.beta, rec.viscosity)]
        self._plain = (~np.any(coupled, axis=0)).astype(np.uint8)
        # Only of dampers: in other scenes all nodes have blocks alike.
        s.plain = self._plain.ctypes.data if masses.whole else 0
        s.alpha, s.beta, s.eta = (t.ctypes.data for t in self._tables)
        self._single = len(masses.density) == 1
        s.klass = 0 if self._single else masses.classes.ctypes.data
        self.rates, self.scratch = (native.aligned(kernels.x.shape) for _ in range(2))
        kernels.sums[:] = 0.0
        kernels.x[:] = 0.0
        kernels.v[:] = 0.0
        kernels.x[:-1, : disc.n] = problem.initial_fields
        self.support_work = 0.0
        kernels.reset_forces()
        self._state_of_its_own()

    # --- steps -------------------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Do ``steps`` steps; collective."""
        if steps > 0 and self.steps == 0:
            self._first()
            steps -= 1
        if steps > 0 and self.ready:
            self._unfused()
            steps -= 1
        if steps <= 0:
            return
        problem, disc = self.problem, self.problem.disc
        alone = problem.comm.size == 1 and not len(problem.moving[0])
        if alone:
            times = (self.steps + np.arange(steps)) * self.step
            amplitudes = np.ascontiguousarray(problem.loads.amplitudes(times))
            self.c.cb_steps(
                self.state, ctypes.c_int64(steps), ctypes.c_int64(len(problem.load_value)),
                native.pointer(problem.load_position), native.pointer(problem.load_group),
                native.pointer(problem.load_value), native.pointer(amplitudes),
                ctypes.c_int64(amplitudes.shape[1]),
            )  # fmt: skip
            self.steps += steps
        else:
            for _ in range(steps):
                self._overlapped()
        self._count(steps * disc.count)

    def _overlapped(self) -> None:
        """One step with messages flying while interior cells are worked on."""
        problem, kernels = self.problem, self.problem.kernels
        amplitude = self.amplitude(self.time)
        problem.load_forces(amplitude)
        kernels.sums[3] += 0.5 * self.step * problem.load_power(amplitude, kernels.v)
        self.c.cb_boundary_forces(self.state)
        if problem.comm.size > 1:
            self._exchange_begin()
        self.c.cb_interior_step(self.state)
        if problem.comm.size > 1:
            self._exchange_end()
        self._late()
        kernels.sums[3] += 0.5 * self.step * problem.load_power(amplitude, kernels.v)
        self.steps += 1

    def _unfused(self) -> None:
        """A step whose forces are there already, after a sample."""
        problem, kernels = self.problem, self.problem.kernels
        amplitude = self.amplitude(self.time)
        kernels.sums[3] += 0.5 * self.step * problem.load_power(amplitude, kernels.v)
        self.c.cb_update(self.state)
        self._late()
        kernels.sums[3] += 0.5 * self.step * problem.load_power(amplitude, kernels.v)
        self.steps += 1
        self.ready = False

    def _late(self) -> None:
        if len(self.problem.moving[0]):
            self._move()
        self.c.cb_update_late(self.state)
        self.c.cb_look(self.state)

    def _move(self) -> None:
        rows, columns = self.problem.moving
        target = self.problem.targets((self.steps + 1) * self.step)
        self.c.cb_move(
            self.state, ctypes.c_int64(len(rows)), native.pointer(rows), native.pointer(columns),
            native.pointer(target), native.pointer(self.mean), native.pointer(self.eta),
        )  # fmt: skip

    def _first(self) -> None:
        """The first kick: half of it (trapezoidal) or the whole (one-sided), on initial rates."""
        problem, kernels, disc, rec = (
            self.problem, self.problem.kernels, self.problem.disc, self.recursion,
        )  # fmt: skip
        self.forces()
        n, weight = disc.n, 0.5 if self.method.start == "trapezoidal" else 1.0
        rates = problem.rates_at_start(1e-3 * self.step)
        moves = ((rates != 0) | (kernels.f[:-1, :n] != 0)).any(axis=1)
        moves[problem.moving[0]] = True
        at = np.flatnonzero(moves)  # all others stay at rest
        v0, klass = rates[at], problem.masses.classes[at]
        volume, owned = disc.volume[at], disc.owned[at]
        f = kernels.f[at, :n] * kernels.inverse_volume[at, None]
        v1 = np.einsum("aij,aj->ai", rec.from_rate[klass], v0)
        v1 += weight * np.einsum("aij,aj->ai", rec.beta[klass], f)
        rows, columns = problem.moving
        moving = np.searchsorted(at, rows), columns
        if len(rows):
            v1[moving] = (problem.targets(self.step) - kernels.x[rows, columns]) / self.step
        both = v0 + v1
        # Half a step: (M̂ + hD/2)v⁺ − Mq̇₀ = (h/2)f times the mean of its ends' rates balances
        # ½v⁺·M̂v⁺ − ½q̇₀·Mq̇₀ (also where hη ≫ ρ̄) with the works of loads and supports.
        lost = np.einsum("ai,aij,aj->a", v0, (self.mean - self.mass)[klass], v1)
        lost += 0.5 * self.step * np.einsum("ai,aij,aj->a", both, self.eta[klass], v1)
        kernels.sums[0] += 0.5 * np.sum(lost * volume * owned)
        self.scratch[:] = 0.0
        self.scratch[at, :n] = both
        power = problem.load_power(self.amplitude(0.0), self.scratch)
        kernels.sums[3] += self.step / 4 * power
        if len(rows):
            momentum = np.einsum("aij,aj->ai", (self.mean + 0.5 * self.step * self.eta)[klass], v1)
            momentum -= np.einsum("aij,aj->ai", self.mass[klass], v0)
            impulse = volume[:, None] * (momentum - weight * self.step * f)
            kernels.sums[4] += (0.5 * impulse * both * owned[:, None])[moving].sum()
        jump = np.abs(v1 - v0) * (volume * owned)[:, None]
        n_u = problem.scene.displacement
        kernels.sums[1] += jump[:, :n_u].sum()
        kernels.sums[2] += jump[:, n_u:].sum()
        kernels.v[at, :n] = v1
        kernels.x[at, :n] += self.step * v1
        kernels.reset_forces()
        self.steps, self.ready = 1, False
        self.c.cb_look(self.state)

    # --- what a user sees at t_n -------------------------------------------------------------

    def sample(self) -> tuple[Array, Array]:
        """(u, ν) and rates at t_n as node records (nodes + 1, NR): views, valid until a step."""
        kernels, disc = self.problem.kernels, self.problem.disc
        self.forces()
        if self.steps == 0:
            self.rates[:] = 0.0
            self.rates[:-1, : disc.n] = self._rates_before_first()
        else:
            self.c.cb_rates(
                self.state, native.pointer(self._to_rate), native.pointer(self._force_to_rate),
                native.pointer(self.rates),
            )  # fmt: skip
            if len(self.problem.moving[0]):
                self._sample_moving()
        return kernels.x, self.rates

    def _sample_moving(self) -> None:
        """Rates of moving supports at t_n (mean of both drifts), work of their last half step."""
        problem, kernels, disc, h = self.problem, self.problem.kernels, self.problem.disc, self.step
        (rows, columns), n = problem.moving, disc.n
        nodes, at = np.unique(rows, return_inverse=True)
        after = (problem.targets(self.time + h) - kernels.x[rows, columns]) / h
        before, jump, both = (np.zeros((len(nodes), n)) for _ in range(3))
        before[at, columns] = kernels.v[rows, columns]
        jump[at, columns] = after - kernels.v[rows, columns]
        both[at, columns] = after + kernels.v[rows, columns]
        self.rates[rows, columns] = 0.5 * both[at, columns]
        klass = problem.masses.classes[nodes]
        impulse = np.einsum("aij,aj->ai", self.mean[klass], jump)
        impulse += 0.5 * h * np.einsum("aij,aj->ai", self.eta[klass], both)
        impulse = disc.volume[nodes, None] * impulse - h * kernels.f[nodes, :n]
        # Half of the kick acts before t_n, on rates between v⁻ and those at t_n.
        work = 0.25 * impulse * (before + 0.5 * both) * disc.owned[nodes, None]
        self.support_work = float(work[at, columns].sum())

    def _rates_before_first(self) -> Array:
        """Initial rates; those of components without inertia follow from the forces."""
        problem, kernels, disc = self.problem, self.problem.kernels, self.problem.disc
        v0 = problem.rates_at_start(1e-3 * self.step)
        klass = problem.masses.classes[:-1]
        massless = np.einsum("cii->ci", self.mass) == 0
        if np.any(massless):
            f = kernels.f[:-1, : disc.n] * kernels.inverse_volume[:, None]
            rates = np.einsum("aij,aj->ai", self.recursion.force_to_rate[klass], f)
            mask = massless[klass] & ~problem.masses.fixed[klass]
            v0[mask] = rates[mask]
        return v0

    def entries(self) -> Entries:
        """Energies and works at t_n, and the discrete energy of the last half step; collective."""
        return entries(self)
