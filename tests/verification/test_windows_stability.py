# SPDX-License-Identifier: LGPL-3.0-or-later
"""Asynchronous windows: resonances where they are predicted, and no growth at the defaults."""

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from dense import halves, prepared, state
from harness import everywhere
from mpi4py import MPI
from verification.cases import CASES, LEFT, build, divisions_of
from verification.waves import pair

import complexbody as cb
from complexbody import _compat, meshes, native
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.balance import BEGIN, blending, component_rates, coupling
from complexbody.integrators.window_run import WindowRun
from complexbody.integrators.windows import divisions
from complexbody.problem import Problem
from complexbody.timesets import cell_steps


def window_map(run):
    """The matrix of one window on (q, q̇) of the free components and, balanced, the held forces.

    A cell's forces are those of some displacement of its nodes: of all others it never holds any.
    """
    problem, balance = run.problem, run.balance
    if run.activity is not None:
        run.activity.stop()  # cells at rest are set moving by hand
    disc, n, record = problem.disc, problem.disc.n, problem.disc.record
    rows, columns = np.nonzero(~problem.masses.fixed[problem.masses.classes[:-1]])
    size, held = len(rows), []
    if balance is not None:
        for block, lane in np.argwhere(disc.source_cell >= 0):
            held += [(block, lane, basis) for basis in force_basis(run, block, lane)]

    def put(q, v, F):
        run.record[:-1, :n] = run.record[:-1, record : record + n] = 0.0
        run.record[rows, columns], run.record[rows, record + columns] = q, v
        run.record[:, run._time] = run.time
        if balance is not None:
            balance.held[:], total = 0.0, np.zeros((disc.nodes + 1, record))
            run.record[:-1, 2 * record : 2 * record + n] = 0.0
            for (block, lane, basis), part in zip(held, F, strict=True):
                if part:
                    balance.held[block, :, lane] += part * basis
                    np.add.at(total[:, :n], disc.cells[block, :, lane], part * basis.reshape(-1, n))
            run.c.cb_accelerate(run._world, native.pointer(total), *run._all)

    out = np.zeros((2 * size + len(held),) * 2)
    for j, unit in enumerate(np.eye(len(out))):
        run.steps = 1
        put(unit[:size], unit[size : 2 * size], unit[2 * size :])
        run.advance(1)
        out[:size, j] = run.record[rows, columns]
        out[size : 2 * size, j] = run.record[rows, record + columns]
        out[2 * size :, j] = [balance.held[m, :, lane] @ basis for m, lane, basis in held]
    return out


def force_basis(run, block, lane):
    """Orthonormal forces that a cell can hold, shape (rank, (d+1)·n)."""
    disc, balance, rows = run.problem.disc, run.balance, []
    nodes, n = disc.cells[block, :, lane], disc.n
    group = next(i for i in range(run.plan.count) if block < run.plan.groups[i].last)
    for a, i in itertools.product(nodes, range(n)):
        run.record[:-1, :n] = 0.0
        run.record[a, i] = 1.0
        run.record[:, run._time] = run.time
        run._together(run.time, BEGIN, first=group, last=group + 1)
        rows.append(balance.held[block, :, lane].copy())
    values, basis = np.linalg.svd(rows)[1:]
    return basis[: np.count_nonzero(values > 1e-10 * values[0])]


def radius(run):
    """Spectral radius of the window map."""
    return abs(np.linalg.eigvals(window_map(run))).max()


EVERYWHERE = lambda x: x[0] > -1  # noqa: E731


def string(lengths, stiffness=(1.0,), where="boundary", viscosity=0.0):
    """ν alone on an interval, ρ̄ = 1, stiffness per half; u is held."""

    def body(a):
        def energy(U, nu, N):
            return 1e-4 * U[0, 0] ** 2 + 0.5 * a * N[0, 0] ** 2

        return cb.Body(1, energy, 1.0, 1.0, viscosity, displacement=1)

    mesh = meshes.graded_interval(MPI.COMM_SELF, lengths)
    supports = [cb.Fix("nu", where), cb.Fix("u", EVERYWHERE)]
    if len(stiffness) == 1:
        return cb.Scene(mesh, body(stiffness[0]), supports)
    bodies = {tag: body(a) for tag, a in zip((1, 2), stiffness, strict=True)}
    return cb.Scene(mesh, bodies, supports, cell_tags=halves(mesh, 0.5 * sum(lengths)))


