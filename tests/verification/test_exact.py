# SPDX-License-Identifier: LGPL-3.0-or-later
"""Exact schedules: equal to a heap of events to round-off, for any scene and number of ranks."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.spatial
from dense import prepared, state, whole
from harness import everywhere, refused
from mpi4py import MPI
from verification.cases import CASES, Case, build, graded, reference, schemes
from verification.exact_reference import Exact
from verification.waves import SIDES, pair

import complexbody as cb
from complexbody import _compat, meshes, native
from complexbody.errors import IntegratorError, StepError
from complexbody.integrators.asynchronous import AVI
from complexbody.problem import Problem
from complexbody.timesets import cell_steps, critical_step

STARTS = ("trapezoidal", "one-sided")


def steps_for(scene, scheme, low=0.15, high=0.5, seed=0):
    """Random fractions of this rank's cells' critical steps, the same for any number of ranks."""
    problem = Problem(scene)
    own, critical = problem.disc.source_cell, cell_steps(problem, scheme)
    out = np.zeros(problem.disc.count)
    out[own[own >= 0]] = critical[own >= 0]
    cells = _compat.original_cells(scene.mesh)[: len(out)]
    total = scene.mesh.comm.allreduce(len(out))
    problem.close()
    return out * np.random.default_rng(seed).uniform(low, high, total)[cells]


def heap_of(run, case, steps):
    """The same run as a heap."""
    points, _ = whole(run.problem.scene.mesh)
    acted = np.zeros(len(points), bool)
    if case.loads or case.potential:
        acted[:] = True  # a body force, or an affine potential, acts on all nodes
    if case.supports == "moving":
        acted |= (points[:, 0] < 1e-9) | (points[:, 0] > 1 - 1e-9)
    every = np.concatenate(run.problem.comm.allgather(steps))
    method = run.method

    def make(**given):
        return Exact(every, method.start, method.corrected, acted, **given)

    return reference(run, case, make)


def compare(run, heap, spans, tolerance=1e-11):
    """Largest relative difference of positions and rates at the end of every span."""
    scales, worst = np.zeros(2), np.zeros(2)
    for _ in range(spans):
        run.advance(1)
        heap.advance(1)
        expected = heap.see()
        scales = np.maximum(scales, [abs(e).max() for e in expected])
        found = [abs(a - b).max() for a, b in zip(state(run), expected, strict=True)]
        worst = np.maximum(worst, found / scales)
        assert np.isfinite(scales).all() and worst.max() < tolerance, (worst, heap.count)


SOME = ("n3", "n4 blocks", "n6 regions", "quartic region")  # also on several ranks
ALL = [(n, s, True, "trapezoidal") for n, c in CASES.items() for s in schemes(c)]
ALL += [(n, s, False, "one-sided") for n in CASES for s in schemes(CASES[n])[-1:]]
ALL += [(n, "exact", *mixed) for n in SOME for mixed in ((True, STARTS[1]), (False, STARTS[0]))]
ALL = [pytest.param(*c, marks=() if c[0] in SOME else pytest.mark.serial) for c in ALL]


@pytest.mark.parametrize("name, scheme, corrected, start", ALL)
def test_trajectories(comm, name, scheme, start, corrected):
    """Fields and rates at every span's end: random steps, schemes, starts, corrected or not."""
    case = CASES[name]
    scene = build(comm, case)
    steps = steps_for(scene, scheme)
    method = AVI(
        schedule="exact", dissipation=scheme, start=start, corrected=corrected, steps=steps
    )
    run = prepared(scene, method, 10.0)
    heap = heap_of(run, case, steps)
    compare(run, heap, 3)
    assert comm.allreduce(run.updates) == heap.done.sum()


