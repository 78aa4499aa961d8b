# SPDX-License-Identifier: LGPL-3.0-or-later
r"""States of a body at one time, and how far two of them are apart.

*L2* of a field is lumped, Σ_a V_a |w_a|² over nodes a with their lumped volumes V_a. The *energy
norm* of (w, ẇ) is

.. math:: \|(w, \dot w)\|^2 = w\cdot Kw + \dot w\cdot M\dot w,

K the stiffness: for quadratic energies twice the energy of the difference, else the derivative of
the forces at the initial state; M the lumped masses (γ in the place of a general inertia). Every
error is relative to the largest norm that the reference has over the run, field by field, so that
a field that happens to pass through zero in the end is not divided by nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody.integrators.entries import Entries, Run
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]

#: Derivatives of forces that are not linear: the differences' size relative to the vector.
SMALL = 1e-3


@dataclass(frozen=True)
class State:
    """(u, ν), rates and energy at one time.

    Attributes:
        fields, rates: By dolfinx's geometry nodes of this rank (nodes, n).
        energy: Of the whole body [J].
    """

    fields: Array
    rates: Array
    energy: float

    def __add__(self, other: State) -> State:
        return State(
            self.fields + other.fields, self.rates + other.rates, self.energy + other.energy
        )

    def __mul__(self, factor: float) -> State:
        return State(self.fields * factor, self.rates * factor, self.energy * factor)

    def __sub__(self, other: State) -> State:
        return self + other * -1.0


def state_of(run: Run, problem: Problem) -> tuple[State, Entries]:
    """What a run has reached, and its books; collective."""
    disc, comm = problem.disc, problem.comm
    entries = Entries.from_array(comm.allreduce(run.entries().array()))
    energy = entries.kinetic_u + entries.kinetic_nu + entries.stored + entries.potential
    out = np.zeros((2, len(problem.scene.mesh.geometry.x), disc.n))
    for values, records in zip(out, run.sample(), strict=True):
        disc.spread(records[:-1, : disc.n], values)
    return State(out[0], out[1], energy), entries


class Norms:
    """Norms of a scene's states, and the largest that its reference has; calls are collective.

    Args:
        problem: The scene, made ready; its arrays are used up: nothing else may run on it.

    Attributes:
        scale: The largest norm seen by :meth:`see`, of each kind.
        largest: The largest entry of the fields seen.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        disc, masses = problem.disc, problem.masses
        self._weight = disc.volume * disc.owned
        mass = masses.full(masses.inertia, masses.density)
        self._mass = mass[masses.classes[:-1]]
        self._linear = problem.kernels.densities.linear
        self._centre = np.zeros((disc.nodes, disc.n))
        if not self._linear:
            self._centre[:] = problem.initial_fields
        self.scale: dict[str, float] = {}
        self.largest = 0.0
        self._kinetic, self._low, self._high = 0.0, np.inf, -np.inf

    def of(self, state: State) -> dict[str, float]:
        """Norms of a state (or of a difference) by field, and in energy."""
        disc, scene = self.problem.disc, self.problem.scene
        fields, rates = state.fields[disc.dof], state.rates[disc.dof]
        squares = []
        for values in (fields, rates):
            for name in ("u", "nu"):
                part = values[:, scene.components_of(name)]
                squares.append(float(self._weight @ np.einsum("ai,ai->a", part, part)))
        momentum = np.einsum("aij,aj->ai", self._mass, rates)
        kinetic = float(self._weight @ np.einsum("ai,ai->a", momentum, rates))
        squares.append(kinetic + self._stored(fields))
        sums = self.problem.comm.allreduce(np.array(squares))
        names = ("u", "nu", "u_dot", "nu_dot", "energy_norm")
        found = {n: float(np.sqrt(max(v, 0.0))) for n, v in zip(names, sums, strict=True)}
        return {**found, "energy": abs(state.energy)}

    def _stored(self, w: Array) -> float:
        """This rank's share of w·Kw."""
        kernels, n = self.problem.kernels, self.problem.disc.n
        part = 1.0 if self._linear else SMALL
        forces = []
        for sign in (1.0, -1.0):
            kernels.x[:] = 0.0
            kernels.x[:-1, :n] = self._centre + sign * part * w
            kernels.forces()
            forces.append(kernels.f[:-1, :n].copy())
        # Forces are partial sums of this rank's cells, w is whole: their product sums over ranks.
        return float(-0.5 / part * np.sum(w * (forces[0] - forces[1])))

    def see(self, state: State, entries: Entries) -> None:
        """Let the scales know a state of the reference."""
        found = self.of(state)
        own = float(np.abs(state.fields).max(initial=0.0))
        self.largest = max(self.largest, self.problem.comm.allreduce(own, op=MPI.MAX))
        kinetic = entries.kinetic_u + entries.kinetic_nu
        self._kinetic = max(self._kinetic, kinetic)
        self._low = min(self._low, state.energy - kinetic)
        self._high = max(self._high, state.energy - kinetic)
        # What energy moved: a constant in the potential counts for nothing.
        found["energy"] = self._kinetic + self._high - self._low
        for name, value in found.items():
            self.scale[name] = max(self.scale.get(name, 0.0), value)

    def errors(self, state: State, exact: State) -> dict[str, float | None]:
        """Relative errors; None of a field that never moves, or where ``exact`` does not say.

        ``fields`` is the larger of those of u and ν.
        """
        found = self.of(state - exact)
        out: dict[str, float | None] = {}
        for name, value in found.items():
            known = np.isfinite(value) and self.scale[name] > 0
            out[name] = value / self.scale[name] if known else None
        both = [out[name] for name in ("u", "nu")]
        known_both = [v for v in both if v is not None]
        out["fields"] = max(known_both) if known_both else None
        return out


def smaller(errors: dict[str, Any], bounds: dict[str, Any], names: tuple[str, ...]) -> bool:
    """Whether errors are at most bounds, for the names that both know."""
    return all(
        errors[n] <= bounds[n]
        for n in names
        if errors.get(n) is not None and bounds.get(n) is not None
    )