BANDS = [(2, [(1.155, 1.414)]), (3, [(0.902, 1.0), (1.581, 1.732)])]


@pytest.mark.serial
@pytest.mark.parametrize("ratio, bands", BANDS)
def test_two_springs(ratio, bands):
    """PHYSICS "Where methods fail" 1: the resonance of two springs, at its predicted rate."""
    found = []
    for omega in np.linspace(0.8, 1.75, 39):
        # Two cells of length 1 around a mass 1: k₂ = 1, k₁ = 1/n², critical steps n and 1.
        scene = string([1.0, 1.0], (1.0 / ratio**2, 1.0))
        window = ratio * omega
        run = prepared(scene, AVI(safety=omega, balanced=False), window)
        assert run.step == pytest.approx(window) and sorted(divisions_of(run)) == [1, ratio]
        matrix = window_map(run)
        theta = 2 * np.arcsin(omega / 2)
        c = window * omega / ratio**2 / np.sin(theta)
        trace = 2 * np.cos(ratio * theta) - c * np.sin(ratio * theta)
        assert np.trace(matrix) == pytest.approx(trace, abs=1e-12)
        predicted = abs(np.roots([1, -trace, 1])).max()
        growth = abs(np.linalg.eigvals(matrix)).max()
        assert growth == pytest.approx(predicted, abs=1e-7)
        found.append((omega, growth))
        if growth > 1.05:
            rows = np.array([np.linalg.matrix_power(matrix, k) @ [1.0, 0.3] for k in (50, 51)])
            first, second = np.linalg.norm(rows, axis=1)
            assert second / first == pytest.approx(growth, rel=0.02)
    for omega, growth in found:
        distance = min(abs(omega - end) for band in bands for end in band)
        if distance > 2e-3:
            inside = any(low < omega < high for low, high in bands)
            assert (growth > 1 + 1e-6) == inside, (omega, growth)


def two_rates(ratio, safety, viscosity=0.0):
    """10 + 10 cells of lengths ``ratio`` to 1, c = 1, h_K = α L_K, plain windows; left end held."""
    ratio = Fraction(ratio)
    length = 1 / (10 + 10 * ratio)
    lengths = [float(ratio * length)] * 10 + [float(length)] * 10
    problem = Problem(string(lengths, where=LEFT, viscosity=viscosity))
    corner = problem.scene.mesh.geometry.x[_compat.cell_nodes(problem.scene.mesh), 0].min(axis=1)
    coarse = corner < float(10 * ratio * length) - 1e-9
    problem.arrange(np.where(coarse, ratio.denominator, ratio.numerator))
    window = safety * float(ratio * length) * ratio.denominator
    return WindowRun(problem, AVI(balanced=False), window, 1.0)


@pytest.mark.serial
@pytest.mark.parametrize("ratio, first", [("2", 0.726), ("3", 0.56), ("4", 0.467), ("3/2", 0.513)])
def test_two_rate_bar(ratio, first):
    """PHYSICS "Where methods fail" 2: the first α that fails, none at 0.45, damping cures."""
    growth = {a: radius(two_rates(ratio, a)) for a in (0.45, *(first + 2.5e-4 * np.arange(-3, 4)))}
    assert growth.pop(0.45) < 1 + 1e-9
    worst = max(growth, key=growth.get)
    assert 1 + 2e-4 < growth[worst] < 1 + 2e-3, growth
    run = two_rates(ratio, worst)
    # A run grows so: by e^(rate t), once the mode that does has left the others behind.
    run.record[:-1, 1] = np.random.default_rng(1).normal(size=run.problem.disc.nodes)
    run.record[:-1, 1] *= ~run.problem.masses.fixed[run.problem.masses.classes[:-1], 1]
    windows, norms = round(12 / (growth[worst] - 1)), []
    for _ in range(2):
        run.advance(windows)
        norms.append(np.linalg.norm(run.sample()[0][:-1, 1]))
    measured = (norms[1] / norms[0]) ** (1 / windows)
    assert measured - 1 == pytest.approx(growth[worst] - 1, rel=0.15)
    rate = (growth[worst] - 1) / run.step
    assert radius(two_rates(ratio, worst, viscosity=2.5 * rate)) < 1


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
    run.c.cb_accelerate(run._world, native.pointer(change), *run._all)
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
