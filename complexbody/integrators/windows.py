# SPDX-License-Identifier: LGPL-3.0-or-later
"""Windows: which cells act when, computed once and replayed in every window.

Time goes in windows W of about α times the largest critical step. Cell K makes
N_K = ⌈W/(α h_K,crit)⌉ equal steps h_K = W/N_K in each, large N_K rounded up a little. Cells of
equal N_K act at the same times j W/N_K, so they form groups; events of different groups at one time
commute. An elemental time set Θ_K is thus rational, and the order of events is the same in every
window.
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
from complexbody.integrators.octaves import largest
from complexbody.kernels.events import CHUNK
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: N_K above this is refused: a window would hold too many distinct times.
MOST_DIVISIONS = 100_000

#: N_K keeps this many binary digits behind its first: on graded meshes up to 3 % more events, and
#: a third to half fewer drifts, since more neighbours act together.
DIGITS = 3


class Group(ctypes.Structure):
    """Mirror of ``group`` in events.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("first", "last", "region", "divisions", "chunk")),
        ("step", ctypes.c_double),
    )


class Happening(ctypes.Structure):
    """Mirror of ``happening`` in events.c."""

    _fields_ = (("time", ctypes.c_double), ("group", ctypes.c_int64))


def divisions(steps: Array, window: float, octaves: bool = False) -> Ints:
    """N_K = ⌈W/h_K⌉ of steps (cells,) not to be exceeded [s], at least 1, rounded up from 17 on.

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
    unit = 1 << np.maximum(np.frexp(count)[1] - 1 - (0 if octaves else DIGITS), 0)
    return -(-count // unit) * unit


def graded(problem: Problem, counts: Ints) -> Ints:
    """N_K raised until cells that share a node differ by a factor of two at most; collective.

    A node then moves with frequencies ω ≤ 2α/h of its smallest cell's h, too slow to be driven by
    what its largest cell, of at most 2h, does twice in a period: 2ω < 2π/(2h) if α < π/4.

    Args:
        problem: The scene.
        counts: N_K of this rank's cells, in the order of dolfinx's owned cells.
    """
    disc = problem.disc
    real = disc.source_cell >= 0
    now = np.zeros(real.shape)
    now[real] = counts[disc.source_cell[real]]
    while True:
        most = np.zeros(disc.nodes + 1)
        np.maximum.at(most, disc.cells, now[:, None, :])
        most[:-1] = largest(problem, most[:-1])
        least = np.ceil(most[disc.cells].max(axis=1) / 2)
        changed = bool(np.any(least[real] > now[real]))
        now[real] = np.maximum(now, least)[real]
        if not problem.comm.allreduce(changed, op=MPI.LOR):
            break
    out = np.zeros_like(counts)
    out[disc.source_cell[real]] = now[real]
    return out


def apart(problem: Problem, counts: Ints) -> Ints:
    """−N_K for cells that touch a damped node of an absorbing boundary: groups of their own.

    Args:
        problem: The scene.
        counts: N_K of this rank's cells, in the order of dolfinx's owned cells.
    """
    disc, masses = problem.disc, problem.masses
    if not masses.absorbing:
        return counts
    damped = np.append(masses.dampers[masses.classes[:-1]], False)
    real = disc.source_cell >= 0
    beside = damped[disc.cells].any(axis=1)
    out = counts.copy()
    out[disc.source_cell[real & beside]] *= -1
    return out


@dataclass
class Cut:
    """A time at which ranks exchange kicks: after the shared-node events [first, shared).

    The events [shared, last) at the same time touch no shared node. ``touched`` are the shared
    nodes, by position, on which cells of any rank act then.
    """

    first: int
    shared: int
    last: int
    time: float
    touched: npt.NDArray[np.int32]


class WindowPlan:
    """Groups and events of one window on this rank; collective.

    Args:
        disc: Arrays whose blocks are grouped by N_K, or −N_K for cells that stay apart.
        window: W [s].

    Attributes:
        groups: C array of groups, those touching shared nodes first.
        edge: Number of groups touching shared nodes.
        events: C array of interior events, 0 < t < W, by time; shared-node groups first.
        touched, touched_from: Nodes that drift before each chunk of blocks acts.
        chunk_ends: Where these chunks end, in blocks.
        cuts: Exchanges (several ranks only), at the same times on every rank.
        every_shared: All shared nodes by position.
        updates: Cell updates per window (boundary counted once) on this rank.
    """

    def __init__(self, disc: Discretisation, window: float) -> None:
        change = np.any(np.diff(np.stack([disc.region, disc.group]), axis=1) != 0, axis=0)
        cuts = {0, disc.blocks, *(np.flatnonzero(change) + 1).tolist(), disc.boundary_blocks}
        ends = sorted(cuts)
        runs = list(itertools.pairwise(ends))
        self.groups = (Group * max(len(runs), 1))()
        self.edge, self.updates, chunk = 0, 0, 0
        for i, (first, last) in enumerate(runs):
            count = abs(int(disc.group[first]))
            step = window / count
            self.groups[i] = Group(first, last, int(disc.region[first]), count, chunk, step)
            chunk += -(-(last - first) // CHUNK)
            self.edge += first < disc.boundary_blocks
            self.updates += count * int(np.sum(disc.source_cell[first:last] >= 0))
        self.count = len(runs)
        self._chunks(disc, np.array(runs, np.int64).reshape(-1, 2), chunk)
        self._events(disc, window)

    def _chunks(self, disc: Discretisation, runs: Ints, chunks: int) -> None:
        """Nodes by the first chunk of CHUNK blocks, within each group, whose cells touch them."""
        blocks = np.arange(disc.blocks)
        group = np.searchsorted(runs[:, 1], blocks, side="right")
        first = np.array([self.groups[i].chunk for i in range(self.count)], np.int64)
        chunk = first[group] + (blocks - runs[group, 0]) // CHUNK
        self.chunk_ends = np.flatnonzero(np.diff(chunk, append=chunks)) + 1
        nodes = disc.cells.reshape(disc.blocks, -1)
        key, at = np.unique(group[:, None] * (disc.nodes + 1) + nodes, return_index=True)
        node, chunk = key % (disc.nodes + 1), chunk[at // max(nodes.shape[1], 1)]
        real = node < disc.nodes
        order = np.argsort(chunk[real], kind="stable")
        self.touched = np.ascontiguousarray(node[real][order], dtype=np.int32)
        counts = np.bincount(chunk[real], minlength=chunks)
        self.touched_from = np.concatenate([[0], np.cumsum(counts)])

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
        self.every_shared = np.arange(disc.shared, dtype=np.int32)
        if disc.comm.size == 1:
            return
        mine = {self.groups[i].divisions for i in range(self.edge)}
        every = sorted(set().union(*disc.comm.allgather(mine)))
        acting: dict[float, list[int]] = {}
        for i, n in enumerate(every):
            for j in range(1, n):
                acting.setdefault(j / n, []).append(i)
        touched = _touched(disc, every)
        fractions = np.array([row[0] for row in rows])
        interior = np.array([row[1] for row in rows], dtype=bool)
        before = 0
        for time in sorted(acting):
            first, last = np.searchsorted(fractions, [time, np.nextafter(time, 2)])
            shared = int(first + np.sum(~interior[first:last]))
            which = np.flatnonzero(touched[:, acting[time]].any(axis=1)).astype(np.int32)
            self.cuts.append(Cut(int(before), shared, int(last), time * window, which))
            before = int(last)


def _touched(disc: Discretisation, divisions: list[int]) -> npt.NDArray[np.bool_]:
    """Shared nodes that cells of each N_K touch on any rank, (nodes, divisions); collective."""
    flags = np.zeros((disc.nodes + 1, len(divisions)))
    for block in range(disc.boundary_blocks):
        flags[disc.cells[block].ravel(), divisions.index(abs(int(disc.group[block])))] = 1.0
    disc.sum_shared(flags[:-1])
    return flags[disc.late : disc.late + disc.shared] > 0


def window_length(steps: Array, until: float, comm: Any) -> float:
    """W: the largest step of any cell [s], shortened so that ``until`` falls on a window's end."""
    finite = steps[np.isfinite(steps)]
    largest = float(comm.allreduce(float(finite.max(initial=0.0)), op=MPI.MAX))
    if largest <= 0:
        raise StepError("No cell has a finite critical step: the body has no stiffness.")
    largest = min(largest, until)
    return float(until / np.ceil(until / largest * (1 - 1e-12)))
