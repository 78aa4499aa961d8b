# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Octaves of cells: which nodes may step how far, which step costs least, who acts at which level.

Nodes have levels, steps of neighbouring levels the ratio r; a cell acts at the finest level of its
nodes. Let Λ_K be the largest eigenvalue of a cell's own pencil (K_K, M_K), and ⟨·⟩_a the mean over
the cells of node a, weighted by their share of its mass. From the cells' bounds follow

* K_PP ≤ max_P ⟨Λ⟩_a M_PP: the nodes of a set P may step together at h ≤ 2/√⟨Λ⟩_a;
* ‖M^{-1/2} K_Q M^{-1/2}‖ ≤ max_Q √⟨Λ²⟩_a for the rows of a set Q, whatever lies beside it.

The first is all that the finest level needs. Coarser nodes must not be driven too hard by finer
ones either (see :mod:`complexbody.integrators.local_leapfrog`): they keep h ≤ 2/⟨Λ²⟩_a^{1/4}. Both
allow longer steps than the smallest of a node's cells where few of them are small.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat, native
from complexbody.errors import StepError
from complexbody.halo import Halo, sharing
from complexbody.integrators.timetable import per_cell
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Steps are compared at so many fractions of an octave; more octaves are refused.
BINS, MOST = 32, 20
#: Cost of an update in a substep over one in a coarse step: its nodes are visited more often.
SUBSTEP_COST = 1.2


@dataclass
class Plan:
    """Steps and levels of a run.

    Attributes:
        step: Coarse step Δt [s]; critical: synchronous critical step of the smallest cell [s].
        level: Level of every geometry node of this rank (dolfinx's numbers).
        depth: The largest level on any rank.
        cells: Critical step of each of this rank's cells, in dolfinx's order [s].
    """

    step: float
    critical: float
    level: Ints
    depth: int
    cells: Array


def plan(
    problem: Problem,
    until: float,
    cells: Array,
    safety: float,
    ratio: float,
    step: float | None,
    levels: int | None,
) -> Plan:
    """Choose step and levels, and regroup the problem's cells by level; collective.

    Args:
        problem: The scene, made ready.
        until: End of the run [s].
        cells: Critical steps of cells in blocks (blocks, W) [s].
        safety: Fraction of its critical step that a node may use.
        ratio: r, of the steps of two levels.
        step: Coarse step [s], or None for the one that needs the fewest updates.
        levels: Octaves below the coarse step, or None for what it needs.

    Raises:
        StepError: if the levels do not reach the step, or the body has no stiffness.
    """
    comm, disc = problem.comm, problem.disc
    alone, beside = (safety * steps for steps in node_steps(problem, cells))
    smallest = float(comm.allreduce(float(cells.min(initial=np.inf)), op=MPI.MIN))
    longest = float(np.max(alone, initial=0.0, where=np.isfinite(alone)))
    longest = float(comm.allreduce(longest, op=MPI.MAX))
    if not np.isfinite(smallest) or longest <= 0:
        raise StepError("No finite critical step: the body has no stiffness. Give an energy.")
    bins, tightest = _bins(beside, longest), int(_bins(alone, longest).max(initial=0))
    tightest = int(comm.allreduce(tightest, op=MPI.MAX))
    base = step
    if levels is not None:
        base = longest * 2 ** min(0.0, levels * np.log2(ratio) - tightest / BINS)
        if step is not None and step > base * (1 + 1e-9):
            raise StepError(
                f"The step {step:.6g} s is larger than {base:.6g} s, the longest that {levels} "
                "octaves reach. Give a smaller step, or more levels."
            )
    elif step is None:
        base = longest * 2 ** (-_cheapest(problem, bins, tightest, ratio) / BINS)
    assert base is not None
    if step is None:
        step = min(base, until)
        step = until / np.ceil(until / step * (1 - 1e-12))
        base = step if levels is None else base
    above = np.log2(base / longest)
    depth = int(_levels(tightest / BINS + above, ratio))
    if depth > MOST:
        raise StepError(
            f"The step {step:.3g} s needs {depth} octaves of smaller ones. Give a smaller step, or "
            "repair the mesh's smallest cells."
        )
    level = np.minimum(_levels(bins / BINS + above, ratio), depth)
    out = np.zeros(_compat.node_count(problem.scene.mesh), np.int64)
    out[disc.dof] = level
    own = per_cell(disc, cells)
    if depth > 0:
        real = disc.source_cell >= 0
        finest = np.zeros(disc.count, np.int64)
        finest[disc.source_cell[real]] = _finest(problem, level)
        problem.arrange(finest)
    return Plan(float(step), smallest, out, depth, own)


