# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time sets: who acts when, against times written down by hand, on every number of ranks."""

import math
from fractions import Fraction

import numpy as np
import pytest
from dense import prepared
from harness import everywhere, largest, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat, meshes
from complexbody.errors import IntegratorError, StepError
from complexbody.forms import isotropic_two_field
from complexbody.integrators.timetable import time_sets
from complexbody.problem import Problem

SIZES = [1.0, 0.3, 0.45, 0.8, 0.11, 0.6, 1.0, 0.25, 0.9, 0.5, 0.7, 1.0]


def bar(comm, **body):
    """Cells of SIZES: critical steps are in proportion to them."""
    body = isotropic_two_field(d=1, k0=0.0, **body)
    shape = cb.Initial(u=lambda x: np.sin(x[:1]))
    return cb.Scene(meshes.graded_interval(comm, SIZES), body, initial=shape)


def numbers(problem):
    """Which of SIZES each of this rank's owned cells is."""
    mesh = problem.scene.mesh
    return _compat.original_cells(mesh)[: _compat.cell_count(mesh)[0]]


def critical(problem):
    return 0.4 * np.array(SIZES)[numbers(problem)]


def points(mesh):
    """Input number of each geometry node."""
    return np.asarray(mesh.geometry.input_global_indices)


def exact_set(h, window, divisions):
    """Θ of step h in [0, W] as exact fractions of W, or multiples of h."""
    if divisions:
        return [Fraction(j, int(divisions)) for j in range(divisions + 1)]
    return [j * h for j in range(math.floor(window / h + 1e-9) + 1)]


@pytest.mark.parametrize("rational", [True, False])
def test_times_of_cells_and_nodes(comm, rational):
    """Θ_K by hand, Θ_a as a union over cells of all ranks, in any stretch of time."""
    problem = Problem(bar(comm))
    window, number = 0.4, numbers(problem)
    count = np.array([math.ceil(window / (0.18 * size)) for size in SIZES])
    steps = window / count if rational else 0.18 * np.array(SIZES)
    given = count[number] if rational else None
    sets = time_sets(problem.disc, steps[number], critical(problem), window, given)
    hand = [exact_set(h, window, n if rational else 0) for h, n in zip(steps, count, strict=True)]
    scale = window if rational else 1.0
    for cell, which in enumerate(number):
        times = sets.of_cell(cell)
        np.testing.assert_allclose(times, [float(t) * scale for t in hand[which]], atol=1e-15)
        later = sets.of_cell(cell, 2 * window, 3 * window)
        if rational:
            np.testing.assert_allclose(later - 2 * window, times, atol=1e-15)
        first = math.ceil(2 * window / steps[which] - 1e-9)
        assert later[0] == pytest.approx(first * steps[which], rel=1e-14)
    mesh = problem.scene.mesh
    nodes = np.unique(_compat.cell_nodes(mesh)[: len(number)])
    for node in nodes:
        which = points(mesh)[node]
        cells = [k for k in (which - 1, which) if 0 <= k < len(SIZES)]
        union = sorted(set().union(*(hand[k] for k in cells)))
        np.testing.assert_allclose(
            sets.of_node(node), [float(t) * scale for t in union], rtol=1e-14
        )
    problem.close()


