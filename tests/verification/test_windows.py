# SPDX-License-Identifier: LGPL-3.0-or-later
"""Asynchronous windows: equal to a slow reference to round-off, then accurate and stable as told.

The reference (windows_reference.py) is the paper's recursion with a heap of events, in numpy.
"""

import itertools
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest
import scipy.linalg
import scipy.spatial
from dense import halves, prepared, quadratic, random_hessian, slopes, state, whole
from dolfinx import fem
from harness import everywhere
from mpi4py import MPI
from verification.windows_reference import Quadratic, Quartic, Windows

import complexbody as cb
from complexbody import _compat, meshes, native
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.balance import BEGIN, blending, component_rates, coupling
from complexbody.integrators.window_run import WindowRun
from complexbody.integrators.windows import divisions
from complexbody.problem import Problem
from complexbody.timesets import cell_steps, critical_step

SCHEMES = ("exact", "symmetric", "forward")
LEFT, RIGHT = (lambda x: x[0] < 1e-9), (lambda x: x[0] > 1 - 1e-9)
QUARTIC = (2.0, 0.7, 0.3)


# --- random bodies on random meshes, for both ----------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A scene that a run and the reference can both be made of."""

    dim: int = 1
    n_u: int = 1
    k: int = 1
    inertia: tuple = (0.8,)  # per region
    viscosity: tuple = (0.0,)
    lumped: bool = False
    quartic: tuple = (False, False)  # per region
    varying: bool = False  # DG0 factor of the energy, DG0 density
    potential: bool = False
    supports: str = "fixed"
    loads: bool = False

    @property
    def n(self):
        """Components."""
        return self.n_u + self.k


def graded(comm, dim, cells=None, amount=0.2, pull=2.0, seed=0):
    """Scattered vertices, and cells that grow along x by a factor of e^pull."""
    if dim == 1:
        sizes = np.random.default_rng(seed).uniform(1, 3.5, cells or 13)
        return meshes.graded_interval(comm, sizes / sizes.sum())
    cells = cells or ((5, 3) if dim == 2 else (4, 2, 2))
    make = meshes.rectangle if dim == 2 else meshes.box
    mesh = meshes.jiggled(make(comm, [0] * dim, [1] * dim, cells), amount, seed)
    x = mesh.geometry.x
    x[:, 0] = np.expm1(pull * x[:, 0]) / np.expm1(pull)
    return mesh


def wave(n, seed, size=1.0):
    """A smooth field of n components as a callable of x."""
    a = size * np.random.default_rng(seed).normal(size=(2, n, 1))
    return lambda x: np.sin(3 * x[:1] + 2 * x[1:2] + a[0]) * a[1] + 0.2 * size * x[1:2]


def factor(x):
    return 1 + 0.4 * np.sin(5 * x[0])


def heaviness(x):
    return 1.5 + np.cos(4 * x[0])


def cellwise(mesh, function):
    out = fem.Function(_compat.cell_space(mesh))
    out.interpolate(lambda x: function(x))
    return out


def parts(case, r):
    """Numbers of region r: H of the energy, C and l of the potential."""
    H = random_hessian(7 * r + 10 * case.n + case.dim, case.n_u, case.k, case.dim)
    rng = np.random.default_rng(100 + r)
    C = rng.normal(size=(case.n, case.n))
    return H, 0.3 * C @ C.T, rng.normal(size=case.n)


def matrix(value, k):
    return np.asarray(value, float) * (np.eye(k) if np.ndim(value) == 0 else 1)


HISTORY = {"ramp": cb.ramp(0.8), "sine": cb.sine(0.7, 0.4)}


