# SPDX-License-Identifier: LGPL-3.0-or-later
"""The reference of balanced windows, and the filter that keeps it stable (DESIGN §5).

At a window's start each cell's stress, carried to mid-window and smoothed, becomes the reference:
its assembled force, small and smooth, acts all through the window, and cells kick with their
force minus their share of it. A filter at the window's end takes what this feeds to rough modes.
"""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.integrators.records import RecordRun
from complexbody.kernels import events
from complexbody.timesets import cell_densities

Array = npt.NDArray[np.float64]


class Balance:
    """Reference stresses of a run's cells, and its filter.

    Args:
        run: The run whose cells act against it.

    Attributes:
        reference: Smoothed stresses of cells (blocks, values, W), times √|K|.
        stress, old: Last and last but one stresses times |K|, summed over a node's cells.
    """

    reference: Array
    stress: Array
    old: Array

    def __init__(self, run: RecordRun) -> None:
        self.run, problem = run, run.problem
        disc, masses = problem.disc, problem.masses
        values = max(events.references(problem.kernels), 1)
        self.reference = native.aligned((disc.blocks, values, disc.lanes))
        rows = -(-values // disc.lanes) * disc.lanes
        self.stress, self.old, self._nodal, self._smoothed = (
            native.aligned((disc.nodes + 1, rows)) for _ in range(4)
        )
        share = disc.geometry[:, -1, :] ** 2 / (disc.dim + 1) ** 2
        self._cell_mass = np.ascontiguousarray(cell_densities(problem) * share)
        self._inverse_node_mass = 1.0 / (masses.density[masses.classes[:-1]] * disc.volume)
        if problem.comm.size > 1 and rows > disc.halo.outgoing.shape[1]:
            run.halo = disc.halo.widened(rows)

    def set(self, t: float, first: bool) -> None:
        """Smoothed stress at mid-window, and the accelerations of its forces and of loads."""
        run, disc, c = self.run, self.run.problem.disc, self.run.c
        if first:
            np.copyto(self.old, self.stress)
        blocks = ctypes.c_int64(disc.blocks)
        now, then = self._nodal, self._smoothed
        c.cb_carry(run._world, native.pointer(self.old), native.pointer(now))
        for left in reversed(range(run.method.passes)):
            run._sum_shared(now)
            c.cb_scale_nodes(run._world, native.pointer(now))
            if left:
                then[:] = 0.0
                c.cb_smooth(run._world, blocks, native.pointer(now), native.pointer(then))
                now, then = then, now
        run._force[:] = 0.0
        c.cb_to_cells(run._world, blocks, native.pointer(now), native.pointer(run._force))
        run._add_loads(t + 0.5 * run.step)
        run._sum_shared(run._force)
        c.cb_accelerate(run._world, native.pointer(run._force))

    def filter(self) -> float:
        """v −= ε (I − S)³ v, S the mass-weighted average over cells and back: the energy it takes.

        Fixed components stay, and so does the momentum of a free body.
        """
        run = self.run
        change, out = native.pointer(run._rates), native.pointer(run._force)
        blocks = ctypes.c_int64(run.problem.disc.blocks)
        weight, inverse = native.pointer(self._cell_mass), native.pointer(self._inverse_node_mass)
        run.c.cb_get_rates(run._world, change)
        run._force[:] = 0.0
        for _ in range(3):
            run.c.cb_average(run._world, blocks, weight, change, out)
            run._sum_shared(run._force)
            run.c.cb_subtract_average(run._world, inverse, change, out)
        strength = ctypes.c_double(-run.method.filter)
        return float(run.c.cb_change_rates(run._world, strength, change))
