# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Explicit local time stepping by leapfrog, recursive over octaves of cells and stabilised.

Nodes of level ℓ act 2^ℓ times per step Δt; P_ℓ selects those of level ≥ ℓ. From the even motion
z̈ = −M̂⁻¹Kz, z(0) = x_n, ż(0) = 0 follows x_{n+1} + x_{n−1} = 2z(Δt) if nothing is dissipated. Each
octave does two leapfrog steps of it, in which what coarser nodes give stays frozen:

.. math:: z(\Delta t) = \hat M^{-1/2} (I - S_0) \hat M^{1/2} x_n,\quad
    S_{\ell-1} = \gamma\,(4 S_\ell - 2 S_\ell P_\ell S_\ell),\quad
    S_L = \tfrac12 (\Delta t / r^L)^2\, \hat M^{-1/2} K \hat M^{-1/2},\quad r = 2\sqrt\gamma

(J. Diaz, M. J. Grote, SIAM J. Sci. Comput. 31, 2009, and CMAME 291, 2015 for many levels, with
γ = 1). The force of the whole step, f_Δt = −(2/Δt²) M̂^{1/2} S_0 M̂^{1/2} x_n, is linear and
symmetric again: that of a modified potential. So the outer step is :class:`SynchronousRun`'s, with
its effective mass M̂ for every dissipation scheme: a variational integrator, second order. Where
viscosity rules it tends to a Runge–Kutta–Chebyshev step of ην̇ = −∂V/∂ν.

*Stability.* Undamped it is stable iff 0 ≤ S_0 ≤ 2. With S = S_ℓ and Q = I − P_ℓ,

.. math:: 2 - S_{\ell-1} = 2\gamma\,\bigl[(I - S)^2 + \tfrac{1-\gamma}{\gamma} - S Q S\bigr].

For γ = 1 any eigenvalue 1 of S whose mode leaks into the coarse nodes Q makes this negative: the
method fails at scattered steps. γ = δ²/(2δ² − 1), δ = 1 + ν/4, is the Chebyshev filter for two
substeps (M. J. Grote, S. Michel, S. A. Sauter, Math. Comp. 90, 2021), here **at every level anew**.
Then S_{ℓ−1} ≥ 0 follows from S_ℓ ≤ 2, and the term in the middle is the same, about ν/2, at every
interface; with one filter for all 2^L substeps ν/4^ℓ would be left at level ℓ. Levels by
:mod:`complexbody.integrators.octaves` give ‖QS‖ ≤ α²/2γ, α the fraction of the critical step, so
that one interface is stable for certain if ν ≥ α⁴/2. The worst of 2·10⁴ scattered, graded and
heterogeneous meshes needed ν = 0.04, 0.08, 0.13 at α = 0.8, 0.9, 0.95. The filter makes r less than
2 (1.93 for ν = 0.15) and costs no accuracy.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import ufl

from complexbody import hessian, native
from complexbody.body import Body
from complexbody.errors import IntegratorError
from complexbody.given import is_finite, is_whole, short
from complexbody.integrators import octaves
from complexbody.integrators.entries import Entries
from complexbody.integrators.stiffened import reach, stiffen
from complexbody.integrators.synchronous import Synchronous
from complexbody.integrators.synchronous_run import SynchronousRun
from complexbody.integrators.timetable import per_cell, time_sets
from complexbody.problem import Problem
from complexbody.timesets import cell_steps, require_constant_inertia

Array = npt.NDArray[np.float64]

#: α, the fraction of critical steps that is used unless another is given.
SAFETY = 0.9


@dataclass(frozen=True)
class LocalLeapfrog:
    """Leapfrog with local steps: octaves of cells, stabilised, for any dissipation scheme.

    Symplectic and time-symmetric for quadratic densities. Others must at least be quadratic in the
    gradients, with a Hessian there that does not depend on ν: forces are then taken at the same
    split positions (fine nodes moving, coarse ones frozen), second order, time-symmetric, momentum
    kept, but of no exact potential. Where stiffness follows the state the step map is not symmetric
    and energy grows, at steps far below those stable for small motions: refused.

    Attributes:
        safety: α, the fraction of its critical step that a node may use.
        stabilisation: ν of the Chebyshev filter, at least α⁴/6; 0 is none, and fails sporadically.
        dissipation, start: As for Synchronous.
        step: Coarse step [s]; by default the one that needs the fewest updates.
        levels: Number of octaves, counted from the smallest critical step up; by default as many as
            the step needs.

    Raises:
        IntegratorError, StepError: for options that make no sense.
    """

    safety: float = SAFETY
    stabilisation: float = 0.15
    dissipation: str = "exact"
    start: str = "trapezoidal"
    step: float | None = None
    levels: int | None = None

    explicit: ClassVar[bool] = True
    asynchronous: ClassVar[bool] = True
    symplectic: ClassVar[bool] = True
    inertia: ClassVar[str] = Synchronous.inertia

    def __post_init__(self) -> None:
        Synchronous(self.step, self.safety, self.dissipation, self.start)  # refuses what it would
        if not (is_finite(self.stabilisation) and self.stabilisation >= 0):
            raise IntegratorError(
                f"LocalLeapfrog: stabilisation is {short(self.stabilisation)}. Give a number, "
                "0 or more."
            )
        levels = self.levels
        if levels is not None and not (is_whole(levels) and 0 <= levels <= octaves.MOST):
            raise IntegratorError(
                f"LocalLeapfrog: levels is {short(levels)}. Give 0 to {octaves.MOST}, or None."
            )

    @property
    def order(self) -> int:
        """Order of convergence in the step."""
        return Synchronous(dissipation=self.dissipation, start=self.start).order

    @property
    def gamma(self) -> float:
        """γ of the filter, 1 without."""
        delta = 1 + self.stabilisation / 4
        return delta**2 / (2 * delta**2 - 1)

    def prepare(self, problem: Problem, until: float) -> LocalLeapfrogRun:
        """Choose step and levels, regroup the cells, and set up the run; collective.

        Raises:
            StepError: if the levels do not reach the step, or the body has no stiffness.
            IntegratorError: if the body does not fit, or not the dissipation scheme.
        """
        require_constant_inertia(problem, "LocalLeapfrog")
        if self.levels != 0:
            for body, read in zip(
                problem.scene.bodies, problem.kernels.densities.stored, strict=True
            ):
                if read is None:  # else quadratic in everything
                    _require_semilinear(problem, body)
        ratio = 2 * np.sqrt(self.gamma)
        cells, safety = cell_steps(problem, self.dissipation), self.safety
        if problem.scene.self_action == "implicit":
            steps = np.minimum(safety * cells, self.step or np.inf)
            cells, safety = reach(cells, steps, SAFETY), max(safety, SAFETY)
        plan = octaves.plan(problem, until, cells, safety, ratio, self.step, self.levels)
        stiffen(problem, np.minimum(plan.cells, plan.step / SAFETY))
        return LocalLeapfrogRun(problem, self, plan)


