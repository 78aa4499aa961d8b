# SPDX-License-Identifier: LGPL-3.0-or-later
"""Asynchronous variational integrators: every cell has its own time step (paper §4).

At an event of cell K its nodes drift to t, the force is taken there, and each node is kicked by
h_K times it: (Discr-dAL1), (Discr-dAL2) with the dissipation's sign corrected. ``balanced`` windows
act against a smooth reference stress taken at the window's start, whose assembled force drives the
drifts: neighbouring cells need not cancel each other at different times (DESIGN §5).
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import native
from complexbody.errors import IntegratorError, StepError
from complexbody.integrators.entries import Entries, energies
from complexbody.integrators.windows import WindowPlan, divisions, time_sets, window_length
from complexbody.kernels import events
from complexbody.masses import SCHEMES
from complexbody.problem import Problem
from complexbody.timesets import cell_densities, cell_steps

Array = npt.NDArray[np.float64]
KEEP, AGAINST = 1, 2


class World(ctypes.Structure):
    """Mirror of ``world`` in events.c."""

    _fields_ = (
        ("nodes", ctypes.c_int64),
        ("late", ctypes.c_int64),
        ("beyond", ctypes.c_int64),
        *(
            (name, ctypes.c_void_p)
            for name in (
                "record", "klass", "inverse_mass", "rate", "compliance", "eta", "basis",
                "inverse_basis", "collected",
                "groups", "cell", "geometry", "coefficient", "reference", "stress", "sums",
                "counted", "coordinates", "forms",
            )
        ),
        ("start", ctypes.c_double),
    )  # fmt: skip


@dataclass(frozen=True)
class AVI:
    """Asynchronous variational integrator on windows: every cell its own step.

    Attributes:
        safety: α, the fraction of each cell's critical step it may use. Resonances start near
            0.47 of it on bars of two rates, hence 0.45.
        schedule: "windows" (N_K = ⌈W/h_K⌉ equal steps per window) or "octaves" (N_K rounded up to a
            power of two).
        balanced: Act against a smoothed reference stress, which removes the error floor of
            asynchronous stepping; False gives plain windows, an AVI of the paper with rational
            time sets, symplectic, with the floor.
        passes: Smoothing passes of the reference (cell → node → cell).
        filter: ε of the filter v −= ε(I − S)³v at window ends (balanced only); 0 is none.
        dissipation: "exact", "symmetric" or "forward", as for Synchronous.

    Raises:
        IntegratorError, StepError: for options that make no sense.
    """

    safety: float = 0.45
    schedule: str = "windows"
    balanced: bool = True
    passes: int = 2
    filter: float = 0.01
    dissipation: str = "exact"

    explicit: ClassVar[bool] = True
    asynchronous: ClassVar[bool] = True
    order: ClassVar[int] = 2
    inertia: ClassVar[str] = "number, or diagonal matrix; 0 where viscosity is positive"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.safety) and 0 < self.safety):
            raise StepError(f"AVI: safety is {self.safety}. Give a positive number, 0.45 or less.")
        if self.dissipation not in SCHEMES:
            raise IntegratorError(
                f"AVI: dissipation={self.dissipation!r} is not known. Give one of "
                f"{', '.join(SCHEMES)}."
            )
        if self.schedule not in ("windows", "octaves"):
            raise IntegratorError(
                f"AVI: schedule={self.schedule!r} is not known. Give 'windows' or 'octaves'."
            )
        if self.passes < 1 or self.filter < 0:
            raise IntegratorError("AVI: give passes ≥ 1 and filter ≥ 0.")

    @property
    def symplectic(self) -> bool:
        """Plain windows are; balanced ones only nearly: the reference depends on the state."""
        return not self.balanced

    def prepare(self, problem: Problem, until: float) -> AVIRun:
        """Choose windows and steps, regroup the cells, and set up the run; collective.

        Raises:
            IntegratorError: for bodies this integrator cannot take.
        """
        critical = cell_steps(problem, self.dissipation)
        disc = problem.disc
        real = disc.source_cell >= 0
        steps = np.full(int(real.sum()), np.inf)
        steps[disc.source_cell[real]] = self.safety * critical[real]
        window = window_length(steps, until, problem.comm)
        problem.arrange(divisions(steps, window, self.schedule == "octaves"))
        return AVIRun(problem, self, window, steps / self.safety)


class AVIRun:
    """An asynchronous run in progress; one *step* of it is one window.

    Attributes:
        time: t at the last window's end [s]; steps: windows done; step: W [s].
        critical: Critical step of the smallest cell [s], that of a synchronous run.
        plan: Groups and events of a window; time_sets: what the paper calls Θ, with speed-ups.
        updates: Cell updates (forces) done by this rank.
    """

    record: Array
    inverse_mass: Array
    rate: Array
    compliance: Array
    eta: Array
    basis: Array
    inverse_basis: Array
    collected: Array
    reference: Array
    stress: Array
    _counted: npt.NDArray[np.bool_]

    def __init__(self, problem: Problem, method: AVI, window: float, critical: Array) -> None:
        self.problem, self.method, self.step = problem, method, window
        smallest = float(np.min(critical, initial=np.inf))
        self.critical = float(problem.comm.allreduce(smallest, op=MPI.MIN))
        self.steps, self.updates = 0, 0
        disc, kernels, masses = problem.disc, problem.kernels, problem.masses
        self.plan = WindowPlan(disc, window)
        self.time_sets = time_sets(self.plan, disc, critical, window)
        # Components that differ in their rate are drifted one by one, like those without inertia.
        damped = masses.damped
        slow = not masses.diagonal or (damped and not masses.one_rate)
        self.c = events.load(kernels, method.balanced, damped, slow, method.dissipation)
        self.references = events.references(kernels) if method.balanced else 0
        self._nodes()
        self._buffers()
        self.sums = kernels.sums
        self.sums[:] = 0.0
        self.work, self.support_work, self.filtered = 0.0, 0.0, 0.0
        self._loaded: int | None = None
        self.mass = np.ascontiguousarray(masses.full(masses.inertia, masses.density))
        kernels.state.klass = masses.classes.ctypes.data
        self._supported = problem.comm.allreduce(len(problem.moving[0])) > 0
        self._support_kinetic: Array | None = None
        self._support_force: Array | None = None
        if self._supported:
            self._support_force = self._forces_now(0.0)[problem.moving]
        world = World()
        # Moving supports are late, too, but only shared nodes wait for the other ranks' kicks.
        world.nodes, world.late, world.beyond = disc.nodes, disc.late, disc.late + disc.shared
        arrays: dict[str, Any] = {
            "record": self.record, "klass": masses.classes, "inverse_mass": self.inverse_mass,
            "rate": self.rate, "compliance": self.compliance, "eta": self.eta,
            "basis": self.basis, "inverse_basis": self.inverse_basis,
            "collected": self.collected, "cell": disc.cells, "geometry": disc.geometry,
            "coefficient": kernels.coefficients, "reference": self.reference,
            "stress": self.stress, "sums": self.sums, "counted": self._counted,
            "coordinates": disc.position,
        }  # fmt: skip
        for name, array in arrays.items():
            setattr(world, name, array.ctypes.data)
        if len(masses.density) == 1:
            world.klass = 0
        self._forms = events.Forms(kernels, method.balanced)
        world.forms = ctypes.addressof(self._forms.records)
        world.groups = ctypes.addressof(self.plan.groups)
        self.world, self._world = world, ctypes.byref(world)

    def _nodes(self) -> None:
        """Node records and the classes' masses and viscosities, component by component."""
        problem, method = self.problem, self.method
        disc, masses = problem.disc, problem.masses
        n, record = disc.n, disc.record
        size, self._time, self._inverse = events.record_size(n, record, method.balanced)
        self.record = native.aligned((disc.nodes + 1, size))
        self.record[:-1, :n] = problem.initial_fields
        self.record[:-1, self._inverse] = 1.0 / disc.volume
        basis = masses.diagonalised()
        self.basis, self.inverse_basis = basis.vectors, basis.inverse
        inert = (basis.mass == 0) & ~masses.fixed
        if np.any(inert) and method.dissipation == "symmetric":
            masses.effective(1.0, "symmetric")  # refuses it by name
        shape = (len(basis.mass), record)
        self.inverse_mass, self.rate, self.compliance, self.eta = (
            native.aligned(shape) for _ in range(4)
        )
        free = ~masses.fixed
        divisor = np.where(basis.mass > 0, basis.mass, 1.0)
        self.inverse_mass[:, :n] = np.where(free, 1.0 / divisor, 0.0)
        self.rate[:, :n] = np.where(inert | ~free, 0.0, basis.viscosity / divisor)
        soft = np.where(inert, basis.viscosity, 1.0)
        self.compliance[:, :n] = np.where(inert, 1.0 / soft, 0.0)
        self.eta[:, :n] = np.where(free, basis.viscosity, 0.0)
        self._inert = bool(np.any(inert))
        # Without inertia a "rate" is momentum per volume: none at the start.
        klass = masses.classes[:-1]
        rates = np.einsum("aij,aj->ai", self.inverse_basis[klass], problem.initial_rates)
        self.record[:-1, record : record + n] = np.where(inert[klass], 0.0, rates)

    def _buffers(self) -> None:
        disc = self.problem.disc
        self.collected = native.aligned((max(disc.shared, 1), disc.record))
        shape = (disc.blocks, max(self.references, 1), disc.lanes)
        self.reference, self.stress = native.aligned(shape), native.aligned(shape)
        self._old = native.aligned(shape)
        rows = -(-max(self.references, 1) // disc.lanes) * disc.lanes
        self._nodal = native.aligned((disc.nodes + 1, rows))
        self._force = native.aligned((disc.nodes + 1, disc.record))
        self._rates = native.aligned((disc.nodes + 1, disc.record))
        width = max(rows, disc.record)
        masses, share = self.problem.masses, disc.geometry[:, -1, :] ** 2 / (disc.dim + 1) ** 2
        self._cell_mass = np.ascontiguousarray(cell_densities(self.problem) * share)
        self._inverse_node_mass = 1.0 / (masses.density[masses.classes[:-1]] * disc.volume)
        self._counted = np.append(disc.owned, False)  # padding cells' node counts for nothing
        self.halo = disc.halo
        if self.problem.comm.size > 1 and width > disc.halo.outgoing.shape[1]:
            self.halo = disc.halo.widened(width)

    @property
    def time(self) -> float:
        """End of the last window [s], from the counter."""
        return self.steps * self.step

    # --- windows -----------------------------------------------------------------------------

    def advance(self, windows: int) -> None:
        """Do ``windows`` windows; collective."""
        for _ in range(windows):
            self._window()

    def _window(self) -> None:
        plan, c, method = self.plan, self.c, self.method
        start, end = self.time, (self.steps + 1) * self.step
        self.world.start = start
        mode = AGAINST if method.balanced else 0
        self._move_supports(start)
        if method.balanced:
            self._set_reference(start)
            loaded = self._loaded_positions()
        else:
            self._load_kick(start)
        self._together(start, mode)
        if self.problem.comm.size == 1:
            c.cb_replay(
                self._world, plan.events, ctypes.c_int64(0), ctypes.c_int64(plan.total), mode
            )
        else:
            self._replay_cut(mode)
        nodes = ctypes.c_int64(self.problem.disc.nodes)
        c.cb_drift(self._world, ctypes.c_int64(0), nodes, ctypes.c_double(end))
        self._together(end, mode | (KEEP if method.balanced else 0))
        if method.balanced:
            # Loads were a constant force: their work is exact.
            amplitude = self.problem.loads.amplitudes(np.array([start + 0.5 * self.step]))[0]
            moved = (self._loaded_positions() - loaded) * self.problem.load_value
            self.work += float(np.dot(amplitude[self.problem.load_group], moved))
            if method.filter > 0:
                self._filter()
        else:
            self._load_kick(end)
        self.steps += 1
        self._book_supports(start, end)
        self.updates += plan.updates + self.problem.disc.count

    def _loaded_positions(self) -> Array:
        """Values of the components that loads act on, entry by entry."""
        record = self.problem.disc.record
        at = self.problem.load_position
        return self.record[at // record, at % record]

    def _book_supports(self, start: float, end: float) -> None:
        """Work of moving supports over a window, by the mean of the forces at its ends."""
        problem = self.problem
        if not self._supported:
            return
        rows, columns = problem.moving
        force = self._forces_now(end)[rows, columns]
        if self._support_force is not None:
            rates = self.record[rows, problem.disc.record + columns]
            pull = -0.5 * (force + self._support_force) * rates * self.step
            mass = self.mass[problem.masses.classes[rows], columns, columns]
            kinetic = 0.5 * mass * problem.disc.volume[rows] * rates**2
            before = (
                np.zeros_like(kinetic) if self._support_kinetic is None else self._support_kinetic
            )
            owned = problem.disc.owned[rows]
            self.support_work += float(np.sum((pull + kinetic - before) * owned))
            self._support_kinetic = kinetic
        self._support_force = force

    def _forces_now(self, t: float) -> Array:
        """All forces at the records' positions, loads included, summed over ranks (nodes, n)."""
        problem, kernels, n = self.problem, self.problem.kernels, self.problem.disc.n
        kernels.x[:, :n] = self.record[:, :n]
        kernels.forces()
        problem.load_forces(problem.loads.amplitudes(np.array([t]))[0])
        force = kernels.f[:-1, :n].copy()
        problem.disc.sum_shared(force)
        return force

    def _move_supports(self, t: float) -> None:
        """Prescribed components move evenly through the window, to their places at its end."""
        rows, columns = self.problem.moving
        if len(rows):
            target = self.problem.targets(t + self.step)
            rates = (target - self.record[rows, columns]) / self.step
            self.record[rows, self.problem.disc.record + columns] = rates

    def _together(self, t: float, mode: int) -> None:
        """All cells act at once with half their steps: a window's first and last kicks."""
        self.c.cb_together(
            self._world, ctypes.c_int64(0), ctypes.c_int64(self.plan.count), ctypes.c_double(t),
            ctypes.c_double(0.5), mode,
        )  # fmt: skip
        if self.problem.comm.size > 1:
            self._exchange(t)

    def _replay_cut(self, mode: int) -> None:
        plan, c = self.plan, self.c
        for cut in plan.cuts:
            c.cb_replay(
                self._world,
                plan.events,
                ctypes.c_int64(cut.first),
                ctypes.c_int64(cut.shared),
                mode,
            )
            self._begin()
            c.cb_replay(
                self._world, plan.events, ctypes.c_int64(cut.shared), ctypes.c_int64(cut.last), mode
            )
            self._end(self.world.start + cut.time)
        last = plan.cuts[-1].last if plan.cuts else 0
        c.cb_replay(
            self._world, plan.events, ctypes.c_int64(last), ctypes.c_int64(plan.total), mode
        )

    def _begin(self) -> None:
        halo, n = self.halo, self.problem.disc.record
        halo.outgoing[:, :n] = self.collected[halo.sends]
        halo.begin()

    def _end(self, t: float) -> None:
        halo, disc = self.halo, self.problem.disc
        halo.end()
        halo.add(self.collected[: disc.shared])
        self.c.cb_apply(self._world, ctypes.c_double(t))

    def _exchange(self, t: float) -> None:
        self._begin()
        self._end(t)

    # --- the reference -----------------------------------------------------------------------

    def _set_reference(self, t: float) -> None:
        """Smoothed stress at mid-window, and the accelerations of its nodal forces and of loads."""
        disc, c = self.problem.disc, self.c
        if self.steps == 0:
            # Nobody has acted yet: a kick of no weight leaves the stress behind.
            c.cb_together(
                self._world, ctypes.c_int64(0), ctypes.c_int64(self.plan.count),
                ctypes.c_double(t), ctypes.c_double(0.0), KEEP,
            )  # fmt: skip
            self.updates += disc.count
            np.copyto(self._old, self.stress)
        blocks, nodal = ctypes.c_int64(disc.blocks), native.pointer(self._nodal)
        old: Array | None = self._old
        for _ in range(self.method.passes):
            self._nodal[:] = 0.0
            c.cb_to_nodes(self._world, blocks, native.pointer(old), nodal)
            self._sum_shared(self._nodal)
            c.cb_scale_nodes(self._world, nodal)
            c.cb_to_cells(self._world, blocks, nodal)
            old = None
        self._force[:] = 0.0
        c.cb_reference_force(self._world, blocks, native.pointer(self._force))
        self._add_loads(t + 0.5 * self.step)
        self._sum_shared(self._force)
        c.cb_accelerate(self._world, native.pointer(self._force))

    def _add_loads(self, t: float) -> None:
        problem = self.problem
        if len(problem.load_value):
            amplitude = problem.loads.amplitudes(np.array([t]))[0]
            np.add.at(
                self._force.ravel(), problem.load_position,
                amplitude[problem.load_group] * problem.load_value,
            )  # fmt: skip
        if problem.kernels.constant is not None:
            self._force += problem.kernels.constant

    def _load_kick(self, t: float) -> None:
        """Half a window's kick by loads, for plain windows."""
        problem = self.problem
        loaded = (
            problem.comm.allreduce(len(problem.load_value))
            if self._loaded is None
            else self._loaded
        )
        self._loaded = loaded
        if not loaded and problem.kernels.constant is None:
            return
        self._force[:] = 0.0
        self._add_loads(t)
        self._sum_shared(self._force)
        before = self._load_power(t)
        self.c.cb_push(self._world, ctypes.c_double(0.5 * self.step), native.pointer(self._force))
        self.work += self.step / 4 * (before + self._load_power(t))

    def _load_power(self, t: float) -> float:
        """Power of the loads on the records' rates at t, this rank's share."""
        self.c.cb_get_rates(self._world, native.pointer(self._rates))
        return self.problem.load_power(self.problem.loads.amplitudes(np.array([t]))[0], self._rates)

    def _sum_shared(self, values: Array) -> None:
        disc = self.problem.disc
        if self.problem.comm.size > 1:
            block = np.ascontiguousarray(values[disc.late : disc.late + disc.shared])
            self.halo.sum(block)
            values[disc.late : disc.late + disc.shared] = block

    def _filter(self) -> None:
        """v −= ε (I − S)³ v, S the mass-weighted average over cells and back.

        Fixed components stay, and so does the momentum of a free body.
        """
        change, out = native.pointer(self._rates), native.pointer(self._force)
        blocks = ctypes.c_int64(self.problem.disc.blocks)
        weight, inverse = native.pointer(self._cell_mass), native.pointer(self._inverse_node_mass)
        self.c.cb_get_rates(self._world, change)
        self._force[:] = 0.0
        for _ in range(3):
            self.c.cb_average(self._world, blocks, weight, change, out)
            self._sum_shared(self._force)
            self.c.cb_subtract_average(self._world, inverse, change, out)
        lost = self.c.cb_change_rates(self._world, ctypes.c_double(-self.method.filter), change)
        self.filtered += lost

    # --- what a user sees at a window's end ----------------------------------------------------

    def sample(self) -> tuple[Array, Array]:
        """(u, ν) and rates at the last window's end, node records (nodes + 1, NR)."""
        problem, kernels, n = self.problem, self.problem.kernels, self.problem.disc.n
        kernels.x[:, :n] = self.record[:, :n]
        self.c.cb_get_rates(self._world, native.pointer(self._rates))
        if self._inert:
            # Components without inertia obey D q̇ = f at any time.
            force = self._forces_now(self.time)
            klass = problem.masses.classes[:-1]
            V, soft = self.basis[klass], self.compliance[klass, :n]
            pull = np.einsum("aji,aj->ai", V, force) / problem.disc.volume[:, None]
            self._rates[:-1, :n] += np.einsum("aij,aj->ai", V, soft * pull)
        return kernels.x, self._rates

    def positions(self) -> Array:
        """(u, ν) at the last window's end, node records."""
        return self.record

    def entries(self) -> Entries:
        """Energies and works at the last window's end; collective."""
        _, rates = self.sample()
        common = energies(self.problem, self.mass, rates)
        works: dict[str, Any] = {
            "work": self.work, "support_work": self.support_work,
            "dissipated": float(self.sums[0]), "filtered": self.filtered,
        }  # fmt: skip
        kinetic = common["kinetic_u"] + common["kinetic_nu"]
        given = self.work + self.support_work - works["dissipated"] - self.filtered
        return Entries(
            **common, **works,
            surplus=kinetic + common["stored"] + common["potential"] - given,
            discrete=0.0, flows=0.0, size=0.0, variation_u=np.nan, variation_nu=np.nan,
        )  # fmt: skip

    def close(self) -> None:
        """Free the run's own communicator; collective."""
        if self.halo is not self.problem.disc.halo:
            self.halo.close()
