# SPDX-License-Identifier: LGPL-3.0-or-later
"""What runs share in which all cells act together: forces at t_n, summed over ranks."""

from __future__ import annotations

import ctypes

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.integrators.activity import ENOUGH, Activity, Counted, active
from complexbody.integrators.snapshot import Snapshot
from complexbody.integrators.timetable import TimeSets
from complexbody.kernels.library import State
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


class ForceRun(Counted):
    """A run with one step for all cells.

    Attributes:
        time: t_n [s]; steps: n; step: h [s]; critical: the critical step [s].
        ready: Whether f holds the forces at (x_n, t_n).
        watched: What the C functions read, with the activity in it; None if energies of quiet cells
            are not zero.
        time_sets: None: all act together.
    """

    time_sets: TimeSets | None = None
    watched: State | None = None

    def __init__(self, problem: Problem, step: float, critical: float) -> None:
        self.problem, self.step, self.critical = problem, step, critical
        self.steps, self.ready = 0, False
        self._watching = False
        self._restless: npt.NDArray[np.bool_] | None = None
        # Whose masses a node has: sums of energies read it too.
        problem.kernels.state.klass = problem.masses.classes.ctypes.data
        self._state_of_its_own()

    def _state_of_its_own(self) -> None:
        """What the C functions read: a copy, since whoever else asks the kernels asks for all."""
        self._own = State.from_buffer_copy(self.problem.kernels.state)
        self.state = ctypes.byref(self._own)

    def watch(self, moving: npt.NDArray[np.bool_] | None = None) -> None:
        """Skip what is quiet from now on, if enough is; between steps, f being reset.

        Args:
            moving: More nodes that are never quiet (nodes,).
        """
        problem, kernels, disc = self.problem, self.problem.kernels, self.problem.disc
        self._watching, self._restless = True, moving
        self.activity = self.watched = self._own.activity = None
        if not (problem.quiet and disc.blocks):
            return
        rates = kernels.v[:-1, : disc.n] if self.steps else problem.initial_rates
        stirred = (kernels.x[:-1, : disc.n] != 0) | (rates != 0)
        stirred = (stirred | (kernels.f[:-1, : disc.n] != 0)).any(axis=1)
        stirred[problem.load_position // disc.record] = True
        if moving is not None:
            stirred |= moving
        if active(disc.cells, stirred) > ENOUGH:
            return
        awake, energetic = kernels.restless()
        self.activity = Activity(
            kernels.c, disc.chunks[:, 1], disc.cells, self.ranges(), stirred, awake,
            np.array([len(disc.chunks)]),
        )  # fmt: skip
        self._own.activity = ctypes.addressof(self.activity.state)
        self.watched = None if energetic else self._own
        kernels.c.cb_look(self.state)

    def ranges(self) -> npt.NDArray[np.int64]:
        """Ends of the ranges of nodes quiet together: those each chunk finishes, late ones."""
        return np.append(self.problem.disc.chunks[:, 3], self.problem.disc.nodes)

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
        self.problem.kernels.c.cb_forces(self.state)
        self._count(problem.disc.count)
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

    # --- what the future depends on ------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """The run between two steps; arrays are views, valid until a step; collective."""
        kernels, n = self.problem.kernels, self.problem.disc.n
        return Snapshot(
            {"steps": self.steps, "ready": self.ready},
            nodes={"x": kernels.x[:-1, :n], "v": kernels.v[:-1, :n]},
            sums={"sums": kernels.sums, "counts": self._counts()},
        )

    def restore(self, saved: Snapshot) -> None:
        """Go on from a snapshot of a run of the same scene, step and options; collective."""
        kernels, n = self.problem.kernels, self.problem.disc.n
        kernels.x[:-1, :n], kernels.v[:-1, :n] = saved.nodes["x"], saved.nodes["v"]
        kernels.sums[:] = saved.sums["sums"]
        self.steps, self.ready = int(saved.numbers["steps"]), False
        kernels.reset_forces()
        self._refresh(saved)
        if saved.numbers["ready"]:
            self.forces()
        self._recount(saved.sums["counts"])

    def _refresh(self, saved: Snapshot) -> None:
        """Take what else a kind of run has in a snapshot, before forces."""
        if self._watching:
            self.watch(self._restless)

    def close(self) -> None:
        """Do nothing: messages are the problem's."""