def build(comm, case, mesh=None):
    """The scene."""
    mesh = graded(comm, case.dim) if mesh is None else mesh
    stiff, rho = cellwise(mesh, factor), cellwise(mesh, heaviness)
    bodies = []
    for r, (inertia, viscosity) in enumerate(zip(case.inertia, case.viscosity, strict=True)):
        H, C, l = parts(case, r)  # noqa: E741

        def energy(U, nu, N, r=r, base=quadratic(H, case.dim)):
            value = base(U, nu, N)
            if case.quartic[r]:
                b, c, s = QUARTIC
                value += b / 4 * nu[0] ** 4 + c * nu[0] ** 2 * U[0, 0] + s / 4 * U[0, 0] ** 4
            return stiff * value if case.varying else value

        def potential(u, nu, C=C, l=l):  # noqa: E741
            q = [u[i] for i in range(case.n_u)] + [nu[i] for i in range(case.k)]
            pairs = itertools.product(range(case.n), repeat=2)
            square = sum(0.5 * float(C[i, j]) * q[i] * q[j] for i, j in pairs)
            return square + sum(float(l[i]) * q[i] for i in range(case.n))

        bodies.append(
            cb.Body(
                case.k, energy, rho if case.varying else 1.5 - 0.4 * r, inertia, viscosity,
                potential if case.potential else None, case.n_u,
            )
        )  # fmt: skip
    body = {"body": bodies[0]}
    if len(bodies) > 1:
        body = {"body": {1: bodies[0], 2: bodies[1]}, "cell_tags": halves(mesh)}
    supports, loads = [], []
    if case.supports == "fixed":
        supports = [cb.Fix("u", LEFT), cb.Fix("nu", RIGHT)]
    if case.supports == "partial":
        supports = [cb.Fix("u", LEFT, components=0), cb.Fix("nu", LEFT, 0.2, components=0)]
        supports.append(cb.Fix("nu", RIGHT, components=case.k - 1))
    if case.supports == "moving":
        supports = [
            cb.Fix("u", LEFT, 0.3 + np.arange(case.n_u), history=HISTORY["ramp"]),
            cb.Fix("nu", RIGHT, 0.4, components=0, history=HISTORY["sine"]),
        ]
    if case.loads:
        loads = [
            cb.BodyForce(0.7 + np.arange(case.n_u), HISTORY["sine"]),
            cb.BodyForce(-0.4 * np.ones(case.k), field="nu"),
            cb.Traction(RIGHT, 0.5 - np.arange(case.n_u), HISTORY["ramp"]),
        ]
    size = 0.4 if any(case.quartic) else 1.0  # the step is that of the initial state
    initial = cb.Initial(*(wave(n, s, size) for s, n in enumerate((case.n_u, case.k) * 2)))
    action = "lumped" if case.lumped else "consistent"
    return cb.Scene(mesh, supports=supports, loads=loads, initial=initial, self_action=action, **body)


def divisions_of(run):
    """N_K of all cells, in the order of ``whole``."""
    disc = run.problem.disc
    real = disc.source_cell >= 0
    out = np.zeros(real.sum(), int)
    out[disc.source_cell[real]] = np.broadcast_to(disc.group[:, None], real.shape)[real]
    return np.concatenate(disc.comm.allgather(out))


def blend_of(run):
    """k of all cells and components, in the order of ``whole``; what it should be is another test."""
    disc, balance = run.problem.disc, run.balance
    if balance is None:
        return None
    out = np.zeros((disc.count, disc.n))
    for i in range(run.plan.count):
        cells = disc.source_cell[run.plan.groups[i].first : run.plan.groups[i].last]
        out[cells[cells >= 0]] = balance.blend[i, : disc.n]
    return np.concatenate(disc.comm.allgather(out))


def traction_nodes(points, cells):
    """∫N_a over the side x = 1."""
    out, dim = np.zeros(len(points)), points.shape[1]
    for c in cells:
        side = c[points[c, 0] > 1 - 1e-9]
        if len(side) == dim:
            edges = points[side[1:]] - points[side[:1]]
            size = np.sqrt(np.linalg.det(edges @ edges.T)) if dim > 1 else 1.0
            out[side] += size / max(dim - 1, 1) / dim
    return out