def _bins(steps: Array, longest: float) -> Ints:
    """How far steps lie below the longest, in whole bins: round-off must not change a level."""
    return np.ceil(BINS * np.log2(np.maximum(longest / steps, 1.0)) - 1e-6).astype(np.int64)


def node_steps(problem: Problem, cells: Array) -> tuple[Array, Array]:
    """Steps of nodes (nodes,) from those of cells (blocks, W): 2/√⟨Λ⟩ and 2/⟨Λ²⟩^¼ [s]; collective.

    Where cells of different materials meet, both are the step of the smallest cell.
    """
    disc, masses = problem.disc, problem.masses
    eigenvalue, real = 4.0 / cells**2, disc.source_cell >= 0
    values = np.zeros(disc.count)
    values[disc.source_cell[real]] = eigenvalue[real]
    most = np.zeros(disc.nodes + 1)
    np.maximum.at(most, disc.cells, eigenvalue[:, None, :])
    most = largest(problem, most[:-1])
    alike = masses.pure[masses.classes[:-1]]
    if any(hasattr(body.density, "function_space") for body in problem.scene.bodies):
        alike = np.zeros_like(alike)
    mean, square = disc.nodal_average(values), disc.nodal_average(values**2)
    with np.errstate(divide="ignore"):
        alone = 2.0 / np.sqrt(np.where(alike, mean, most))
        beside = 2.0 / np.sqrt(np.where(alike, np.sqrt(square), most))
    return alone, np.minimum(alone, beside)


def largest(problem: Problem, values: Array) -> Array:
    """The largest of the values that ranks have for a node (nodes,); collective."""
    disc, halo, out = problem.disc, problem.disc.halo, values.copy()
    if problem.comm.size > 1:
        shared = out[disc.late : disc.late + disc.shared]
        halo.outgoing[:, 0] = shared[halo.sends]
        halo.begin()
        halo.end()
        row, others = np.repeat(np.arange(disc.shared), np.diff(halo.start)), halo.source >= 0
        np.maximum.at(shared, row[others], halo.incoming[halo.source[others], 0])
    return out


def _levels(octaves: Any, ratio: float) -> Ints:
    """Levels of nodes whose steps lie so many octaves below the coarse one."""
    return np.maximum(np.ceil(octaves / np.log2(ratio) - 1e-6), 0).astype(np.int64)


def _finest(problem: Problem, values: Ints) -> Ints:
    """The largest nodal value of each real cell, in the order of blocks and lanes."""
    nodal = np.append(values, 0)[problem.disc.cells].max(axis=1)
    return nodal[problem.disc.source_cell >= 0]


def _cheapest(problem: Problem, bins: Ints, tightest: int, ratio: float) -> int:
    """How many bins below the longest step updates per time cost least; collective."""
    last = int(problem.comm.allreduce(int(bins.max(initial=0)), op=MPI.MAX))
    finest = np.bincount(_finest(problem, bins), minlength=last + 1)
    counts = problem.comm.allreduce(finest.astype(np.float64))
    shift = np.arange(tightest + 1)[:, None]
    level = _levels((np.arange(last + 1) - shift) / BINS, ratio)
    level = np.minimum(level, _levels((tightest - shift) / BINS, ratio))
    work = np.where(level > 0, SUBSTEP_COST, 1.0) * 2.0**level
    return int(np.argmin((work @ counts) * 2.0 ** (shift[:, 0] / BINS)))