@pytest.mark.parametrize("rational", [True, False])
def test_numbers(comm, rational):
    """T, h, τ, events, speed-ups and octaves of the whole body, by hand."""
    problem = Problem(bar(comm))
    window, number = 0.4, numbers(problem)
    count = np.array([math.ceil(window / (0.18 * size)) for size in SIZES])
    steps = window / count if rational else 0.18 * np.array(SIZES)
    given = count[number] if rational else None
    sets = time_sets(problem.disc, steps[number], critical(problem), window, given, ends=1)
    assert sets.largest_step == pytest.approx(steps.max(), rel=1e-15)
    assert sets.asynchronicity == pytest.approx(steps.max() / steps.min(), rel=1e-14)
    times = np.unique(np.concatenate([sets.of_cell(k) for k in range(len(number))]))
    times = np.unique(np.round(np.concatenate(comm.allgather(times)), 13))
    assert sets.size == pytest.approx(np.diff(times).max(), rel=1e-9)  # the largest gap of Θ
    events = count.sum() if rational else round(sum(window / steps))
    assert sets.events == events and sets.updates == events + len(SIZES)
    ideal = len(SIZES) / min(SIZES) / sum(1 / np.array(SIZES))
    assert sets.ideal == pytest.approx(ideal, rel=1e-12)
    alone = len(SIZES) * window / (0.9 * 0.4 * min(SIZES))
    exact = events if rational else sum(window / steps)
    assert sets.scheduled == pytest.approx(alone / (exact + len(SIZES)), rel=1e-12)
    octave = np.floor(np.log2(window / steps) + 1e-9).astype(int)
    np.testing.assert_array_equal(sets.levels, octave[number])
    np.testing.assert_array_equal(sets.octaves[: octave.max() + 1], np.bincount(octave))
    assert sets.octaves.sum() == len(SIZES) == sets.cells
    mine = (window / steps + 1)[number].sum()
    whole = comm.allreduce(mine, op=MPI.MAX) * comm.size / (exact + len(SIZES)) - 1
    assert sets.imbalance == pytest.approx(whole, abs=1e-12)
    edges, counts = sets.histogram(5)
    expected, _ = np.histogram(steps, np.geomspace(steps.min() * (1 - 1e-12), steps.max(), 6))
    np.testing.assert_array_equal(counts, expected)
    np.testing.assert_allclose(edges, np.geomspace(steps.min(), steps.max(), 6), rtol=1e-12)
    problem.close()


def test_words(comm):
    """The block that run and check print: short lines, the same on all ranks."""
    run = prepared(bar(comm), cb.AVI())
    text = str(run.time_sets)
    assert comm.allgather(text) == [text] * comm.size
    for words in (
        f"asynchronicity {run.time_sets.asynchronicity:.3g}",
        f"{run.time_sets.events} events of 12 cells per window",
        f"factor {run.time_sets.ideal:.3g} ideal, {run.time_sets.scheduled:.3g} scheduled",
    ):
        assert words in text
    assert ("the busiest of" in text) == (comm.size > 1)
    assert all(len(line) < 130 for line in text.splitlines())
    run.close()


METHODS = {
    "windows": cb.AVI(balanced=False),
    "balanced": cb.AVI(),
    "octaves": cb.AVI(schedule="octaves", balanced=False),
    "leapfrog": cb.LocalLeapfrog(),
    "one level": cb.LocalLeapfrog(levels=0),
}


@pytest.mark.parametrize("name", METHODS)
def test_of_runs(comm, name):
    """Events are those that a run has: updates of a stretch of steps, and times of its kicks."""
    run = prepared(bar(comm), METHODS[name], until=3.0)
    sets = run.time_sets
    assert sets.window == pytest.approx(run.step) and sets.cells == len(SIZES)
    run.advance(2)
    before = run.updates
    run.advance(3)
    assert comm.allreduce(run.updates - before) == 3 * sets.updates
    real = run.problem.disc.source_cell >= 0
    assert len(sets.steps) == real.sum()
    ratio = sets.window / sets.steps
    assert everywhere(comm, np.allclose(ratio, np.round(ratio), rtol=1e-12))
    if name in ("octaves", "balanced", "leapfrog"):
        np.testing.assert_array_equal(2.0**sets.levels, np.round(ratio))
    if name == "one level":
        assert sets.asynchronicity == 1 and sets.events == len(SIZES)
        assert sets.scheduled == pytest.approx(sets.window / (0.9 * run.critical), rel=1e-9)
    else:
        assert sets.asynchronicity >= 2
    ideal = len(SIZES) / min(SIZES) / sum(1 / np.array(SIZES))
    assert sets.ideal == pytest.approx(ideal, rel=1e-6)
    run.close()
    run.problem.close()


