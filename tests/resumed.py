# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs that are cut at a checkpoint and resumed, and what must be the same afterwards."""

import shutil

import numpy as np
from mpi4py import MPI
from written import read

import complexbody as cb
from complexbody import _compat, statefile

FIELDS = ("u", "nu", "u_dot", "nu_dot")


def simulated(scene, method, until, folder, **options):
    """A run with output between steps, probes and a ledger of few rows."""
    dim = scene.mesh.geometry.dim
    given = {"every": until / 7, "probes": {"inside": (0.41, 0.37, 0.33)[:dim]}, "probe_steps": 3}
    output = cb.Output(folder, fields=("u", "nu_dot", "stress"), **given)
    return cb.simulate(scene, method, until=until, output=output, ledger_steps=4, **options)


def cut(comm, old, new, which):
    """Copy a run's folder as if it had been killed when a later step was under way.

    The ``which``-th of its checkpoints is the last in the copy. Returns its steps.
    """
    steps = None
    comm.barrier()
    if comm.rank == 0:
        shutil.copytree(old, new)
        paths = statefile.listed(new / "checkpoints")[::-1]
        for path in paths[which + 1 :]:
            path.unlink()
        steps = statefile.steps_of(paths[which])
    return comm.bcast(steps)


def by_number(function):
    """Numbers in the mesh's input of this rank's nodes, and their values."""
    mesh = function.function_space.mesh
    values = function.x.array.reshape(_compat.node_count(mesh), -1)
    return np.asarray(mesh.geometry.input_global_indices), values


def same_result(comm, one, other):
    """To the bit: fields, ledger, probes, counters."""
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name).x.array, getattr(other, name).x.array)
    np.testing.assert_array_equal(np.array(one.ledger.rows), np.array(other.ledger.rows))
    assert one.probes.keys() == other.probes.keys()
    for name, table in one.probes.items():
        for column, values in table.items():
            np.testing.assert_array_equal(values, other.probes[name][column])
    for name in ("steps", "updates", "quiet", "step", "critical"):
        assert getattr(one.stats, name) == getattr(other.stats, name), name
    assert one.time == other.time and one.solving == other.solving


def same_files(comm, one, other):
    """The same series, to the bit."""
    comm.barrier()
    if comm.rank == 0:
        for name in ("ledger.csv", "probe-inside.csv"):
            assert (one / name).read_bytes() == (other / name).read_bytes()
        for name in ("u", "nu_dot", "stress"):
            both = (read(folder / f"{name}.xdmf")[2] for folder in (one, other))
            for first, second in zip(*both, strict=True):
                assert first[:2] == second[:2]
                np.testing.assert_array_equal(first[2], second[2])
    comm.barrier()


def sub(comm, size):
    """A communicator of the first ``size`` ranks, or None on the others."""
    part = comm.Split(0 if comm.rank < size else MPI.UNDEFINED)
    return None if part == MPI.COMM_NULL else part