def reference(run, case, make=None):
    """The same scene for the reference, windows by default; ``make`` is given what it is made of."""
    method, mesh = run.method, run.problem.scene.mesh
    points, cells = whole(mesh)
    x = np.pad(points, ((0, 0), (0, 3 - case.dim))).T
    n, n_u, k, nd = case.n, case.n_u, case.k, case.n * case.dim
    potentials, masses, viscosities = [], [], []
    for c in cells:
        corners = points[c]
        r = 0 if len(case.inertia) == 1 or (corners[:, 0] < 0.5 + 1e-9).all() else 1
        middle = np.pad(corners.mean(axis=0), (0, 3 - case.dim))
        energy, C, l = parts(case, r)  # noqa: E741
        scale = factor(middle) if case.varying else 1.0
        H, ix = np.zeros((nd + n, nd + n)), np.r_[:nd, nd + n_u : nd + n]
        H[np.ix_(ix, ix)] = scale * energy
        linear = np.zeros(nd + n)
        if case.potential:
            H[nd:, nd:] += C
            linear[nd:] = l
        if case.quartic[r]:
            potentials.append(Quartic(corners, H, n, n_u, scale * np.array(QUARTIC)))
        else:
            potentials.append(Quadratic(corners, H, linear, n, case.lumped))
        rho = heaviness(middle) if case.varying else 1.5 - 0.4 * r
        M, D = rho * np.eye(n), np.zeros((n, n))
        M[n_u:, n_u:] = matrix(case.inertia[r], k)
        D[n_u:, n_u:] = matrix(case.viscosity[r], k)
        masses.append(M)
        viscosities.append(D)
    fixed, value, history = np.zeros((len(points), n), bool), np.zeros((len(points), n)), {}
    left, right = LEFT(x)[:, None], RIGHT(x)[:, None]
    if case.supports == "fixed":
        fixed[:, :n_u], fixed[:, n_u:] = left, right
    if case.supports == "partial":
        fixed[:, :1], fixed[:, n_u : n_u + 1] = left, left
        value[:, n_u : n_u + 1] = 0.2 * left
        fixed[:, -1:] |= right
    if case.supports == "moving":
        fixed[:, :n_u], fixed[:, n_u : n_u + 1] = left, right
        value[:, :n_u] = left * (0.3 + np.arange(n_u))
        value[:, n_u : n_u + 1] = 0.4 * right
        history = {"ramp": slice(0, n_u), "sine": slice(n_u, n)}

    def targets(t):
        out = value.copy()
        for name, columns in history.items():
            out[:, columns] *= float(HISTORY[name](t))
        return out

    size = 0.4 if any(case.quartic) else 1.0
    given = [wave(m, s, size)(x).T for s, m in enumerate((n_u, k) * 2)]
    q, rates = np.hstack(given[:2]), np.hstack(given[2:])
    given = {
        "cells": cells, "potentials": potentials, "window": run.step, "masses": masses,
        "viscosities": viscosities, "q": q, "rates": rates, "fixed": fixed, "targets": targets,
        "scheme": method.dissipation,
    }  # fmt: skip
    out = make(**given) if make else Windows(
        divisions=divisions_of(run), balanced=method.balanced, blend=blend_of(run),
        start=method.start, **given,
    )  # fmt: skip
    if case.loads:
        side, zero = traction_nodes(points, cells), np.zeros((len(points), n))
        for weight, columns, vector, name in (
            (out.volume, slice(0, n_u), 0.7 + np.arange(n_u), "sine"),
            (out.volume, slice(n_u, n), -0.4 * np.ones(k), None),
            (side, slice(0, n_u), 0.5 - np.arange(n_u), "ramp"),
        ):
            force = zero.copy()
            force[:, columns] = np.outer(weight, vector)
            history_of = HISTORY[name] if name else (lambda t: 1.0)
            out.loads.append((force, history_of))
    return out


def compare(run, plain, windows, tolerance=1e-11):
    """Largest relative difference of positions and rates, at the end of every window."""
    worst, scales = np.zeros(2), np.zeros(2)
    for _ in range(windows):
        run.advance(1)
        plain.advance(1)
        expected = (plain.q, plain.rates())
        scales = np.maximum(scales, [abs(e).max() for e in expected])
        found = [abs(a - b).max() for a, b in zip(state(run), expected, strict=True)]
        worst = np.maximum(worst, found / scales)
        assert np.isfinite([*scales, *run.sums]).all() and worst.max() < tolerance, f"{worst}, window {plain.count}"
    return worst