def _require_semilinear(problem: Problem, body: Body) -> None:
    """Refuse densities whose second derivatives by gradients depend on the state."""
    mesh, n_u, k = problem.scene.mesh, problem.scene.displacement, problem.scene.descriptor
    seen: list[dict[tuple[int, int], Any]] = []
    for scale in (0.37, -1.21):
        nu = ufl.as_vector([scale * (i + 1) for i in range(k)]) if k else None
        frozen = hessian.read(lambda U, _, N, v=nu: body.energy(U, v, N), mesh, n_u, k, "gradients")
        seen.append({} if frozen is None else frozen.hessian)
    if not seen[0] or seen[0] != seen[1]:
        raise IntegratorError(
            f"LocalLeapfrog needs energies that are quadratic in the gradients, with coefficients "
            f"free of ν; that of {body.name} is not. Use Synchronous or AVI, or levels=0."
        )


class World(ctypes.Structure):
    """Mirror of ``octaves`` in levels.c."""

    _fields_ = (
        ("levels", ctypes.c_int64), ("count", ctypes.c_int64), ("gain", ctypes.c_double),
        *(
            (name, ctypes.c_void_p)
            for name in (
                "weight", "first", "slot", "node", "q", "still", "held", "before", "own", "list",
                "softness", "inverse_volume", "klass", "x", "f", "chunks", "start", "edge",
                "forces", "state", "driven", "driven_entry", "driven_component", "bend", "unit",
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

    def __init__(self, problem: Problem, method: LocalLeapfrog, plan: octaves.Plan) -> None:
        outer = Synchronous(dissipation=method.dissipation, start=method.start)
        super().__init__(problem, outer, plan.step, plan.critical)
        disc, self.plan, self.levels = problem.disc, plan, plan.depth
        real = (disc.source_cell >= 0).sum(axis=1)
        self.per_step = int(np.sum(real * 2**disc.group)) if self.levels else disc.count
        count = per_cell(disc, 2 ** disc.group[:, None])  # one group at first: number 0
        self.time_sets = time_sets(disc, plan.step / count, plan.cells, plan.step, count)
        self._driven = problem.comm.allreduce(len(problem.moving[0])) > 0
        self._loaded = problem.comm.allreduce(len(problem.load_value)) > 0
        self._messages: list[octaves.Message] = []
        if self.levels:  # octaves act on all their cells
            self._make(method, plan.level[disc.dof])
        else:
            self.watch()

    def _make(self, method: LocalLeapfrog, level: octaves.Ints) -> None:
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
            "weight": (4 * method.gamma) ** -np.arange(L + 1.0), "first": table.first,
            "slot": table.slot, "node": table.node, "q": q, "still": still, "held": held,
            "before": before, "own": table.own, "list": table.list, "softness": self._softness(),
            "inverse_volume": kernels.inverse_volume, "x": kernels.x, "f": kernels.f,
            "chunks": table.chunks, "start": table.start, "edge": table.edge,
            "driven": np.searchsorted(level[driven], np.arange(L + 2)),
            "driven_entry": table.of_node[driven], "bend": self._bend, "unit": np.zeros(L + 2),
            "driven_component": columns[self._listed].astype(np.int32),
        }  # fmt: skip
        world = World(L, count, 2 * method.gamma)
        for name, array in self._arrays.items():
            setattr(world, name, native.pointer(array).value)
        world.klass, world.state = kernels.state.klass, ctypes.addressof(kernels.state)
        world.forces = ctypes.cast(self.c.cb_forces_of, ctypes.c_void_p).value
        self._held, self._world = world, ctypes.byref(world)
        defines = {"N": disc.n, "NR": disc.record, "DIAGONAL": int(masses.diagonal)}
        source = [f"#define {name} {value}" for name, value in defines.items()]
        self._library = native.load("\n".join([*source, native.template("levels.c")]))
        self._coarse = native.pointer(table.chunks), ctypes.c_int64(int(table.start[1]))
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
        self.c.cb_forces_of(self.state, *self._coarse)
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
        self.updates += self.per_step
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
