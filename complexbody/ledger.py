# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Energies, momenta and work against time: the books of a run, and whether they balance.

At a step's own time t_n the balance is
``kinetic_u + kinetic_nu + stored + potential − work − support_work + dissipated = initial``;
for a variational integrator it oscillates with O(h²) and does not drift. To round-off, for linear
forces, the discrete energy with its effective mass M̂ (DESIGN §2, all three dissipation schemes)

.. math:: E_h = \tfrac12 v\cdot\hat M v - \tfrac12 f(x_n)\cdot x_{n-1},

v = (x_n − x_{n−1})/h, changes exactly by the work of loads and supports minus
(h/4)(v⁺+v⁻)·D(v⁺+v⁻) per step: column ``identity`` is what is missing, relative to
the largest energy.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from complexbody import guards
from complexbody.errors import DivergenceError, ResultsError
from complexbody.integrators.entries import Entries, Run
from complexbody.momentum import AngularMomentum, axes_of
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]

#: Share of the energy from which a cell is worth naming.
TELLING = 0.01
#: Columns and their units; momentum columns follow by component of u.
COLUMNS = {
    "time": "s", "kinetic_u": "J", "kinetic_nu": "J", "stored": "J", "potential": "J",
    "work": "J", "support_work": "J", "dissipated": "J", "balance": "J",
    "identity": "1",
    "variation_u": "m^(d+1)/s", "variation_nu": "[nu] m^d/s",
}  # fmt: skip


class Ledger:
    """Rows of energies and momenta at the times they were asked for.

    ``ledger["stored"]`` is a column as an array. ``balance`` is the energy that came from nowhere
    since the start [J]; ``variation_u`` and ``variation_nu`` are pV of the rates,
    ∫ Σ_steps |q̇⁺ − q̇⁻|₁ dx (paper, Proposition 1, in the 1-norm over components), nan where an
    integrator does not measure it. Bodies that say how ν turns have ``angular_momentum_3`` about
    the origin (in 3D 1 to 3), with ν's share (:mod:`complexbody.momentum`).
    """

    def __init__(self, displacement: int, axes: Sequence[int] = ()) -> None:
        self.columns = [*COLUMNS, *(f"momentum_{i + 1}" for i in range(displacement))]
        self.columns += [f"angular_momentum_{axis + 1}" for axis in axes]
        self.rows: list[list[float]] = []

    def __getitem__(self, name: str) -> Array:
        if name not in self.columns:
            raise ResultsError(f"The ledger has no {name!r}. It has {', '.join(self.columns)}.")
        index = self.columns.index(name)
        return np.array([row[index] for row in self.rows])

    def __len__(self) -> int:
        return len(self.rows)

    def units(self) -> list[str]:
        """Unit of each column."""
        rest = ("N m s" if name.startswith("angular") else "N s" for name in self.columns)
        return [COLUMNS.get(name, unit) for name, unit in zip(self.columns, rest, strict=True)]


