# SPDX-License-Identifier: LGPL-3.0-or-later
"""Asynchronous windows: resonances where they are predicted, and no growth at the defaults."""

from dataclasses import replace

import numpy as np
import pytest
from dense import prepared, state
from harness import everywhere
from mpi4py import MPI
from verification.cases import CASES, LEFT, build
from verification.step_maps import EVERYWHERE, radius
from verification.waves import pair

import complexbody as cb
from complexbody import meshes, native
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.balance import BEGIN, blending, component_rates, coupling
from complexbody.integrators.window_run import WindowRun
from complexbody.integrators.windows import divisions
from complexbody.problem import Problem
from complexbody.timesets import cell_steps

# Small meshes, scattered and graded. No AVI is stable for every mesh; these are samples.


def lines(seed, spread, grade=1.0, cells=40):
    lengths = np.exp(np.random.default_rng(seed).uniform(0, np.log(spread), cells))
    lengths = lengths * grade ** np.linspace(0, 1, cells)
    return meshes.graded_interval(MPI.COMM_SELF, lengths / lengths.sum())


def boxes(dim, cells, amount=0.0, seed=0, grade=1.0):
    """A square or cube, graded towards a corner."""
    make = meshes.rectangle if dim == 2 else meshes.box
    mesh = make(MPI.COMM_SELF, [0] * dim, [1] * dim, cells)
    if amount:
        mesh = meshes.jiggled(mesh, amount, seed)
    if grade > 1:
        x = mesh.geometry.x
        x[:, :dim] = np.expm1(np.log(grade) * x[:, :dim]) / (grade - 1)
    return mesh


SAMPLES = {
    **{f"1D, sizes in [1, 3], {s}": (lambda s=s: lines(s, 3)) for s in range(3)},
    **{f"1D, sizes in [1, 10], {s}": (lambda s=s: lines(s, 10)) for s in range(3)},
    **{f"1D, sizes in [1, 30], {s}": (lambda s=s: lines(s, 30)) for s in range(3)},
    **{f"1D, graded by {g}": (lambda g=g: lines(0, 1, g)) for g in (10, 40, 160)},
    **{f"2D, scattered, {s}": (lambda s=s: boxes(2, 8, 0.25, s)) for s in range(4)},
    **{f"2D, graded by {g}": (lambda g=g: boxes(2, 8, grade=g)) for g in (3, 9, 81)},
    **{f"2D, graded by {g}, scattered": (lambda g=g: boxes(2, 8, 0.2, g, g)) for g in (9, 27, 243)},
    **{f"3D, scattered, {s}": (lambda s=s: boxes(3, 4, 0.2, s)) for s in range(3)},
    **{f"3D, graded by {g}": (lambda g=g: boxes(3, 4, 0.15, g, g)) for g in (4, 16, 32)},
}
QUICK = ("1D, sizes in [1, 3], 0", "1D, graded by 10", "2D, scattered, 0")


# In 3D the map of the pair would have 3000 rows.
SLOW = [
    pytest.param(n, c, marks=[] if n in QUICK else pytest.mark.slow, id=f"{n}, {w}")
    for n in SAMPLES
    for c, w in ((False, "one field"), (True, "pair"))
    if not (c and n.startswith("3D"))
]


def sample(name, coupled, **options):
    """A scene of the pair, or of u alone, on one of the meshes."""
    mesh = SAMPLES[name]()
    supports = [cb.Fix("u", LEFT), cb.Fix("nu", "boundary" if coupled else EVERYWHERE)]
    return cb.Scene(mesh, pair(mesh.geometry.dim, **options), supports)


@pytest.mark.serial
@pytest.mark.parametrize("name, coupled", SLOW)
@pytest.mark.parametrize("safety", [0.45, 0.6])
def test_no_growth(name, coupled, safety):
    """Balanced windows: no mode of a linear body grows, at the default α and well above it."""
    growth = radius(prepared(sample(name, coupled), AVI(safety=safety), 1e3)) - 1
    assert growth <= 1e-10, f"{growth:.1e} per window"


@pytest.mark.serial
@pytest.mark.parametrize("safety", [0.45, 0.6])
@pytest.mark.parametrize(
    "seed, grade", [(0, 1.0), *(pytest.param(g, g, marks=pytest.mark.slow) for g in (4, 16, 32))]
)
def test_no_growth_of_pairs_in_space(seed, grade, safety):
    """The pair in 3D, on meshes small enough for its map."""
    mesh = boxes(3, 3, 0.2 if grade == 1 else 0.15, seed, grade)
    supports = [cb.Fix("u", LEFT), cb.Fix("nu", "boundary")]
    run = prepared(cb.Scene(mesh, pair(3), supports), AVI(safety=safety), 1e3)
    assert radius(run) - 1 <= 1e-10


