# SPDX-License-Identifier: LGPL-3.0-or-later
"""What the runs of peers share: dolfinx's vectors as node records, and books from samples.

Peers keep their state in :class:`SemiDiscrete`; node records are filled when somebody looks. Works
and dissipation come from the ends of each step. Forces are counted in ``updates``, a cell each:
residuals assembled, products with the assembled matrix (those of linear solvers too), and
matrices assembled.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from complexbody import native
from complexbody.errors import SolverError
from complexbody.integrators.entries import Entries, energies
from complexbody.integrators.semidiscrete import Blocks, SemiDiscrete
from complexbody.integrators.snapshot import Snapshot
from complexbody.integrators.solvers import last_line
from complexbody.integrators.timetable import TimeSets
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


class PeerRun:
    """A run of a peer, fields and rates of which are known at t_n.

    Args:
        problem: The scene made ready.
        step, critical: Step and critical synchronous step [s].
        matrix: PETSc type of the stiffness to multiply with, "" for none.

    Attributes:
        time: t_n [s]; steps: n; step: h [s]; critical: the critical synchronous step [s].
        system: The semi-discrete equations.
        v: Rates at t_n, owned unknowns.
        mass, damping: M, D of owned nodes.
        work, lost: Of loads, and by viscosity, so far, this rank's share [J].
        linear: Iterations of linear solvers so far.
        time_sets: None: all act together.
    """

    time_sets: TimeSets | None = None
    #: Books by Simpson's rule on Hermite's cubic (order 4), else by the midpoint of the step, which
    #: is what the trapezoidal and midpoint schemes themselves balance.
    simpson = False

    def __init__(self, problem: Problem, step: float, critical: float, matrix: str = "") -> None:
        self.problem, self.step, self.critical = problem, step, critical
        self.steps, self.linear = 0, 0
        disc, kernels, masses = problem.disc, problem.kernels, problem.masses
        kernels.select(masses.diagonal, masses.damped, masses.whole)
        # Sums over nodes read each node's class.
        kernels.state.klass = masses.classes.ctypes.data
        kernels.x[:] = 0.0
        kernels.v[:] = 0.0
        self._rates = native.aligned(kernels.x.shape)
        self.system = system = SemiDiscrete(problem, matrix)
        klass, volume = masses.classes[:-1], disc.volume[:, None, None]
        mass = masses.full(masses.inertia, masses.density)
        self.mass_by_class = np.ascontiguousarray(mass)
        self.mass = system.blocks(mass[klass] * volume)
        self.damping: Blocks | None = None
        if masses.damped:
            self.damping = system.blocks(masses.damping[klass] * volume)
        self.v = system.owned(problem.initial_rates)
        self.work = self.lost = 0.0
        self._one, self._two = np.zeros(system.size), np.zeros(system.size)

    @property
    def time(self) -> float:
        """t_n = n h [s], from the counter: never summed up."""
        return self.steps * self.step

    @property
    def skipped(self) -> int:
        """None: all cells are looked at in every step."""
        return 0

    @property
    def updates(self) -> int:
        """Cells that forces, matrices or products passed over, on this rank."""
        return (self.system.evaluations + self.linear) * self.problem.disc.count

    # --- steps -----------------------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Do ``steps`` steps; collective.

        Raises:
            SolverError: if a step has no solution; the state is then that before the step.
        """
        system = self.system
        booked = system.loaded or self.damping is not None
        for _ in range(steps):
            x, v = system.x.copy(), self.v.copy()
            try:
                why = self._step()
            except PETSc.Error as error:
                why = f"PETSc: {last_line(error)}"
            if why:
                system.x[:], self.v[:] = x, v
                system.q.x.scatter_forward()
                system.write(self.v, self.problem.kernels.v)
                raise SolverError(
                    f"The step from t = {self.time:.6g} s has no solution: {why}. Use a smaller "
                    f"step than {self.step:.3g} s, or other options: the last state is kept."
                )
            if booked:
                self._book(x, v)
            self.steps += 1

    def _step(self) -> str:
        """Bring q (with its ghosts) and v to the end of a step; why not, in words.

        Of runs that leave ``advance`` as it is.
        """
        return f"{type(self).__name__} has no step of its own"

    @cached_property
    def inverse_mass(self) -> Blocks:
        """M⁻¹ of free components, zero on prescribed ones; made at first use, collectively."""
        masses, disc = self.problem.masses, self.problem.disc
        inverse = np.zeros_like(self.mass_by_class)
        for out, mass, fixed in zip(inverse, self.mass_by_class, masses.fixed, strict=True):
            free = np.ix_(~fixed, ~fixed)
            out[free] = np.linalg.inv(mass[free])
        by_node = inverse[masses.classes[:-1]] / disc.volume[:, None, None]
        return self.system.blocks(by_node)

    def accelerations(self, t: float, v: Array) -> Array:
        """M⁻¹(F(t) − Dv − r), r being there already; zero where prescribed."""
        force = self.system.force(t) - self.system.r
        if self.damping is not None:
            force -= self.damping.times(v, self._one)
        return self.inverse_mass.times(force, np.empty_like(force))

    def _book(self, x: Array, v: Array) -> None:
        """Work and dissipation of the step from (x, v)."""
        h, t, system = self.step, self.time, self.system
        moved = system.x - x
        nodes = [(0.0, 1.0, v), (1.0, 1.0, self.v)]
        if self.simpson:
            middle = 1.5 * moved / h - 0.25 * (v + self.v)
            nodes = [(0.0, 1 / 6, v), (0.5, 2 / 3, middle), (1.0, 1 / 6, self.v)]
        if system.loaded:
            for s, weight, rate in nodes:
                if self.simpson:
                    self.work += h * weight * float(system.force(t + s * h) @ rate)
                else:
                    self.work += 0.5 * float(system.force(t + s * h) @ moved)
        if self.damping is not None:
            rates = [(1.0, moved / h)] if not self.simpson else [n[1:] for n in nodes]
            for weight, rate in rates:
                self.lost += h * weight * float(self.damping.times(rate, self._one) @ rate)

    # --- what the future depends on --------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """The run between two steps; collective."""
        system = self.system
        saved = Snapshot(
            {"steps": self.steps, "evaluations": system.evaluations, "linear": self.linear},
            nodes={"x": self._record(system.x), "v": self._record(self.v)},
            sums={"work": np.array([self.work, self.lost])},
        )
        self._add(saved)
        return saved

    def restore(self, saved: Snapshot) -> None:
        """Go on from a snapshot of a run of the same scene, step and options; collective."""
        system = self.system
        system.set(saved.nodes["x"])
        self.v = system.owned(saved.nodes["v"])
        self.work, self.lost = (float(v) for v in saved.sums["work"])
        self.steps = int(saved.numbers["steps"])
        self._refresh(saved)
        system.evaluations = int(saved.numbers["evaluations"])
        self.linear = int(saved.numbers["linear"])

    def _record(self, values: Array) -> Array:
        """Node records (nodes, n) of owned unknowns; collective."""
        out = np.zeros((self.problem.disc.nodes + 1, self.system.n))
        self.system.write(values, out)
        return out[:-1]

    def _add(self, saved: Snapshot) -> None:
        """Add what else a kind of run has to a snapshot; collective."""

    def _refresh(self, saved: Snapshot) -> None:
        """Take it from one; collective."""

    # --- what a user sees at t_n -----------------------------------------------------------------

    def positions(self) -> Array:
        """(u, ν) at t_n, node records."""
        self.system.read(self.system.q, self.problem.kernels.x)
        return self.problem.kernels.x

    def rates(self) -> Array:
        """Rates at t_n, owned unknowns; collective."""
        return self.v

    def sample(self) -> tuple[Array, Array]:
        """(u, ν) and rates at t_n as node records: views, valid until a step; collective."""
        self.system.write(self.rates(), self._rates)
        return self.positions(), self._rates

    def entries(self) -> Entries:
        """Energies and works at t_n; collective."""
        _, rates = self.sample()
        common = energies(self.problem, self.mass_by_class, rates)
        energy = sum(common[n] for n in ("kinetic_u", "kinetic_nu", "stored", "potential"))
        return Entries(
            **common, work=self.work, support_work=0.0, dissipated=self.lost,
            surplus=energy - self.work + self.lost, discrete=0.0, flows=0.0, size=0.0,
            variation_u=float("nan"), variation_nu=float("nan"),
        )  # fmt: skip

    def close(self) -> None:
        """Free PETSc's objects."""
        self.system.close()
