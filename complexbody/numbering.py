# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes and cells by the numbers of the mesh's input, which no partition changes.

Brings this rank's rows to rank 0 in the order of these numbers, and back to whatever ranks there
are; sums over the whole body that any change of rows would change. Knows arrays, and no field.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat
from complexbody.discretisation import Discretisation

Array = npt.NDArray[Any]
Ints = npt.NDArray[np.int64]

#: Bytes of a message.
PIECE = 64 << 20
_TAG = 71


def weights(numbers: npt.NDArray[Any], seed: int = 0) -> npt.NDArray[np.float64]:
    """A number in [-1, 1) for each number: the splitmix64 hash of it and the seed."""
    z = np.asarray(numbers, dtype=np.uint64) + np.uint64((seed + 1) * 0x9E3779B97F4A7C15 % 2**64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        z = (z ^ (z >> np.uint64(shift))) * np.uint64(factor)
    return (z >> np.uint64(11)).astype(np.float64) * 2.0**-52 - 1.0


class Numbering:
    """Numbers of a discretisation's nodes and cells; made collectively.

    Args:
        disc: Arrays of a scene.

    Attributes:
        nodes: Input numbers of this rank's nodes, in own numbering (nodes,).
        cells: Input numbers of this rank's owned cells, in dolfinx's order (cells,).
        corners: Of each owned cell, which of its corners has the lowest number, the next, …
            (cells, d + 1).
        layout: For each rank, a number that changes with its cells and nodes and their order.
    """

    def __init__(self, disc: Discretisation) -> None:
        mesh, self.comm = disc.scene.mesh, disc.comm
        every = np.array(mesh.geometry.input_global_indices, dtype=np.int64)
        same = disc.scene.identified
        if same is not None:  # periodic copies: the lowest number of any
            lowest = np.full(len(same.number), np.iinfo(np.int64).max)
            np.minimum.at(lowest, same.klass, every[same.nodes])
            self.comm.Allreduce(MPI.IN_PLACE, lowest, op=MPI.MIN)
            every[same.nodes] = lowest[same.klass]
        self.nodes, self._counted = every[disc.dof], disc.owned
        self.cells = _compat.original_cells(mesh)[: disc.count]
        self.corners = np.argsort(every[_compat.cell_nodes(mesh)[: disc.count]], axis=1)
        mine = zlib.crc32(every.tobytes(), zlib.crc32(self.cells.tobytes()))
        self.layout: list[int] = self.comm.allgather(mine)
        owned = self.nodes[self._counted]
        self._order = [self._ordered(numbers) for numbers in (owned, self.cells)]
        # What each rank asks for, in the order of the input; on rank 0 only.
        self._asked = [self._places(numbers) for numbers in (self.nodes, self.cells)]

    def _ordered(self, numbers: Ints) -> Ints | None:
        every = self.comm.gather(numbers)
        return None if every is None else np.argsort(np.concatenate(every), kind="stable")

    def _places(self, numbers: Ints) -> list[Ints] | None:
        every = self.comm.gather(numbers)
        if every is None:
            return None
        known = np.unique(np.concatenate(every))
        return [np.searchsorted(known, part) for part in every]

    # --- rows to rank 0, and back ----------------------------------------------------------------

    def rows(self) -> dict[str, int]:
        """Rows of arrays of nodes, cells and cells' corners, on rank 0; zeros elsewhere."""
        nodes, cells = (0 if order is None else len(order) for order in self._order)
        return {"nodes": nodes, "cells": cells, "corners": cells}

    def gather_nodes(self, values: Array) -> Array | None:
        """Rows of nodes (nodes, …) in the order of the input on rank 0, else None; collective."""
        found = _collect(self.comm, values[self._counted])
        return None if found is None else found[self._order[0]]

    def gather_cells(self, values: Array) -> Array | None:
        """Rows of owned cells (cells, …), as :meth:`gather_nodes`; collective."""
        found = _collect(self.comm, values)
        return None if found is None else found[self._order[1]]

    def spread_nodes(self, rows: Array | None) -> Array:
        """The inverse of :meth:`gather_nodes`: each rank's, shared ones too; collective."""
        return _deliver(self.comm, rows, self._asked[0], len(self.nodes))

    def spread_cells(self, rows: Array | None) -> Array:
        """The inverse of :meth:`gather_cells`; collective."""
        return _deliver(self.comm, rows, self._asked[1], len(self.cells))

    # --- sums that tell bodies apart -------------------------------------------------------------

    def node_sum(self, values: Array) -> list[float]:
        """Σ over all nodes of w·v with other weights w everywhere, and Σ |v|; collective."""
        return self._sum(values[self._counted], self.nodes[self._counted])

    def cell_sum(self, values: Array) -> list[float]:
        """The same over all cells of values (cells, …)."""
        return self._sum(values, self.cells)

    def _sum(self, values: Array, numbers: Ints) -> list[float]:
        flat = np.asarray(values, dtype=np.float64).reshape(len(numbers), -1)
        total = np.zeros(2)
        for column in range(flat.shape[1]):
            part = flat[:, column]
            total += float(weights(numbers, column) @ part), float(np.abs(part).sum())
        return [float(x) for x in self.comm.allreduce(total)]


def _pieces(rows: int, width: int) -> list[slice]:
    most = max(1, PIECE // max(width, 1))
    return [slice(first, first + most) for first in range(0, rows, most)]


def _collect(comm: Any, values: Array) -> Array | None:
    """Rows of all ranks, one rank's after another's, on rank 0; collective."""
    values = np.ascontiguousarray(values)
    counts = comm.gather(len(values))
    width = values.itemsize * int(np.prod(values.shape[1:]))
    if counts is None:
        for part in _pieces(len(values), width):
            comm.Send(values[part].view(np.uint8).reshape(-1), 0, _TAG)
        return None
    out = np.empty((sum(counts), *values.shape[1:]), values.dtype)
    out[: counts[0]] = values
    first = counts[0]
    for rank, count in enumerate(counts[1:], 1):
        block = out[first : first + count]
        for part in _pieces(count, width):
            comm.Recv(block[part].view(np.uint8).reshape(-1), rank, _TAG)
        first += count
    return out


def _deliver(comm: Any, rows: Array | None, asked: list[Ints] | None, count: int) -> Array:
    """Rows of a table of rank 0, those that each rank asks for; collective."""
    shape, kind = comm.bcast(None if rows is None else (rows.shape[1:], rows.dtype))
    out = np.empty((count, *shape), kind)
    width = out.itemsize * int(np.prod(shape))
    if rows is None or asked is None:
        for part in _pieces(count, width):
            comm.Recv(out[part].view(np.uint8).reshape(-1), 0, _TAG)
        return out
    out[:] = rows[asked[0]]
    for rank, places in enumerate(asked[1:], 1):
        for part in _pieces(len(places), width):
            block = np.ascontiguousarray(rows[places[part]])
            comm.Send(block.view(np.uint8).reshape(-1), rank, _TAG)
    return out
