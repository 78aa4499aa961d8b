# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes that several ranks share, and the sum of their partial forces.

Every rank works on its own cells only. What cells of different ranks give to a shared node is
exchanged in one message per neighbour and added in the order of the ranks, so that all copies of
a node stay equal to the bit. The tables are made once; an exchange allocates nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

Ints = npt.NDArray[np.int64]


def sharing(numbers: Ints, index_map: Any, comm: Any) -> dict[int, list[int]]:
    """Which ranks' owned cells touch each node that this rank shares; collective.

    Args:
        numbers: Global numbers of the nodes of this rank's owned cells, each once, in any order.
        index_map: dolfinx index map of the nodes: the owner of a number knows who touches it.
        comm: The mesh's communicator.

    Returns:
        {row of ``numbers``: sorted ranks, this one included} for nodes touched by two ranks or
        more.
    """
    if comm.size == 1:
        return {}
    first = np.concatenate([[0], np.cumsum(comm.allgather(int(index_map.size_local)))])
    owner = np.searchsorted(first, numbers, side="right") - 1
    elsewhere = np.flatnonzero(owner != comm.rank)
    row_of = dict(zip(numbers[elsewhere].tolist(), elsewhere.tolist(), strict=True))
    # Rows of what this rank owns: most of its nodes, so by a table.
    start, row = int(first[comm.rank]), np.full(int(index_map.size_local), -1, np.int64)
    here = np.flatnonzero(owner == comm.rank)
    row[numbers[here] - start] = here
    asked = [numbers[elsewhere[owner[elsewhere] == r]] for r in range(comm.size)]
    ranks: dict[int, list[int]] = {}
    for rank, nodes in enumerate(comm.alltoall(asked)):
        for node in nodes:
            ranks.setdefault(int(node), []).append(rank)
    replies: list[list[tuple[int, list[int]]]] = [[] for _ in range(comm.size)]
    shared: dict[int, list[int]] = {}
    for node, others in ranks.items():
        mine = int(row[node - start])
        everyone = sorted([*others, comm.rank] if mine >= 0 else others)
        if len(everyone) < 2:
            continue
        if mine >= 0:
            shared[mine] = everyone
        for rank in others:
            replies[rank].append((node, everyone))
    for answer in comm.alltoall(replies):
        for node, everyone in answer:
            shared[row_of[node]] = everyone
    return shared


class Halo:
    """Exchange of ``width`` doubles per shared node, over fixed tables.

    Args:
        comm: Communicator; it is duplicated, so that messages never meet the user's.
        shared: As from :func:`sharing`, but keyed by *position* among the shared nodes.
        order: Global number of each shared node: neighbours list their nodes in its order.
        width: Doubles per node.
        apart: On a communicator of its own.

    Attributes:
        sends: Positions of shared nodes in the order in which they are packed.
        starts: A neighbour's nodes are ``sends[starts[i]:starts[i+1]]``.
        start, source: For shared node i, ``source[start[i]:start[i+1]]`` are rows of the receive
            buffer in the order of the ranks, −1 standing for this rank's own part.
        owner: True where this rank is the lowest that touches the node (it counts it in sums).
    """

    def __init__(
        self, comm: Any, shared: dict[int, list[int]], order: Ints, width: int, apart: bool = True
    ) -> None:
        self._own = apart and comm.size > 1
        self.comm = comm.Dup() if self._own else comm
        self._made_from = (shared, order)
        me, count = comm.rank, len(shared)
        lists: dict[int, list[int]] = {}
        for position in sorted(shared, key=lambda p: int(order[p])):
            for rank in shared[position]:
                if rank != me:
                    lists.setdefault(rank, []).append(position)
        self.neighbours = sorted(lists)
        sizes = [len(lists[r]) for r in self.neighbours]
        self.starts = offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        self.sends = np.array([p for r in self.neighbours for p in lists[r]], dtype=np.int32)
        self.outgoing = np.zeros((int(offsets[-1]), width))
        self.incoming = np.zeros((int(offsets[-1]), width))
        row = {
            (r, p): int(offsets[i]) + j
            for i, r in enumerate(self.neighbours)
            for j, p in enumerate(lists[r])
        }
        source: list[int] = []
        start = [0]
        for position in range(count):
            source += [-1 if r == me else row[r, position] for r in shared[position]]
            start.append(len(source))
        self.start, self.source = np.array(start, np.int64), np.array(source, np.int64)
        self.owner = np.array([shared[p][0] == me for p in range(count)], dtype=np.bool_)
        self._requests = []
        for i, rank in enumerate(self.neighbours):
            part = slice(offsets[i], offsets[i + 1])
            self._requests.append(self.comm.Recv_init([self.incoming[part], MPI.DOUBLE], rank, 7))
        for i, rank in enumerate(self.neighbours):
            part = slice(offsets[i], offsets[i + 1])
            self._requests.append(self.comm.Send_init([self.outgoing[part], MPI.DOUBLE], rank, 7))

    def widened(self, width: int) -> Halo:
        """Another exchange over the same nodes with more doubles each; collective."""
        return Halo(self.comm, *self._made_from, width)

    def part(self, rows: npt.NDArray[np.int32]) -> Halo:
        """An exchange of some of the shared nodes only, by position: the same nodes on all ranks.

        It goes over this one's communicator, and is to be closed before it.
        """
        shared, order = self._made_from
        some = {i: shared[int(p)] for i, p in enumerate(rows)}
        return Halo(self.comm, some, order[rows], self.outgoing.shape[1], apart=False)

    def begin(self) -> None:
        """Start sending ``outgoing`` and receiving into ``incoming``."""
        MPI.Prequest.Startall(self._requests)

    def end(self) -> None:
        """Wait until ``incoming`` is complete."""
        MPI.Request.Waitall(self._requests)

    def sum(self, values: npt.NDArray[np.float64]) -> None:
        """Sum rows of ``values`` (shared nodes, m) over ranks, in place; collective.

        For set-up: the time loops do the same in C.
        """
        width = self.outgoing.shape[1]
        for first in range(0, values.shape[1], width):
            part = values[:, first : first + width]
            self.outgoing[:, : part.shape[1]] = part[self.sends]
            self.begin()
            self.end()
            self.add(part)

    def add(self, values: npt.NDArray[np.float64]) -> None:
        """Add what has come in to ``values`` (shared nodes, m), in the order of the ranks."""
        m = values.shape[1]
        out = np.zeros_like(values)
        counts = np.diff(self.start)
        for step in range(int(counts.max(initial=0))):
            has = np.flatnonzero(counts > step)
            rows = self.source[self.start[has] + step]
            own = rows < 0
            out[has[own]] += values[has[own]]
            out[has[~own]] += self.incoming[rows[~own], :m]
        values[:] = out

    def close(self) -> None:
        """Free the requests and the communicator."""
        for request in self._requests:
            request.Free()
        self._requests = []
        if self._own and self.comm != MPI.COMM_NULL:
            self.comm.Free()
