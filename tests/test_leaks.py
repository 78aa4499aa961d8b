# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nothing is left behind: communicators, PETSc's objects, files, and memory, over many runs."""

import gc
import os
import re
from pathlib import Path

import numpy as np
import pytest
import ufl
from harness import everywhere, largest
from petsc4py import PETSc

import complexbody as cb
from complexbody import meshes
from complexbody.errors import ComplexBodyError
from complexbody.problem import Problem
from complexbody.simulation import Simulation


def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + ufl.inner(nu, nu) + 0.1 * U[0, 0] * nu[0]


def bent_energy(U, nu, N):
    return energy(U, nu, N) + nu[0] ** 4


def chi(nu, rate):
    return 0.5 * (1 + nu[0] ** 2) * rate[0] ** 2


#: Integrators with the energy and inertia that they run on: linear, or solved by SNES.
CASES = {
    "synchronous": (cb.Synchronous(), energy, 1.0),
    "octaves": (cb.AVI(), energy, 1.0),
    "windows": (cb.AVI(balanced=False), energy, 1.0),
    "exact": (cb.AVI(schedule="exact"), energy, 1.0),
    "local": (cb.LocalLeapfrog(), energy, 1.0),
    "nodal newton": (cb.Implicit(), energy, chi),
    "snes": (cb.Implicit(quadrature="consistent"), energy, chi),
    "split": (cb.Implicit(forces="implicit"), bent_energy, 1.0),
    "assembly": (cb.AssembledLeapfrog(), energy, 1.0),
    "matrix": (cb.AssembledLeapfrog("matrix"), energy, 1.0),
    "newmark": (cb.Newmark(0.01), energy, 1.0),
    "newmark, snes": (cb.Newmark(0.01), bent_energy, 1.0),
    "alpha2": (cb.PetscTS("alpha2", 0.01), energy, 1.0),
    "rk4": (cb.PetscTS("rk4"), energy, 1.0),
    "cn": (cb.PetscTS("cn", 0.01), energy, 1.0),
}


def scene(mesh, density, inertia):
    body = cb.Body(1, density, 1.0, inertia, displacement=2)
    return cb.Scene(
        mesh, body, initial=cb.Initial(u=lambda x: 0.01 * x[:2], nu=0.1),
        supports=[cb.Fix("u", lambda x: x[0] < 1e-9, value=0.1, history=cb.ramp(1.0))],
    )  # fmt: skip


def simulated(comm, name, folder):
    """One simulation with output and a probe; or one that is refused, on the way or before."""
    method, density, inertia = CASES[name]
    mesh = meshes.rectangle(comm, (0, 0), (1, 1), (4, 4))
    made = scene(mesh, density, inertia)
    if name in ("newmark", "newmark, snes", "alpha2", "rk4", "cn"):  # they move no supports
        made = cb.Scene(mesh, made.body, initial=made.initial)
    output = cb.Output(folder, probes={"a": (0.5, 0.5)})
    cb.simulate(made, method, until=0.05, output=output)


def refused_ones(comm):
    """Errors before a run and in it, which must leave nothing either."""
    mesh = meshes.rectangle(comm, (0, 0), (1, 1), (4, 4))
    good = scene(mesh, energy, 1.0)
    for method, history in (
        (cb.Synchronous(step=9.0), cb.constant()),
        (cb.Newmark(), cb.constant()),
        (cb.AVI(), lambda t: np.nan * t),
    ):
        loads = [cb.BodyForce((1.0, 0.0), history=history)]
        made = cb.Scene(mesh, good.body, supports=good.supports, loads=loads)
        with pytest.raises(ComplexBodyError):
            cb.simulate(made, method, until=0.05)


class Counts:
    """What is alive now, on this rank; collective."""

    def __init__(self, comm, folder):
        gc.collect()
        comm.barrier()
        # Open MPI gives a new communicator the lowest number that is free.
        new = comm.Dup()
        self.communicators = new.py2f()
        new.Free()
        self.files = len(os.listdir("/proc/self/fd"))
        self.petsc = alive(comm, folder)

    def __eq__(self, other):
        return self.__dict__ == other.__dict__

    def __repr__(self):
        return repr(self.__dict__)