OMEGA = np.array([[1.3, 0.4], [0.4, 0.7]])
ETA = np.array([[0.5, -0.3], [-0.3, 2.0]])
CASES = {
    "n2": Case(1, 1, 1, supports="none"),
    "n2 lumped": Case(1, 1, 1, (0.8,), (1.7,), lumped=True, loads=True, supports="moving"),
    "n2 plane": Case(2, 1, 1, (0.8,), (1.7,), potential=True),
    "n3": Case(1, 2, 1, (0.8,), (0.9,), supports="moving", loads=True),
    "n4": Case(2, 2, 2, (0.8,), (1.7,), lumped=True),
    "n4 partial": Case(2, 2, 2, (0.8,), (1.7,), supports="partial"),
    "n4 moving": Case(2, 2, 2, (0.8,), (1.7,), supports="moving", loads=True),
    "n4 unequal rates": Case(2, 2, 2, (np.diag([0.6, 1.1]),), (np.diag([0.0, 2.0]),)),
    "n4 blocks": Case(2, 2, 2, (OMEGA,), (ETA,), loads=True),
    "n4 no inertia": Case(1, 2, 2, (0.0,), (np.diag([1.0, 2.0]),), loads=True),
    "n4 half of it": Case(1, 2, 2, (np.diag([0.9, 0.0]),), (np.diag([0.4, 1.5]),)),
    "n6": Case(3, 3, 3, (0.8,), (0.0,), varying=True),
    "n6 regions": Case(2, 3, 3, (0.8, 1.1), (0.6, 0.0), loads=True, potential=True),
    "n7": Case(1, 3, 4, (0.8,), (0.5,), supports="moving"),
    "n8": Case(3, 3, 5, (0.8,), (1.2,), supports="none"),
    "n9": Case(2, 3, 6, (0.8,), (1.2,), supports="partial", varying=True),
    "quartic": Case(2, 2, 1, (0.8,), (0.7,), quartic=(True,), varying=True),
    "quartic region": Case(2, 2, 2, (0.8, 1.1), (0.6, 0.2), quartic=(True, False)),
    "quartic line": Case(1, 1, 2, (0.8,), (0.0,), quartic=(True,), potential=False, loads=True),
}


def schemes(case):
    damped = any(np.any(v) for v in case.viscosity)
    singular = any(np.linalg.matrix_rank(matrix(i, case.k)) < case.k for i in case.inertia)
    return [s for s in SCHEMES if (damped or s == "exact") and not (singular and s == "symmetric")]


@pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])
@pytest.mark.parametrize("name, scheme", [(n, s) for n, c in CASES.items() for s in schemes(c)])
def test_trajectories(comm, name, scheme, balanced):
    """Fields and rates at the end of every window."""
    case = CASES[name]
    run = prepared(build(comm, case), AVI(dissipation=scheme, balanced=balanced), 10.0)
    plain = reference(run, case)
    counts = set(plain.divisions.tolist())
    assert len(counts) > 1 + (not balanced) and min(counts) <= 2, counts
    compare(run, plain, 5)


@pytest.mark.parametrize("name, scheme", [(n, schemes(CASES[n])[-1]) for n in CASES])
def test_one_sided(comm, name, scheme):
    """The paper's start on windows: whole kicks at their starts, none at their ends."""
    run = prepared(build(comm, CASES[name]), AVI(dissipation=scheme, start="one-sided"), 10.0)
    assert not run.method.balanced
    plain, cells = reference(run, CASES[name]), len(divisions_of(run))
    compare(run, plain, 4)
    assert comm.allreduce(run.updates) == 4 * plain.divisions.sum() >= 4 * cells


@pytest.mark.parametrize("lanes", [4, 8])
@pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])
@pytest.mark.parametrize("name", ["n2 lumped", "n3", "n4 blocks", "n6", "quartic region"])
def test_lanes(comm, monkeypatch, name, balanced, lanes):
    """Every width of vectors gives the same."""
    monkeypatch.setattr(native, "lanes", lambda: lanes)
    case = CASES[name]
    run = prepared(build(comm, case), AVI(balanced=balanced), 10.0)
    assert run.problem.disc.lanes == lanes
    compare(run, reference(run, case), 3)


