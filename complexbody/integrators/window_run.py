# SPDX-License-Identifier: LGPL-3.0-or-later
"""A run on windows: the same order of events in every window, plain or against a reference."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from complexbody.integrators.balance import Balance
from complexbody.integrators.records import RecordRun
from complexbody.integrators.timetable import per_cell, time_sets
from complexbody.integrators.windows import WindowPlan
from complexbody.problem import Problem

if TYPE_CHECKING:
    from complexbody.integrators.asynchronous import AVI

Array = npt.NDArray[np.float64]
KEEP, AGAINST = 1, 2


class WindowRun(RecordRun):
    """An asynchronous run in progress; one *step* of it is one window.

    Attributes:
        plan: Groups and events of a window; time_sets: what the paper calls Θ, with speed-ups.
        balance: The reference, or None for plain windows.
    """

    def __init__(self, problem: Problem, method: AVI, window: float, critical: Array) -> None:
        super().__init__(problem, method, window, critical)
        self.plan = WindowPlan(problem.disc, window)
        count = per_cell(problem.disc, problem.disc.group[:, None])
        # Half kicks at both ends are one force more than events.
        ends = int(method.start == "trapezoidal")
        self.time_sets = time_sets(
            problem.disc, window / count, critical, window, count, ends=ends
        )
        self.world.groups = ctypes.addressof(self.plan.groups)
        self._point(touched=self.plan.touched, touched_from=self.plan.touched_from)
        self.balance = Balance(self) if method.balanced else None
        if self.balance is not None:
            self._point(reference=self.balance.reference, stress=self.balance.stress)

    def advance(self, windows: int) -> None:
        """Do ``windows`` windows; collective."""
        for _ in range(windows):
            self._window()

    def _window(self) -> None:
        plan, c, balance = self.plan, self.c, self.balance
        start, end = self.time, (self.steps + 1) * self.step
        self.world.start = start
        mode = 0 if balance is None else AGAINST
        self._move_supports(start)
        # One-sided: cells' first kicks are whole, and there are none at the end.
        whole = self.method.start == "one-sided"
        if balance is None:
            self._load_kick(start, 1.0 if whole else 0.5)
        else:
            if self.steps == 0:
                # Nobody has acted yet: a kick of no weight leaves the stress behind.
                self._together(start, KEEP, 0.0)
                self.updates += self.problem.disc.count
            balance.set(start, self.steps == 0)
            loaded = self._loaded_positions()
        self._together(start, mode, 1.0 if whole else 0.5)
        if self.problem.comm.size == 1:
            c.cb_replay(
                self._world, plan.events, ctypes.c_int64(0), ctypes.c_int64(plan.total), mode
            )
        else:
            self._replay_cut(mode)
        nodes = ctypes.c_int64(self.problem.disc.nodes)
        c.cb_drift(self._world, ctypes.c_int64(0), nodes, ctypes.c_double(end))
        if whole:
            self.updates -= self.problem.disc.count
        else:
            self._together(end, mode if balance is None else mode | KEEP)
        if balance is None:
            if not whole:
                self._load_kick(end)
        else:
            # Loads were a constant force: their work is exact.
            amplitude = self.problem.loads.amplitudes(np.array([start + 0.5 * self.step]))[0]
            moved = (self._loaded_positions() - loaded) * self.problem.load_value
            self.work += float(np.dot(amplitude[self.problem.load_group], moved))
            if self.method.filter > 0:
                self.filtered += balance.filter()
        self.steps += 1
        self._book_supports(end)
        self.updates += plan.updates + self.problem.disc.count

    def _loaded_positions(self) -> Array:
        """Values of the components that loads act on, entry by entry."""
        record = self.problem.disc.record
        at = self.problem.load_position
        return self.record[at // record, at % record]

    def _together(self, t: float, mode: int, part: float = 0.5) -> None:
        """All cells act at once with part of their steps: a window's first and last kicks."""
        self.c.cb_together(
            self._world, ctypes.c_int64(0), ctypes.c_int64(self.plan.count), ctypes.c_double(t),
            ctypes.c_double(part), mode,
        )  # fmt: skip
        if self.problem.comm.size > 1 and part > 0:
            self._begin()
            self._end(t, self.plan.every_shared)

    def _replay_cut(self, mode: int) -> None:
        plan, c = self.plan, self.c

        def replay(first: int, last: int) -> None:
            c.cb_replay(self._world, plan.events, ctypes.c_int64(first), ctypes.c_int64(last), mode)

        for cut in plan.cuts:
            replay(cut.first, cut.shared)
            self._begin()
            replay(cut.shared, cut.last)
            self._end(self.world.start + cut.time, cut.touched)
        replay(plan.cuts[-1].last if plan.cuts else 0, plan.total)
