# SPDX-License-Identifier: LGPL-3.0-or-later
"""``self_action="implicit"`` where every cell has its own step."""

import numpy as np
import pytest
from dense import halves, prepared, slopes
from harness import largest
from mpi4py import MPI
from verification.step_maps import radius
from verification.stiff_bars import start
from verification.test_stiff import mode, pair

import complexbody as cb
from complexbody import meshes
from complexbody.forms import elastic_voids
from complexbody.problem import Problem
from complexbody.timesets import cell_steps

METHODS = {
    "balanced": cb.AVI(),
    "plain": cb.AVI(balanced=False),
    "real steps": cb.AVI(schedule="exact"),
    "local leapfrog": cb.LocalLeapfrog(),
}
TWO = np.r_[np.ones(12), np.full(12, 0.3)]
SCATTERED = np.random.default_rng(1).uniform(1, 4, 8)


def bar(comm, body, sizes, length=1.0, **more):
    """A bar of cells of those sizes, held at its ends in u."""
    mesh = meshes.graded_interval(comm, np.asarray(sizes) * length / np.sum(sizes))
    return cb.Scene(mesh, body, supports=[cb.Fix("u", "boundary")],
                    **({"self_action": "implicit"} | more))  # fmt: skip


@pytest.mark.parametrize("eta", (0.0, 0.3))
@pytest.mark.parametrize("name", ("balanced", "real steps", "local leapfrog"))
def test_second_order(comm, name, eta):
    """On one mesh, as all steps tend to zero, against a synchronous run with tiny ones."""
    method, until = type(METHODS[name]), 0.5
    options = {"schedule": "exact"} if name == "real steps" else {}
    scene = bar(comm, pair(eta=eta), TWO, initial=start(mode()[1]))
    h = 0.5 * prepared(scene, METHODS[name], until).critical
    exact = cb.simulate(scene, cb.Synchronous(h / 16), until=until)
    base = METHODS[name].safety
    found = []
    for part in (0.5, 0.25):
        result = cb.simulate(scene, method(safety=part * base, **options), until=until)
        found.append(largest(comm, result.u_dot.x.array - exact.u_dot.x.array))
    assert 1.6 < slopes([2, 1], found)[0] < 2.6, found


@pytest.mark.serial
@pytest.mark.parametrize("name", ("balanced", "plain"))
@pytest.mark.parametrize("eta", (0.0, 5.0))
@pytest.mark.parametrize("sizes", (TWO[8:16], SCATTERED), ids=("two", "scattered"))
def test_no_resonance_on_the_map(name, eta, sizes):
    """The window map's spectral radius is 1 for optical frequencies from the waves' to 1e4 times.

    A finer map, 17 frequencies and three couplings, showed none either.
    """
    for k0 in (1.0, 30.0, 1e3, 1e5, 1e8):
        scene = bar(MPI.COMM_SELF, pair(k0, 0.9, eta), sizes)
        assert radius(prepared(scene, METHODS[name])) < 1 + 1e-12, k0


def test_the_inertia_is_enough_for_every_cell(comm):
    """4(M + H_a²S/4) ⪰ H_K²K_K at all nodes of K; few classes of nodes."""
    rng = np.random.default_rng(5)
    body = pair(1e5, 0.9)
    problem = Problem(bar(comm, body, np.exp(rng.uniform(0, 4, 60))))
    prepared(problem.scene, METHODS["plain"])
    run = METHODS["plain"].prepare(problem, 1.0)
    problem, disc = run.problem, run.problem.disc
    H = problem.node_step[disc.dof]
    assert len(np.unique(np.round(4 * np.log2(H / H.min()), 6))) < 4 * 4 / np.log(2) + 3
    own = cell_steps(problem)
    real = disc.source_cell >= 0
    for block, lane in np.argwhere(real):
        assert H[disc.cells[block, :, lane]].min() >= own[block, lane] * (1 - 1e-9)
    inertia = problem.masses.inertia[problem.masses.classes[:-1], 0, 0]
    expected = body.inertia + H**2 / 4 * problem.self_stiffness[0, 0, 0]
    np.testing.assert_allclose(inertia, expected, rtol=1e-12)


@pytest.mark.parametrize("name", METHODS)
def test_magnesium_with_voids(comm, name):
    """Cells of 1 and 0.25 mm, steps over 1000 times the optical one; the slow wave within 1 %."""
    body, length = elastic_voids(d=1), 0.03
    c = body.constants
    q = np.pi / length
    stiff = np.array([[(c["lambda_"] + 2 * c["mu"]) * q**2, c["b"] * q],
                      [c["b"] * q, c["alpha"] * q**2 + c["xi"]]])  # fmt: skip
    # The voids follow the strain: ν = −b u'/(ξ + αq²), and the softened modulus moves ρ.
    omega = np.sqrt((stiff[0, 0] - stiff[0, 1] ** 2 / stiff[1, 1]) / body.density)
    scene = bar(comm, body, np.r_[np.ones(24), np.full(24, 0.25)], length,
                initial=start(-stiff[0, 1] / stiff[1, 1], length))  # fmt: skip
    until = 1.75 * 2 * np.pi / omega
    result = cb.simulate(scene, METHODS[name], until=until)
    assert result.stats.step > 1000 * 2 / np.sqrt(c["xi"] / body.inertia)
    assert result.stats.step > 2 * METHODS[name].safety * result.stats.critical
    # At a quarter period the error of u is that of the phase.
    assert largest(comm, result.u.x.array) < 0.01 * 2 * np.pi * 1.75


@pytest.mark.parametrize("name", METHODS)
def test_regions_damping_and_ranks(comm, name):
    """Bodies of different self-action and viscosity share nodes: bounded, and one answer."""

    def run(on):
        mesh = meshes.graded_interval(on, np.r_[np.ones(10), np.full(10, 0.2)] / 12)
        bodies = {1: pair(1e6, 0.9, 5.0, 0.1), 2: pair(10.0, 0.9, 0.0)}
        scene = cb.Scene(mesh, bodies, cell_tags=halves(mesh), self_action="implicit",
                         initial=cb.Initial(u=lambda x: np.sin(9 * x[0])))  # fmt: skip
        return cb.simulate(scene, METHODS[name], until=4.0)

    together, alone = run(comm), run(MPI.COMM_SELF)
    total = sum(together.ledger[n] for n in ("kinetic_u", "kinetic_nu", "stored"))
    assert total.max() < 1.5 * total[0]
    x = [np.round(r.scene.mesh.geometry.x[:, 0], 9) for r in (together, alone)]
    for field in ("u", "nu"):
        known = dict(zip(x[1], getattr(alone, field).x.array, strict=True))
        mine = getattr(together, field).x.array
        wrong = mine - np.array([known[p] for p in x[0]])
        assert largest(comm, wrong) < 1e-10 * max(map(abs, known.values())), field


def test_updates_saved(comm):
    """The same scene with its self-action lumped needs some hundred times the updates."""
    body = pair(1e8)
    updates = []
    for action in ("implicit", "lumped"):
        scene = bar(comm, body, TWO, initial=start(mode(1e8)[1]), self_action=action)
        result = cb.simulate(scene, cb.AVI(), until=0.1)
        updates.append(result.time_sets.updates / result.stats.step)
    assert updates[1] > 50 * updates[0]
