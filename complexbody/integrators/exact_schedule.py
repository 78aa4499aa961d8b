# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of an exact schedule: cells packed for single use, other ranks' visits, messages.

Every rank knows the steps of the other ranks' cells that touch its nodes, hence when they act: it
needs to be sent their kicks only. Made once; a span allocates nothing.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat, native
from complexbody.kernels.events import packed_size
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
_TAG = 8


#: A span has about so many events, or one per cell if that is more: its arrays stay in a cache,
#: and little is lost in going through all cells for it.
EVENTS, PER_CELL = 50_000, 1.0

#: Binary digits of a step that is not given.
DIGITS = 26


def alike(steps: Array) -> Array:
    """h_K rounded to so many binary digits that cells alike but for round-off act together [s].

    Else motion, if ever so little, would run through all of them within one step.
    """
    digits, exponent = np.frexp(steps)
    return np.asarray(np.ldexp(np.round(np.ldexp(digits, DIGITS)), exponent - DIGITS))


def span_length(steps: Array, until: float, comm: Any) -> float:
    """Length of a span [s], at most the largest step; ``until`` ends one.

    Args:
        steps: h_K of this rank's cells [s], infinite for padding.
        until: End of the run [s].
        comm: Communicator; collective.
    """
    finite = steps[np.isfinite(steps)]
    count, rate = comm.allreduce(np.array([len(finite), np.sum(1.0 / finite)]))
    largest = comm.allreduce(float(finite.max(initial=0.0)), op=MPI.MAX)
    span = min(max(EVENTS, PER_CELL * count) / rate, largest, until)
    return float(until / np.ceil(until / span * (1 - 1e-12)))


class Schedule(ctypes.Structure):
    """Mirror of ``schedule`` in exact.c."""

    _fields_ = (
        ("cells", ctypes.c_int64), ("visits", ctypes.c_int64),
        *(
            (name, ctypes.c_void_p)
            for name in ("packed", "node", "region", "step", "counter", "due", "actor", "index",
                         "row", "row_node", "list", "event", "link", "last", "stack",
                         "bucket")
        ),
        ("buckets", ctypes.c_int64),
        *(
            (name, ctypes.c_void_p)
            for name in ("head", "tail", "kicks", "rows_of", "rows", "row_neighbour", "row_place",
                         "outgoing", "out_start", "out_count")
        ),
        *(
            (name, ctypes.c_int64)
            for name in ("first_shared", "last_shared", "events", "top", "done")
        ),
        ("trapezoidal", ctypes.c_int32),
    )  # fmt: skip


