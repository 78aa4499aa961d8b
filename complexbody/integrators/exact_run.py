# SPDX-License-Identifier: LGPL-3.0-or-later
"""A run on an exact schedule: every cell acts at the multiples of its own step (paper §4).

Time goes in *spans*, which are only a way to put events in order a stretch at a time; cells do not
see where one ends, and neither do nodes without load. What a user sees at a span's end is made on a
copy of the records: nodes drifted to that time, and every cell's impulse completed to it.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import native
from complexbody.integrators.activity import ENOUGH, active
from complexbody.integrators.exact_schedule import ExactSchedule
from complexbody.integrators.reached import Reached
from complexbody.integrators.records import RecordRun, World
from complexbody.integrators.snapshot import Snapshot, to_blocks, to_cells
from complexbody.integrators.timetable import per_cell, time_sets
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.asynchronous import AVI

Array = npt.NDArray[np.float64]


class ExactRun(RecordRun):
    """An asynchronous run in progress; one *step* of it is one span.

    Attributes:
        steps_of: h_K of this rank's cells in blocks (blocks, W) [s], infinite for padding.
        schedule: Events of the span in progress, and messages.
        reached: Which cells are quiet; None if that is not watched for.
    """

    def __init__(self, problem: Problem, method: AVI, span: float, steps: Array, critical: Array):
        super().__init__(problem, method, span, critical)
        disc, self.steps_of = problem.disc, steps
        trapezoidal = method.start == "trapezoidal"
        self.schedule = ExactSchedule(problem, steps, span, trapezoidal)
        own = per_cell(disc, steps)
        # Counted over the largest step: spans are as short as suits the machine.
        largest = problem.comm.allreduce(float(own.max(initial=0.0)), op=MPI.MAX)
        self.time_sets = time_sets(disc, own, critical, largest)
        self._ahead = ctypes.byref(self.schedule.state)
        # Kicks of shared nodes are applied one by one, not collected.
        self.world.late = self.world.beyond = 0
        self._copy = native.aligned(self.record.shape)
        self._seen = World.from_buffer_copy(self.world)
        self._seen.record = self._copy.ctypes.data
        self._seen.late, self._seen.beyond = disc.late, disc.late + disc.shared
        self._rows = np.arange(disc.shared, dtype=np.int32)
        self._touched = self._touched_nodes()
        self._sampled = False
        self.reached: Reached | None = None
        self._passed = 0  # events left out that ``reached`` does not know of
        self._watch()

    def _watch(self) -> None:
        """Schedule only what motion can reach, if that is not nearly all; between spans."""
        problem, disc = self.problem, self.problem.disc
        self.reached = None
        if not problem.quiet:
            return
        moving = (problem.initial_rates != 0).any(axis=1) & (self.steps == 0)
        for first in (0, disc.record):  # positions, rates
            moving |= (self.record[:-1, first : first + disc.n] != 0).any(axis=1)
        moving[self._touched] = True
        force, _ = problem.kernels.restless()
        restless = np.repeat(force, np.diff(disc.chunks[:, :2], axis=1).ravel())
        node = np.unique(disc.cells[restless])
        moving[node[node < disc.nodes]] = True
        enough = active(disc.cells, moving) > ENOUGH
        if not problem.comm.allreduce(enough, op=MPI.LAND):
            self.reached = Reached(problem, self.c, self.schedule, moving, self.time)

    def wake(self) -> None:
        """All cells act from now on."""
        if self.reached is not None:
            self.reached.stop()

    def snapshot(self) -> Snapshot:
        """The run between two spans, with its cells' counters."""
        saved = super().snapshot()
        counters = self.schedule.counters()
        if self.reached is not None and self.reached.on:
            counters = self.reached.counters(counters, self.steps_of, self.time)
        saved.cells["counter"] = to_cells(self.problem.disc, counters)
        return saved

    def _refresh(self, saved: Snapshot) -> None:
        self.schedule.set(to_blocks(self.problem.disc, saved.cells["counter"]))
        self._sampled = False
        self._watch()

    def _recount(self, counts: npt.NDArray[np.int64]) -> None:
        super()._recount(counts)
        if self.reached is not None:
            self._passed = self.skipped - self.reached.skipped(self.time)

    def _touched_nodes(self) -> npt.NDArray[np.int32]:
        """Nodes that loads or moving supports act on, on any rank."""
        problem, disc = self.problem, self.problem.disc
        flags = np.zeros((disc.nodes + 1, 1))
        flags[self.acted] = 1.0
        flags[problem.moving[0]] = 1.0
        disc.sum_shared(flags[:-1])
        return np.flatnonzero(flags[:-1, 0]).astype(np.int32)

    def _touch(self, t: float) -> None:
        self.c.cb_exact_touch(
            self._world, native.pointer(self._touched), ctypes.c_int64(len(self._touched)),
            ctypes.c_double(t),
        )  # fmt: skip

    def advance(self, spans: int) -> None:
        """Do ``spans`` spans; collective."""
        trapezoidal = self.method.start == "trapezoidal"
        for _ in range(spans):
            start, end = self.time, (self.steps + 1) * self.step
            self._touch(start)
            if self.reached is not None and self.reached.on:
                self.reached.follow(start, end)
            self._move_supports(start)
            self._load_kick(start, 0.5 if trapezoidal else 1.0)
            self.updates += self.schedule.run(self.c, self._world, start, end)
            self._touch(end)
            if trapezoidal:
                self._load_kick(end)
            self.steps += 1
            self._sampled = False
            self._book_supports(end)
        if self.reached is not None:
            self.skipped = self._passed + self.reached.skipped(self.time)

    def _see(self) -> None:
        """Bring the copy of the records to the last span's end, unless it is there."""
        if self._sampled:
            return
        t = ctypes.c_double(self.time)
        disc, seen = self.problem.disc, ctypes.byref(self._seen)
        np.copyto(self._copy, self.record)
        self.c.cb_drift(seen, t)
        self.c.cb_exact_complete(seen, self._ahead, ctypes.c_int64(disc.blocks), t)
        if self.problem.comm.size > 1:
            message = self._message(self._rows)
            message.begin()
            message.end(self.time, seen)
        self._sampled = True

    def sample(self) -> tuple[Array, Array]:
        """(u, ν) and rates at the last span's end, node records (nodes + 1, NR)."""
        self._see()
        kernels, n = self.problem.kernels, self.problem.disc.n
        kernels.x[:, :n] = self._copy[:, :n]
        self.c.cb_get_rates(ctypes.byref(self._seen), native.pointer(self._rates), *self._all)
        if self._inert:
            self._follow(self._rates)
        return kernels.x, self._rates

    def positions(self) -> Array:
        """(u, ν) at the last span's end, node records."""
        self._see()
        return self._copy

    def dissipated(self) -> float:
        """Work of the viscosity up to the last span's end, this rank's share [J]."""
        self._see()
        if not self.losing:
            return 0.0
        disc, first = self.problem.disc, 2 * self.problem.disc.record
        # A snapshot gives all copies of a node what its owner knows.
        return float(np.sum(self._copy[:-1, first : first + disc.n][disc.owned]))
