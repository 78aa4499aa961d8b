# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Where a run went wrong: the node, the cell, and a guess at why.

Watching costs next to nothing, since it is done at ledger rows alone; the search for the place is
made once, when a run is about to stop. Numbers are those of the mesh's input, the same for every
number of ranks. A body whose energy is not quadratic in U is also watched for cells turned inside
out, :math:`\det(I + \nabla u) \le 0`: its density was not written for them, and some (log det F)
have no value there. Knows no integrator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat, hessian
from complexbody.kernels.library import State
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]

#: Blocks whose determinants are taken at once: bounds the memory of temporaries.
PIECE = 4096


@dataclass(frozen=True)
class Place:
    """A cell or a node.

    Attributes:
        kind: "cell" or "node"; number: in the mesh's input; rank: which has it.
        position: Of the node, or of the cell's midpoint [m].
        value: What was found there: a share of the energy, a determinant, a count of nodes.
        name: Component, or body.
    """

    kind: str
    number: int
    rank: int
    position: tuple[float, ...]
    value: float
    name: str = ""

    def __str__(self) -> str:
        at = ", ".join(f"{x:.6g}" for x in self.position)
        return f"{self.kind} {self.number} at ({at}), rank {self.rank}"


def lost_node(problem: Problem, positions: Array, rates: Array) -> Place | None:
    """The non-finite node farthest (in cells) from any finite one: there it began; collective.

    Args:
        problem: The scene made ready.
        positions: (u, ν), node records (nodes + 1, at least n).
        rates: Likewise.

    Returns:
        The node, ``value`` being how many are not finite and ``name`` its first such component.
    """
    disc, comm, n = problem.disc, problem.comm, problem.disc.n
    wrong = ~np.isfinite(positions[:-1, :n]), ~np.isfinite(rates[:-1, :n])
    lost = wrong[0].any(axis=1) | wrong[1].any(axis=1)
    total = comm.allreduce(int(np.sum(lost & disc.owned)))
    if not total:
        return None
    depth = _depths(problem, lost)
    most = comm.allreduce(int(depth.max(initial=-1)), op=MPI.MAX)
    found: Place | None = None
    at = np.flatnonzero(lost & (depth == most) & disc.owned)
    if len(at):
        numbers = np.asarray(problem.scene.mesh.geometry.input_global_indices)[disc.dof[at]]
        node, number = int(at[np.argmin(numbers)]), int(numbers.min())
        names = component_names(problem)
        named = [names[i] for i in np.flatnonzero(wrong[0][node])]
        named += [f"rate of {names[i]}" for i in np.flatnonzero(wrong[1][node])]
        where = tuple(disc.position[node, : disc.dim].tolist())
        found = Place("node", number, comm.rank, where, total, named[0])
    return lowest(comm, found)


