# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which cells are quiet: all their nodes at zero, so that neither force nor rate can come of them.

Forces and rates of nodes at (u, ν) = 0 are exactly zero where the density has no force there and no
load or support acts. Skipping what is quiet therefore changes no bit of a trajectory. Cells are
watched by chunks of blocks, and only the chunks next to what moves are looked at (quiet.h). Knows
chunks and nodes, no integrator.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import native

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

#: Share of awake cells above which nothing is skipped: ENOUGH in quiet.h.
ENOUGH = 0.9


class State(ctypes.Structure):
    """Mirror of ``activity`` in quiet.h."""

    _fields_ = (
        *((n, ctypes.c_int64) for n in ("on", "chunks", "cells", "awake_cells", "skipped")),
        *(
            (name, ctypes.c_void_p)
            for name in ("awake", "near", "stirred", "size", "node_from", "node", "range_from",
                         "range", "chunk_from", "chunk")
        ),
    )  # fmt: skip


class Counted:
    """Cell updates of a run on this rank.

    Attributes:
        updates, skipped: Done, and those of quiet cells, which were not needed.
        activity: Which cells are quiet; None if that is not watched for.
    """

    updates: int = 0
    skipped: int = 0
    activity: Activity | None = None

    def wake(self) -> None:
        """All cells act from now on: for who changes the state by hand."""
        if self.activity is not None:
            self.activity.stop()

    def _count(self, due: int) -> None:
        """Of so many cell updates that were due, count those done and those skipped."""
        saved = 0 if self.activity is None else self.activity.skipped - self.skipped
        self.skipped += saved
        self.updates += due - saved

    def _counts(self) -> Ints:
        """What a snapshot keeps of the counters."""
        return np.array([self.updates, self.skipped])

    def _recount(self, counts: npt.NDArray[Any]) -> None:
        """Go on from these counters."""
        self.updates, self.skipped = (int(c) for c in counts)
        if self.activity is not None:
            self.activity.state.skipped = self.skipped


class Activity:
    """Chunks of cells and ranges of nodes, and what is awake of them.

    Args:
        c: A library with quiet.h in it.
        blocks: Ends of the chunks' blocks (chunks,), the first starting at 0.
        cells: Nodes of cells (blocks, d + 1, W); those at or above ``ranges[-1]`` are padding.
        ranges: Ends of the ranges of nodes; the last is the number of nodes.
        stirred: Nodes that are not at zero or that something acts on, shape (nodes,).
        awake: Chunks that are never quiet (chunks,).
        always: Ranges that are always looked after.

    Attributes:
        state: What the C functions read.
        blocks: Blocks of each chunk (chunks,); flags: Which are awake or near, and ranges stirred.
        skipped: Cell updates skipped so far.
    """

    def __init__(
        self, c: ctypes.CDLL, blocks: Ints, cells: npt.NDArray[np.int32], ranges: Ints,
        stirred: Flags, awake: Flags, always: Ints,
    ) -> None:  # fmt: skip
        chunks, nodes = len(blocks), int(ranges[-1])
        ends = np.concatenate([[0], blocks]).astype(np.int64)
        size = np.add.reduceat((cells[:, 0, :] < nodes).sum(axis=1), ends[:-1]).astype(np.int64)
        self.state = State(1, chunks, int(size.sum()))
        node_from, node = _distinct(c, ends * cells[0].size, cells.ravel(), nodes)
        place = np.searchsorted(ranges, np.arange(nodes), side="right").astype(np.int32)
        range_from, touched = _distinct(c, node_from, place[node], len(ranges))
        back = np.argsort(touched, kind="stable")
        self.blocks = np.diff(ends)
        counts = {"awake": chunks, "near": chunks, "stirred": len(ranges)}
        self.flags = {name: np.zeros(count, np.uint8) for name, count in counts.items()}
        self._arrays: dict[str, npt.NDArray[Any]] = {
            **self.flags, "size": size, "node_from": node_from, "node": node,
            "range_from": range_from, "range": touched,
            "chunk_from": np.searchsorted(touched[back], np.arange(len(ranges) + 1)),
            "chunk": np.repeat(np.arange(chunks), np.diff(range_from))[back].astype(np.int32),
        }  # fmt: skip
        for name, array in self._arrays.items():
            setattr(self.state, name, array.ctypes.data)
        moved = np.unique(np.concatenate([place[stirred], always])).astype(np.int64)
        rows, this = np.flatnonzero(awake).astype(np.int64), ctypes.byref(self.state)
        c.cb_stir(this, ctypes.c_int64(len(moved)), native.pointer(moved))
        c.cb_wake(this, ctypes.c_int64(len(rows)), native.pointer(rows))

    def stop(self) -> None:
        """All cells act from now on."""
        self.state.on = 0

    @property
    def skipped(self) -> int:
        """Cell updates skipped so far."""
        return int(self.state.skipped)


def _distinct(
    c: ctypes.CDLL, start: Ints, values: npt.NDArray[np.int32], most: int
) -> tuple[Ints, npt.NDArray[np.int32]]:
    """(starts, values) of the distinct values below ``most`` of each group of values."""
    starts, scratch = np.zeros(len(start), np.int64), np.zeros(most, np.int32)
    out = np.empty(len(values), np.int32)
    c.cb_distinct(
        ctypes.c_int64(len(start) - 1), native.pointer(start), native.pointer(values),
        ctypes.c_int32(most), native.pointer(scratch), native.pointer(starts), native.pointer(out),
    )  # fmt: skip
    return starts, out[: starts[-1]].copy()


def active(cells: npt.NDArray[np.int32], stirred: Flags) -> float:
    """Share of blocks that have a stirred node, of cells (blocks, d + 1, W)."""
    if not len(cells):
        return 1.0
    return float(np.mean(np.append(stirred, False)[cells].reshape(len(cells), -1).any(axis=1)))
