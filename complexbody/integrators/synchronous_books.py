# SPDX-License-Identifier: LGPL-3.0-or-later
"""The books of a synchronous run: energies and works at t_n from the state (x_n, v_{n−½}).

What acts in the half step before t_n belongs to t_n; the next kick would complete it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from complexbody.integrators.entries import Entries, energies, half_quadratic

if TYPE_CHECKING:
    from complexbody.integrators.synchronous_run import SynchronousRun

Array = npt.NDArray[np.float64]


def entries(run: SynchronousRun) -> Entries:
    """Energies and works at t_n, and the discrete energy of the last half step; collective."""
    problem, kernels, n = run.problem, run.problem.kernels, run.problem.disc.n
    x, rates = run.sample()
    work, support, lost = _works(run, rates)
    drift = half_quadratic(problem, run.mean, kernels.v, 0, n, run.watched)
    discrete, size = _discrete(run, x, drift)
    common = energies(problem, run.mass, rates, run.watched)
    flows = float(kernels.sums[3] + kernels.sums[4] - kernels.sums[0])
    return Entries(
        **common, work=work, support_work=support, dissipated=lost,
        surplus=drift + common["stored"] + common["potential"] - flows,
        discrete=discrete, flows=flows if size else 0.0, size=size,
        variation_u=float(kernels.sums[1]), variation_nu=float(kernels.sums[2]),
    )  # fmt: skip


def _works(run: SynchronousRun, rates: Array) -> tuple[float, float, float]:
    """Work of loads, of supports and dissipation up to t_n, on this rank."""
    problem, kernels, h = run.problem, run.problem.kernels, run.step
    if run.steps == 0:
        return 0.0, 0.0, 0.0
    # The half step before t_n, which the next kick would complete.
    np.add(kernels.v, rates, out=run.scratch)
    work = kernels.sums[3] + h / 4 * problem.load_power(run.amplitude(run.time), run.scratch)
    lost = kernels.sums[0] + h / 4 * half_quadratic(
        problem, run.eta, run.scratch, 0, problem.disc.n, run.watched
    )
    return float(work), float(kernels.sums[4]) + run.support_work, float(lost)


def _discrete(run: SynchronousRun, x: Array, kinetic: float) -> tuple[float, float]:
    """E_h of the last half step on this rank and its size; zero before the first step."""
    problem, kernels = run.problem, run.problem.kernels
    if run.steps == 0 or not kernels.densities.linear:
        return 0.0, 0.0
    force = float(run.c.cb_force_before(run.state))
    if len(problem.load_value):
        # Loads belong to the work, not to the energy; they are partial: each rank's own.
        np.multiply(kernels.v, -run.step, out=run.scratch)
        run.scratch += x
        force -= problem.load_power(run.amplitude(run.time), run.scratch)
    if kernels.constant is not None:
        # The affine part f0 acts on both positions; it is partial, as loads are.
        force += float(np.sum(kernels.constant[:-1] * x[:-1]))
    return kinetic - 0.5 * force, abs(kinetic) + 0.5 * abs(force)
