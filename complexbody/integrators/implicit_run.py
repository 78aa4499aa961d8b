# SPDX-License-Identifier: LGPL-3.0-or-later
"""An implicit run in progress: explicit forces, lumped u, and a solver for the rates of ν.

The state at t_n is x_n, the rates v_{n−½} of the last drift and the momentum π of ν that this drift
left. A step solves at all nodes before it moves any: after a failure the last state is whole.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.errors import BodyError, SolverError
from complexbody.integrators.entries import Entries, energies
from complexbody.integrators.force_run import ForceRun
from complexbody.integrators.global_newton import GlobalNewton
from complexbody.integrators.nodal_newton import NodalNewton
from complexbody.integrators.snapshot import Snapshot
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.implicit import Implicit

Array = npt.NDArray[np.float64]


class Solver(Protocol):
    """Momenta and rates of ν; vertex rule or full quadrature. All but ``kinetic`` are collective.

    ``solve`` and ``rates`` return why they failed and at which node of this rank: ("", −1) if fine.
    """

    def solve(self) -> tuple[str, int]:
        """Fill the run's ``next`` rates and ``after`` momenta."""

    def commit(self) -> None:
        """Take that step."""

    def momenta(self, rates: Array, out: Array) -> None:
        """Momenta of given rates at this time."""

    def rates(self, momentum: Array, rates: Array) -> tuple[str, int]:
        """Rates of given momenta at this time."""

    def kinetic(self, rates: Array) -> float:
        """Kinetic energy of ν of this rank [J]."""

    def close(self) -> None:
        """Free what it holds."""


