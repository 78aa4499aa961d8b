# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The books of a run that is implicit in ν: works, dissipation, and its discrete energy.

Sums are taken step by step with the forces and loads that the step saw. Between the midpoints x̄ of
two neighbouring steps j−1 and j, for linear forces and ϑ = ½, the momentum of ν obeys

.. math:: M(r_j - r_{j-1})/h + \eta\,\delta/h = \tfrac12(f_j + f_{j-1}),\qquad
          \delta = \nu_{m,j} - \nu_{m,j-1} = \tfrac h2(r_j + r_{j-1}),

the mean of both steps; with δ, and u's kick with the mean of its rates, follows the balance of E_h
in :mod:`complexbody.integrators.split_run`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.integrators.entries import Entries, energies, half_quadratic
from complexbody.integrators.snapshot import Snapshot

if TYPE_CHECKING:
    from complexbody.integrators.split_run import SplitRun

Array = npt.NDArray[np.float64]


class Books:
    """What a :class:`SplitRun` keeps for its ledger, of this rank.

    Args:
        run: The run, its masses and initial rates set.
    """

    def __init__(self, run: SplitRun) -> None:
        self.run = run
        self.identity = run.theta < 1 and run.problem.kernels.densities.linear
        self.discrete, self.flows, self.size = 0.0, 0.0, 0.0
        self._record = native.aligned(run.problem.kernels.x.shape)
        self._before: tuple[Array, Array, Array, Array] | None = None
        self._supports = self._support_energy(run.rate)

    def _fill(self, u: Array | float, nu: Array | float) -> Array:
        """A node record (nodes + 1, NR) with these values of u and ν."""
        run = self.run
        self._record[:-1, : run.n_u] = u
        self._record[:-1, run.n_u : run.n] = nu
        return self._record

    def _support_energy(self, rates: Array) -> float:
        """Kinetic energy of moving supports [J]."""
        run, disc = self.run, self.run.problem.disc
        rows, columns = run.problem.moving
        momenta = np.einsum("aij,aj->ai", run.inertia, rates[:, run.n_u :])
        momenta = np.concatenate([run.heavy[:, None] * rates[:, : run.n_u], momenta], axis=1)
        return 0.5 * float(((rates * momenta)[rows, columns] * disc.owned[rows]).sum())

    # --- what the future depends on ------------------------------------------------------------

    def save(self, saved: Snapshot) -> None:
        """Add the sums, and what the next step's identity needs of the last, to a snapshot."""
        saved.sums["discrete"] = np.array([self.discrete, self.flows, self.size, self._supports])
        saved.numbers["before"] = self._before is not None
        if self._before is not None:
            middle, rate, force, _ = self._before
            saved.nodes |= {"middle": middle, "rate_before": rate, "force": force}

    def restore(self, saved: Snapshot) -> None:
        """Take them from one; the run's step and counter are set."""
        self.discrete, self.flows, self.size, self._supports = (
            float(v) for v in saved.sums["discrete"]
        )
        self._before = None
        if saved.numbers["before"]:
            h, nodes = self.run.step, saved.nodes
            amplitude = self.run.amplitude((self.run.steps - 1) * h + 0.5 * h)
            self._before = nodes["middle"], nodes["rate_before"], nodes["force"], amplitude

    # --- one step ------------------------------------------------------------------------------

    def step(self, before: Array) -> None:
        """Book the step that the run has just taken from the rates ``before`` (nodes, n)."""
        run, problem, h, n_u = self.run, self.run.problem, self.run.step, self.run.n_u
        sums, owned = problem.kernels.sums, problem.disc.owned
        delta = run.moved[:, n_u:]
        lost = np.einsum("aij,aj->ai", run.eta, delta) / h
        sums[0] += float((delta * lost)[owned].sum())
        weight = (problem.disc.volume * owned)[:, None]
        # The first drift follows the initial rates, later ones each other.
        last = run._drifts[1] / h if run.steps > 0 else before[:, n_u:]
        sums[1] += float((np.abs(run.rate - before)[:, :n_u] * weight).sum())
        sums[2] += float((np.abs(delta / h - last) * weight).sum())
        amplitude = run.amplitude(run.time + 0.5 * h)
        sums[3] += h * problem.load_power(amplitude, problem.kernels.v)
        rows, columns = problem.moving
        if len(rows):
            work = -run.force * run.moved
            work[:, n_u:] += lost * delta
            sums[4] += float((work[rows, columns] * owned[rows]).sum())
        if self.identity:
            self._discrete(before, amplitude)

    def _discrete(self, before: Array, amplitude: Array) -> None:
        """E_h after this step, and the flows that must have changed it since the last one."""
        run, problem, h, n_u = self.run, self.run.problem, self.run.step, self.run.n_u
        nu = slice(n_u, run.n)
        rate, middle, force = run.moved[:, nu] / h, run.middle, run.force
        mean = 0.5 * (before + run.rate)[:, :n_u]
        rows, columns = problem.moving
        if self._before is not None:
            last_middle, last_rate, last_force, last_amplitude = self._before
            delta = (middle - last_middle)[:, nu]
            drag = np.einsum("aij,aj->ai", run.eta, delta) / h
            self.flows -= float((delta * drag)[problem.disc.owned].sum())
            self.flows += problem.load_power(amplitude, self._fill(h * mean, 0.5 * delta))
            self.flows += problem.load_power(last_amplitude, self._fill(0.0, 0.5 * delta))
            if len(rows):
                work = np.zeros_like(force)
                kick = run.heavy[:, None] * (run.rate - before)[:, :n_u] - h * force[:, :n_u]
                push = np.einsum("aij,aj->ai", run.inertia, rate - last_rate) / h + drag
                push -= 0.5 * (force + last_force)[:, nu]
                work[:, :n_u], work[:, nu] = kick * mean, push * delta
                self.flows += float((work[rows, columns] * problem.disc.owned[rows]).sum())
        self._before = middle.copy(), rate, force.copy(), amplitude
        # −½ f·x̄ with the next midpoint of u; loads belong to the work, not to the energy.
        kinetic = half_quadratic(problem, run.mass, self._fill(run.rate[:, :n_u], rate), 0, run.n)
        following = problem.kernels.x[:-1, :n_u] + 0.5 * h * run.rate[:, :n_u]
        if len(rows):
            following = np.concatenate([following, middle[:, nu]], axis=1)
            two = problem.targets(run.time + h) + problem.targets(run.time + 2 * h)
            following[rows, columns] = np.where(columns < n_u, two / 2, following[rows, columns])
            following = following[:, :n_u]
        record = self._fill(following, middle[:, nu])
        product = float((force * record[:-1, : run.n])[problem.disc.owned].sum())
        product -= problem.load_power(amplitude, record)
        if problem.kernels.constant is not None:
            # The affine part f0 acts on both midpoints; it is partial, as loads are.
            product += float(np.sum(problem.kernels.constant[:-1, : run.n] * middle))
        self.discrete = kinetic - 0.5 * product
        self.size = abs(kinetic) + 0.5 * abs(product)

    # --- what the ledger asks ------------------------------------------------------------------

    def entries(self) -> Entries:
        """Energies and works at t_n, this rank's share; collective."""
        run, sums = self.run, self.run.problem.kernels.sums
        _, rates = run.sample()
        common = energies(run.problem, run.mass, rates)
        support = self._support_energy(run.rate) - self._supports if run.steps else 0.0
        work, support, lost = float(sums[3]), float(sums[4]) + support, float(sums[0])
        energy = sum(common[n] for n in ("kinetic_u", "kinetic_nu", "stored", "potential"))
        return Entries(
            **common, work=work, support_work=support, dissipated=lost,
            surplus=energy - work - support + lost, discrete=self.discrete, flows=self.flows,
            size=self.size, variation_u=float(sums[1]), variation_nu=float(sums[2]),
        )  # fmt: skip