@pytest.mark.parametrize("safety", [0.3, 0.45, 0.6])
@pytest.mark.parametrize("schedule", ["windows", "octaves"])
def test_options(comm, schedule, safety):
    """N_K = ⌈W/(α h_K)⌉; octaves: a power of two, no larger than it or half a neighbour's asks for."""
    case = CASES["n4 unequal rates"]
    scene = build(comm, case, graded(comm, 2, (7, 3), amount=0.35, pull=3.0))
    run = prepared(scene, AVI(schedule=schedule, safety=safety), 10.0)
    assert run.method.balanced == (schedule == "octaves")
    disc, critical = run.problem.disc, cell_steps(run.problem)
    real = disc.source_cell >= 0
    allowed, group = safety * critical[real], np.repeat(disc.group, disc.lanes)[real.ravel()]
    longest = comm.allreduce(allowed.max(initial=0), MPI.MAX)
    assert run.step == pytest.approx(10.0 / np.ceil(10.0 / longest))
    counts = np.ceil(run.step / allowed * (1 - 1e-9))
    if schedule == "windows":
        assert np.all((group == counts) | (counts > 16)) and np.all(group >= counts)
    else:
        counts = 2 ** np.ceil(np.log2(counts))
        assert np.all(group >= counts) and np.all(np.log2(group) % 1 == 0)
        number, (_, cells) = divisions_of(run), whole(run.problem.scene.mesh)
        most = np.zeros(cells.max() + 1)
        np.maximum.at(most, cells.ravel(), np.repeat(number, cells.shape[1]))
        beside = most[cells].max(axis=1) / 2
        own = np.zeros(disc.count)
        own[disc.source_cell[real]] = counts
        own = np.concatenate(comm.allgather(own))
        assert np.all(number >= beside) and np.all((number == own) | (number == beside))
        assert np.any(number > own)
    compare(run, reference(run, case), 4)


# --- relations between runs ----------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, scheme",
    [(n, s) for n in ("n3", "n4 blocks", "n4 half of it", "quartic region") for s in schemes(CASES[n])],
)
@pytest.mark.parametrize("start", ["trapezoidal", "one-sided"])
def test_equal_steps_are_synchronous(comm, name, scheme, start):
    """If no cell divides the window, plain windows are the synchronous integrator."""
    case = CASES[name]
    scene = build(comm, case)
    step = 0.6 * critical_step(Problem(scene), scheme)
    method = AVI(balanced=False, dissipation=scheme, safety=0.9, start=start)
    run = prepared(scene, method, step)
    assert run.step == step and set(divisions_of(run)) == {1}
    other = prepared(scene, cb.Synchronous(step, dissipation=scheme, start=start))
    moving = np.zeros(case.n, bool)
    if case.supports == "moving":
        moving[: case.n_u + 1] = True  # rates of moving supports are defined otherwise
    scales = np.zeros(2)
    for _ in range(12):
        run.advance(1)
        other.advance(1)
        pairs = list(zip(state(run), state(other), strict=True))
        scales = np.maximum(scales, [abs(b).max() for _, b in pairs])
        assert abs(pairs[0][0] - pairs[0][1]).max() < 1e-11 * scales[0]
        assert abs((pairs[1][0] - pairs[1][1])[:, ~moving]).max(initial=0) < 1e-11 * scales[1]


@pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])
@pytest.mark.parametrize("name", ["n3", "n4 moving", "n6", "n6 regions", "quartic region"])
def test_any_number_of_ranks(comm, name, balanced):
    """All ranks together do what one does alone; and the same again, to the bit."""
    case, states = CASES[name], []
    cells = {1: 40, 2: (9, 6), 3: (5, 3, 3)}[case.dim]
    alone, together = (graded(one, case.dim, cells) for one in (MPI.COMM_SELF, comm))
    # One mesh for both runs on all ranks: another one may be cut between the ranks otherwise.
    for mesh in (alone, together, together):
        run = prepared(build(mesh.comm, case, mesh), AVI(balanced=balanced), 10.0)
        run.advance(6)
        states.append((whole(run.problem.scene.mesh)[0], *state(run)))
    distance, at = scipy.spatial.cKDTree(states[0][0]).query(states[1][0])
    assert distance.max() < 1e-12
    for alone, together, again in list(zip(*states, strict=True))[1:]:
        assert abs(alone[at] - together).max() < 1e-11 * abs(alone).max()
        assert everywhere(comm, np.array_equal(together, again))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_touches_count(comm, scheme):
    """Nodes drift where their cells act even if no force comes of it: for any number of ranks."""
    states, plans = [], []
    for one in (MPI.COMM_SELF, comm):
        mesh = graded(one, 2, (7, 5), pull=1.0)
        scene = cb.Scene(mesh, pair(2, 30.0, own=0.0), initial=cb.Initial(nu_dot=1.0))
        run = prepared(scene, AVI(dissipation=scheme), 10.0)
        plans.append((run.step, sorted(divisions_of(run).tolist())))
        run.advance(4)
        states.append((whole(mesh)[0], *state(run)))
    # If states differ, these tell whether bodies or schedules did before.
    distance, at = scipy.spatial.cKDTree(states[0][0]).query(states[1][0])
    assert distance.max() < 1e-14 and plans[0] == plans[1], (distance.max(), plans)
    for alone, together in list(zip(*states, strict=True))[1:]:
        assert abs(alone[at] - together).max() < 1e-14