class ImplicitRun(ForceRun):
    """An implicit run in progress.

    Attributes:
        s: Where in a step χ is taken: 0 (order 1) or ½ (order 2).
        previous, next: Rates of the drift before the last, and of the next one (nodes + 1, NR).
        momentum, after: π after the last drift, and after the next (nodes, k), integrated over
            nodal volumes [J s per unit of ν].
        reaction: Impulses of supports in the next kick, where supports move.
        count: Newton iterations in all, the most of one solve (of one node), steps solved.
        linear: Iterations of SNES's linear solver.
        range: γ, Ξ, T₀ over the states seen at ledger times.
    """

    def __init__(self, problem: Problem, method: Implicit, step: float, critical: float) -> None:
        super().__init__(problem, step, critical)
        self.method, self.s = method, 0.0 if method.order == 1 else 0.5
        disc, kernels = problem.disc, problem.kernels
        k = problem.scene.descriptor
        kernels.select(problem.masses.diagonal, damped=False)
        self.previous, self.next, self._rates = (
            native.aligned(kernels.x.shape) for _ in range(3)
        )  # fmt: skip
        self.momentum, self.after, self._sampled = (
            native.aligned((disc.nodes, k)) for _ in range(3)
        )  # fmt: skip
        moves = problem.comm.allreduce(len(problem.moving[0])) > 0
        self.reaction = native.aligned(kernels.x.shape) if moves else None
        self.count, self.linear = np.zeros(3, np.int64), 0
        self.range = problem.kinetic_range
        self.support_work = 0.0
        kernels.sums[:] = 0.0
        kernels.x[:] = 0.0
        kernels.v[:] = 0.0
        kernels.x[:-1, : disc.n] = problem.initial_fields
        self._start = problem.rates_at_start(1e-3 * step)
        # The first guess is extrapolated from here: a state without history has constant rates.
        for rates in (kernels.v, self.previous):
            rates[:-1, : disc.n] = self._start
        klass = problem.masses.classes[:-1]
        self._fixed = problem.masses.fixed[klass]
        self.solver: Solver = (
            NodalNewton(self) if method.quadrature == "vertex" else GlobalNewton(self)
        )
        self.mass = np.ascontiguousarray(
            problem.masses.full(problem.masses.inertia, problem.masses.density)
        )
        self._masses = disc.volume * problem.masses.density[klass]
        self.solver.momenta(kernels.v, self.momentum)
        kernels.reset_forces()
        if isinstance(self.solver, NodalNewton):
            self.watch(self.solver.restless())

    # --- steps ---------------------------------------------------------------------------------

    def advance(self, steps: int) -> None:
        """Do ``steps`` steps; collective.

        Raises:
            SolverError: if a step has no solution; the state is then that before the step.
        """
        problem, kernels, h = self.problem, self.problem.kernels, self.step
        for _ in range(steps):
            self.forces()
            half = self.steps == 0 and self.s > 0
            if half:
                kernels.f *= 0.5  # the trapezoidal rule's first kick
            self._move()
            why, node = self.solver.solve()
            if half:
                kernels.f *= 2.0
            self._agree(why, node, self.next)
            if self.reaction is not None:
                # The kick at t_n acts on the drifts before and behind it; the first on one only.
                before = 0.0 if half else 0.5
                kernels.sums[4] += self._support_work(kernels.v, before)
                kernels.sums[4] += self._support_work(self.next, 1.0 - before)
            # So do loads: half of the mean rate, whose work is exact for a constant inertia.
            kick = 0.25 * h if half else 0.5 * h
            amplitude = self.amplitude(self.time)
            kernels.sums[3] += kick * problem.load_power(amplitude, kernels.v)
            self.solver.commit()
            if self.activity is not None:
                kernels.c.cb_look(self.state)
            kernels.sums[3] += kick * problem.load_power(amplitude, kernels.v)
            kernels.reset_forces()
            self.steps += 1
            self.ready = False

    def _move(self) -> None:
        """Rates that bring moving supports to their targets at the step's end."""
        rows, columns = self.problem.moving
        if len(rows):
            target = self.problem.targets(self.time + self.step)
            x = self.problem.kernels.x[rows, columns]
            self.next[rows, columns] = (target - x) / self.step

    def _support_work(self, rates: Array, weight: float) -> float:
        """``weight`` times the impulses of this kick on moving supports, on given rates [J]."""
        rows, columns = self.problem.moving
        assert self.reaction is not None
        power = (self.reaction * rates)[rows, columns] * self.problem.disc.owned[rows]
        return weight * float(power.sum())

    def _agree(self, why: str, node: int, rates: Array) -> None:
        """Stop all ranks if one of them has no solution.

        Raises:
            SolverError: with time, rank, node and its state.
        """
        problem = self.problem
        if not problem.comm.allreduce(bool(why)):
            return
        text = ""
        if why and node >= 0:
            nu = problem.scene.components_of("nu")
            place = np.round(problem.disc.position[node, : problem.disc.dim], 9).tolist()
            indices = problem.scene.mesh.geometry.input_global_indices
            number = indices[problem.disc.dof[node]]
            text = (
                f", on rank {problem.comm.rank} at node {number}, {place}, with ν = "
                f"{problem.kernels.x[node, nu].tolist()}, ν̇ = {rates[node, nu].tolist()}"
            )
        first = next(t for t in problem.comm.allgather(f"{why}{text}") if t)
        raise SolverError(
            f"The step from t = {self.time:.6g} s has no solution: {first}. "
            f"Use a smaller step than {self.step:.3g} s, or check the inertia there: the last "
            "state is kept."
        )

    # --- what the future depends on ------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """The run between two steps; arrays are views, valid until a step; collective."""
        saved, n = super().snapshot(), self.problem.disc.n
        saved.nodes |= {"previous": self.previous[:-1, :n], "momentum": self.momentum}
        saved.sums["newton"] = self.count[:1]
        saved.numbers |= {"most": max(self.problem.comm.allgather(int(self.count[1])))}
        saved.numbers |= {"solved": int(self.count[2]), "linear": self.linear, **vars(self.range)}
        return saved

    def _refresh(self, saved: Snapshot) -> None:
        self.previous[:-1, : self.problem.disc.n] = saved.nodes["previous"]
        self.momentum[:] = saved.nodes["momentum"]
        newton, numbers = saved.sums["newton"][0], saved.numbers
        self.count[:] = newton, numbers["most"], numbers["solved"]
        self.linear = int(numbers["linear"])
        for name in vars(self.range):
            setattr(self.range, name, numbers[name])
        super()._refresh(saved)
        if isinstance(self.solver, NodalNewton) and self.steps > 0:
            self.solver.follow()

    # --- what a user sees at t_n ---------------------------------------------------------------

    def sample(self) -> tuple[Array, Array]:
        """(u, ν) and rates at t_n as node records: views, valid until a step; collective."""
        kernels, disc, h = self.problem.kernels, self.problem.disc, self.step
        rates, n_u = self._rates, self.problem.scene.displacement
        if self.steps == 0:
            rates[:-1, : disc.n] = self._start
            self.support_work = 0.0
            return kernels.x, rates
        self.forces()
        rates[:] = kernels.v
        free = ~self._fixed
        f = kernels.f[:-1, : disc.n]
        kick = self.s * h * f[:, :n_u] / self._masses[:, None]
        rates[:-1, :n_u] += np.where(free[:, :n_u], kick, 0.0)
        if self.reaction is not None:
            self._sample_supports(rates)
        np.add(self.momentum, self.s * h * f[:, n_u:], out=self._sampled)
        self._agree(*self.solver.rates(self._sampled, rates), rates)
        return kernels.x, rates

    def _sample_supports(self, rates: Array) -> None:
        """Rates of moving supports at t_n (mean of both drifts), and their last half's work."""
        self._move()
        self._agree(*self.solver.solve(), self.next)
        self.support_work = self._support_work(self.problem.kernels.v, 0.5)
        rows, columns = self.problem.moving
        rates[rows, columns] = 0.5 * (rates + self.next)[rows, columns]

    def entries(self) -> Entries:
        """Energies and works at t_n; collective.

        Raises:
            SolverError: where χ has lost its convexity (A5), or if T₀ has fallen below the step
                and ``unstable_ok`` is False.
        """
        problem, sums = self.problem, self.problem.kernels.sums
        _, rates = self.sample()
        common = energies(problem, self.mass, rates, self.watched)
        common["kinetic_nu"] = self.solver.kinetic(rates)
        self._measure(rates)
        work, support, lost = float(sums[3]), float(sums[4]) + self.support_work, float(sums[0])
        if self.steps:
            # The half kick before t_n, which order 1 has not.
            both = problem.kernels.v + rates
            work += 0.5 * self.s * self.step * problem.load_power(self.amplitude(self.time), both)
        still = self.solver.kinetic(np.zeros_like(rates)) if problem.convexity is not None else 0.0
        energy = sum(common[n] for n in ("kinetic_u", "kinetic_nu", "stored", "potential"))
        return Entries(
            **common, work=work, support_work=support, dissipated=lost,
            surplus=energy - work - support + lost, discrete=0.0, flows=0.0, size=0.0,
            variation_u=float(sums[1]), variation_nu=float(sums[2]), still=still,
        )  # fmt: skip

    def _measure(self, rates: Array) -> None:
        """Widen the range of χ by this state; refuse a step that T₀ has fallen below."""
        problem = self.problem
        if problem.convexity is None:
            return
        nu, disc = problem.scene.components_of("nu"), problem.disc
        values = np.zeros((2, len(problem.scene.mesh.geometry.x), len(nu)))
        for out, records in zip(values, (problem.kernels.x, rates), strict=True):
            disc.spread(records[:-1, nu], out)
        try:
            measured = problem.convexity.measure(*values)
        except BodyError as error:
            raise SolverError(f"By t = {self.time:.6g} s: {error}") from error
        for found in measured.values():
            self.range.widen(found)
        limit = self.range.limit(self.method.order)
        if self.step > limit * (1 + 1e-9) and not self.method.unstable_ok:
            raise SolverError(
                f"By t = {self.time:.6g} s the step {self.step:.3g} s is larger than T₀ = "
                f"{limit:.3g} s of the inertia (γ = {self.range.gamma:.3g}) in "
                f"{self.range.place(self.method.order)}: its solution need not be the only one. "
                "Use a smaller step, or unstable_ok=True: the last state is kept."
            )

    def summary(self) -> str:
        """What solving took, and γ, Ξ and T₀ over the states seen, in words; collective."""
        nodal, comm = isinstance(self.solver, NodalNewton), self.problem.comm
        # SNES counts the same on every rank; nodes are counted where they are.
        nodes = comm.allreduce(self.problem.disc.nodes) if nodal else comm.size
        total, most = comm.allreduce(int(self.count[0])), max(comm.allgather(int(self.count[1])))
        mean = total / nodes / max(int(self.count[2]), 1)
        text = f"{mean:.2f} Newton iterations per step, at most {most}"
        if self.linear:
            text += f"; {self.linear / max(int(self.count[0]), 1):.1f} linear ones per Newton"
        r, order = self.range, self.method.order
        if self.problem.convexity is not None:
            xi = r.mixed if order == 1 else r.second
            text += f"; γ = {r.gamma:.3g}, Ξ = {xi:.3g}, T₀ = {r.limit(order):.3g} s"
        return text

    def close(self) -> None:
        """Free what the solver holds."""
        self.solver.close()