def alive(comm, folder):
    """PETSc's objects created and not destroyed since logging began, by class, on rank 0."""
    path = str(folder / "log.txt")
    viewer = PETSc.Viewer().createASCII(path, comm=comm)
    PETSc.Log.view(viewer)
    viewer.destroy()
    comm.barrier()
    counts = {}
    for line in Path(path).read_text().splitlines():
        found = re.match(r"\s*([A-Z][A-Za-z ]+?)\s+(\d+)\s+(\d+)(\s+\d+\s+\d+)?\.?\s*$", line)
        if found and found[1] != "Viewer":
            counts[found[1]] = int(found[2]) - int(found[3])
    comm.barrier()
    return counts


def check_nothing_left(comm, folder, rounds, names=tuple(CASES)):
    """Counts after some rounds of cases are those after the first one; simulations run."""
    PETSc.Log.begin()

    def round_of_all():
        for name in names:
            simulated(comm, name, folder / "out")
        refused_ones(comm)

    round_of_all()
    before = Counts(comm, folder)
    assert "Vector" in before.petsc and "Matrix" in before.petsc
    for _ in range(rounds):
        round_of_all()
    after = Counts(comm, folder)
    assert everywhere(comm, after == before), (before, after)
    return rounds * len(names)


def test_nothing_is_left_on_any_rank(comm, shared_path):
    """Over a few simulations of all kinds of objects, and three that are refused."""
    names = ("synchronous", "octaves", "snes", "newmark, snes")
    assert check_nothing_left(comm, shared_path, 2, names) == 8


@pytest.mark.slow
def test_nothing_is_left_of_many_on_any_rank(comm, shared_path):
    """Over 210 simulations."""
    assert check_nothing_left(comm, shared_path, 14) >= 200


def test_the_counts_count(comm, shared_path):
    """A communicator and a vector that are kept are seen."""
    PETSc.Log.begin()
    before = Counts(comm, shared_path)
    kept = comm.Dup(), PETSc.Vec().createMPI(5 * comm.size, comm=comm)
    after = Counts(comm, shared_path)
    assert after.communicators > before.communicators
    assert after.petsc.get("Vector", 0) == before.petsc.get("Vector", 0) + 1
    kept[0].Free()
    kept[1].destroy()


class Memory:
    """Looks at the resident memory of this process as a run goes."""

    looks = 50

    def __init__(self):
        self.pages = []

    def look(self, run, problem):
        """Pages now."""
        self.pages.append(int(Path("/proc/self/statm").read_text().split()[1]))


@pytest.mark.slow
@pytest.mark.parametrize("method", [cb.Synchronous(), cb.AVI(), cb.LocalLeapfrog()])
def test_memory_is_flat_over_many_steps_on_any_rank(comm, shared_path, method):
    """100 000 steps with loads, moving supports, ledger, probes: flat after the first tenth."""
    mesh = meshes.rectangle(comm, (0, 0), (1, 1), (6, 6))
    made = scene(mesh, energy, 1.0)
    loads = [cb.BodyForce((1.0, 0.0), history=cb.sine(3.0))]
    made = cb.Scene(mesh, made.body, supports=made.supports, loads=loads)
    problem = Problem(made)
    step = method.prepare(problem, 1e4).step  # as long as this one's, steps divide a run evenly
    problem.close()
    watch = Memory()
    output = cb.Output(shared_path / "out", probes={"a": (0.5, 0.5)}, probe_steps=1000)
    simulation = Simulation(made, method, until=100_000 * step, output=output, watch=watch)
    result = simulation.run()
    assert result.stats.steps >= 99_000
    early, late = watch.pages[len(watch.pages) // 10], watch.pages[-1]
    assert largest(comm, (late - early) / early) < 0.01, watch.pages
