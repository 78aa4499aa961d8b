# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which cells of an exact schedule motion can have reached: others are not scheduled (reached.c).

Who may move whom, and when, is known before anything moves: a cell's event moves all its nodes if
one of them has begun to move before. Followed to a span's end, cell by cell, that gives the cells
to schedule. Ranks tell each other when shared nodes begin to move; cells at shared nodes are always
scheduled, since the other ranks wait for their kicks.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import native
from complexbody.integrators.activity import ENOUGH
from complexbody.integrators.exact_schedule import ExactSchedule
from complexbody.integrators.octaves import largest
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class State(ctypes.Structure):
    """Mirror of ``reached`` in reached.c."""

    _fields_ = (
        *((n, ctypes.c_int64) for n in ("cells", "nodes", "awake_cells", "skipped")),
        *(
            (name, ctypes.c_void_p)
            for name in ("cell_from", "cell", "since", "first", "awake", "queued", "queue")
        ),
        ("head", ctypes.c_int64), ("waiting", ctypes.c_int64),
        ("idle", ctypes.c_void_p), ("idles", ctypes.c_int64),
    )  # fmt: skip


class Reached:
    """Cells that are awake, and what is known of when nodes begin to move; collective.

    Args:
        problem: The scene.
        c: A library with reached.c in it.
        schedule: Cells and their events; what is quiet is taken out of it.
        moving: Nodes that are not at zero, or that something acts on at any time (nodes,).
        time: Start of the span to be scheduled next [s].

    Attributes:
        state: What the C functions read.
        on: False once all cells act: nothing is followed any more.
        count: Cells of this rank.
    """

    def __init__(
        self, problem: Problem, c: ctypes.CDLL, schedule: ExactSchedule,
        moving: npt.NDArray[np.bool_], time: float = 0.0,
    ) -> None:  # fmt: skip
        disc = problem.disc
        self.problem, self.on, self.count = problem, True, disc.count
        self._c, self._ahead, self._time = c, ctypes.byref(schedule.state), time
        c.cb_reached_begin.restype = c.cb_reached_skipped.restype = ctypes.c_int64
        cells = disc.blocks * disc.lanes
        nodes = disc.cells.transpose(0, 2, 1).reshape(cells, -1)
        order = np.argsort(nodes, axis=None, kind="stable")
        of_node = np.searchsorted(nodes.ravel()[order], np.arange(disc.nodes + 1))
        self._arrays: dict[str, npt.NDArray[Any]] = {
            "cell_from": of_node.astype(np.int64),
            "cell": (order // nodes.shape[1]).astype(np.int32),
            "since": np.full(disc.nodes + 1, np.inf), "first": np.full(cells, np.inf),
            "awake": np.zeros(cells, np.uint8), "queued": np.zeros(cells, np.uint8),
            "queue": np.zeros(cells, np.int32), "idle": np.zeros(cells, np.int32),
        }  # fmt: skip
        self.state = State(cells, disc.nodes)
        for name, array in self._arrays.items():
            setattr(self.state, name, native.pointer(array).value)
        self._this = ctypes.byref(self.state)
        schedule.arrays["due"][schedule.arrays["index"][:cells]] = np.inf
        edge = np.flatnonzero(disc.source_cell[: disc.boundary_blocks].ravel() >= 0)
        self._rouse(edge.astype(np.int32))
        self._shared = np.arange(disc.late, disc.late + disc.shared, dtype=np.int32)
        self._begin(np.flatnonzero(moving).astype(np.int32), -np.inf)

    def _rouse(self, cells: npt.NDArray[np.int32]) -> None:
        count = ctypes.c_int64(len(cells))
        self._c.cb_reached_rouse(
            self._ahead, self._this, native.pointer(cells), count, ctypes.c_double(self._time)
        )

    def _begin(self, nodes: npt.NDArray[np.int32], times: Array | float) -> bool:
        times = np.array(np.broadcast_to(times, len(nodes)), np.float64)
        count = ctypes.c_int64(len(nodes))
        return bool(
            self._c.cb_reached_begin(
                self._this, native.pointer(nodes), native.pointer(times), count
            )
        )

    def follow(self, start: float, end: float) -> None:
        """Schedule what motion can reach in the span [start, end); collective, while ``on``."""
        problem, since = self.problem, self._arrays["since"]
        self._time = start
        if self.state.awake_cells > ENOUGH * self.count:
            self._all()
        span = ctypes.c_double(start), ctypes.c_double(end)
        while True:
            self._c.cb_reached_follow(self._ahead, self._this, *span)
            if problem.comm.size == 1:
                break
            heard = -largest(problem, -since[:-1])[self._shared]
            news = self._begin(self._shared, heard)
            if not problem.comm.allreduce(news, op=MPI.LOR):
                break
        full = self.state.awake_cells == self.count
        self.on = not problem.comm.allreduce(full, op=MPI.LAND)

    def _all(self) -> None:
        self._c.cb_reached_all(self._ahead, self._this, ctypes.c_double(self._time))

    def stop(self) -> None:
        """All cells act from now on: for who changes a run's state by hand, on all ranks."""
        self._all()
        self.on = False

    def counters(self, known: Ints, steps: Array, t: float) -> Ints:
        """j of the next event of all cells in blocks, those that are not scheduled too.

        Args:
            known: Of those that are (blocks, W).
            steps: h_K (blocks, W) [s], infinite for padding.
            t: Start of the next span [s].
        """
        quiet = (self._arrays["awake"].reshape(steps.shape) == 0) & np.isfinite(steps)
        h = np.where(quiet, steps, 1.0)
        j = np.maximum((t / h).astype(np.int64) - 1, 0)
        for _ in range(3):  # as reached.c counts
            j += j * h < t
        return np.where(quiet, j, known)

    def skipped(self, t: float) -> int:
        """Events before t that were left out."""
        return int(self._c.cb_reached_skipped(self._ahead, self._this, ctypes.c_double(t)))
