# SPDX-License-Identifier: LGPL-3.0-or-later
"""A run of local leapfrog: a synchronous one, whose force is that of a whole step of octaves.

Cells at rest are skipped at every level: those of a level are looked at as soon as its nodes have
been moved, so that within a step activity spreads by a layer of cells per evaluation.
"""

from __future__ import annotations

import ctypes
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.integrators import octaves
from complexbody.integrators.entries import Entries
from complexbody.integrators.synchronous import Synchronous
from complexbody.integrators.synchronous_run import SynchronousRun
from complexbody.integrators.timetable import per_cell, time_sets
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


class World(ctypes.Structure):
    """Mirror of ``octaves`` in levels.c."""

    _fields_ = (
        ("levels", ctypes.c_int64), ("count", ctypes.c_int64), ("gain", ctypes.c_double),
        *(
            (name, ctypes.c_void_p)
            for name in (
                "weight", "first", "slot", "node", "q", "still", "held", "before", "list",
                "softness", "inverse_volume", "klass", "x", "f", "chunks", "start", "edge",
                "forces", "state", "driven", "driven_entry", "driven_component", "bend", "unit",
                "number", "entries", "entries_from", "entries_range", "owned", "owned_from",
                "owned_range", "activity",
            )
        ),
    )  # fmt: skip


