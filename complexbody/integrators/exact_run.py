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
from complexbody.integrators.exact_schedule import ExactSchedule
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
        self._sampled: tuple[int, float] | None = None

    def snapshot(self) -> Snapshot:
        """The run between two spans, with its cells' counters."""
        saved = super().snapshot()
        saved.cells["counter"] = to_cells(self.problem.disc, self.schedule.counters())
        return saved

    def _refresh(self, saved: Snapshot) -> None:
        self.schedule.set(to_blocks(self.problem.disc, saved.cells["counter"]))
        self._sampled = None

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
            self._move_supports(start)
            self._load_kick(start, 0.5 if trapezoidal else 1.0)
            self._count(self.schedule.run(self.c, self._world, start, end))
            self._touch(end)
            if trapezoidal:
                self._load_kick(end)
            self.steps += 1
            self._sampled = None
            self._book_supports(end)

    def _see(self) -> None:
        """Bring the copy of the records to the last span's end, unless it is there."""
        if self._sampled is not None:
            return
        t, before = ctypes.c_double(self.time), float(self.sums[0])
        disc, seen = self.problem.disc, ctypes.byref(self._seen)
        np.copyto(self._copy, self.record)
        self.c.cb_drift(seen, t)
        self.c.cb_exact_complete(seen, self._ahead, ctypes.c_int64(disc.blocks), t)
        if self.problem.comm.size > 1:
            message = self._message(self._rows)
            message.begin()
            message.end(self.time, seen)
        self._sampled = (self.steps, float(self.sums[0]))
        self.sums[0] = before

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
        assert self._sampled is not None
        return self._sampled[1]
