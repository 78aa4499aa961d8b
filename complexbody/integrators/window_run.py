# SPDX-License-Identifier: LGPL-3.0-or-later
"""A run on windows: the same order of events in every window, plain or balanced."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from complexbody.integrators.activity import ENOUGH, Activity, active
from complexbody.integrators.balance import Balance
from complexbody.integrators.records import RecordRun
from complexbody.integrators.snapshot import Snapshot
from complexbody.integrators.timetable import per_cell, time_sets
from complexbody.integrators.windows import WindowPlan
from complexbody.kernels.events import RANGE
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.asynchronous import AVI

Array = npt.NDArray[np.float64]


class WindowRun(RecordRun):
    """An asynchronous run in progress; one *step* of it is one window.

    Attributes:
        plan: Groups and events of a window; time_sets: what the paper calls Θ, with speed-ups.
        balance: Forces that act through the cells' steps, or None for plain windows.
    """

    def __init__(self, problem: Problem, method: AVI, window: float, critical: Array) -> None:
        super().__init__(problem, method, window, critical)
        self.plan = WindowPlan(problem.disc, window)
        count = per_cell(problem.disc, np.abs(problem.disc.group[:, None]))
        # Half kicks at both ends are one force more than events.
        ends = int(method.start == "trapezoidal" and not method.balanced)
        self.time_sets = time_sets(problem.disc, window / count, critical, window, count, ends=ends)
        self.world.groups = ctypes.addressof(self.plan.groups)
        self._point(touched=self.plan.touched, touched_from=self.plan.touched_from)
        self.balance = Balance(self, self.plan) if method.balanced else None
        if self.balance is not None:
            self._point(held=self.balance.held, blend=self.balance.blend)
        self._watch()

    def _watch(self) -> None:
        """Skip what is quiet from now on, if enough is; between windows."""
        problem, kernels, disc = self.problem, self.problem.kernels, self.problem.disc
        self.activity, self.world.activity, self.skips_energies = None, None, False
        if not (problem.quiet and disc.blocks):
            return
        stirred = (problem.initial_rates != 0).any(axis=1)
        for part in range(3 if self.balance is not None else 2):  # positions, rates, accelerations
            first = part * disc.record
            stirred |= (self.record[:-1, first : first + disc.n] != 0).any(axis=1)
        stirred[self.acted] = True
        if active(disc.cells, stirred) > ENOUGH:
            return
        force, energetic = kernels.restless()
        restless = np.repeat(force, np.diff(disc.chunks[:, :2], axis=1).ravel())
        if self.balance is not None:
            restless = restless | self.balance.held.any(axis=(1, 2))
        ends = self.plan.chunk_ends
        awake = np.add.reduceat(restless, np.append(0, ends[:-1])) > 0
        ranges = np.append(np.arange(RANGE, disc.nodes, RANGE), disc.nodes)
        late = np.arange(disc.late // RANGE, len(ranges))
        self.activity = Activity(self.c, ends, disc.cells, ranges, stirred, awake, late)
        self.world.activity = ctypes.addressof(self.activity.state)
        self.skips_energies = not energetic

    def snapshot(self) -> Snapshot:
        """The run between two windows, with the forces that its cells hold."""
        saved = super().snapshot()
        if self.balance is not None:
            self.balance.save(saved)
        return saved

    def _refresh(self, saved: Snapshot) -> None:
        if self.balance is not None:
            self.balance.restore(saved)
        self._watch()

    def advance(self, windows: int) -> None:
        """Do ``windows`` windows; collective."""
        for _ in range(windows):
            self._window()

    def _window(self) -> None:
        if self.balance is None:
            self._plain()
        else:
            self._balanced(self.balance)
        self.steps += 1
        self._book_supports(self.time)

    def _plain(self) -> None:
        """Kicks, half of them at the ends; one-sided: the first ones whole, none at the end."""
        start, end = self.time, (self.steps + 1) * self.step
        whole = self.method.start == "one-sided"
        self._move_supports(start)
        self._load_kick(start, 1.0 if whole else 0.5)
        self._together(start, 0, 1.0 if whole else 0.5)
        self._replay(start, end)
        if not whole:
            self._together(end, 0)
            self._load_kick(end)
            self._count(self.problem.disc.count)
        self._count(self.plan.updates)

    def _balanced(self, balance: Balance) -> None:
        """Forces act all the time; all cells renew theirs at the window's end."""
        start, end = self.time, (self.steps + 1) * self.step
        self._move_supports(start)
        if self.steps == 0:
            balance.begin(start)
        balance.load(start + 0.5 * self.step)
        loaded = self._loaded_positions()
        self._replay(start, end)
        self._together(end, 0, 1.0)
        # Loads were a constant force: their work is exact.
        amplitude = self.problem.loads.amplitudes(np.array([start + 0.5 * self.step]))[0]
        moved = (self._loaded_positions() - loaded) * self.problem.load_value
        self.work += float(np.dot(amplitude[self.problem.load_group], moved))
        self._count(self.plan.updates)

    def _replay(self, start: float, end: float) -> None:
        """The window's events between its ends, and all nodes to its end."""
        plan, c = self.plan, self.c
        self.world.start = start

        def replay(first: int, last: int) -> None:
            c.cb_replay(self._world, plan.events, ctypes.c_int64(first), ctypes.c_int64(last), 0)

        if self.problem.comm.size == 1:
            replay(0, plan.total)
        else:
            for cut in plan.cuts:
                message = self._message(cut.touched)
                replay(cut.first, cut.shared)
                message.begin()
                replay(cut.shared, cut.last)
                message.end(start + cut.time)
            replay(plan.cuts[-1].last if plan.cuts else 0, plan.total)
        c.cb_drift(self._world, ctypes.c_double(end))

    def _loaded_positions(self) -> Array:
        """Values of the components that loads act on, entry by entry."""
        record = self.problem.disc.record
        at = self.problem.load_position
        return self.record[at // record, at % record]

    def _together(
        self, t: float, mode: int, part: float = 0.5, first: int = 0, last: int | None = None,
        exchange: bool = True,
    ) -> None:  # fmt: skip
        """All cells (or those of some groups) act at once, with part of their steps."""
        last = self.plan.count if last is None else last
        self.c.cb_together(
            self._world, ctypes.c_int64(first), ctypes.c_int64(last), ctypes.c_double(t),
            ctypes.c_double(part), mode,
        )  # fmt: skip
        if exchange:
            self._exchange(t)

    def _exchange(self, t: float) -> None:
        """What cells of all ranks gave to shared nodes at t."""
        if self.problem.comm.size > 1:
            message = self._message(self.plan.every_shared)
            message.begin()
            message.end(t)
