# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a run hands to its ledger: energies, works and momenta at its own time, one rank's share.

Every integrator fills the same :class:`Entries`; summing them over ranks and judging the balance is
the ledger's business.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.integrators.timetable import TimeSets
from complexbody.kernels.library import State
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


@dataclass
class Entries:
    """This rank's share of the books at one time, all in J but for variations and momentum.

    Attributes:
        kinetic_u, kinetic_nu, stored, potential: Energies.
        work, support_work: Work of loads and of moving supports since the start.
        dissipated: By viscosity.
        surplus: Energy as it stands between kicks minus all that was given: what a guard watches,
            since rates of a stiff damping make no leaps there.
        discrete, flows: Discrete energy E_h of the last half step, and what must have changed it
            (works minus dissipation); both 0 where an integrator has no such identity.
        size: Size of the terms of E_h.
        variation_u, variation_nu: pV of the rates, ∫Σ|q̇⁺ − q̇⁻|₁ dx.
        momentum: Linear momentum by component [N s].
        still: Kinetic energy that ν would have without rates, −∫χ(ν, 0); 0 for a quadratic χ.
    """

    kinetic_u: float
    kinetic_nu: float
    stored: float
    potential: float
    work: float
    support_work: float
    dissipated: float
    surplus: float
    discrete: float
    flows: float
    size: float
    variation_u: float
    variation_nu: float
    momentum: Array
    still: float = 0.0

    def array(self) -> Array:
        """All of it as one array, to be summed over ranks."""
        scalars = [getattr(self, f.name) for f in fields(self) if f.name != "momentum"]
        return np.array([*scalars, *self.momentum], dtype=np.float64)

    @classmethod
    def from_array(cls, values: Array) -> Entries:
        """The inverse of :meth:`array`."""
        names = [f.name for f in fields(cls) if f.name != "momentum"]
        scalars: dict[str, Any] = {n: float(v) for n, v in zip(names, values, strict=False)}
        return cls(**scalars, momentum=values[len(names) :])


class Run(Protocol):
    """What a simulation needs of an integrator's run; ``advance`` and the rest are collective.

    Attributes:
        step, critical: Step (or window) and critical synchronous step [s].
        steps: Done so far; time: reached [s].
        updates, skipped: Cell updates of this rank, and those that quiet cells saved.
    """

    step: float
    critical: float
    steps: int

    @property
    def updates(self) -> int:
        """Cell updates of this rank."""

    @property
    def skipped(self) -> int:
        """Those that quiet cells saved."""

    @property
    def time(self) -> float:
        """Time reached [s]."""

    @property
    def time_sets(self) -> TimeSets | None:
        """Who acts when; None where all cells act together."""

    def advance(self, steps: int) -> None:
        """Do some steps."""

    def sample(self) -> tuple[Array, Array]:
        """(u, ν) and rates at the time reached, as node records; views, valid until a step."""

    def positions(self) -> Array:
        """(u, ν) at the time reached, node records (nodes + 1, at least n); a view."""

    def entries(self) -> Entries:
        """The books at the time reached, this rank's share."""

    def close(self) -> None:
        """Free communicators of the run's own."""


def half_quadratic(
    problem: Problem, matrix: Array, w: Array, first: int, last: int, state: State | None = None
) -> float:
    """½ Σ_a V_a w·m w over this rank's nodes and components [first, last), m per class (n, n).

    A run that tracks which cells are quiet gives its own ``state``.
    """
    kernels = problem.kernels
    return float(
        kernels.c.cb_quadratic(
            ctypes.byref(state or kernels.state), native.pointer(matrix), native.pointer(w),
            ctypes.c_int64(first), ctypes.c_int64(last),
        )
    )  # fmt: skip


def energies(
    problem: Problem, mass: Array, rates: Array, state: State | None = None
) -> dict[str, Any]:
    """Kinetic, stored and potential energy and momentum of this rank at (kernels.x, rates)."""
    disc, masses = problem.disc, problem.masses
    n, n_u = disc.n, problem.scene.displacement
    stored, potential = problem.kernels.energies(state).sum(axis=0)
    weight = disc.volume * disc.owned * masses.density[masses.classes[:-1]]
    return {
        "kinetic_u": half_quadratic(problem, mass, rates, 0, n_u, state),
        "kinetic_nu": half_quadratic(problem, mass, rates, n_u, n, state),
        "stored": float(stored),
        "potential": float(potential),
        "momentum": weight @ rates[:-1, :n_u],
    }
