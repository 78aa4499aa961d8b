# SPDX-License-Identifier: LGPL-3.0-or-later
"""Growth of a run in progress: of its linear map, built from the run itself, or over a long run.

A run of a linear scene without loads is a linear map of its state, and superposition is exact: its
matrix has the runs of unit states for columns. Where a map is too large, or repeats after no common
period, or the scene is not linear, growth is read off a long run from rough data. Knows no scene:
:mod:`complexbody.stability` makes the runs.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.integrators.balance import BEGIN
from complexbody.integrators.exact_run import ExactRun
from complexbody.integrators.synchronous_run import SynchronousRun
from complexbody.integrators.window_run import WindowRun

Array = npt.NDArray[np.float64]

#: Samples of a long run at most, and its growth (of a norm) after which it is long enough.
SAMPLES, ENOUGH = 160, 1e30


class RunMap:
    """The linear map of one step of a run (a window, or some spans) on its state; on one rank.

    The state is (q, q̇) of the free components (of a synchronous run the rates of the last drift),
    and, balanced, the forces that cells hold: those of some displacement of their nodes, of all
    others they never hold any.

    Args:
        run: A run of a linear scene without loads, moving supports or constant forces.
        spans: Steps of an exact run that make a period common to all cells.
    """

    def __init__(self, run: Any, spans: int = 1) -> None:
        self.run, self.spans = run, spans
        problem = run.problem
        run.wake()  # cells at rest are set moving by hand
        self._rows, self._columns = np.nonzero(~problem.masses.fixed[problem.masses.classes[:-1]])
        self.free = len(self._rows)
        self._held: list[tuple[int, int, Array]] = []
        if getattr(run, "balance", None) is not None:
            for block, lane in np.argwhere(problem.disc.source_cell >= 0):
                self._held += [(block, lane, b) for b in force_basis(run, block, lane)]
        self.size = 2 * self.free + len(self._held)

    def __call__(self, state: Array) -> Array:
        """The state one step later, shape (size,)."""
        run = self.run
        if isinstance(run, SynchronousRun):
            return self._synchronous(run, state)
        return self._recorded(run, state)

    def matrix(self) -> Array:
        """The map, column by column, shape (size, size)."""
        return np.array([self(unit) for unit in np.eye(self.size)]).T

    def radius(self) -> float:
        """Spectral radius."""
        return float(np.abs(np.linalg.eigvals(self.matrix())).max(initial=0.0))

    def _synchronous(self, run: SynchronousRun, state: Array) -> Array:
        kernels, at = run.problem.kernels, (self._rows, self._columns)
        kernels.x[:], kernels.v[:] = 0.0, 0.0
        kernels.x[at], kernels.v[at] = state[: self.free], state[self.free :]
        kernels.reset_forces()
        run.steps, run.ready = 1, False
        run.advance(1)
        return np.concatenate([kernels.x[at], kernels.v[at]])

    def _recorded(self, run: Any, state: Array) -> Array:
        disc, free = run.problem.disc, self.free
        record, n = disc.record, disc.n
        rates = (self._rows, record + self._columns)
        exact = isinstance(run, ExactRun)
        run.record[:-1, :n] = run.record[:-1, record : record + n] = 0.0
        run.record[self._rows, self._columns], run.record[rates] = state[:free], state[free:][:free]
        # Balanced windows would begin anew at step 0.
        run.steps = 0 if exact else 1
        run.record[:, run._time] = run.time
        if exact:
            run.schedule.restart()
        if self._held:
            self._hold(state[2 * free :])
        run.advance(self.spans)
        seen = run.positions()
        out = [seen[self._rows, self._columns], seen[rates]]
        if self._held:
            held = run.balance.held
            out.append(np.array([held[m, :, lane] @ basis for m, lane, basis in self._held]))
        return np.concatenate(out)

    def _hold(self, parts: Array) -> None:
        run, disc = self.run, self.run.problem.disc
        n, record = disc.n, disc.record
        run.balance.held[:], total = 0.0, np.zeros((disc.nodes + 1, record))
        run.record[:-1, 2 * record : 2 * record + n] = 0.0
        for part, (block, lane, basis) in zip(parts, self._held, strict=True):
            if part:
                run.balance.held[block, :, lane] += part * basis
                nodes = disc.cells[block, :, lane]
                np.add.at(total[:, :n], nodes, part * basis.reshape(-1, n))
        run.c.cb_accelerate(run._world, native.pointer(total), *run._all)


def force_basis(run: WindowRun, block: int, lane: int) -> Array:
    """Orthonormal forces that a cell can hold, shape (rank, (d+1)·n)."""
    assert run.balance is not None
    disc, balance, rows = run.problem.disc, run.balance, []
    nodes, n = disc.cells[block, :, lane], disc.n
    group = next(i for i in range(run.plan.count) if block < run.plan.groups[i].last)
    for a, i in itertools.product(nodes, range(n)):
        run.record[:-1, :n] = 0.0
        run.record[a, i] = 1.0
        run.record[:, run._time] = run.time
        run._together(run.time, BEGIN, first=group, last=group + 1)
        rows.append(balance.held[block, :, lane].copy())
    values, basis = np.linalg.svd(rows)[1:]
    return basis[: np.count_nonzero(values > 1e-10 * values[0])]


def rate_norm(runs: Sequence[Any], inertia: Array) -> float:
    """Norm of the rates of a run, or of the difference of two, weighted like kinetic energy.

    Rates, because a body without supports may move for ever without being unstable. Collective.

    Args:
        runs: A run, or a disturbed one and the same undisturbed.
        inertia: Weights per class of nodes and component (classes, n); see :func:`weights`.
    """
    problem = runs[0].problem
    disc = problem.disc
    rates = runs[0].sample()[1][:-1, : disc.n].copy()
    if len(runs) > 1:
        rates -= runs[1].sample()[1][:-1, : disc.n]
    share = np.einsum("ai,ai->a", inertia[problem.masses.classes[:-1]], rates**2)
    total = float(np.sum(share * disc.volume * disc.owned))
    return float(np.sqrt(problem.comm.allreduce(total)))


def weights(problem: Any, step: float) -> Array:
    """Inertia per class and component, hη where there is none; 0 on supports. (classes, n)."""
    masses = problem.masses
    mass = np.einsum("cii->ci", masses.full(masses.inertia, masses.density))
    loss = np.einsum("cii->ci", masses.damping) * step
    return np.where(masses.fixed, 0.0, np.where(mass > 0, mass, loss))


def resolution(steps: int) -> float:
    """Growth per step that a long run tells from a beat of modes: fiftyfold in its second half."""
    return float(2 * np.log(50.0) / steps)


def long_run(runs: Sequence[Any], steps: int, enough: float = ENOUGH) -> float:
    """Growth of a run per step, ln of its factor: slope of the log norm over the second half.

    The run ends early where the norm has grown by ``enough``. Collective.

    Args:
        runs: A run that stands at its start, or two whose difference is meant.
        steps: How many steps to do.
        enough: Growth of the norm that is enough to see it.
    """
    inertia = weights(runs[0].problem, runs[0].step)
    at, logs = [], []
    first, done, piece = -1.0, 0, 1
    while done < steps:
        for run in runs:
            run.advance(min(piece, steps - done))
        done += min(piece, steps - done)
        norm = rate_norm(runs, inertia)
        if first < 0 < norm:
            first = norm
        at.append(done)
        logs.append(np.log(norm) if 0 < norm < np.inf else np.nan)
        if not norm < enough * first or norm == 0.0:
            break
        # At first step by step: what grows fast is over soon.
        if len(at) == SAMPLES // 2:
            piece = max(1, (steps - done) // (SAMPLES // 2))
    x, y = np.array(at, dtype=float), np.array(logs)
    late = (x >= 0.5 * x[-1]) & np.isfinite(y)
    if late.sum() < 2:
        return -np.inf if not logs or (not np.isfinite(logs[-1]) and norm == 0.0) else np.inf
    return float(np.polyfit(x[late], y[late], 1)[0])
