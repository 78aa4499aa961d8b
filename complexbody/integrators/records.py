# SPDX-License-Identifier: LGPL-3.0-or-later
"""What all asynchronous runs share: node records, masses by class, loads, supports, the books.

A node's record holds its position and rate, its own time and, if balanced, an acceleration
(drifts.h). Runs differ in who acts when; between two *beats* of length ``step`` (a window, or a
span of exact events) they are all alike: supports move evenly, loads kick at the beat's ends.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import native
from complexbody.integrators.activity import Counted
from complexbody.integrators.entries import Entries
from complexbody.integrators.messages import Message
from complexbody.integrators.record_books import entries
from complexbody.integrators.snapshot import Snapshot
from complexbody.integrators.timetable import TimeSets
from complexbody.kernels import events
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.asynchronous import AVI

Array = npt.NDArray[np.float64]


class World(ctypes.Structure):
    """Mirror of ``world`` in events.h."""

    _fields_ = (
        ("nodes", ctypes.c_int64),
        ("late", ctypes.c_int64),
        ("beyond", ctypes.c_int64),
        *(
            (name, ctypes.c_void_p)
            for name in (
                "record", "klass", "inverse_mass", "rate", "pace", "paced", "plain", "compliance",
                "eta", "basis",
                "collected",
                "groups", "cell", "geometry", "coefficient", "held", "blend", "sums",
                "counted", "coordinates", "forms", "touched", "touched_from", "activity",
            )
        ),
        ("start", ctypes.c_double),
    )  # fmt: skip


class RecordRun(Counted):
    """Node records of an asynchronous run and what does not depend on its schedule; collective.

    Args:
        problem: The scene, its cells laid out as the run wants them.
        method: The integrator.
        step: Length of a beat [s].
        critical: Critical steps of this rank's cells [s].

    Attributes:
        time: t at the last beat's end [s]; steps: beats done; step: their length [s].
        critical: Critical step of the smallest cell [s], that of a synchronous run.
        record: Node records (nodes + 1, doubles per node); the last one is padding.
        losing: Whether nodes keep account of what they dissipate.
        acted: Nodes that loads or constant forces of the bodies act on, on any rank.
        skips_energies: Whether quiet cells have no energy either.
        time_sets: Who acts when: what the paper calls Θ, with speed-ups.
    """

    time_sets: TimeSets
    skips_energies: bool = False

    record: Array
    inverse_mass: Array
    rate: Array
    compliance: Array
    eta: Array
    basis: Array
    inverse_basis: Array
    collected: Array

    def __init__(self, problem: Problem, method: AVI, step: float, critical: Array) -> None:
        self.problem, self.method, self.step = problem, method, step
        smallest = float(np.min(critical, initial=np.inf))
        self.critical = float(problem.comm.allreduce(smallest, op=MPI.MIN))
        self.steps = 0
        disc, kernels, masses = problem.disc, problem.kernels, problem.masses
        # Components that differ in their rate are drifted one by one, like those without inertia.
        slow = not masses.diagonal or (masses.damped and not masses.one_rate)
        self.c = events.load(kernels, method, masses.damped, slow)
        self._nodes()
        sent = disc.record * (2 if method.balanced else 1)
        self.collected = native.aligned((max(disc.shared, 1), sent))
        self._force = native.aligned((disc.nodes + 1, disc.record))
        self._rates = native.aligned((disc.nodes + 1, disc.record))
        self._pace = np.ascontiguousarray(self.rate.max(axis=1))
        self._paced = native.aligned(self.rate.shape)
        self._paced[:] = self.rate > 0
        self._simple = self._plain_classes()
        self._counted = np.append(disc.owned, False)  # padding cells' node counts for nothing
        self.halo = disc.halo.widened(sent) if sent > disc.record else disc.halo
        self.sums = kernels.sums
        self.sums[:] = 0.0
        self.work, self.support_work = 0.0, 0.0
        self.acted = self._acted()
        self._loaded = problem.comm.allreduce(len(self.acted)) > 0
        self._all = native.pointer(None), ctypes.c_int64(disc.nodes)
        self._some = native.pointer(self.acted), ctypes.c_int64(len(self.acted))
        self.mass = np.ascontiguousarray(masses.full(masses.inertia, masses.density))
        kernels.state.klass = masses.classes.ctypes.data
        self._supported = problem.comm.allreduce(len(problem.moving[0])) > 0
        self._support_kinetic: Array | None = None
        self._support_force: Array | None = None
        if self._supported:
            self._support_force = self._forces_at(self.record, 0.0)[problem.moving]
        self._forms = events.Forms(kernels)
        self.world = world = World()
        # Moving supports are late, too, but only shared nodes wait for the other ranks' kicks.
        world.nodes, world.late, world.beyond = disc.nodes, disc.late, disc.late + disc.shared
        self._point(
            record=self.record, klass=masses.classes, inverse_mass=self.inverse_mass,
            rate=self.rate, pace=self._pace, paced=self._paced, plain=self._simple,
            compliance=self.compliance, eta=self.eta, basis=self.basis, collected=self.collected,
            cell=disc.cells, geometry=disc.geometry, coefficient=kernels.coefficients,
            sums=self.sums, counted=self._counted, coordinates=disc.position,
        )  # fmt: skip
        if len(masses.density) == 1:
            world.klass = 0
        world.forms = ctypes.addressof(self._forms.records)
        self._world = ctypes.byref(world)
        self._messages: dict[bytes, Message] = {}

    def _point(self, **arrays: npt.NDArray[Any]) -> None:
        """Hand arrays, which the run keeps, to the C side."""
        for name, array in arrays.items():
            setattr(self.world, name, array.ctypes.data)

    def _nodes(self) -> None:
        """Node records and the classes' masses and viscosities, component by component."""
        problem, method = self.problem, self.method
        disc, masses = problem.disc, problem.masses
        n, record = disc.n, disc.record
        self.losing = method.schedule == "exact" and masses.damped
        third = bool(method.balanced) or self.losing
        size, self._time, self._inverse = events.record_size(n, record, third)
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

    def _plain_classes(self) -> npt.NDArray[np.uint8]:
        """Classes without coupling whose components have inertia, and one rate or none."""
        own = np.abs(self.basis - np.eye(self.problem.disc.n)).max(axis=(1, 2)) == 0
        one = np.where(self._paced > 0, self.rate == self._pace[:, None], True).all(axis=1)
        return (own & one & ~np.any(self.compliance, axis=1)).astype(np.uint8)

    @property
    def time(self) -> float:
        """End of the last beat [s], from the counter."""
        return self.steps * self.step

    def close(self) -> None:
        """Free the run's own communicator and messages; collective."""
        for message in self._messages.values():
            message.halo.close()
        self._messages = {}
        if self.halo is not self.problem.disc.halo:
            self.halo.close()

    # --- supports and loads ------------------------------------------------------------------

    def _move_supports(self, t: float) -> None:
        """Prescribed components move evenly through the beat, to their places at its end."""
        rows, columns = self.problem.moving
        if len(rows):
            target = self.problem.targets(t + self.step)
            rates = (target - self.record[rows, columns]) / self.step
            self.record[rows, self.problem.disc.record + columns] = rates

    def _book_supports(self, end: float) -> None:
        """Work of moving supports over a beat, by the mean of the forces at its ends."""
        problem = self.problem
        if not self._supported:
            return
        rows, columns = problem.moving
        force = self._forces_at(self.positions(), end)[rows, columns]
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

    def _forces_at(self, positions: Array, t: float) -> Array:
        """All forces at positions (nodes + 1, ≥ n) and t, loads included, summed over ranks."""
        problem, kernels, n = self.problem, self.problem.kernels, self.problem.disc.n
        kernels.x[:, :n] = positions[:, :n]
        kernels.forces()
        problem.load_forces(problem.loads.amplitudes(np.array([t]))[0])
        force = kernels.f[:-1, :n].copy()
        problem.disc.sum_shared(force)
        return force

    def _acted(self) -> npt.NDArray[np.int32]:
        """Nodes that loads or the bodies' own constant forces act on, on any rank."""
        problem, disc = self.problem, self.problem.disc
        flags = np.zeros((disc.nodes + 1, 1))
        flags[problem.load_position // disc.record] = 1.0
        if problem.kernels.constant is not None:
            flags[np.any(problem.kernels.constant[:, : disc.n] != 0, axis=1)] = 1.0
        disc.sum_shared(flags[:-1])
        return np.flatnonzero(flags[:-1, 0]).astype(np.int32)

    def _load_forces(self, t: float) -> None:
        """Loads at t, and the bodies' own constant forces, into the force buffer; collective."""
        problem = self.problem
        self._force[self.acted] = 0.0
        if len(problem.load_value):
            amplitude = problem.loads.amplitudes(np.array([t]))[0]
            np.add.at(
                self._force.ravel(), problem.load_position,
                amplitude[problem.load_group] * problem.load_value,
            )  # fmt: skip
        if problem.kernels.constant is not None:
            self._force += problem.kernels.constant
        self._sum_shared(self._force)

    def _load_kick(self, t: float, part: float = 0.5) -> None:
        """A kick by loads at t, over ``part`` of a beat."""
        if not self._loaded:
            return
        self._load_forces(t)
        before, weight = self._load_power(t), part * self.step
        force = native.pointer(self._force)
        self.c.cb_push(self._world, ctypes.c_double(weight), force, *self._some)
        self.work += 0.5 * weight * (before + self._load_power(t))

    def _load_power(self, t: float) -> float:
        """Power of the loads on the records' rates at t, this rank's share."""
        self.c.cb_get_rates(self._world, native.pointer(self._rates), *self._some)
        return self.problem.load_power(self.problem.loads.amplitudes(np.array([t]))[0], self._rates)

    # --- shared nodes --------------------------------------------------------------------------

    def _sum_shared(self, values: Array) -> None:
        disc = self.problem.disc
        if self.problem.comm.size > 1:
            block = np.ascontiguousarray(values[disc.late : disc.late + disc.shared])
            self.halo.sum(block)
            values[disc.late : disc.late + disc.shared] = block

    def _message(self, rows: npt.NDArray[np.int32]) -> Message:
        """The exchange of those shared nodes (by position); made when first asked for."""
        key = rows.tobytes()
        if key not in self._messages:
            self._messages[key] = Message(self.halo.part(rows), rows, self._world, self.c)
        return self._messages[key]

    # --- what the future depends on ------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """The run between two beats; arrays are views, valid until a beat; collective."""
        saved = Snapshot(
            {"steps": self.steps},
            nodes={"record": self.record[:-1]},
            sums={"sums": self.sums, "counts": self._counts(),
                  "work": np.array([self.work, self.support_work])},
        )  # fmt: skip
        for name in ("force", "kinetic"):
            values = getattr(self, f"_support_{name}")
            saved.numbers[name] = self.problem.comm.allreduce(values is not None, op=MPI.LOR)
            if saved.numbers[name]:
                dense = np.zeros((self.problem.disc.nodes, self.problem.disc.n))
                dense[self.problem.moving] = values
                saved.nodes[name] = dense
        return saved

    def restore(self, saved: Snapshot) -> None:
        """Go on from a snapshot of a run of the same scene, step and options; collective."""
        own = self.record[:-1, self._inverse].copy()  # of this number of ranks, to the last bit
        self.record[:-1] = saved.nodes["record"]
        self.record[:-1, self._inverse] = own
        self.sums[:] = saved.sums["sums"]
        self.work, self.support_work = (float(v) for v in saved.sums["work"])
        self.steps = int(saved.numbers["steps"])
        for name in ("force", "kinetic"):
            if saved.numbers[name]:
                setattr(self, f"_support_{name}", saved.nodes[name][self.problem.moving])
        self._refresh(saved)
        self._recount(saved.sums["counts"])

    def _refresh(self, saved: Snapshot) -> None:
        """Take what else a kind of run has in a snapshot."""

    # --- what a user sees at a beat's end ------------------------------------------------------

    def sample(self) -> tuple[Array, Array]:
        """(u, ν) and rates at the last beat's end, node records (nodes + 1, NR)."""
        kernels, n = self.problem.kernels, self.problem.disc.n
        kernels.x[:, :n] = self.record[:, :n]
        self.c.cb_get_rates(self._world, native.pointer(self._rates), *self._all)
        if self._inert:
            self._follow(self._rates)
        return kernels.x, self._rates

    def _follow(self, rates: Array) -> None:
        """Rates of components without inertia: they obey D q̇ = f at any time."""
        problem, n = self.problem, self.problem.disc.n
        force = self._forces_at(self.positions(), self.time)
        klass = problem.masses.classes[:-1]
        V, soft = self.basis[klass], self.compliance[klass, :n]
        pull = np.einsum("aji,aj->ai", V, force) / problem.disc.volume[:, None]
        rates[:-1, :n] += np.einsum("aij,aj->ai", V, soft * pull)

    def positions(self) -> Array:
        """(u, ν) at the last beat's end, node records."""
        return self.record

    def dissipated(self) -> float:
        """Work of the viscosity up to the last beat's end, this rank's share [J]."""
        return float(self.sums[0])

    def entries(self) -> Entries:
        """Energies and works at the last beat's end; collective."""
        return entries(self)