class ExactSchedule:
    """Cells, visits and messages of a run whose cells step as they like; collective.

    Args:
        problem: The scene.
        steps: h_K in blocks (blocks, W) [s]; infinite for padding.
        span: Length of the stretches of time that are scheduled at once [s].
        trapezoidal: Cells' first kicks are halves.

    Attributes:
        state: What the C functions read.
        most: Most events of this rank in a span, visits included.
        counter: j of the next event of cells and visits, by rank and global number.
    """

    def __init__(self, problem: Problem, steps: Array, span: float, trapezoidal: bool) -> None:
        disc = problem.disc
        self.halo, self.comm, self.n = disc.halo, problem.comm, disc.n
        self._blocks = disc.source_cell.shape
        cells = disc.blocks * disc.lanes
        original = _compat.original_cells(problem.scene.mesh)
        source = disc.source_cell.ravel()
        number = np.where(source >= 0, original[np.maximum(source, 0)], -1)
        rows = len(disc.halo.sends)
        visits = self._visits(disc, steps, number)
        every = np.concatenate([steps.ravel(), visits["step"]])
        # Events at one time come in this order on all ranks: one rank's all together, so that
        # kicks need not go to and fro between equal cells.
        rank = np.full(cells, self.comm.rank)
        others = np.asarray(self.halo.neighbours, np.int64)[visits["from"]]
        order = np.lexsort(
            (np.concatenate([number, visits["number"]]), np.concatenate([rank, others]))
        )
        self._index = np.argsort(order)
        every = every[order]
        self.counter = np.zeros(len(every), np.int64)
        with np.errstate(divide="ignore"):
            self.most = int(np.sum(np.ceil(span / every) + 1))
        buckets = max(self.most // 4, 1)
        self.state = state = Schedule(cells, len(visits["row"]))
        event = np.dtype(
            [("time", "f8"), ("actor", "i4"), ("waits", "i4"), ("next", "i4", disc.dim + 1)],
            align=True,
        )
        neighbour = np.repeat(np.arange(len(self.halo.neighbours)), self._sizes)
        place = np.arange(rows) - np.repeat(self._offsets, self._sizes)
        kicks = np.zeros(len(self.halo.neighbours), np.int64)
        np.add.at(kicks, neighbour, self._sent(disc, steps, span))
        self._starts = np.concatenate([[0], np.cumsum(kicks)])
        by_node = np.argsort(self.halo.sends, kind="stable")
        self.arrays: dict[str, Array | Ints | npt.NDArray[Any]] = {
            "packed": self._pack(problem, steps, self._alone(disc, steps, visits)), "step": every,
            "node": np.ascontiguousarray(disc.cells.transpose(0, 2, 1)), "counter": self.counter,
            "due": np.where(np.isfinite(every), 0.0, np.inf),
            "region": np.repeat(disc.region, disc.lanes).astype(np.int32),
            "actor": order.astype(np.int32), "index": self._index.astype(np.int32),
            "row": visits["row"].astype(np.int32),
            "row_node": (disc.late + self.halo.sends).astype(np.int32),
            "list": np.zeros((self.most, 2)), "event": np.zeros(self.most + 1, event),
            "link": np.zeros(self.most, np.int32),
            "stack": np.zeros(self.most + 1, np.int32), "bucket": np.zeros(buckets + 1, np.int32),
            "last": np.zeros(disc.nodes + 1, np.int32),
            "head": np.zeros(rows, np.int32), "tail": np.zeros(rows, np.int32),
            "kicks": np.zeros((self.most if rows else 1, disc.n)),
            "rows_of": np.searchsorted(
                self.halo.sends[by_node], np.arange(disc.shared + 1)
            ).astype(np.int32),
            "rows": by_node.astype(np.int32), "row_neighbour": neighbour.astype(np.int32),
            "row_place": place.astype(np.int32),
            "outgoing": np.zeros((int(self._starts[-1]), 1 + disc.n)),
            "out_start": self._starts[:-1].copy(),
            "out_count": np.zeros(len(kicks), np.int64),
        }  # fmt: skip
        for name, array in self.arrays.items():
            setattr(state, name, native.pointer(array).value)
        state.buckets, state.trapezoidal = buckets, int(trapezoidal)
        state.first_shared, state.last_shared = disc.late, disc.late + disc.shared
        self._from = visits["from"]
        most = np.ceil(span / visits["step"]) + 1
        self._incoming = [
            np.zeros((int(most[self._from == i].sum()), 1 + self.n))
            for i in range(len(self.halo.neighbours))
        ]

    def _visits(self, disc: Any, steps: Array, number: Ints) -> dict[str, Any]:
        """Visits by other ranks' cells to this rank's nodes: step, number, row, from."""
        halo, comm = disc.halo, disc.comm
        self._sizes = np.zeros(len(halo.neighbours), np.int64)
        rows_of: list[dict[int, int]] = []
        starts = halo.starts if len(halo.neighbours) else np.zeros(1, np.int64)
        self._offsets = np.asarray(starts[:-1], np.int64)
        self._sizes = np.diff(starts).astype(np.int64)
        for first, size in zip(self._offsets, self._sizes, strict=True):
            nodes = disc.late + halo.sends[first : first + size]
            rows_of.append({int(a): i for i, a in enumerate(nodes)})
        # Cells at shared nodes come first.
        blocks = np.arange(disc.boundary_blocks)
        told: list[tuple[Array, Ints, Ints]] = [
            (np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.int64)) for _ in range(comm.size)
        ]
        self._touches: list[tuple[Ints, Ints]] = []
        for rank, table in zip(halo.neighbours, rows_of, strict=True):
            lookup = np.full(disc.nodes + 1, -1, np.int64)
            lookup[list(table)] = list(table.values())
            at = lookup[disc.cells[blocks]]  # (blocks, d+1, W)
            block, _, lane = np.nonzero(at >= 0)
            cell = block * disc.lanes + lane
            told[rank] = (steps.ravel()[cell], number[cell], at[at >= 0])
            self._touches.append((cell, at[at >= 0]))
        heard = comm.alltoall(told) if comm.size > 1 else []
        parts = [heard[rank] for rank in halo.neighbours]
        empty = np.zeros(0, np.int64)
        return {
            "step": np.concatenate([p[0] for p in parts] or [np.zeros(0)]),
            "number": np.concatenate([p[1] for p in parts] or [empty]),
            "row": np.concatenate(
                [p[2] + first for p, first in zip(parts, self._offsets, strict=True)] or [empty]
            ),
            "from": np.repeat(np.arange(len(parts)), [len(p[0]) for p in parts]).astype(np.int64),
        }

    def _sent(self, disc: Any, steps: Array, span: float) -> Ints:
        """Most kicks that this rank sends in a span for each row of the table."""
        out = np.zeros(len(self.halo.sends), np.int64)
        for first, (cell, place) in zip(self._offsets, self._touches, strict=True):
            most = np.ceil(span / steps.ravel()[cell]).astype(np.int64) + 1
            np.add.at(out, first + place, most)
        return out

    def _alone(self, disc: Any, steps: Array, visits: dict[str, Any]) -> Array:
        """Share of a cell's neighbours that do not act together with it (blocks, W).

        Counted node by node, neighbours at two nodes twice; those of equal steps act together.
        """
        real = disc.source_cell >= 0
        mine = disc.cells.transpose(0, 2, 1)[real]
        h = np.broadcast_to(steps[real][:, None], mine.shape)
        node = np.concatenate([mine.ravel(), disc.late + self.halo.sends[visits["row"]]])
        every = np.concatenate([h.ravel(), visits["step"]])
        order = np.lexsort((every, node))
        node, every = node[order], every[order]
        new = (np.diff(node) != 0) | (np.diff(every) > 1e-9 * every[1:])
        run = np.concatenate([[0], np.cumsum(new)]).astype(np.int64)
        together = np.empty(len(order))
        together[order] = np.bincount(run)[run] - 1.0
        there = np.bincount(node, minlength=disc.nodes)[mine] - 1.0
        equal = together[: mine.size].reshape(mine.shape).sum(axis=1)
        out = np.zeros(real.shape)
        out[real] = 1.0 - equal / np.maximum(there.sum(axis=1), 1.0)
        return out

    def _pack(self, problem: Problem, steps: Array, alone: Array) -> Array:
        """Cells one after the other: geometry, coefficients, h_K, nodes, alone (cells, PACKED)."""
        disc, kernels = problem.disc, problem.kernels
        size, count = packed_size(kernels), len(kernels.densities.coefficients)
        out = native.aligned((disc.blocks, disc.lanes, size))
        used = disc.dim**2 + 1
        out[:, :, :used] = disc.geometry.transpose(0, 2, 1)
        if count:
            out[:, :, used : used + count] = kernels.coefficients.transpose(0, 2, 1)
        out[:, :, used + count] = np.where(np.isfinite(steps), steps, 0.0)
        nodes = out.view(np.int32)[:, :, 2 * (used + count + 1) :]
        nodes[:, :, : disc.dim + 1] = disc.cells.transpose(0, 2, 1)
        nodes.view(np.float32)[:, :, disc.dim + 1] = alone
        return out

    def restart(self) -> None:
        """Let all cells act at t = 0 again."""
        self.counter[:] = 0
        self.arrays["due"][:] = np.where(np.isfinite(self.arrays["step"]), 0.0, np.inf)

    def counters(self) -> Ints:
        """j of the next event of this rank's cells, in blocks (blocks, W)."""
        cells = self.counter[self._index[: self.state.cells]]
        return cells.reshape(self._blocks)

    def set(self, counters: Ints) -> None:
        """Let cells go on with these events (blocks, W), on all ranks; collective."""
        cells, own = self.state.cells, counters.ravel()
        self.counter[self._index[:cells]] = own
        told: list[Ints] = [np.zeros(0, np.int64) for _ in range(self.comm.size)]
        for rank, (cell, _) in zip(self.halo.neighbours, self._touches, strict=True):
            told[rank] = own[cell]
        heard = self.comm.alltoall(told) if self.comm.size > 1 else []
        visits = [heard[rank] for rank in self.halo.neighbours]
        self.counter[self._index[cells:]] = np.concatenate([*visits, np.zeros(0, np.int64)])
        step = self.arrays["step"]
        with np.errstate(invalid="ignore"):
            self.arrays["due"][:] = np.where(np.isfinite(step), self.counter * step, np.inf)

    # --- a span ------------------------------------------------------------------------------

    def run(self, c: Any, world: Any, start: float, end: float) -> int:
        """Do all events with start ≤ t < end; collective: how many are of this rank's cells."""
        state, ahead = self.state, ctypes.byref(self.state)
        j0 = self.counter.copy() if len(self._from) else self.counter
        rows = ctypes.c_int64(len(self.halo.sends))
        events = c.cb_exact_schedule(
            world, ahead, ctypes.c_double(start), ctypes.c_double(end), rows
        )
        assert events <= self.most
        c.cb_exact_go(world, ahead)
        visited = 0
        if len(self.halo.neighbours):
            made = (self.counter - j0)[self._index]
            visited = int(made[state.cells :].sum())
            awaited = np.bincount(
                self._from, weights=made[state.cells :], minlength=len(self.halo.neighbours)
            ).astype(np.int64)
            owed = np.array([int(made[cell].sum()) for cell, _ in self._touches], np.int64)
            self._rounds(c, world, awaited, owed)
        assert state.done == state.events, "events wait for what never comes"
        return int(events) - visited

    def _rounds(self, c: Any, world: Any, awaited: Ints, owed: Ints) -> None:
        """Send kicks, take kicks, go on: as long as any neighbour has some to send or to get."""
        comm, ahead, width = self.halo.comm, ctypes.byref(self.state), 1 + self.n
        counts, outgoing = self.arrays["out_count"], self.arrays["outgoing"]
        pairs = list(enumerate(self.halo.neighbours))
        while awaited.any() or owed.any():
            requests, status, open_ = [], [], []
            for i, rank in pairs:
                if awaited[i]:
                    requests.append(comm.Irecv([self._incoming[i], MPI.DOUBLE], rank, _TAG))
                    open_.append(i)
            for i, rank in pairs:
                if owed[i]:
                    first, count = int(self._starts[i]), int(counts[i])
                    part = outgoing[first : first + count]
                    requests.append(comm.Isend([part, part.size, MPI.DOUBLE], rank, _TAG))
                    owed[i] -= count
            status = [MPI.Status() for _ in requests]
            MPI.Request.Waitall(requests, status)
            counts[:] = 0
            for i, told in zip(open_, status, strict=False):
                count = told.Get_count(MPI.DOUBLE) // width
                awaited[i] -= count
                c.cb_exact_deliver(
                    world, ahead, ctypes.c_int64(int(self._offsets[i])),
                    native.pointer(self._incoming[i]), ctypes.c_int64(count),
                )  # fmt: skip
            c.cb_exact_go(world, ahead)