@pytest.mark.parametrize("lanes", [4, 8])
@pytest.mark.parametrize("name", ["n2 lumped", "n3", "n4 blocks", "n6", "quartic region"])
def test_lanes(comm, monkeypatch, name, lanes):
    """Every width of vectors gives the same."""
    monkeypatch.setattr(native, "lanes", lambda: lanes)
    case = CASES[name]
    scene = build(comm, case)
    steps = steps_for(scene, "exact")
    run = prepared(scene, AVI(schedule="exact", steps=steps), 10.0)
    compare(run, heap_of(run, case, steps), 2)


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize(
    "name, scheme",
    [
        (n, s)
        for n in ("n3", "n4 blocks", "n4 half of it", "quartic region")
        for s in schemes(CASES[n])
    ],
)
def test_equal_steps_are_synchronous(comm, name, scheme, start):
    """If all cells have one step it is the synchronous integrator, whatever the start."""
    case = CASES[name]
    scene = build(comm, case)
    step = 0.6 * critical_step(Problem(scene), scheme)
    steps = np.full(_compat.cell_count(scene.mesh)[0], step)
    method = AVI(schedule="exact", dissipation=scheme, start=start, corrected=False, steps=steps)
    run = prepared(scene, method, 12 * step)
    other = prepared(scene, cb.Synchronous(step, dissipation=scheme, start=start))
    moving = np.zeros(case.n, bool)
    if case.supports == "moving":
        moving[: case.n_u + 1] = True  # rates of moving supports are defined otherwise
    for _ in range(12):
        run.advance(1)
        other.advance(1)
        (x, v), (y, w) = state(run), state(other)
        assert abs(x - y).max() < 1e-11 * abs(y).max()
        assert abs((v - w)[:, ~moving]).max(initial=0) < 1e-11 * abs(w).max()


@pytest.mark.parametrize("name", ["n3", "n4 moving", "n6", "n6 regions", "quartic region"])
def test_any_number_of_ranks(comm, name):
    """All ranks together do what one does alone; and the same again, to the bit."""
    case, states = CASES[name], []
    cells = {1: 40, 2: (9, 6), 3: (5, 3, 3)}[case.dim]
    alone, together = (graded(one, case.dim, cells) for one in (MPI.COMM_SELF, comm))
    # One mesh for both runs on all ranks: another one may be cut between the ranks otherwise.
    for mesh in (alone, together, together):
        scene = build(mesh.comm, case, mesh)
        run = prepared(scene, AVI(schedule="exact", dissipation="forward"), 10.0)
        run.advance(4)
        states.append((whole(mesh)[0], *state(run)))
    distance, at = scipy.spatial.cKDTree(states[0][0]).query(states[1][0])
    assert distance.max() < 1e-12
    for alone, together, again in list(zip(*states, strict=True))[1:]:
        assert abs(alone[at] - together).max() < 1e-11 * abs(alone).max()
        assert everywhere(comm, np.array_equal(together, again))


def test_coinciding_events(comm):
    """Steps in ratios of whole numbers: cells that act at one time see the same positions."""
    case = CASES["n4 moving"]
    scene = build(comm, case, graded(comm, 2, (6, 4)))
    least = critical_step(Problem(scene))
    steps = steps_for(scene, "exact", 0.3, 0.45)
    steps = 0.2 * least * 2.0 ** np.floor(np.log2(steps / (0.2 * least)))
    run = prepared(scene, AVI(schedule="exact", steps=steps, corrected=False), 10.0)
    compare(run, heap_of(run, case, steps), 3)


def test_cells_together_need_no_correction(comm):
    """Neighbours of equal steps cancel each other: there nothing is corrected."""
    case, states = CASES["n4"], []
    for corrected in (False, True):
        scene = build(comm, case)
        steps = np.full(_compat.cell_count(scene.mesh)[0], 0.4 * critical_step(Problem(scene)))
        run = prepared(scene, AVI(schedule="exact", corrected=corrected, steps=steps), 1.0)
        run.advance(4)
        states.append(state(run))
    for one, other in zip(*states, strict=True):
        assert abs(one - other).max() < 1e-14 * abs(one).max()


@pytest.mark.parametrize("corrected", [False, True], ids=["plain", "corrected"])
def test_momentum(comm, corrected):
    """A free body keeps its linear momentum, also where its density varies."""
    case = replace(CASES["n6 regions"], potential=False, loads=False, supports="none")
    for chosen in (case, replace(case, varying=True)):
        scene = build(comm, chosen)
        run = prepared(scene, AVI(schedule="exact", corrected=corrected), 10.0)
        before = comm.allreduce(run.entries().momentum)
        run.advance(8)
        change = comm.allreduce(run.entries().momentum) - before
        disc, masses = run.problem.disc, run.problem.masses
        mass = masses.density[masses.classes[:-1]] * disc.volume * disc.owned
        speed = abs(run.sample()[1][:-1, : chosen.n_u])
        size = comm.allreduce(float(mass @ speed.sum(axis=1)))
        assert abs(change).max() < 1e-12 * size


