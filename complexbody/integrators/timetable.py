# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Time sets as objects to look at: who acts when, how often, and what that saves (paper §4).

Cell K acts at Θ_K = {0, h_K, 2h_K, …}, node a at Θ_a = ∪ Θ_K over its cells, on whatever rank, and
Θ = ∪ Θ_K. T_Θ is the largest step of any cell, h_Θ the largest gap of Θ, τ_Θ the asynchronicity
(MTeta). As all sets begin together, the first gap of Θ is the smallest step, and no gap is larger:
h_Θ = min h_K, and τ_Θ = T_Θ/h_Θ. Steps are arbitrary; where each divides a window W they are given
by N_K = W/h_K, and times are j/N_K of W, as the integrators have them: coinciding times are equal.

Knows arrays and ranks, and no integrator.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat
from complexbody.discretisation import Discretisation
from complexbody.errors import IntegratorError, StepError

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: A synchronous run's fraction of the critical step, with which speed-ups compare.
SYNCHRONOUS_SAFETY = 0.9
#: Octaves below the window that are counted one by one; the rest is counted with the last.
OCTAVES = 40


@dataclass(frozen=True, eq=False)
class TimeSets:
    """The time sets Θ of a run.

    Numbers are those of the whole body, the same on all ranks; arrays are this rank's share.

    Attributes:
        steps: h_K of this rank's cells [s], in the order of dolfinx's owned cells.
        divisions: N_K = W/h_K of the same, or None if steps need not divide the window.
        window: W [s], after which all repeats, or a span of about the largest step.
        cells: Number of cells; ranks: of processes.
        largest_step: T_Θ [s]; size: h_Θ [s]; asynchronicity: τ_Θ = T_Θ/h_Θ.
        events: Events of all cells per window, rounded where steps do not divide it.
        updates: Forces of cells per window: events, and those that an integrator adds at its ends.
        ideal: Speed-up over one step for all, in cell updates, if every cell took its own critical
            step: N/h_min over Σ 1/h_K.
        scheduled: The same with the updates of this run, against a synchronous one at 0.9 of the
            critical step.
        imbalance: Updates of the busiest rank over the mean of all ranks, minus 1.
        octaves: Cells whose step lies between W/2^i and W/2^(i+1), the former included, i = 0, ….
    """

    steps: Array = field(repr=False)
    divisions: Ints | None = field(repr=False)
    window: float
    cells: int
    ranks: int
    largest_step: float
    size: float
    asynchronicity: float
    events: int
    updates: int
    ideal: float
    scheduled: float
    imbalance: float
    octaves: Ints
    _comm: Any = field(repr=False)
    _nodes: Any = field(repr=False)
    _numbers: Any = field(repr=False)
    _elsewhere: dict[int, Array] = field(repr=False)

    @property
    def levels(self) -> Ints:
        """Octave of each of this rank's cells below the window, ⌊log₂ W/h_K⌋, shape (cells,)."""
        return _octaves(self.window / self.steps)

    def of_cell(self, cell: int, start: float = 0.0, end: float | None = None) -> Array:
        """Times at which a cell acts: Θ_K between two times, both included.

        Args:
            cell: Number of one of this rank's owned cells in dolfinx.
            start: First time [s].
            end: Last time [s]; by default the end of the first window.

        Returns:
            Rising times [s].

        Raises:
            IntegratorError: if this rank does not own the cell (on this rank alone).
        """
        if not 0 <= cell < len(self.steps):
            raise IntegratorError(
                f"TimeSets: no cell {cell} on this rank. Give 0 to {len(self.steps) - 1}."
            )
        return self._multiples(float(self.steps[cell]), start, self.window if end is None else end)

    def of_node(self, node: int, start: float = 0.0, end: float | None = None) -> Array:
        """Times at which any cell of a node acts: Θ_a between two times, both included.

        Args:
            node: Number of a geometry node in dolfinx, of this rank's owned cells. Cells of other
                ranks count as well.
            start: First time [s].
            end: Last time [s]; by default the end of the first window.

        Returns:
            Rising times [s], coinciding ones once.

        Raises:
            IntegratorError: if no cell of this rank has the node (on this rank alone).
        """
        own = int(self._numbers[node]) if 0 <= node < len(self._numbers) else -1
        mine = np.flatnonzero((self._nodes == own).any(axis=1)) if own >= 0 else np.zeros(0, int)
        if not len(mine):
            raise IntegratorError(
                f"TimeSets: no cell of this rank has a node {node}. Give one of its cells' nodes."
            )
        every = np.concatenate([self.steps[mine], self._elsewhere.get(own, np.zeros(0))])
        last = self.window if end is None else end
        times = [self._multiples(float(h), start, last) for h in np.unique(every)]
        return np.unique(np.concatenate(times))

    def _multiples(self, h: float, start: float, end: float) -> Array:
        at = np.arange(np.ceil(start / h - 1e-9), np.floor(end / h + 1e-9) + 1)
        if self.divisions is None:
            return at * h
        n = round(self.window / h)
        return (at // n + (at % n) / n) * self.window

    def histogram(self, bins: int = 10) -> tuple[Array, Ints]:
        """How many cells of the whole body have steps of which size; collective.

        Args:
            bins: Number of classes, of equal width in the logarithm of the step.

        Returns:
            Their bounds [s], shape (bins + 1,), and the numbers of cells, shape (bins,); one class
            if all steps are equal.

        Raises:
            IntegratorError: if bins is not positive.
        """
        if bins < 1:
            raise IntegratorError(f"TimeSets: histogram of {bins} bins. Give 1 or more.")
        low, high = self.size, self.largest_step
        if high <= low * (1 + 1e-12):
            return np.array([low, high]), np.array([self.cells])
        edges = np.geomspace(low, high, bins + 1)
        counts, _ = np.histogram(np.clip(self.steps, low, high), edges)
        edges[0], edges[-1] = low, high
        return edges, np.asarray(self._comm.allreduce(counts), dtype=np.int64)

    def __str__(self) -> str:
        """A block of four short lines, or three on one rank."""
        kind = "window" if self.divisions is not None else "span"
        filled = range(int(np.max(np.flatnonzero(self.octaves), initial=0)) + 1)
        table = ", ".join(f"{self.octaves[i]}" for i in filled)
        lines = [
            f"steps {self.size:.4g} to {self.largest_step:.4g} s, asynchronicity "
            f"{self.asynchronicity:.3g}; {self.events} events of {self.cells} cells per {kind} of "
            f"{self.window:.4g} s",
            f"cells by octave of steps, from the {kind} down: {table}",
            f"cell updates saved over one step for all: factor {self.ideal:.3g} ideal, "
            f"{self.scheduled:.3g} scheduled",
        ]
        if self.ranks > 1:
            lines.append(
                f"the busiest of {self.ranks} ranks has {self.imbalance:.1%} more updates than "
                "the mean"
            )
        return "\n".join(lines)


def time_sets(
    disc: Discretisation,
    steps: Array,
    critical: Array,
    window: float,
    divisions: Ints | None = None,
    ends: int = 0,
) -> TimeSets:
    """Time sets from the steps of this rank's cells; collective.

    Args:
        disc: Arrays of the scene, in whatever grouping.
        steps: h_K of dolfinx's owned cells (cells,) [s], any positive numbers.
        critical: Critical steps of the same [s]; infinity where nothing limits one.
        window: W [s]: a period if ``divisions`` are given, else a span to count events in.
        divisions: N_K if h_K = W/N_K.
        ends: Forces per cell and window beside its events (half kicks at both ends need one more).

    Raises:
        StepError: if a step is not a positive number (on all ranks).
    """
    comm = disc.comm
    least = float(comm.allreduce(float(np.min(steps, initial=np.inf)), op=MPI.MIN))
    most = float(comm.allreduce(float(np.max(steps, initial=0.0)), op=MPI.MAX))
    bad = comm.allreduce(bool(np.any(np.isnan(steps))), op=MPI.LOR)
    if bad or not 0 < least <= most < np.inf:
        raise StepError(
            f"Steps of cells go from {least:g} to {most:g} s. Give positive, finite numbers."
        )
    smallest = float(comm.allreduce(float(np.min(critical, initial=np.inf)), op=MPI.MIN))
    mine = float(np.sum(window / steps)) if divisions is None else float(np.sum(divisions))
    sums = np.array([disc.count, np.sum(1.0 / critical), mine])
    cells, rate, events = comm.allreduce(sums)
    updates = events + ends * cells
    busiest = float(comm.allreduce(mine + ends * disc.count, op=MPI.MAX))
    octaves = np.bincount(_octaves(window / steps), minlength=OCTAVES + 1)
    return TimeSets(
        steps=steps, divisions=divisions, window=window, cells=int(cells), ranks=comm.size,
        largest_step=most, size=least, asynchronicity=most / least,
        events=round(events), updates=round(updates),
        ideal=float(cells / smallest / rate) if rate > 0 else 1.0,
        scheduled=float(cells * window / (SYNCHRONOUS_SAFETY * smallest) / updates),
        imbalance=busiest * comm.size / updates - 1.0,
        octaves=np.asarray(comm.allreduce(octaves), dtype=np.int64),
        _comm=comm, _nodes=disc.number[_compat.cell_nodes(disc.scene.mesh)[: disc.count]],
        _numbers=disc.number, _elsewhere=_elsewhere(disc, steps),
    )  # fmt: skip


def per_cell(disc: Discretisation, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Values of dolfinx's owned cells (cells,) from those in blocks, (blocks, W) or (blocks, 1)."""
    real = disc.source_cell >= 0
    out = np.zeros(disc.count, values.dtype)
    out[disc.source_cell[real]] = np.broadcast_to(values, real.shape)[real]
    return out


def _octaves(ratio: Array) -> Ints:
    """⌊log₂⌋ of ratios, from 0 to OCTAVES; round-off must not change an octave."""
    return np.clip(np.floor(np.log2(ratio) + 1e-9), 0, OCTAVES).astype(np.int64)


def _elsewhere(disc: Discretisation, steps: Array) -> dict[int, Array]:
    """Distinct steps of other ranks' cells at each shared node, by own number; collective."""
    if disc.comm.size == 1:
        return {}
    real, halo = disc.source_cell >= 0, disc.halo
    row = disc.cells.transpose(0, 2, 1)[real] - disc.late
    shared = (row >= 0) & (row < disc.shared)
    h = np.broadcast_to(steps[disc.source_cell[real]][:, None], row.shape)
    pairs = np.unique(np.stack([row[shared].astype(np.float64), h[shared]]), axis=1)
    row = pairs[0].astype(np.int64)
    count = np.bincount(row, minlength=disc.shared)
    slot = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    most = int(disc.comm.allreduce(int(count.max(initial=0)), op=MPI.MAX))
    table = np.zeros((disc.shared, most))
    table[row, slot] = pairs[1]
    heard, width = np.zeros((len(halo.incoming), most)), halo.outgoing.shape[1]
    for first in range(0, most, width):
        part = table[:, first : first + width]
        halo.outgoing[:, : part.shape[1]] = part[halo.sends]
        halo.begin()
        halo.end()
        heard[:, first : first + width] = halo.incoming[:, : part.shape[1]]
    out: dict[int, Array] = {}
    for i in range(disc.shared):
        source = halo.source[halo.start[i] : halo.start[i + 1]]
        values = heard[source[source >= 0]]
        out[disc.late + i] = np.unique(values[values > 0])
    return out
