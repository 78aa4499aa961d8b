# SPDX-License-Identifier: LGPL-3.0-or-later
"""What runs share in which all cells act together: forces at t_n, summed over ranks."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.integrators.timetable import TimeSets
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


class ForceRun:
    """A run with one step for all cells.

    Attributes:
        time: t_n [s]; steps: n; step: h [s]; critical: the critical step [s].
        updates: Cell updates done by this rank.
        ready: Whether f holds the forces at (x_n, t_n).
        time_sets: None: all act together.
    """

    time_sets: TimeSets | None = None

    def __init__(self, problem: Problem, step: float, critical: float) -> None:
        self.problem, self.step, self.critical = problem, step, critical
        self.steps, self.updates, self.ready = 0, 0, False
        # Whose masses a node has: sums of energies read it too.
        problem.kernels.state.klass = problem.masses.classes.ctypes.data

    @property
    def time(self) -> float:
        """t_n = n h [s], from the counter: never summed up."""
        return self.steps * self.step

    # --- forces at t_n -----------------------------------------------------------------------

    def forces(self) -> None:
        """Bring f to the forces at (x_n, t_n), summed over ranks; once per step at most."""
        if self.ready:
            return
        problem = self.problem
        problem.load_forces(self.amplitude(self.time))
        self.problem.kernels.c.cb_forces(ctypes.byref(self.problem.kernels.state))
        self.updates += problem.disc.count
        if problem.comm.size > 1:
            self._exchange_begin()
            self._exchange_end()
        self.ready = True

    def amplitude(self, t: float) -> Array:
        """Factors of the loads' groups at t [s]."""
        return self.problem.loads.amplitudes(np.array([t]))[0]

    def _exchange_begin(self) -> None:
        halo, disc, kernels = self.problem.disc.halo, self.problem.disc, self.problem.kernels
        self.problem.kernels.c.cb_pack(
            ctypes.c_int64(len(halo.sends)), native.pointer(halo.sends),
            ctypes.c_void_p(kernels.f.ctypes.data + disc.late * disc.record * 8),
            native.pointer(halo.outgoing),
        )  # fmt: skip
        halo.begin()

    def _exchange_end(self) -> None:
        halo, disc, kernels = self.problem.disc.halo, self.problem.disc, self.problem.kernels
        halo.end()
        self.problem.kernels.c.cb_sum_shared(
            ctypes.c_int64(disc.shared), ctypes.c_int64(disc.late), native.pointer(halo.start),
            native.pointer(halo.source), native.pointer(halo.incoming), native.pointer(kernels.f),
        )  # fmt: skip

    def positions(self) -> Array:
        """(u, ν) at t_n, node records."""
        return self.problem.kernels.x

    def close(self) -> None:
        """Do nothing: messages are the problem's."""