def test_sampling_does_not_disturb(comm):
    """Looking at a run between spans changes nothing of what follows."""
    case = CASES["n4 unequal rates"]
    states = []
    for look in (False, True):
        run = prepared(build(comm, case), AVI(schedule="exact", dissipation="symmetric"), 10.0)
        for _ in range(5):
            run.advance(1)
            if look:
                run.entries()
                run.sample()
        states.append((*state(run), np.array([run.dissipated()])))
    for one, other in zip(*states, strict=True):
        assert np.array_equal(one, other)


def test_as_published():
    """The paper's scheme by name."""
    method = AVI.as_published()
    assert (method.schedule, method.start, method.dissipation) == ("exact", "one-sided", "forward")
    assert not method.corrected and not method.balanced and method.symplectic and method.order == 1


@pytest.mark.parametrize(
    "options, word",
    [
        ({"schedule": "exact", "balanced": True}, "balanced"),
        ({"start": "one-sided", "schedule": "octaves", "balanced": True}, "half a step on"),
        ({"schedule": "windows", "balanced": True}, "differ by two"),
        ({"corrected": True}, "corrected"),
        ({"steps": np.ones(3)}, "schedule='exact'"),
        ({"schedule": "heap"}, "windows, exact, octaves"),
        ({"start": "late"}, "trapezoidal"),
    ],
)
def test_options_that_do_not_fit(comm, options, word):
    """Refused by name, with what to do."""
    with refused(IntegratorError, word):
        AVI(**options)


@pytest.mark.parametrize(
    "make, word",
    [
        (lambda s: s[:-1], "shape"),
        (lambda s: 0 * s, "positive"),
        (lambda s: np.where(np.arange(len(s)) == 1, np.nan, s), "finite"),
        (lambda s: np.where(np.arange(len(s)) == 1, 9.0, 1.0) * s, "critical"),
    ],
)
def test_steps_that_cannot_run(comm, make, word):
    """Refused on all ranks, though only one has the bad cell."""
    scene = build(comm, Case(2, 1, 1))
    steps = steps_for(scene, "exact", 0.4, 0.41)
    if comm.rank == comm.size - 1:
        steps = make(steps)
    with refused(StepError, word):
        prepared(scene, AVI(schedule="exact", steps=steps), 1.0)


# --- accuracy ------------------------------------------------------------------------------------


def amplitude(run):
    """Amplitudes of (u, ν) in the mode Π sin πx_i: the ripple of single nodes averages out."""
    disc = run.problem.disc
    mode = np.prod(np.sin(np.pi * disc.position[:-1, : disc.dim]), axis=1)
    weight = disc.volume * mode
    return weight @ run.sample()[0][:-1, :2] / (weight @ mode)


@pytest.mark.serial
@pytest.mark.parametrize("dim, size, factor", [(1, 400, 10), (2, 80, 10), (3, 16, 10)])
def test_corrected_cells_have_no_bias(dim, size, factor):
    """Cells that act alone stiffen a body by a share of order α²; corrected ones do not.

    Measured as what a standing mode's amplitude differs from one step for all on the same mesh.
    """
    comm = MPI.COMM_SELF
    if dim == 1:
        lengths = np.random.default_rng(size).uniform(1, 3, size)
        mesh = meshes.graded_interval(comm, lengths / lengths.sum())
    else:
        make = meshes.rectangle if dim == 2 else meshes.box
        mesh = meshes.jiggled(make(comm, (0,) * dim, (1,) * dim, size), 0.3 - 0.03 * dim, 3)
    initial = cb.Initial(
        *(lambda x, a=a: a * np.prod(np.sin(np.pi * x[:dim]), axis=0) for a in (1.0, 0.5))
    )
    scene, found = cb.Scene(mesh, pair(dim), SIDES, (), initial), []
    for method in (
        cb.Synchronous(),
        AVI(schedule="exact", corrected=False),
        AVI(schedule="exact"),
    ):
        run = prepared(scene, method, 1.3)
        run.advance(round(1.3 / run.step))
        found.append(amplitude(run))
    alone, corrected = (abs(other - found[0]).max() for other in found[1:])
    assert alone > 5e-4 and corrected < alone / factor, (alone, corrected)