class Bookkeeper:
    """Writes ledger rows of a run; every call is collective.

    Args:
        problem: The scene, made ready.
        run: The run whose state is booked.
        growth: A run is stopped when the unexplained energy exceeds this multiple of what was put
            in; None lets it go on.

    Attributes:
        last_good: Time of the last row that no guard minded [s], None before the first.
    """

    def __init__(self, problem: Problem, run: Run, growth: float | None = 10.0) -> None:
        self.problem, self.run, self.growth = problem, run, growth
        self._axes = list(axes_of(problem.whole))
        self._angular = AngularMomentum(problem) if self._axes else None
        self.ledger = Ledger(problem.whole.displacement, self._axes)
        self._start: float | None = None
        self._put = 0.0
        self._still: tuple[float, float] = 0.0, 0.0
        self._reference: float | None = None
        self._size = 1e-300
        self._orientation = guards.Orientation(problem)
        self.last_good: float | None = None

    def row(self) -> list[float]:
        """Book the state at the run's time and return the new row.

        Raises:
            DivergenceError: for non-finite values, energy from nowhere, or a cell turned inside
                out, with its place and the time of the last good row (on all ranks).
        """
        run = self.run
        e = Entries.from_array(self.problem.comm.allreduce(run.entries().array()))
        energy = e.kinetic_u + e.kinetic_nu + e.stored + e.potential
        if self._start is None:
            self._start, self._still = energy, (e.still, e.still)
        self._still = self._still[0], e.still
        given = e.work + e.support_work - e.dissipated
        identity = 0.0
        if run.steps > 0 and e.size > 0:
            missing = e.discrete - e.flows
            self._reference = missing if self._reference is None else self._reference
            self._size = max(self._size, e.size)
            identity = (missing - self._reference) / self._size
        row = [run.time, e.kinetic_u, e.kinetic_nu, e.stored, e.potential, e.work, e.support_work]
        row += [e.dissipated, energy - given - self._start, identity]
        # Components that were left out have no momentum.
        n_u = self.problem.scene.displacement
        record = np.zeros(self.problem.scene.components)
        record[:n_u] = e.momentum
        momentum = self.problem.spread(record)[: self.problem.whole.displacement]
        row += [e.variation_u, e.variation_nu, *momentum]
        if self._angular is not None:
            moments = self.problem.comm.allreduce(self._angular(*run.sample()))
            row += moments[self._axes].tolist()
        self.ledger.rows.append([float(v) for v in row])
        self._guard(e.surplus - self._start if run.steps > 0 else 0.0)
        return self.ledger.rows[-1]

    def state(self) -> dict[str, float | None]:
        """What later rows depend on besides the run."""
        kept = {name: getattr(self, f"_{name}") for name in ("start", "put", "reference", "size")}
        return {**kept, "still": self._still[0]}

    def restore(self, state: Mapping[str, float | None], rows: Array) -> None:
        """Go on from a state and the rows so far (rows, columns)."""
        still = state["still"] or 0.0
        self._start, self._reference = state["start"], state["reference"]
        self._put, self._size = state["put"] or 0.0, state["size"] or 0.0
        self._still = still, still
        self.ledger.rows[:] = rows.tolist()

    def _guard(self, excess: float) -> None:
        run, problem = self.run, self.problem
        # The last columns but momentum are pV, nan for integrators that do not measure it.
        measured = [v for v, c in zip(self.ledger.rows[-1], self.ledger.columns, strict=True)
                    if not c.startswith("variation")]  # fmt: skip
        if not np.isfinite(measured).all():
            place = guards.lost_node(problem, run.positions(), problem.kernels.v)
            began = f", most likely first at {place.name} of {place}" if place else ""
            if place is None:  # what is squared overflows first
                place = guards.fullest_cell(problem, run.positions())
                began = f", largest in {place}" if place else ""
            self._stop(
                f"Values became non-finite by t = {run.time:.6g} s (step {run.steps}){began}. The "
                f"step {run.step:.3g} s is {run.step / run.critical:.3g} of the critical one"
                f"{self._of_start()}: use a smaller one, or check initial data, loads and the "
                "energy there.",
                place,
            )
        if self.growth is not None and abs(excess) > self.growth * self._bound():
            place = guards.fullest_cell(problem, run.positions())
            most = ""
            if place is not None and place.value >= TELLING:
                most = f"; {place.value:.0%} of the energy is in {place}"
            self._stop(
                f"Energy appeared from nowhere by t = {run.time:.6g} s (step {run.steps}): "
                f"{excess:.3g} J, more than {self.growth:g} times what was put in{most}. The step "
                f"is {run.step / run.critical:.3g} of the critical one{self._of_start()}: use a "
                "smaller one, or let it go on with growth=None.",
                place,
            )
        place = self._orientation.worst(run.positions())
        if place is not None:
            self._stop(
                f"By t = {run.time:.6g} s (step {run.steps}) the body {place.name} has a cell "
                f"turned inside out, det F = {place.value:.3g} in {place}. Use a smaller step or "
                "load or a finer mesh there, or Body(orientation=False) if its energy is meant "
                "for that.",
                place,
            )
        self.last_good = run.time

    def _of_start(self) -> str:
        """What to know of the critical step of a body whose stiffness changes, or ""."""
        if self.problem.kernels.densities.linear:
            return ""
        return (
            " of the initial state, from which this body has changed (a ν that has become stiff is "
            "taken by Implicit(forces='implicit'))"
        )

    def _stop(self, message: str, place: guards.Place | None) -> NoReturn:
        good = self.last_good
        well = "It was so at the start." if good is None else f"All was well at t = {good:.6g} s."
        message = f"{message} {well}"
        error = DivergenceError(message)
        error.ledger, error.last_good, error.place = self.ledger, good, place
        raise error

    def _bound(self) -> float:
        """What was ever put in: initial energies, works, what stored, potential, χ(ν, 0) gave away.

        Losses do not count: where a step is too large they grow with the energy from nowhere.
        """
        first, row = self.ledger.rows[0], self.ledger.rows[-1]
        given = first[3] + first[4] + self._still[0] - row[3] - row[4] - self._still[1]
        initial = sum(abs(v) for v in first[1:5])
        self._put = max(self._put, initial, abs(row[5]), abs(row[6]), given, 1e-300)
        return self._put


def summary(ledger: Any) -> str:
    """One line: the largest imbalance relative to the largest energy, and the identity's if any."""
    parts = [np.abs(ledger[c]).max() for c in ("kinetic_u", "kinetic_nu", "stored", "work")]
    top = max(*parts, 1e-300)
    missing, worst = np.abs(ledger["balance"]).max(), np.abs(ledger["identity"]).max()
    text = f"energy balance within {missing / top:.2e} of the largest energy"
    # Exactly zero where an integrator has no such identity.
    return text + (f"; discrete energy identity within {worst:.1e}" if worst > 0 else "")
