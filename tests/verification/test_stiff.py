# SPDX-License-Identifier: LGPL-3.0-or-later
"""``self_action="implicit"``: steps of gradients alone, whatever the self-action."""

import dolfinx
import numpy as np
import pytest
import scipy.linalg
import ufl
from harness import largest, refused
from verification.step_maps import stiffness
from verification.stiff_bars import bar, start

import complexbody as cb
from complexbody.errors import CoercivityError, IntegratorError, SceneError
from complexbody.forms import elastic_voids
from complexbody.problem import Problem
from complexbody.timesets import critical_step


def pair(k0=4.0, c=0.7, eta=0.0, rho=0.5):
    """½(u'² + ½ν'² + k0ν²) + c√k0 u'ν: coupled to a gradient, coercive for c < 1."""
    return cb.Body(
        1, lambda U, nu, N: 0.5 * ufl.inner(U, U) + 0.25 * ufl.inner(N, N)
        + 0.5 * k0 * nu[0] ** 2 + c * np.sqrt(k0) * U[0, 0] * nu[0], 1.0, rho, eta, displacement=1,
    )  # fmt: skip


def mode(k0=4.0, c=0.7, rho=0.5, q=np.pi):
    """Slow frequency and ν's share of u ∝ sin qx, ν ∝ cos qx."""
    stiff = np.array([[q**2, c * np.sqrt(k0) * q], [c * np.sqrt(k0) * q, 0.5 * q**2 + k0]])
    values, vectors = scipy.linalg.eigh(stiff, np.diag([1.0, rho]))
    return np.sqrt(values[0]), vectors[1, 0] / vectors[0, 0]


def test_second_order(comm):
    """On a mesh that stays the same, against a run with steps 8 times smaller."""
    _, share = mode()
    make = lambda: bar(comm, pair(eta=0.3), initial=start(share))  # noqa: E731
    fine = cb.simulate(make(), cb.Synchronous(0.001), until=1.0)
    found = []
    for h in (0.016, 0.008):
        result = cb.simulate(make(), cb.Synchronous(h), until=0.96)
        exact = cb.simulate(make(), cb.Synchronous(0.001), until=0.96)
        found.append(largest(comm, result.nu.x.array - exact.nu.x.array))
        assert np.abs(result.ledger["identity"]).max() < 1e-11
    assert fine.time == 1.0
    assert 1.85 < np.log2(found[0] / found[1]) < 2.15, found


@pytest.mark.serial
@pytest.mark.parametrize("k0", (1.0, 1e2, 1e4, 1e8))
def test_stable_at_the_gradient_step_without_resonance(comm, k0):
    """4M + h²S − h²K ⪰ 0 of the assembled matrices up to the step, for any ratio of frequencies."""
    problem = Problem(bar(comm, pair(k0, 0.95), 12))
    step = critical_step(problem)
    soft = critical_step(Problem(bar(comm, pair(1e-3, 0.0), 12)))
    assert step > 0.8 * soft
    problem.stiffen(step)
    K, disc = stiffness(problem), problem.disc
    masses = problem.masses
    rho = np.column_stack([masses.density, masses.inertia[:, 0, 0]])[masses.classes[:-1]]
    M = np.diag((rho * disc.volume[:, None]).ravel())
    values = scipy.linalg.eigh(K, M, eigvals_only=True)
    # Leapfrog's amplification is on the unit circle for all eigenvalues in [0, 4/h²].
    assert values.min() > -1e-9 * values.max()
    assert step**2 * values.max() <= 4 * (1 + 1e-9)


def test_two_regions_and_damping_stay_stable(comm):
    """Bodies of different self-action and viscosity share nodes; 500 steps at the default step."""
    mesh = dolfinx.mesh.create_interval(comm, 20, [0.0, 1.0])
    cells = np.arange(mesh.topology.index_map(1).size_local, dtype=np.int32)
    left = dolfinx.mesh.compute_midpoints(mesh, 1, cells)[:, 0] < 0.5
    tags = dolfinx.mesh.meshtags(mesh, 1, cells, np.where(left, 1, 2).astype(np.int32))
    bodies = {1: pair(1e6, 0.9, 5.0, 0.1), 2: pair(10.0, 0.9, 0.0)}
    scene = cb.Scene(mesh, bodies, cell_tags=tags, self_action="implicit",
                     initial=cb.Initial(u=lambda x: np.sin(9 * x[0])))  # fmt: skip
    result = cb.simulate(scene, until=10.0, ledger_steps=1)
    total = sum(result.ledger[n] for n in ("kinetic_u", "kinetic_nu", "stored"))
    assert result.stats.steps > 200 and total.max() < 1.5 * total[0]
    assert np.abs(result.ledger["identity"]).max() < 1e-11


def test_refusals(comm):
    """Integrators and energies that cannot take it; constants that no coercive body has."""
    scene = bar(comm, pair())
    for method in (cb.Implicit(solve="always"), cb.Synchronous(critical="global")):
        with refused(IntegratorError, "self_action='implicit'", "Synchronous"):
            cb.simulate(scene, method, until=1.0)
    quartic = cb.Body(1, lambda U, nu, N: ufl.inner(U, U) + ufl.inner(N, N) + nu[0] ** 4, 1.0, 1.0,
                      displacement=1)  # fmt: skip
    with refused(SceneError, "self_action='implicit'", "quadratic"):
        cb.simulate(bar(comm, quartic), until=1.0)
    bulk = 2.17e10 + 2 * 3.278e10 / 3
    limit = np.sqrt(bulk * 1.475e10)
    elastic_voids(b=limit * (1 - 1e-9))
    with refused(CoercivityError, "b**2"):
        elastic_voids(b=limit * (1 + 1e-9))
    for name in ("mu", "alpha", "xi"):
        with refused(CoercivityError, f"{name} > 0"):
            elastic_voids(**{name: 0.0})
