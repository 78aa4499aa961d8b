# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Pilot runs: short pieces of a scene's own motion, and how far two of them end apart.

A *window* begins at a state of the motion, with all histories shifted to its time. In it the states
of two runs part by (d, s), of fields and rates. A field's *amplitude* of parting

.. math:: a^2 = |d|^2 + \tfrac12 r^2 |s|^2, \qquad
          r = \min\Bigl(\sqrt{\frac{s\cdot Ms}{s\cdot Ks}}, \frac{s\cdot Ms}{s\cdot Ds}\Bigr)

(L2 norms; r is how far a unit rate moves the field: an oscillation's 1/ω, or what viscosity lets
through) grows by the first power of time while phases drift apart, also in windows much shorter
than a period, where d alone grows by the second. There s is in phase with the motion and out of
phase by turns; only one of them lasts: hence ½.

*The mesh.* P1 with masses half-way between lumped and consistent has no leading error of dispersion
in one dimension. A motion with accelerations q̈ and rates q̇ would feel the forces

.. math:: \delta f = \tfrac12 (M_l - M_c)\,\ddot q + \tfrac12 (D_l - D_c)\,\dot q

more if it had such masses. As loads of a window they give what the mesh's own error grows by.
"""

from __future__ import annotations

import time as clock
import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody.errors import ComplexBodyError
from complexbody.histories import Constant
from complexbody.integrators.entries import Run
from complexbody.loading import Loads
from complexbody.problem import Problem
from complexbody.scene import Scene
from complexbody.timesets import cell_densities

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Moment:
    """(u, ν) and rates of this rank's geometry nodes (geometry nodes, n) at a time [s]."""

    fields: Array
    rates: Array
    time: float

    def __sub__(self, other: Moment) -> Moment:
        return Moment(self.fields - other.fields, self.rates - other.rates, self.time)

    def __add__(self, other: Moment) -> Moment:
        return Moment(self.fields + other.fields, self.rates + other.rates, self.time)

    def __mul__(self, factor: float) -> Moment:
        return Moment(self.fields * factor, self.rates * factor, self.time)


def moment_of(run: Run, problem: Problem, begin: float = 0.0) -> Moment:
    """What a run has reached, whatever the order of its nodes; collective."""
    disc = problem.disc
    out = np.zeros((2, len(problem.scene.mesh.geometry.x), disc.n))
    for values, records in zip(out, run.sample(), strict=True):
        disc.spread(records[:-1, : disc.n], values)
    return Moment(out[0], out[1], begin + run.time)


@dataclass(frozen=True)
class Piece:
    """A run through a window.

    Attributes:
        ends: States at the window's middle and end.
        steps: To the middle; updates: cell updates of all ranks per second of the motion, without
            what looking at states costs; work: updates done.
        seconds: Processor time per second of the motion, of the slowest rank.
        measured: Processor time in all [s].
        finite: Whether it blew up.
    """

    ends: tuple[Moment, Moment]
    steps: int
    updates: float
    work: int
    seconds: float
    measured: float
    finite: bool


