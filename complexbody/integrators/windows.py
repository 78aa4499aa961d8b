# SPDX-License-Identifier: LGPL-3.0-or-later
"""Windows: which cells act when, computed once and replayed in every window.

Time goes in windows W of about α times the largest critical step. Cell K makes
N_K = ⌈W/(α h_K,crit)⌉ equal steps h_K = W/N_K in each. Cells of equal N_K act at the same times
j W/N_K, so they form groups; events of different groups at one time commute. An elemental time set
Θ_K is thus rational, and the order of events is the same in every window.
"""

from __future__ import annotations

import ctypes
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody.discretisation import Discretisation
from complexbody.errors import StepError
from complexbody.integrators import timetable
from complexbody.integrators.timetable import TimeSets

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: N_K above this is refused: a window would hold too many distinct times.
MOST_DIVISIONS = 100_000


class Group(ctypes.Structure):
    """Mirror of ``group`` in events.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("first", "last", "region", "divisions")),
        ("step", ctypes.c_double),
    )


class Happening(ctypes.Structure):
    """Mirror of ``happening`` in events.c."""

    _fields_ = (("time", ctypes.c_double), ("group", ctypes.c_int64))


def divisions(steps: Array, window: float, octaves: bool = False) -> Ints:
    """N_K = ⌈W/h_K⌉ of steps (cells,) not to be exceeded [s], at least 1.

    With ``octaves`` N_K is rounded up to a power of two: fewer groups, coherent levels.

    Raises:
        StepError: if a cell would need more than 100 000 steps per window.
    """
    count = np.ceil(window / steps * (1 - 1e-12)).astype(np.int64)
    worst = int(count.max(initial=1))
    if worst > MOST_DIVISIONS:
        raise StepError(
            f"A cell needs {worst} steps per window of {window:.3g} s: the mesh has cells too "
            "different in size. Repair its smallest cells, or use a smaller window."
        )
    count = np.maximum(count, 1)
    return 2 ** np.ceil(np.log2(count)).astype(np.int64) if octaves else count


@dataclass
class Cut:
    """A time at which ranks exchange kicks: after the shared-node events [first, shared).

    The events [shared, last) at the same time touch no shared node.
    """

    first: int
    shared: int
    last: int
    time: float


class WindowPlan:
    """Groups and events of one window on this rank; collective.

    Args:
        disc: Arrays whose blocks are grouped by N_K.
        window: W [s].

    Attributes:
        groups: C array of groups, those touching shared nodes first.
        edge: Number of groups touching shared nodes.
        events: C array of interior events, 0 < t < W, by time; shared-node groups first.
        cuts: Exchanges (several ranks only), at the same times on every rank.
        updates: Cell updates per window (boundary counted once) on this rank.
    """

    def __init__(self, disc: Discretisation, window: float) -> None:
        change = np.any(np.diff(np.stack([disc.region, disc.group]), axis=1) != 0, axis=0)
        cuts = {0, disc.blocks, *(np.flatnonzero(change) + 1).tolist(), disc.boundary_blocks}
        ends = sorted(cuts)
        runs = list(itertools.pairwise(ends))
        self.groups = (Group * max(len(runs), 1))()
        self.edge, self.updates = 0, 0
        for i, (first, last) in enumerate(runs):
            count = int(disc.group[first])
            self.groups[i] = Group(first, last, int(disc.region[first]), count, window / count)
            self.edge += first < disc.boundary_blocks
            self.updates += count * int(np.sum(disc.source_cell[first:last] >= 0))
        self.count = len(runs)
        self._events(disc, window)

    def _events(self, disc: Discretisation, window: float) -> None:
        rows: list[tuple[float, int, int]] = []
        for i in range(self.count):
            n = self.groups[i].divisions
            # j/n is the same double for equal fractions, so that coinciding events coincide.
            rows += [(j / n, int(i >= self.edge), i) for j in range(1, n)]
        rows.sort()
        self.events = (Happening * max(len(rows), 1))()
        for at, (fraction, _, group) in enumerate(rows):
            self.events[at] = Happening(fraction * window, group)
        self.total = len(rows)
        self.cuts: list[Cut] = []
        if disc.comm.size == 1:
            return
        mine = {self.groups[i].divisions for i in range(self.edge)}
        every = set().union(*disc.comm.allgather(mine))
        times = sorted({j / n for n in every for j in range(1, n)})
        fractions = np.array([row[0] for row in rows])
        interior = np.array([row[1] for row in rows], dtype=bool)
        before = 0
        for time in times:
            first, last = np.searchsorted(fractions, [time, np.nextafter(time, 2)])
            shared = int(first + np.sum(~interior[first:last]))
            self.cuts.append(Cut(int(before), shared, int(last), time * window))
            before = int(last)


def window_length(steps: Array, until: float, comm: Any) -> float:
    """W: the largest step of any cell [s], shortened so that ``until`` falls on a window's end."""
    finite = steps[np.isfinite(steps)]
    largest = float(comm.allreduce(float(finite.max(initial=0.0)), op=MPI.MAX))
    if largest <= 0:
        raise StepError("No cell has a finite critical step: the body has no stiffness.")
    largest = min(largest, until)
    return float(until / np.ceil(until / largest * (1 - 1e-12)))


def time_sets(plan: WindowPlan, disc: Discretisation, critical: Array, window: float) -> TimeSets:
    """Time sets of a window plan; collective.

    Args:
        plan: The plan.
        disc: Its arrays.
        critical: Critical steps of this rank's cells (cells,) [s].
        window: W [s].
    """
    count = timetable.per_cell(disc, disc.group[:, None])
    # Half kicks at both ends: one force more than events.
    return timetable.time_sets(disc, window / count, critical, window, count, ends=1)
