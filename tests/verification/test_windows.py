# SPDX-License-Identifier: LGPL-3.0-or-later
"""Asynchronous windows: equal to a slow reference to round-off, on any number of ranks.

The reference (windows_reference.py) is the paper's recursion with a heap of events, in numpy.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.spatial
from dense import prepared, state, whole
from harness import everywhere
from mpi4py import MPI
from verification.cases import (
    CASES,
    SCHEMES,
    Case,
    build,
    compare,
    divisions_of,
    graded,
    reference,
    schemes,
)
from verification.waves import pair

import complexbody as cb
from complexbody import _compat, native
from complexbody.integrators.asynchronous import AVI
from complexbody.problem import Problem
from complexbody.timesets import cell_steps, critical_step

SOME = ("n3", "n4 blocks", "n4 half of it", "n6 regions", "quartic region")  # on several ranks
ALL = [
    pytest.param(n, s, marks=() if n in SOME else pytest.mark.serial)
    for n, c in CASES.items()
    for s in schemes(c)
]


@pytest.mark.parametrize("balanced", [False, True], ids=["plain", "balanced"])
@pytest.mark.parametrize("name, scheme", ALL)
def test_trajectories(comm, name, scheme, balanced):
    """Fields and rates at the end of every window."""
    case = CASES[name]
    run = prepared(build(comm, case), AVI(dissipation=scheme, balanced=balanced), 10.0)
    plain = reference(run, case)
    counts = set(plain.divisions.tolist())
    assert len(counts) > 1 + (not balanced) and min(counts) <= 2, counts
    compare(run, plain, 5)


@pytest.mark.serial
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
    """N_K = ⌈W/(α h_K)⌉; octaves: a power of two, no larger than it or a neighbour asks for."""
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
    [
        (n, s)
        for n in ("n3", "n4 blocks", "n4 half of it", "quartic region")
        for s in schemes(CASES[n])
    ],
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