class Pilots:
    """A scene ready for short runs; collective.

    Args:
        scene: The scene.
        plan: Leave out components that stay zero, as the run itself does.

    Attributes:
        problem: Its problem, whose components are those of states; start: the initial one.
    """

    def __init__(self, scene: Scene, plan: bool = True) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # the run itself will tell them
            self.problem = Problem(scene, reduce=plan)
        self.comm, self._loads = self.problem.comm, self.problem.loads
        self.n_u = self.problem.scene.displacement
        masses, disc = self.problem.masses, self.problem.disc
        start = np.zeros((2, len(self.problem.scene.mesh.geometry.x), disc.n))
        for values, records in zip(
            start, (self.problem.initial_fields, self.problem.initial_rates), strict=True
        ):
            disc.spread(records, values)
        self.start = Moment(start[0], start[1], 0.0)
        weight = disc.volume * disc.owned
        node = masses.full(masses.inertia, masses.density)[masses.classes[:-1]]
        mass = np.einsum("a,aii->i", weight, node)
        self._mean_mass = self.comm.allreduce(mass) / self.comm.allreduce(float(weight.sum()))

    def run(self, method: Any, begin: Moment, length: float, extra: Array | None = None) -> Piece:
        """Run through a window; collective.

        Args:
            method: An integrator; its step divides half of the window.
            begin: The state at its begin.
            length: Of the window [s].
            extra: Partial forces on this rank's nodes (geometry nodes, n), beside the loads.

        Raises:
            ComplexBodyError: if the method does not take this scene.
        """
        problem, comm = self.problem, self.comm
        problem.loads = self._loads if extra is None else _with(self._loads, extra)
        problem.restart(begin.fields, begin.rates, begin.time)
        run: Run = method.prepare(problem, 0.5 * length)
        steps = max(1, round(0.5 * length / run.step))
        before, measured, ends = run.updates, 0.0, []
        with np.errstate(all="ignore"):
            for _ in range(2):
                begun = clock.process_time()
                run.advance(steps)
                measured += clock.process_time() - begun
                ends.append(moment_of(run, problem, begin.time))
        measured = float(comm.allreduce(measured, op=MPI.MAX))
        work, sets = comm.allreduce(int(run.updates) - int(before)), run.time_sets
        cells = comm.allreduce(problem.disc.count)
        updates = cells / run.step if sets is None else sets.updates / sets.window
        finite = all(np.isfinite(m.fields).all() and np.isfinite(m.rates).all() for m in ends)
        run.close()
        problem.loads = self._loads
        alright = bool(comm.allreduce(finite, op=MPI.LAND))
        return Piece((ends[0], ends[1]), steps, updates, work, measured / length, measured, alright)

    # --- norms ---------------------------------------------------------------------------------

    def _parts(self, values: Array) -> Array:
        """Squares of L2 norms of u and ν of values (geometry nodes, n)."""
        disc = self.problem.disc
        square = (disc.volume * disc.owned) @ values[disc.dof] ** 2
        sums = np.array([square[: self.n_u].sum(), square[self.n_u :].sum()])
        return np.asarray(self.comm.allreduce(sums))

    def norms(self, moment: Moment) -> Array:
        """L2 norms of u and ν (2,)."""
        return np.sqrt(self._parts(moment.fields))

    def reach(self, centre: Moment, difference: Moment) -> Array:
        """r of u and ν for a difference of rates (2,) [s]; 0 without inertia, or without any."""
        problem, disc, kernels = self.problem, self.problem.disc, self.problem.kernels
        masses, out = problem.masses, np.zeros(2)
        mass = masses.full(masses.inertia, masses.density)[masses.classes[:-1]]
        eta = masses.damping[masses.classes[:-1]]
        weight = disc.volume * disc.owned
        for i, columns in enumerate((slice(0, self.n_u), slice(self.n_u, disc.n))):
            s = np.zeros((disc.nodes, disc.n))
            s[:, columns] = difference.rates[disc.dof][:, columns]
            largest = self.comm.allreduce(float(np.abs(s).max(initial=0.0)), op=MPI.MAX)
            if not largest > 0:
                continue
            s /= largest
            size = float(np.abs(centre.fields).max(initial=0.0))
            size = 1e-3 * (self.comm.allreduce(size, op=MPI.MAX) or 1.0)
            forces = []
            for sign in (size, -size):
                kernels.x[:] = 0.0
                kernels.x[:-1, : disc.n] = centre.fields[disc.dof] + sign * s
                kernels.forces()
                forces.append(kernels.f[:-1, : disc.n].copy())
            # Forces are partial sums of this rank's cells, s is whole: products sum over ranks.
            stiff = -np.sum(s * (forces[0] - forces[1])) / (2 * size)
            inertia = np.einsum("a,ai,aij,aj->", weight, s, mass, s)
            damping = np.einsum("a,ai,aij,aj->", weight, s, eta, s)
            k, m, d = self.comm.allreduce(np.array([stiff, inertia, damping]))
            ways = [np.sqrt(m / k)] if k > 0 else []
            ways += [m / d] if d > 0 else []
            out[i] = min(ways, default=0.0)
        return out

    def amplitude(self, moment: Moment, reach: Array, weight: float = 1.0) -> Array:
        """√(|d|² + weight (r|s|)²) of u and ν (2,)."""
        rates = weight * reach**2 * self._parts(moment.rates)
        return np.sqrt(self._parts(moment.fields) + rates)

    def floored(self, scale: Array) -> Array:
        """Norms of u and ν, neither below a twentieth of the other by √mass: it may yet grow."""
        n_u, out = self.n_u, scale.copy()
        masses = [float(self._mean_mass[:n_u].mean()) if n_u else 0.0]
        masses.append(float(self._mean_mass[n_u:].mean()) if n_u < self.problem.disc.n else 0.0)
        if min(masses) > 0:
            ratio = np.sqrt(masses[0] / masses[1])
            out[1] = max(out[1], 0.05 * ratio * scale[0])
            out[0] = max(out[0], 0.05 / ratio * scale[1])
        return out

    # --- the mesh ------------------------------------------------------------------------------

    def defect(self, begin: Moment, end: Moment) -> Array:
        """δf of the mean acceleration between two states, partial sums (geometry nodes, n)."""
        problem, disc = self.problem, self.problem.disc
        dim, n, span = disc.dim, disc.n, end.time - begin.time
        density, bodies = cell_densities(problem), problem.scene.bodies
        # (M_l − M_c) q of a cell: |K|/((d+1)(d+2)) ((d+1) q_i − Σ_j q_j).
        share = disc.geometry[:, -1, :] ** 2 / ((dim + 1) * (dim + 2))
        acceleration = np.zeros((disc.nodes + 1, n))
        rate = np.zeros_like(acceleration)
        acceleration[:-1] = (end.rates - begin.rates)[disc.dof] / span
        rate[:-1] = (end.fields - begin.fields)[disc.dof] / span
        out = np.zeros((disc.nodes + 1, n))
        for r, body in enumerate(bodies):
            mine = np.flatnonzero(disc.region == r)
            cells = disc.cells[mine].transpose(0, 2, 1)
            a, v = acceleration[cells], rate[cells]  # (blocks, W, d + 1, n)
            q = np.empty_like(a)
            q[..., : self.n_u] = a[..., : self.n_u] * density[mine][..., None, None]
            q[..., self.n_u :] = a[..., self.n_u :] @ np.asarray(body.inertia_matrix).T
            q[..., self.n_u :] += v[..., self.n_u :] @ np.asarray(body.viscosity_matrix).T
            g = (dim + 1) * q - q.sum(axis=2, keepdims=True)
            g *= 0.5 * share[mine][..., None, None]
            np.add.at(out, cells.ravel(), g.reshape(-1, n))
        full = np.zeros((len(problem.scene.mesh.geometry.x), n))
        full[disc.dof] = out[:-1]
        return full

    def cell_size(self) -> float:
        """Size of the median cell, |K|^(1/d) [m]; collective."""
        disc = self.problem.disc
        volume = disc.geometry[:, -1, :][disc.source_cell >= 0] ** 2
        every = np.concatenate(self.comm.allgather(volume))
        return float(np.median(every) ** (1 / disc.dim))

    def close(self) -> None:
        """Free communicators; collective."""
        self.problem.release()
        self.problem.close()


def _with(loads: Loads, extra: Array) -> Loads:
    """Loads and more forces, constant in time."""
    node, component = np.nonzero(extra)
    group = np.full(len(node), len(loads.histories), np.int32)
    return replace(
        loads, node=np.concatenate([loads.node, node.astype(np.int64)]),
        component=np.concatenate([loads.component, component.astype(np.int64)]),
        group=np.concatenate([loads.group, group]),
        value=np.concatenate([loads.value, extra[node, component]]),
        histories=[*loads.histories, Constant()],
    )  # fmt: skip


def attempt(function: Any) -> Any:
    """What a function gives, or None if the scene is none for it (on all ranks)."""
    try:
        return function()
    except ComplexBodyError:
        return None
