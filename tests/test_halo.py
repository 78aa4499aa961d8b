# SPDX-License-Identifier: LGPL-3.0-or-later
"""Sums over shared nodes: equal to dolfinx's, and the same to the bit on every rank."""

import ctypes

import numpy as np
import pytest
from dolfinx import fem
from harness import Machine, bent, everywhere, largest

import complexbody as cb
from complexbody import _compat, native


def body(n_u, k):
    return cb.Body(k, lambda U, nu, N: U[0, 0] ** 2 + N[0, 0] ** 2, 1.0, 1.0, displacement=n_u)


def partial(machine, columns):
    """What this rank would give to its nodes: of all magnitudes, so that the order matters."""
    rng = np.random.default_rng(machine.disc.comm.rank)
    size = (machine.disc.nodes, columns)
    return rng.normal(size=size) * 10.0 ** rng.integers(-8, 8, size)


def global_numbers(machine):
    """Number of each of this rank's nodes that all ranks know it by."""
    disc = machine.disc
    return _compat.node_map(disc.scene.mesh).local_to_global(disc.dof.astype(np.int32))


def all_contributions(machine, values):
    """{node: [(rank, values), …] in the order of the ranks} of the whole body."""
    nodes = {}
    everyone = machine.disc.comm.allgather((global_numbers(machine), values))
    for rank, (numbers, rows) in enumerate(everyone):
        for number, row in zip(numbers, rows, strict=True):
            nodes.setdefault(int(number), []).append((rank, row))
    return nodes


@pytest.mark.parametrize("cells", [(11,), (5, 4), (3, 2, 3)])
def test_sum_equals_dolfinx_and_is_bitwise_the_same(comm, cells):
    """Also for more columns than a node's record has."""
    mesh = bent(comm, cells)
    machine = Machine(mesh, body(1, 1))
    for columns in (1, machine.disc.record + 3):
        given = partial(machine, columns)
        function = fem.Function(_compat.vector_space(mesh, columns))
        function.x.array.reshape(-1, columns)[machine.disc.dof] = given
        _compat.accumulate(function)
        found = given.copy()
        machine.disc.sum_shared(found)
        wide, disc = machine.disc.halo.widened(columns), machine.disc
        again = given[disc.late : disc.late + disc.shared].copy()
        wide.sum(again)
        wide.close()
        assert everywhere(comm, np.array_equal(again, found[disc.late : disc.late + disc.shared]))
        expected = function.x.array.reshape(-1, columns)[machine.disc.dof]
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-7)  # round-off of 1e8

        # In the order of the ranks, starting from zero: hence equal to the bit everywhere.
        nodes = all_contributions(machine, given)
        sums = {}
        for number, parts in nodes.items():
            sums[number] = np.zeros(columns)
            for _, row in parts:
                sums[number] += row
        exact = np.array([sums[int(i)] for i in global_numbers(machine)])
        assert everywhere(comm, np.array_equal(found, exact))
    if comm.size > 1:
        shared = [parts for parts in nodes.values() if len(parts) > 1]
        assert shared and comm.allreduce(machine.disc.shared) == sum(len(p) for p in shared)
    machine.close()


@pytest.mark.parametrize("cells, n_u, k", [((11,), 1, 1), ((5, 4), 3, 1), ((3, 2, 3), 3, 3)])
def test_compiled_exchange_equals_the_one_for_set_up(comm, cells, n_u, k):
    """The time loops' pack and sum, on records of 2, 4 and 8 doubles."""
    machine = Machine(bent(comm, cells), body(n_u, k))
    disc, kernels, halo = machine.disc, machine.kernels, machine.disc.halo
    kernels.f[:-1] = partial(machine, disc.record)
    expected = kernels.f[:-1].copy()
    disc.sum_shared(expected)
    kernels.c.cb_pack(
        ctypes.c_int64(len(halo.sends)), native.pointer(halo.sends),
        ctypes.c_void_p(kernels.f.ctypes.data + disc.late * disc.record * 8),
        native.pointer(halo.outgoing),
    )  # fmt: skip
    halo.begin()
    halo.end()
    kernels.c.cb_sum_shared(
        ctypes.c_int64(disc.shared), ctypes.c_int64(disc.late), native.pointer(halo.start),
        native.pointer(halo.source), native.pointer(halo.incoming), native.pointer(kernels.f),
    )  # fmt: skip
    assert everywhere(comm, np.array_equal(kernels.f[:-1], expected))
    machine.close()


def test_each_node_is_counted_by_one_rank(comm):
    """The lowest rank whose own cells touch it."""
    machine = Machine(bent(comm, (5, 4)), body(1, 1))
    flags = machine.disc.owned[:, None].astype(float)
    for parts in all_contributions(machine, flags).values():
        assert [row[0] for _, row in parts] == [1.0] + [0.0] * (len(parts) - 1)
    machine.close()


def test_a_rank_without_cells(comm):
    """More ranks than cells: nobody waits, and the sums are right."""
    machine = Machine(bent(comm, (2,)), body(1, 1))
    disc = machine.disc
    assert comm.allreduce(int(disc.owned.sum())) == 3
    ones = np.ones((disc.nodes, 1))
    disc.sum_shared(ones)
    x = disc.position[:-1, 0]
    inner = np.abs(x - np.median(np.unique(np.concatenate(comm.allgather(x))))) < 1e-9
    ranks = comm.allreduce(int(inner.any()))
    assert everywhere(comm, np.array_equal(ones[:, 0], np.where(inner, ranks, 1)))
    length = comm.allreduce(disc.volume[disc.owned].sum())
    ends = np.concatenate(comm.allgather(x))
    assert length == pytest.approx(np.ptp(ends), rel=1e-14)
    assert largest(comm, machine.forces()) == 0.0
    machine.close()