@pytest.mark.filterwarnings("ignore:The energy of .* does not see the mode")
@pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_touches_without_forces(comm, scheme, balanced):
    """The same where every kick is exactly zero; and all copies of a node are equal to the bit."""
    body = cb.Body(1, lambda U, nu, N: 0.5 * (U[0, 0] ** 2 + U[0, 1] ** 2), 1.0, 1.0, 30.0,
                   displacement=1)  # fmt: skip
    states = []
    for one in (MPI.COMM_SELF, comm):
        mesh = graded(one, 2, (7, 5))
        scene = cb.Scene(mesh, body, initial=cb.Initial(nu_dot=1.0))
        run = prepared(scene, AVI(dissipation=scheme, balanced=balanced), 10.0)
        assert run.time_sets.asynchronicity > 3
        run.advance(2)
        states.append((whole(mesh)[0], *state(run)))
    _, at = scipy.spatial.cKDTree(states[0][0]).query(states[1][0])
    for alone, together in list(zip(*states, strict=True))[1:]:
        assert abs(alone[at] - together).max() < 1e-15
    assert scheme == "exact" or np.ptp(states[0][2][:, 1]) > 1e-3, "touches say nothing"
    disc = run.problem.disc
    mine = dict(zip(_compat.node_map(mesh).local_to_global(disc.dof.astype(np.int32)).tolist(),
                    run.record[:-1].tolist(), strict=True))  # fmt: skip
    for other in comm.allgather(mine):
        assert all(mine[node] == copy for node, copy in other.items() if node in mine)


@pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])
def test_momentum(comm, balanced):
    """A free body keeps its linear momentum, also where its density varies."""
    case = replace(CASES["n6 regions"], potential=False, loads=False, supports="none")
    for chosen in (case, replace(case, varying=True)):
        run = prepared(build(comm, chosen), AVI(balanced=balanced), 10.0)
        before = run.entries().momentum
        run.advance(10)
        change = comm.allreduce(run.entries().momentum - before)
        disc, masses = run.problem.disc, run.problem.masses
        weight = disc.volume * disc.owned * masses.density[masses.classes[:-1]]
        size = comm.allreduce(weight @ abs(run.sample()[1][:-1, : case.n_u]))
        assert abs(change).max() < 1e-12 * size.max(), chosen.varying


@pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_translation(comm, dim, balanced):
    """A free body that moves as a whole goes on so."""
    case = Case(dim, 3, 1, (0.8,), (0.5,), supports="none")
    scene = build(comm, case)
    start, rate = np.array([0.3, -0.2, 0.7, 0.0]), np.array([1.1, 0.4, -0.6, 0.0])
    initial = cb.Initial(tuple(start[:3]), 0.0, tuple(rate[:3]), 0.0)
    run = prepared(replace(scene, initial=initial), AVI(balanced=balanced), 10.0)
    run.advance(20)
    fields, rates = state(run)
    assert abs(fields - start - run.time * rate).max() < 1e-13
    assert abs(rates - rate).max() < 1e-12


@pytest.mark.serial
@pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])
def test_coinciding_events_commute(balanced):
    """Their order among themselves does not matter."""
    case, rng, states = CASES["n6 regions"], np.random.default_rng(5), []
    for shuffled in (False, True):
        run = prepared(build(MPI.COMM_SELF, case), AVI(balanced=balanced), 10.0)
        events = run.plan.events
        rows = [(events[i].time, events[i].group) for i in range(run.plan.total)]
        times = [t for t, _ in rows]
        assert times == sorted(times) and len(set(times)) < len(times) - 2
        if shuffled:
            rows = sorted(rows, key=lambda row: (row[0], rng.random()))
            assert rows != [(events[i].time, events[i].group) for i in range(run.plan.total)]
            for i, (time, group) in enumerate(rows):
                events[i].time, events[i].group = time, group
        run.advance(8)
        states.append(state(run))
    for one, other in zip(*states, strict=True):
        assert abs(one - other).max() < 1e-13 * abs(one).max()