class Entries:
    """The nodes that cells of level > 0 touch, sorted by the finest such level; collective.

    Args:
        problem: The scene, its cells grouped by level.
        level: Level of each node in own numbering (nodes,).
        depth: L, the largest level.

    Attributes:
        node: Node of each entry; first: entries whose force changes at level l are [first[l], …).
        slot: Rows of level l in arrays of all levels' entries start here.
        touched: Nodes that cells of each level touch on any rank, shape (nodes, L + 1).
        list: Entries by the level of their nodes.
        entries, owned: Parts of the entries, and of ``list``, by ranges of nodes (_parts).
        chunks, start, edge: The discretisation's chunks by level; those of level l are
            [start[l], start[l + 1]), and those before edge[l] touch shared nodes.
        number: Of these chunks, in the discretisation.
    """

    def __init__(self, problem: Problem, level: Ints, depth: int) -> None:
        disc, levels = problem.disc, np.arange(depth + 2)
        flags = np.zeros((disc.nodes + 1, depth + 1))
        flags[disc.cells, disc.group[:, None, None]] = 1.0
        disc.sum_shared(flags[:-1])
        self.touched = flags[:-1] > 0
        top = depth - np.argmax(self.touched[:, ::-1], axis=1)
        node = np.flatnonzero(top > 0)
        self.node = node[np.argsort(top[node], kind="stable")].astype(np.int32)
        self.first = np.searchsorted(top[self.node], levels)
        self.slot = np.zeros(depth + 2, np.int64)
        self.slot[2:] = np.cumsum(len(node) - self.first[1:-1])
        mine = level[self.node]
        order = np.argsort(mine, kind="stable")
        self.list = order.astype(np.int32)
        self.of_node = np.full(disc.nodes, -1, np.int32)
        self.of_node[self.node] = np.arange(len(node))
        edge = np.arange(len(disc.chunks)) < disc.boundary_chunks
        group = disc.group[disc.chunks[:, 0]] if len(disc.chunks) else np.zeros(0, np.int64)
        self.number = np.lexsort((disc.chunks[:, 2], ~edge, group)).astype(np.int64)
        self.chunks = np.ascontiguousarray(disc.chunks[self.number])
        sides = (2 * group + ~edge)[self.number]
        self.start = np.searchsorted(sides, 2 * levels)
        self.edge = np.searchsorted(sides, 2 * levels + 1)
        ends = np.append(disc.chunks[:, 3], disc.nodes)
        self.entries = _parts(top[self.node], self.node, ends, depth)
        self.owned = _parts(mine[order], self.node[order], ends, depth)


def _parts(level: Ints, node: Any, ends: Ints, depth: int) -> tuple[Ints, Ints, Ints]:
    """(first, from, range): runs of one level and one range of nodes, of entries by level.

    Args:
        level: Of each entry.
        node: Of each entry.
        ends: Where the ranges of nodes end.
        depth: L, the largest level.
    """
    place = np.searchsorted(ends, node, side="right")
    new = (np.diff(level, prepend=-1) != 0) | (np.diff(place, prepend=-1) != 0)
    start = np.flatnonzero(new)
    first = np.searchsorted(level[start], np.arange(depth + 2))
    return first, np.append(start, len(node)), place[start]


class Message:
    """The sum over ranks of the forces at the shared nodes that cells of one level touch.

    Args:
        problem: The scene.
        touched: Those nodes, on any rank (nodes,).
    """

    def __init__(self, problem: Problem, touched: npt.NDArray[np.bool_]) -> None:
        disc, index_map = problem.disc, _compat.node_map(problem.scene.mesh)
        nodes = np.flatnonzero(touched)
        names = disc.names(disc.dof[nodes])
        ranks = sharing(names, index_map, problem.comm)
        rows = np.array(sorted(ranks), dtype=np.int64)
        shared = {i: ranks[int(row)] for i, row in enumerate(rows)}
        self.halo = halo = Halo(problem.comm, shared, names[rows], disc.record)
        self.node, f = nodes[rows].astype(np.int32), native.pointer(problem.kernels.f)
        self._pack = (
            ctypes.c_int64(len(halo.sends)), native.pointer(halo.sends), native.pointer(self.node),
            f, native.pointer(halo.outgoing),
        )  # fmt: skip
        self._add = (
            ctypes.c_int64(len(rows)), native.pointer(self.node), native.pointer(halo.start),
            native.pointer(halo.source), native.pointer(halo.incoming), f,
        )  # fmt: skip

    def begin(self, library: Any) -> None:
        """Send this rank's parts."""
        library.cb_octaves_pack(*self._pack)
        self.halo.begin()

    def end(self, library: Any) -> None:
        """Wait for the others' parts and add them in the order of the ranks."""
        self.halo.end()
        library.cb_octaves_add(*self._add)