@pytest.mark.parametrize("schedule", ["windows", "octaves"])
def test_safety(comm, schedule):
    """No cell steps further than its share of its critical step, and none needlessly short."""
    run = prepared(bar(comm), cb.AVI(safety=0.3, schedule=schedule))
    longest = 0.3 * run.critical / min(SIZES) * np.array(SIZES)[numbers(run.problem)]
    share = run.time_sets.steps / longest
    assert largest(comm, share) <= 1 + 1e-9
    needed = share > (0.49 if schedule == "octaves" else 0.5)
    # Octaves also keep a cell within twice the step of its neighbours.
    assert schedule == "octaves" or everywhere(comm, np.all(needed))
    assert comm.allreduce(int(needed.sum())) >= len(SIZES) // 2
    run.close()


def test_result(comm):
    """A result has them where cells have steps of their own, and None where they act together."""
    scene = bar(comm)
    assert cb.simulate(scene, until=0.2).time_sets is None
    result = cb.simulate(scene, cb.LocalLeapfrog(), until=2.0)
    assert result.time_sets.asynchronicity >= 2
    realised = cb.realised_speed_up(result)
    assert realised > 0 and comm.allgather(realised) == [realised] * comm.size


@pytest.mark.parametrize(
    "method", [cb.Synchronous(), cb.AVI(), cb.AVI(schedule="exact"), cb.LocalLeapfrog()]
)
def test_steps_and_levels_as_fields(comm, shared_path, method):
    """Written once, in the order of the mesh's input, and readable by h5py and meshio."""
    h5py, meshio = pytest.importorskip("h5py"), pytest.importorskip("meshio")
    output = cb.Output(shared_path, every=0.1, fields=("u", "steps", "levels"))
    result = cb.simulate(bar(comm), method, until=1.0, output=output)
    comm.barrier()
    sets, number = result.time_sets, None
    mesh = result.scene.mesh
    number = _compat.original_cells(mesh)[: _compat.cell_count(mesh)[0]]
    h = np.zeros(len(SIZES))
    h[number] = result.stats.step if sets is None else sets.steps
    h = comm.allreduce(h)
    window = result.stats.step if sets is None else sets.window
    level = np.floor(np.log2(window / h) + 1e-9)
    for name, symbol, expected in (("steps", "h", h), ("levels", "level", level)):
        with h5py.File(shared_path / f"{name}.h5", locking=False) as file:
            steps = file[f"Function/{symbol}"]
            assert list(steps) == ["0"] and steps["0"].attrs["time"] == 0.0
            np.testing.assert_array_equal(steps["0"][:, 0], expected)
        if comm.rank == 0:
            with meshio.xdmf.TimeSeriesReader(shared_path / f"{name}.xdmf") as reader:
                _, cells = reader.read_points_cells()
                time, _, data = reader.read_data(0)
            assert time == 0.0 and len(cells[0].data) == len(SIZES) and reader.num_steps == 1
            np.testing.assert_array_equal(np.ravel(data[symbol][0]), expected)
        comm.barrier()


def test_refusals(comm):
    """What makes no sense says so: steps on all ranks, questions on the rank that asks."""
    problem = Problem(bar(comm))
    steps = np.ones(problem.disc.count)
    for wrong in (0.0, -1.0, np.inf, np.nan):
        bad = steps.copy()
        if comm.rank == comm.size - 1:
            bad[-1] = wrong
        with refused(StepError, "positive"):
            time_sets(problem.disc, bad, steps, 1.0)
    sets = time_sets(problem.disc, steps, steps, 1.0)
    for question in (
        lambda: sets.of_cell(problem.disc.count),
        lambda: sets.of_cell(-1),
        lambda: sets.of_node(10**6),
        lambda: sets.histogram(0),
    ):
        with refused(IntegratorError, "TimeSets"):
            question()
    edges, counts = sets.histogram()
    assert counts.tolist() == [len(SIZES)] and edges.tolist() == [1.0, 1.0]
    problem.close()
