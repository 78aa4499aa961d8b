# SPDX-License-Identifier: LGPL-3.0-or-later
"""Any number of ranks gives the same results; the same number gives the same bits.

The scene on COMM_WORLD is compared with the same one that every rank computes for itself.
"""

import numpy as np
import pytest
from busy import busy
from harness import everywhere, largest
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat
from complexbody.problem import Problem
from complexbody.timesets import critical_step

FIELDS = ("u", "nu", "u_dot", "nu_dot")
CASES = {
    "numbers": ("numbers", "exact", 0.0),
    "blocks": ("blocks", "forward", 0.0),
    "no inertia": ("no inertia", "exact", 0.0),
    "nonlinear": ("blocks", "symmetric", 3.0),
}


def rows(function):
    """Values by node, and each node's number in the input of the mesh."""
    mesh = function.function_space.mesh
    values = function.x.array.reshape(_compat.node_count(mesh), -1)
    return values, np.asarray(mesh.geometry.input_global_indices)


def run(comm, case, folder, dim=3, scene=None):
    """Results at an end between two steps, with ledger, probes and outputs on the way."""
    kind, scheme, quartic = CASES[case]
    scene = scene or busy(comm, dim, kind, quartic)
    probes = {"inside": (0.41, 0.37, 0.33)[:dim], "corner": (1.0, 0.8, 0.7)[:dim]}
    until = 45.3 * critical_step(Problem(scene), scheme)
    output = cb.Output(folder, every=until / 7, probes=probes, probe_steps=3)
    step = until / 50.5
    method = cb.Synchronous(step, dissipation=scheme)
    return cb.simulate(scene, method, until=until, output=output, ledger_steps=4)


@pytest.mark.skipif(MPI.COMM_WORLD.size == 1, reason="one rank is one rank")
@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("case", CASES)
def test_one_rank_or_more(comm, shared_path, tmp_path, case, dim):
    together = run(comm, case, shared_path / "together", dim)
    alone = run(MPI.COMM_SELF, case, tmp_path / f"alone-{comm.rank}", dim)
    assert together.stats.cells == alone.stats.cells
    assert together.stats.nodes == alone.stats.nodes
    assert together.stats.critical == pytest.approx(alone.stats.critical, rel=1e-12)
    for name in FIELDS:
        mine, numbers = rows(getattr(together, name))
        known, order = rows(getattr(alone, name))
        expected = np.empty_like(known)
        expected[order] = known
        assert abs(known).max() > 1e-3
        assert largest(comm, mine - expected[numbers]) < 1e-11 * abs(known).max(), name
    assert len(together.ledger) == len(alone.ledger) > 10
    energy = max(abs(alone.ledger[c]).max() for c in ("kinetic_u", "stored", "potential"))
    for column in alone.ledger.columns:
        known = alone.ledger[column]
        # What is small because it is a difference is compared with what it is the difference of.
        size = {"identity": 1.0, "balance": energy}.get(column, abs(known).max())
        assert abs(together.ledger[column] - known).max() <= 1e-11 * size, column
    if comm.rank == 0:
        assert set(together.probes) == {"inside", "corner"}
        for name, known in alone.probes.items():
            for column in ("time", "u", "nu"):
                error = abs(together.probes[name][column] - known[column]).max()
                assert error < 1e-11 * abs(known[column]).max(), (name, column)
    else:
        assert together.probes == {}


@pytest.mark.parametrize("case", CASES)
def test_the_same_bits_again(comm, shared_path, case):
    # One mesh for both: dolfinx's partitioner may cut the same input differently the next time.
    kind, _, quartic = CASES[case]
    scene = busy(comm, 3, kind, quartic)
    first, second = (
        run(comm, case, shared_path / name, scene=scene) for name in ("first", "second")
    )
    for name in FIELDS:
        same = np.array_equal(getattr(first, name).x.array, getattr(second, name).x.array)
        assert everywhere(comm, same), name
    assert first.ledger.rows == second.ledger.rows


@pytest.mark.parametrize("case", CASES)
def test_all_ranks_agree_on_shared_nodes(comm, shared_path, case):
    """Ghosts hold their owners' values, to the bit."""
    result = run(comm, case, shared_path / "run")
    for name in FIELDS:
        function = getattr(result, name)
        before = function.x.array.copy()
        function.x.scatter_forward()
        assert everywhere(comm, np.array_equal(before, function.x.array)), name
    books = comm.bcast(result.ledger.rows)
    assert everywhere(comm, books == result.ledger.rows)
