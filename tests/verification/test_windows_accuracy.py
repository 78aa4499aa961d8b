# SPDX-License-Identifier: LGPL-3.0-or-later
"""Asynchronous windows are as accurate as told: under refinement, and as steps go to zero."""


import numpy as np
import pytest
from dense import prepared, slopes, state
from mpi4py import MPI
from verification.cases import Case, build, graded, reference
from verification.waves import SIDES, mode_error, pair, semidiscrete

import complexbody as cb
from complexbody import meshes
from complexbody.integrators.asynchronous import AVI


@pytest.mark.serial
@pytest.mark.parametrize("viscosity", [0.0, 2.0])
@pytest.mark.parametrize(
    "dim, sizes, until, best",
    [
        (1, (25, 50, 100, 200), 3.0, 1.95),
        (2, (10, 20, 40, 80), 1.3, 0.85),
        (3, (4, 8, 16), 1.3, 1.3),
    ],
)
def test_refinement_at_fixed_safety(comm, dim, sizes, until, best, viscosity):
    """Balanced windows are as accurate as one step for all, in both norms; plain ones are not.

    ``best`` is the order in the energy norm that one step has: interpolation's, but for 1D and
    meshes as coarse as in 3D.
    """
    methods = {"one step": cb.Synchronous(), "plain": AVI(balanced=False), "balanced": AVI()}
    errors = {name: [] for name in methods}
    for size in sizes:
        for name, method in methods.items():
            if dim == 1:
                lengths = np.random.default_rng(size).uniform(1, 3, size)
                mesh = meshes.graded_interval(comm, lengths / lengths.sum())
            elif dim == 2:
                mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 1), size), 0.25, 3)
            else:
                mesh = meshes.jiggled(meshes.box(comm, [0] * 3, [1] * 3, size), 0.2, 3)
            initial = cb.Initial(
                *(lambda x, a=a: a * np.prod(np.sin(np.pi * x[:dim]), axis=0) for a in (1.0, 0.5))
            )
            run = prepared(cb.Scene(mesh, pair(dim, viscosity), SIDES, (), initial), method, until)
            run.advance(round(until / run.step))
            errors[name].append(mode_error(run, viscosity))
    errors = {name: np.array(found) for name, found in errors.items()}
    told = f"{errors}"
    slope, alone = (np.log2(errors[n][-2] / errors[n][-1]) for n in ("balanced", "one step"))
    assert slope[0] >= min(1.95, alone[0] - 0.03) and slope[1] >= best, f"{slope} {alone} {told}"
    assert np.all(errors["balanced"] <= 1.3 * errors["one step"]), told
    if dim < 3:
        assert errors["plain"][-1, 0] > 0.5 * errors["plain"][-2, 0], told
        assert np.all(errors["plain"][-1] > np.array([3, 1.5]) * errors["balanced"][-1]), told


@pytest.mark.serial
@pytest.mark.parametrize("scheme, balanced, order", [
    ("exact", False, 2), ("symmetric", False, 2), ("forward", False, 1), ("exact", True, 2),
])  # fmt: skip
def test_steps_to_zero(scheme, balanced, order):
    """Theorem "main": on one mesh, T_Θ → 0, (u, ν) converge uniformly and their rates in L^p.

    Rates are those of the paper, constant between a node's kicks: order 1, or 2 at window ends.
    The solution of (ddAL) is a matrix exponential.
    """
    case = Case(1, 1, 1, (0.8,), (1.7,), potential=True)
    mesh = graded(MPI.COMM_SELF, 1, 6, seed=4)
    errors, steps, until = [], [], 0.7
    for safety in (0.2, 0.1, 0.05):
        method = AVI(dissipation=scheme, balanced=balanced, safety=safety)
        run = prepared(build(MPI.COMM_SELF, case, mesh), method, until)
        plain = reference(run, case)
        solve = semidiscrete(plain)
        plain.log, ends = [], []
        for _ in range(round(until / run.step)):
            run.advance(1)
            plain.advance(1)
            exact = solve(run.time)
            ends.append([abs(a - b).max() for a, b in zip(state(run), exact, strict=True)])
        assert abs(state(run)[0] - plain.q).max() < 1e-10
        nodal = [abs(solve(t1)[0][a] - q).max() for a, _, t1, q, _ in plain.log]
        size = np.array([t1 - t0 for _, t0, t1, _, _ in plain.log])
        rough = np.array([solve((t0 + t1) / 2)[1][a] - v for a, t0, t1, _, v in plain.log])
        powers = [(size @ (abs(rough) ** p).sum(axis=1)) ** (1 / p) for p in (1, 2, 8)]
        errors.append([*np.max(ends, axis=0), max(nodal), *powers])
        steps.append(run.step)
    measured = slopes(np.array(steps)[:, None], np.array(errors))
    assert np.all(np.diff(errors, axis=0) < 0), errors
    wanted = [order, order, order, 1, 1, 1]
    assert np.all(measured[-1] > np.array(wanted) - 0.13), (measured, errors)