class LocalLeapfrogRun(SynchronousRun):
    """A run in progress: a synchronous one with the force of a whole step of octaves.

    Attributes:
        plan: Steps and levels; levels: number of octaves below the coarse step.
        time_sets: Who acts when, substeps counted as equal parts of the step: with the filter they
            are a little longer, and only the step's end has a time.
        per_step: Cell updates of this rank per step.
        critical: Critical step of the smallest cell, that of a synchronous run [s].
    """

    def __init__(
        self, problem: Problem, outer: Synchronous, gamma: float, plan: octaves.Plan
    ) -> None:
        super().__init__(problem, outer, plan.step, plan.critical)
        disc, self.plan, self.levels = problem.disc, plan, plan.depth
        real = (disc.source_cell >= 0).sum(axis=1)
        self.per_step = int(np.sum(real * 2**disc.group)) if self.levels else disc.count
        count = per_cell(disc, 2 ** disc.group[:, None])  # one group at first: number 0
        self.time_sets = time_sets(disc, plan.step / count, plan.cells, plan.step, count)
        self._driven = problem.comm.allreduce(len(problem.moving[0])) > 0
        self._loaded = problem.comm.allreduce(len(problem.load_value)) > 0
        self._messages: list[octaves.Message] = []
        if self.levels:
            self._make(gamma, plan.level[disc.dof])
        self.watch()

    def watch(self, moving: npt.NDArray[np.bool_] | None = None) -> None:
        """Skip what is quiet from now on, if enough is, at all levels; between steps."""
        super().watch(moving)
        if self.levels:
            activity = self.activity
            self._held.activity = None if activity is None else ctypes.addressof(activity.state)

    def _make(self, gamma: float, level: octaves.Ints) -> None:
        problem, kernels, L = self.problem, self.problem.kernels, self.levels
        disc, masses = problem.disc, problem.masses
        table = octaves.Entries(problem, level, L)
        count, rows = len(table.node), int(table.slot[-1])
        moving, columns = problem.moving
        self._listed = np.argsort(level[moving], kind="stable")
        self._listed = self._listed[level[moving[self._listed]] > 0]
        driven = moving[self._listed]
        self._bend = np.zeros(len(driven))
        q, still = (native.aligned((count, disc.record)) for _ in range(2))
        held, before = (native.aligned((rows, disc.record)) for _ in range(2))
        self._arrays = {
            "weight": (4 * gamma) ** -np.arange(L + 1.0), "first": table.first,
            "slot": table.slot, "node": table.node, "q": q, "still": still, "held": held,
            "before": before, "list": table.list, "softness": self._softness(),
            "inverse_volume": kernels.inverse_volume, "x": kernels.x, "f": kernels.f,
            "chunks": table.chunks, "start": table.start, "edge": table.edge,
            "driven": np.searchsorted(level[driven], np.arange(L + 2)),
            "driven_entry": table.of_node[driven], "bend": self._bend, "unit": np.zeros(L + 2),
            "driven_component": columns[self._listed].astype(np.int32),
            "number": table.number,
        }  # fmt: skip
        for name in ("entries", "owned"):
            tables = getattr(table, name)
            names = name, f"{name}_from", f"{name}_range"
            self._arrays |= {n: np.ascontiguousarray(t) for n, t in zip(names, tables, strict=True)}
        world = World(L, count, 2 * gamma)
        for name, array in self._arrays.items():
            setattr(world, name, native.pointer(array).value)
        world.klass, world.state = kernels.state.klass, ctypes.addressof(kernels.state)
        world.forces = ctypes.cast(self.c.cb_forces_of, ctypes.c_void_p).value
        self._held, self._world = world, ctypes.byref(world)
        defines = {"N": disc.n, "NR": disc.record, "DIAGONAL": int(masses.diagonal)}
        source = [f"#define {name} {value}" for name, value in defines.items()]
        source += [native.template(name) for name in ("quiet.h", "levels.c")]
        self._library = native.load("\n".join(source))
        if problem.comm.size > 1:
            self._messages = [octaves.Message(problem, table.touched[:, i]) for i in range(L + 1)]

    def _softness(self) -> Array:
        """(Δt²/2) M̂⁻¹ on free components per class: how far a unit force moves in a step."""
        masses, mean = self.problem.masses, self.recursion.mean
        out = np.zeros_like(mean)
        for c, fixed in enumerate(masses.fixed):
            ix = np.ix_(~fixed, ~fixed)
            out[c][ix] = 0.5 * self.step**2 * np.linalg.inv(mean[c][ix])
        return masses.pack(out, self.problem.disc.record)

    def forces(self) -> None:
        """Bring f to f_Δt(x_n), loads and supports included, summed over ranks; once per step."""
        if self.ready or not self.levels:
            return super().forces()
        problem, library, world = self.problem, self._library, self._world
        problem.load_forces(self.amplitude(self.time))
        library.cb_octaves_coarse(world)
        if self._driven:
            self._bend[:] = self._second_difference()[self._listed]
        if problem.comm.size == 1:
            library.cb_octaves(world)
        else:
            self._exchange_begin()
            self._exchange_end()
            library.cb_octaves_begin(world)
            for leaf in range(2**self.levels):
                self._leaf(leaf)
            library.cb_octaves_end(world)
        self._count(self.per_step)
        self.ready = True

    def _leaf(self, leaf: int) -> None:
        """Passage ``leaf`` of the finest level, with the coarser ones that begin or end there."""
        library, world, L = self._library, self._world, self.levels
        halvings = (leaf & -leaf).bit_length() - 1 if leaf else L - 1
        for i in range(L - halvings, L + 1):
            level, message = ctypes.c_int64(i), self._messages[i]
            library.cb_octaves_edge(world, level, ctypes.c_int64(leaf))
            message.begin(library)
            library.cb_octaves_inner(world, level)
            message.end(library)
            library.cb_octaves_take(world, level)
        done = leaf + 1
        for i in range(L, L - ((done & -done).bit_length() - 1), -1):
            library.cb_octaves_close(world, ctypes.c_int64(i))

    def _second_difference(self) -> Array:
        """½(x(t+Δt) − 2x(t) + x(t−Δt)) of moving supports; at t = 0 that of the first two steps."""
        centre = max(self.steps, 1)
        a, b, c = (self.problem.targets((centre + i) * self.step) for i in (-1, 0, 1))
        return 0.5 * (a - 2 * b + c)

    def advance(self, steps: int) -> None:
        """Do ``steps`` steps; collective."""
        if not self.levels:
            return super().advance(steps)
        if steps > 0 and self.steps == 0:
            self._first()
            steps -= 1
        for _ in range(steps):
            self.forces()
            self._unfused()

    def entries(self) -> Entries:
        """The books at t_n; no E_h if loads or supports drive: their share of f_Δt is unknown."""
        books, affine = super().entries(), self.problem.kernels.constant is not None
        if self.levels and (self._loaded or self._driven or affine):
            books = replace(books, discrete=0.0, flows=0.0, size=0.0)
        return books

    def close(self) -> None:
        """Free the levels' communicators; collective."""
        for message in self._messages:
            message.halo.close()
        self._messages = []
