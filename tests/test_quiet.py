# SPDX-License-Identifier: LGPL-3.0-or-later
"""Cells at rest are skipped, and no bit of any result tells: trajectory, ledger, probes, output."""

import h5py
import numpy as np
import pytest
from busy import busy
from dense import prepared
from harness import everywhere
from resting import bar, pair, quartic, small_chunks  # noqa: F401

import complexbody as cb
from complexbody.scene import FIELDS

pytestmark = pytest.mark.usefixtures("small_chunks")

METHODS = {
    "synchronous": (cb.Synchronous(), 10),
    "balanced": (cb.AVI(), 4),
    "plain": (cb.AVI(balanced=False), 4),
    "one-sided": (cb.AVI(balanced=False, start="one-sided", dissipation="forward"), 4),
}
SOME = ["synchronous", "balanced"]


@pytest.mark.parametrize("dim, method", [(1, "one-sided"), (2, "synchronous"), (2, "balanced"),
                                         (2, "plain"), (3, "synchronous"), (3, "balanced")])
def test_point_pulse(comm, dim, method):
    """A pulse that enters at one end pays for what it has reached."""
    assert pair(comm, bar(comm, dim, "traction"), *METHODS[method], ledger_steps=3) > 0.6


@pytest.mark.parametrize("source, method", [
    *((source, "synchronous") for source in ("later", "force", "bump", "support", "held")),
    *((source, "balanced") for source in ("force", "bump", "support")),
    *((source, "plain") for source in ("later", "support", "held")),
])  # fmt: skip
def test_sources(comm, source, method):
    """Whatever sets cells moving: loads, at work or not yet, initial data, supports."""
    assert pair(comm, bar(comm, 1, source), *METHODS[method]) > 0.4


@pytest.mark.parametrize("method", SOME)
def test_until_all_is_awake(comm, method):
    """A run that starts quiet and ends with all cells awake, long after the watch is given up."""
    integrator, steps = METHODS[method]
    assert 0 < pair(comm, bar(comm, 2, "bump"), integrator, 8 * steps) < 0.6


@pytest.mark.parametrize("method", SOME)
def test_nothing_happens(comm, method):
    """A body at rest stays there, and costs nothing."""
    assert pair(comm, bar(comm, 1, "nothing"), *METHODS[method]) == 1.0


@pytest.mark.parametrize("kind, scheme, start", [
    ("numbers", "exact", "one-sided"), ("numbers", "symmetric", "trapezoidal"),
    ("blocks", "exact", "trapezoidal"), ("blocks", "forward", "one-sided"),
    ("no inertia", "exact", "trapezoidal"), ("no inertia", "forward", "one-sided"),
])  # fmt: skip
def test_viscosity(comm, kind, scheme, start):
    """All dissipation schemes, with inertia and viscosity in blocks, and without inertia."""
    method = cb.Synchronous(dissipation=scheme, start=start)
    assert pair(comm, bar(comm, 1, "bump", kind), method, 8) > 0.4
    slow = cb.AVI(balanced=kind == "numbers", dissipation=scheme)
    assert pair(comm, bar(comm, 1, "bump", kind), slow, 3) > 0.4


@pytest.mark.parametrize("method", SOME)
def test_any_density(comm, method):
    """A density that is not quadratic has no force at zero either: checked by evaluating it."""
    assert pair(comm, bar(comm, 1, "traction", extra=quartic), *METHODS[method]) > 0.6


@pytest.mark.parametrize("method", SOME)
@pytest.mark.parametrize("extra", [
    lambda U, nu: 0.3 * U[0, 0] - 0.2 * nu[1],
    lambda U, nu: 0.3 * U[0, 0] - 0.2 * nu[1] + quartic(U, nu),
], ids=["quadratic", "any"])  # fmt: skip
def test_prestress(comm, extra, method):
    """Forces at zero move all cells at once, even where those of neighbours cancel."""
    assert pair(comm, bar(comm, 1, "traction", extra=extra), *METHODS[method]) == 0.0


@pytest.mark.parametrize("method", SOME)
def test_potential(comm, method):
    """A potential of external actions: of second order it acts on what moves, of first on all."""
    soft = bar(comm, 1, "traction", potential=lambda u, nu: 0.4 * (u[0] + nu[1]) ** 2 + 1.5)
    assert pair(comm, soft, *METHODS[method]) > 0.6
    pulled = bar(comm, 1, "traction", potential=lambda u, nu: 0.2 * u[1])
    assert pair(comm, pulled, *METHODS[method]) == 0.0


@pytest.mark.parametrize("method", SOME)
def test_everything_at_once(comm, method):
    """Where all cells are awake from the start nothing is watched."""
    assert pair(comm, bar(comm, 1, "everywhere"), *METHODS[method]) == 0.0
    assert pair(comm, busy(comm, 1, "numbers"), *METHODS[method]) == 0.0
    run = prepared(busy(comm, 1, "numbers"), METHODS[method][0])
    assert run.activity is None


def test_output(comm, shared_path):
    """Fields between steps, probes and ledger: looking at a quiet body wakes none of it."""
    scene, folders = bar(comm, 2, "traction"), iter("ab")
    step = prepared(scene, cb.Synchronous()).step
    probes = {"near": (0.03, 0.05), "far": (0.9, 0.05)}

    def output(folder):
        return cb.Output(shared_path / folder, every=2.3 * step, probes=probes, probe_steps=2)

    results = [
        cb.simulate(scene, until=10 * step, quiet=quiet, output=output(next(folders)),
                    ledger_steps=1)
        for quiet in (True, False)
    ]  # fmt: skip
    comm.barrier()
    if comm.rank == 0:
        for name in FIELDS:
            files = (h5py.File(r.folder / f"{name}.h5") for r in results)
            with next(files) as one, next(files) as two:
                parts = list(one["Function"][name])
                assert len(parts) >= 5
                for part in parts:
                    same = (f["Function"][name][part][:] for f in (one, two))
                    np.testing.assert_array_equal(*same)
    for name in results[0].probes:
        for column, values in results[0].probes[name].items():
            np.testing.assert_array_equal(values, results[1].probes[name][column])
    assert np.array_equal(*(r.ledger.rows for r in results), equal_nan=True)
    assert results[0].stats.quiet > 0.6


def test_others_see_all_cells(comm):
    """Kernels evaluate all cells for whoever else asks them while a run skips some."""
    run = prepared(bar(comm, 2, "traction"), cb.Synchronous())
    run.advance(3)
    kernels = run.problem.kernels
    kernels.x[:-1, : run.problem.disc.n] = run.problem.disc.position[:-1, :1] ** 2
    assert run.activity is not None and everywhere(comm, kernels.energies()[:, 0].min() >= 0)
    total = comm.allreduce(kernels.energies())
    other = prepared(bar(comm, 2, "everywhere"), cb.Synchronous()).problem
    other.kernels.x[:-1, : other.disc.n] = other.disc.position[:-1, :1] ** 2
    np.testing.assert_allclose(total, comm.allreduce(other.kernels.energies()), rtol=1e-12)