@pytest.mark.serial
@pytest.mark.parametrize("viscosity", [0.3, 3.0, 30.0, 300.0])
@pytest.mark.parametrize("coupled", [0.0, 0.03, 0.3])
@pytest.mark.parametrize(
    "name",
    ["1D, sizes in [1, 10], 0", pytest.param("2D, scattered, 0", marks=pytest.mark.slow)],
)
def test_no_growth_damped(name, coupled, viscosity):
    """Viscosity of ν, weakly or not at all coupled to u: alternating errors of forces decay."""
    stiff = np.array([[1.0, coupled], [coupled, 0.6]])
    run = prepared(sample(name, True, viscosity=viscosity, stiff=stiff), AVI(), 1e3)
    assert radius(run) - 1 <= 1e-10
    if coupled and viscosity < 100:
        run.balance.blend[:] = 0.0
        assert radius(run) - 1 > 1e-5  # without it they grow


@pytest.mark.serial
def test_neighbours_within_two():
    """Where neighbours' steps differ by more, balanced windows may grow fast: hence grading."""
    run = prepared(sample("1D, sizes in [1, 30], 2", True), AVI(), 1e3)
    assert radius(run) - 1 <= 1e-10
    scene = sample("1D, sizes in [1, 30], 2", True)
    problem = Problem(scene)
    critical = cell_steps(problem)
    real = problem.disc.source_cell >= 0
    steps = np.zeros(problem.disc.count)
    steps[problem.disc.source_cell[real]] = 0.45 * critical[real]
    problem.arrange(divisions(steps, run.step, octaves=True))
    assert radius(WindowRun(problem, AVI(), run.step, steps)) - 1 > 0.1


@pytest.mark.parametrize("name", ["n2 plane", "n4", "n6", "quartic", "quartic line"])
def test_reversible(comm, name):
    """Back in time the way it came: held forces F are half a step on, hence 2f − F backwards."""
    case = replace(CASES[name], viscosity=(0.0,), loads=False)
    run = prepared(build(comm, case), AVI(), 10.0)
    disc, balance = run.problem.disc, run.balance
    n, record = disc.n, disc.record
    run.advance(1)
    start, held = [part.copy() for part in state(run)], balance.held.copy()
    run.advance(12)
    moved = state(run)[0] - start[0]
    # Held forces of the steps that led here: f itself comes of an event without effect.
    now, keep = balance.held.copy(), run.record.copy()
    run._together(run.time, BEGIN, 0.0)
    force = balance.held.copy()
    run.record[:] = keep
    balance.held[:] = 2 * force - now
    run.record[:, record : record + n] *= -1.0
    change = np.zeros((disc.nodes + 1, record))
    for a in range(disc.dim + 1):
        part = (balance.held - now)[:, a * n : (a + 1) * n, :]
        np.add.at(change[:, :n], disc.cells[:, a, :], part.transpose(0, 2, 1))
    disc.sum_shared(change[:-1])
    run.c.cb_accelerate(run._world, native.pointer(change))
    run.advance(12)
    fields, rates = state(run)
    assert abs(fields - start[0]).max() < 1e-10 * abs(moved).max()
    assert abs(rates + start[1]).max() < 1e-10 * abs(start[1]).max()
    apart, size = (abs(a).max(initial=0) for a in (balance.held - held, held))
    assert everywhere(comm, apart > 1e-3 * size)


@pytest.mark.serial
@pytest.mark.parametrize("name", ["n4", "quartic", "quartic line"])
def test_energy(comm, name):
    """Energy neither drifts nor wanders over thousands of windows, from rough data."""
    case = replace(CASES[name], viscosity=(0.0,), loads=False)
    run = prepared(build(comm, case), AVI(), 1e3)
    energies = []
    for _ in range(60):
        run.advance(50)
        e = run.entries()
        energies.append(e.kinetic_u + e.kinetic_nu + e.stored + e.potential)
    energies = np.array(energies) / energies[0] - 1
    assert abs(energies).max() < 0.08
    assert abs(energies[:30].mean() - energies[30:].mean()) < 0.01


def test_blending():
    """k = min(1, hη/ρ̄), and C²z/(1 + z²) of what a component is coupled to."""
    coupled = np.array([[0.0, 0.1, 0.0], [0.1, 0.0, 0.5], [0.0, 0.5, 0.0]])
    rates = np.array([0.0, 2.0, 0.0])
    assert blending(rates, coupled, 0.1) == pytest.approx([0.1 * 0.2 / 1.04, 0.2, 0.5 * 0.2 / 1.04])
    assert blending(np.array([0.0, np.inf, 3.0]), coupled, 1.0) == pytest.approx([0.0, 1.0, 1.0])
    scene = cb.Scene(lines(0, 3), pair(1, 2.0))
    problem = Problem(scene)
    assert coupling(problem, 0) == pytest.approx(np.array([[0, 0.15], [0.15, 0]]))
    assert component_rates(problem, 0) == pytest.approx([0.0, 2.0])