def _depths(problem: Problem, lost: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """How many cells each lost node (nodes,) is away from one that is not; 0 for all if none is."""
    disc, comm = problem.disc, problem.comm
    depth = np.zeros(disc.nodes, np.int64)
    alive = np.append(~lost, False)
    for layer in range(1, 1 << 30):
        cells = alive[disc.cells].any(axis=1)
        reached = np.zeros((disc.nodes + 1, 1))
        for a in range(disc.dim + 1):
            reached[disc.cells[:, a, :][cells]] = 1.0
        disc.sum_shared(reached[:-1])
        new = (reached[:-1, 0] > 0) & ~alive[:-1]
        if not comm.allreduce(int(new.any())):
            return depth
        depth[new], alive[:-1] = layer, alive[:-1] | new
    raise AssertionError


def component_names(problem: Problem) -> list[str]:
    """u1, …, nu1, … of the scene's own components, by their numbers in the user's scene."""
    n_u = problem.whole.displacement
    return [f"u{i + 1}" if i < n_u else f"nu{i - n_u + 1}" for i in problem.live.components]


def fullest_cell(problem: Problem, positions: Array) -> Place | None:
    """The cell with the largest stored and potential energy, by magnitude; collective.

    Returns:
        The cell, ``value`` being its share of the sum of all magnitudes; None if all are zero.
    """
    disc, comm, n = problem.disc, problem.comm, problem.disc.n
    problem.kernels.x[:, :n] = positions[:, :n]
    blocks = _block_energies(problem)
    total = comm.allreduce(float(blocks.sum()))
    found: Place | None = None
    if disc.blocks and blocks.max() > 0:
        block = int(np.argmax(blocks))
        lanes = _lane_energies(problem, block)
        lane = int(np.argmax(lanes))
        share = float(lanes[lane]) / total if np.isfinite(total) else np.nan
        found = cell_place(problem, block, lane, share)
    # The largest of all ranks; among equals the lowest number.
    ranked = [(-p.value if p.value == p.value else -np.inf, p.number) if p else (np.inf, 0)
              for p in comm.allgather(found)]  # fmt: skip
    return comm.bcast(found, root=min(range(comm.size), key=ranked.__getitem__))


def _block_energies(problem: Problem) -> Array:
    """|e| + |w| of each block of cells (blocks,); not finite counts as the largest."""
    disc = problem.disc
    table = np.zeros((1, 4), np.int64)
    state = State.from_buffer_copy(problem.kernels.state)
    state.chunks, state.table, state.activity = 1, table.ctypes.data, None
    return np.array([_energy(problem, state, table, b) for b in range(disc.blocks)])


def _energy(problem: Problem, state: State, table: Any, block: int) -> float:
    table[0] = block, block + 1, problem.disc.region[block], 0
    value = float(np.abs(problem.kernels.energies(state)).sum())
    return value if np.isfinite(value) else 1e300


def _lane_energies(problem: Problem, block: int) -> Array:
    """The same of the cells of one block (W,), the others being moved to the padding node."""
    disc = problem.disc
    own = disc.cells[block].copy()
    table = np.zeros((1, 4), np.int64)
    state = State.from_buffer_copy(problem.kernels.state)
    state.chunks, state.table, state.activity = 1, table.ctypes.data, None
    out = np.zeros(disc.lanes)
    try:
        for lane in range(disc.lanes):
            if disc.source_cell[block, lane] < 0:
                continue
            disc.cells[block] = disc.nodes
            disc.cells[block, :, lane] = own[:, lane]
            out[lane] = _energy(problem, state, table, block)
    finally:
        disc.cells[block] = own
    return out


class Orientation:
    """det F = det(I + ∇u) of the cells of bodies whose energy is not quadratic in U.

    Bodies with ``orientation=False`` are left out, and those with fewer components of u than the
    mesh has dimensions, whose u is no displacement in space.

    Attributes:
        watched: Whether there is any such cell, on any rank.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, disc = problem, problem.disc
        n_u, mesh = problem.whole.displacement, problem.whole.mesh
        # Rows of F that move: components of the scene by the direction they are along.
        self._rows = [(c, i) for c, i in enumerate(problem.live.components) if i < disc.dim]
        bent = [
            body.orientation and n_u >= disc.dim and not problem.kernels.densities.stored[r]
            and not hessian.quadratic_in_gradient(body.energy, mesh, n_u, body.descriptor)
            for r, body in enumerate(problem.whole.bodies)
        ]  # fmt: skip
        self.watched = any(bent) and bool(self._rows)
        self._blocks = np.flatnonzero(np.array(bent)[disc.region]) if self.watched else None

    def worst(self, positions: Array) -> Place | None:
        """The cell with the smallest det F, ``value``, if that is not positive; collective."""
        if self._blocks is None:
            return None
        least, block, lane = np.inf, 0, 0
        for first in range(0, len(self._blocks), PIECE):
            part = self._blocks[first : first + PIECE]
            det = np.where(self.problem.disc.source_cell[part] >= 0, self._det(part, positions), 1)
            at = int(np.argmin(det))
            if det.flat[at] < least:
                least = float(det.flat[at])
                block, lane = int(part[at // det.shape[1]]), at % det.shape[1]
        comm = self.problem.comm
        if comm.allreduce(least, op=MPI.MIN) > 0:
            return None
        ranked = comm.allgather(least)
        found = cell_place(self.problem, block, lane, least) if least <= 0 else None
        return comm.bcast(found, root=int(np.argmin(ranked)))

    def _det(self, blocks: Any, positions: Array) -> Array:
        """Of all cells of the blocks, shape (blocks, W): columns that the mesh has not are e_j."""
        disc = self.problem.disc
        d, x = disc.dim, positions[disc.cells[blocks]]  # (blocks, d + 1, W, record)
        geometry = disc.geometry[blocks]
        root = np.where(geometry[:, -1] > 0, geometry[:, -1], 1.0)
        F = np.zeros((d, d, *root.shape))
        F[range(d), range(d)] = 1.0
        for column, i in self._rows:
            for a in range(d):
                jump = (x[:, a + 1, :, column] - x[:, 0, :, column]) / root
                for j in range(d):
                    F[i, j] += jump * geometry[:, a * d + j]
        if d == 1:
            return F[0, 0]
        if d == 2:
            return F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0]
        return sum(
            F[0, i] * (F[1, j] * F[2, k] - F[1, k] * F[2, j])
            for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        )


def cell_place(problem: Problem, block: int, lane: int, value: float) -> Place:
    """The cell in a lane of a block of this rank."""
    disc = problem.disc
    corners = disc.position[disc.cells[block, :, lane], : disc.dim]
    number = _compat.original_cells(problem.scene.mesh)[disc.source_cell[block, lane]]
    name = problem.whole.bodies[int(disc.region[block])].name
    middle = tuple(corners.mean(axis=0).tolist())
    return Place("cell", int(number), problem.comm.rank, middle, value, name)


def lowest(comm: Any, found: Place | None) -> Place | None:
    """Of the places that ranks found the one with the lowest number; collective."""
    places = [place for place in comm.allgather(found) if place is not None]
    return min(places, key=lambda place: place.number, default=None)