# --- accuracy ------------------------------------------------------------------------------------

STIFF = np.array([[1.0, 0.3], [0.3, 0.6]])  # of the pair (u, ν) in gradients
OWN = 0.5  # of ν itself


def pair(dim, viscosity=0.0, own=OWN):
    """The scalar pair: ½∇q·A∇q + ½k₀ν², q = (u, ν)."""

    def energy(U, nu, N):
        value = 0.5 * own * nu[0] ** 2
        for i in range(dim):
            value += 0.5 * STIFF[0, 0] * U[0, i] ** 2 + 0.5 * STIFF[1, 1] * N[0, i] ** 2
            value += STIFF[0, 1] * U[0, i] * N[0, i]
        return value

    return cb.Body(1, energy, 1.0, 1.0, viscosity, displacement=1)


SIDES = (cb.Fix("u", "boundary"), cb.Fix("nu", "boundary"))


def mode_error(run, viscosity):
    """Errors of q of a standing mode, L2 (lumped) and energy norm."""
    problem, disc, dim = run.problem, run.problem.disc, run.problem.disc.dim
    stiff = STIFF * dim * np.pi**2 + np.diag([0, OWN])
    zero, eye = np.zeros((2, 2)), np.eye(2)
    rates = np.block([[zero, eye], [-stiff, -np.diag([0, viscosity])]])
    exact = scipy.linalg.expm(run.time * rates) @ [1.0, 0.5, 0, 0]
    mode = np.prod(np.sin(np.pi * disc.position[:-1, :dim]), axis=1)
    wrong = run.sample()[0][:-1, :2] - np.outer(mode, exact[:2])
    problem.kernels.x[:] = 0.0
    problem.kernels.x[:-1, :2] = wrong
    return np.sqrt([np.sum(wrong**2 * disc.volume[:, None]), 2 * problem.kernels.energies().sum()])


@pytest.mark.serial
@pytest.mark.parametrize("viscosity", [0.0, 2.0])
@pytest.mark.parametrize(
    "dim, sizes, until, best",
    [(1, (25, 50, 100, 200), 3.0, 1.95), (2, (10, 20, 40, 80), 1.3, 0.85), (3, (4, 8, 16), 1.3, 1.3)],
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
    slope, alone = (np.log2(errors[name][-2] / errors[name][-1]) for name in ("balanced", "one step"))
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


def semidiscrete(plain):
    """(q, q̇) at t of the equations discrete in space only, from the initial state."""
    shape, start, momenta = plain.q.shape, plain.q.copy(), plain.p.copy()
    free = ~plain.fixed.ravel()

    def force(q):
        parts = [p.force(q[c]) for c, p in zip(plain.cells, plain.potentials, strict=True)]
        return plain._assemble(parts)

    constant = (force(np.where(plain.fixed, start, 0.0)) + plain.load(0.0)).ravel()[free]
    K = np.array([-force(e.reshape(shape)).ravel()[free] for e in np.eye(start.size)[free]]).T
    M, D = (
        scipy.linalg.block_diag(*(getattr(node, name) for node in plain.nodes)) for name in "MD"
    )
    inverse, size = np.linalg.inv(M), len(M)
    rows = np.zeros((2 * size + 1, 2 * size + 1))
    rows[:size, size:-1], rows[size:-1, :size] = np.eye(size), -inverse @ K
    rows[size:-1, size:-1], rows[size:-1, -1] = -inverse @ D, inverse @ constant
    q0, v0 = start.ravel()[free], inverse @ momenta.ravel()[free]
    values, basis = np.linalg.eig(rows)
    weights = np.linalg.solve(basis, np.concatenate([q0, v0, [1.0]]))

    def solve(t):
        y = (basis @ (np.exp(values * t) * weights)).real
        out = np.stack([start, np.zeros(shape)]).reshape(2, -1)
        out[:, free] = y[:-1].reshape(2, -1)
        return out.reshape(2, *shape)

    return solve


# --- stability -----------------------------------------------------------------------------------


def window_map(run):
    """The matrix of one window on (q, q̇) of the free components and, balanced, the held forces.

    A cell's forces are those of some displacement of its nodes: of all others it never holds any.
    """
    problem, balance = run.problem, run.balance
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
            run.c.cb_accelerate(run._world, native.pointer(total))

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


@pytest.mark.serial
@pytest.mark.parametrize("ratio, bands", [(2, [(1.155, 1.414)]), (3, [(0.902, 1.0), (1.581, 1.732)])])
def test_two_springs(ratio, bands):
    """PHYSICS "Where methods fail" 1: the resonance of two springs, at its predicted rate."""
    found = []
    for omega in np.linspace(0.8, 1.75, 39):
        # Two cells of length 1 around a mass 1: k₂ = 1, k₁ = 1/n², critical steps n and 1.
        scene = string([1.0, 1.0], (1.0 / ratio**2, 1.0))
        window = ratio * omega
        run = prepared(scene, AVI(safety=omega, balanced=False), window)
        assert run.step == pytest.approx(window) and list(divisions_of(run)) in ([1, ratio], [ratio, 1])
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
            assert np.linalg.norm(rows[1]) / np.linalg.norm(rows[0]) == pytest.approx(growth, rel=0.02)
    for omega, growth in found:
        distance = min(abs(omega - end) for band in bands for end in band)
        if distance > 2e-3:
            inside = any(low < omega < high for low, high in bands)
            assert (growth > 1 + 1e-6) == inside, (omega, growth)


def two_rates(ratio, safety, viscosity=0.0):
    """10 + 10 cells of lengths ``ratio`` to 1, c = 1, h_K = α L_K, plain windows; the left end held."""
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
QUICK = ("1D, sizes in [1, 3], 0", "1D, graded by 10", "2D, scattered, 0", "3D, scattered, 0")


SLOW = [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow, id=n) for n in SAMPLES]


def sample(name, coupled, viscosity=0.0):
    """A scene of the pair, or of u alone, on one of the meshes."""
    mesh = SAMPLES[name]()
    supports = [cb.Fix("u", LEFT), cb.Fix("nu", "boundary" if coupled else EVERYWHERE)]
    return cb.Scene(mesh, pair(mesh.geometry.dim, viscosity), supports)


@pytest.mark.serial
@pytest.mark.parametrize("coupled", [False, True], ids=["one field", "pair"])
@pytest.mark.parametrize("name", SLOW)
@pytest.mark.parametrize("safety", [0.45, 0.6])
def test_no_growth(name, coupled, safety):
    """Balanced windows: no mode of a linear body grows, at the default α and well above it."""
    if coupled and name.startswith("3D"):
        pytest.skip("a matrix of 3000 rows")
    growth = radius(prepared(sample(name, coupled), AVI(safety=safety), 1e3)) - 1
    assert growth <= 1e-10, f"{growth:.1e} per window"


@pytest.mark.serial
@pytest.mark.parametrize("viscosity", [0.3, 3.0, 30.0, 300.0])
@pytest.mark.parametrize("coupled", [0.0, 0.03, 0.3])
@pytest.mark.parametrize("name", ["1D, sizes in [1, 10], 0", pytest.param("2D, scattered, 0", marks=pytest.mark.slow)])
def test_no_growth_damped(monkeypatch, name, coupled, viscosity):
    """Viscosity of ν, weakly or not at all coupled to u: alternating errors of held forces decay."""
    monkeypatch.setattr(f"{__name__}.STIFF", np.array([[1.0, coupled], [coupled, 0.6]]))
    run = prepared(sample(name, True, viscosity), AVI(), 1e3)
    assert radius(run) - 1 <= 1e-10
    if coupled and viscosity < 100:
        run.balance.blend[:] = 0.0
        assert radius(run) - 1 > 1e-5  # without it they grow


@pytest.mark.serial
def test_neighbours_within_two():
    """Where neighbours' steps differ by more, balanced windows may grow fast: why octaves are graded."""
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
    assert everywhere(comm, abs(balance.held - held).max(initial=0) > 1e-3 * abs(held).max(initial=0))


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
