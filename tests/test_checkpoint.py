# SPDX-License-Identifier: LGPL-3.0-or-later
"""A run resumed from a checkpoint is one that was never stopped: to the bit on as many ranks."""

import numpy as np
import pytest
from busy import busy
from harness import largest, refused
from mpi4py import MPI
from resumed import FIELDS, by_number, cut, same_files, same_result, simulated, sub

import complexbody as cb
from complexbody import meshes
from complexbody.errors import CheckpointError
from complexbody.problem import Problem
from complexbody.timesets import critical_step

SLOW = pytest.mark.slow


def cases(known, *fast):
    """Names of cases, those that are not fast left to `make verify`."""
    return [name if name in fast else pytest.param(name, marks=SLOW) for name in known]


SYNCHRONOUS = {
    "exact": ("numbers", 0.0, cb.Synchronous()),
    "blocks, forward": ("blocks", 0.0, cb.Synchronous(dissipation="forward")),
    "no inertia, one-sided": ("no inertia", 0.0, cb.Synchronous(start="one-sided")),
    "nonlinear, symmetric": ("numbers", 3.0, cb.Synchronous(dissipation="symmetric")),
}
LOCAL = {
    "balanced": ("numbers", 0.0, cb.AVI()),
    "plain windows": ("blocks", 0.0, cb.AVI(balanced=False, dissipation="forward")),
    "real steps": ("numbers", 0.0, cb.AVI(schedule="exact")),
    "as published": ("numbers", 0.0, cb.AVI.as_published()),
    "nonlinear balanced": ("numbers", 3.0, cb.AVI(dissipation="symmetric")),
    "local leapfrog": ("numbers", 0.0, cb.LocalLeapfrog(step=None, levels=2)),
}
IMPLICIT = {
    "midpoint": ("numbers", 0.0, cb.Implicit(0.004)),
    "first order": ("numbers", 3.0, cb.Implicit(0.004, order=1)),
    "SNES": ("numbers", 0.0, cb.Implicit(0.004, quadrature="consistent")),
    "forces": ("numbers", 0.0, cb.Implicit(0.004, forces="implicit")),
    "nonlinear forces": ("no inertia", 3.0, cb.Implicit(0.004, forces="implicit", order=1)),
}


def whole_and_cut(comm, scene, method, until, folder, each, which, **options):
    """Run to the end, without and with checkpoints; then resume from one, and compare bits."""
    plain = simulated(scene, method, until, folder / "plain", **options)
    keep = {"checkpoint": cb.Checkpoint(None, each, keep=1000), **options}
    whole = simulated(scene, method, until, folder / "whole", **keep)
    same_result(comm, plain, whole)
    same_files(comm, folder / "plain", folder / "whole")
    for number in which:
        again = folder / f"again-{number}"
        steps = cut(comm, folder / "whole", again, number)
        resumed = simulated(scene, method, until, again, resume=True, **keep)
        assert 0 < steps < resumed.stats.steps
        same_result(comm, whole, resumed)
        same_files(comm, folder / "whole", again)
    return whole


@pytest.mark.parametrize("case", cases(SYNCHRONOUS, "exact", "nonlinear, symmetric"))
def test_synchronous(comm, shared_path, case):
    kind, quartic, method = SYNCHRONOUS[case]
    scene = busy(comm, 2, kind, quartic)
    until = 23.4 * critical_step(Problem(scene), method.dissipation)
    whole_and_cut(comm, scene, method, until, shared_path, 5, (0, 2))


@pytest.mark.parametrize("case", cases(LOCAL, "balanced", "real steps", "local leapfrog"))
def test_local_steps(comm, shared_path, case):
    kind, quartic, method = LOCAL[case]
    scene = busy(comm, 2, kind, quartic)
    until = 40.4 * critical_step(Problem(scene), method.dissipation)
    whole_and_cut(comm, scene, method, until, shared_path, 1, (0, 2))


def plain_scene(comm, nonlinear=False):
    """A square with supports at rest, for integrators that move none."""

    def energy(U, nu, N):
        grad = sum(U[i, j] ** 2 for i in range(2) for j in range(3)) + 0.6 * U[0, 0] * N[0, 1]
        value = 0.5 * grad + 0.4 * sum(N[0, j] ** 2 for j in range(3)) + 0.7 * nu[0] ** 2
        return value + (0.5 * nu[0] ** 4 if nonlinear else 0.0)

    mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 1), (5, 4)), 0.2)
    body = cb.Body(1, energy, 1.3, 0.8, 0.3, displacement=2)
    return cb.Scene(
        mesh, body, [cb.Fix("u", lambda x: x[0] < 1e-9)],
        [cb.Traction(lambda x: x[0] > 1 - 1e-9, (0.3, -0.2), cb.sine(0.7))],
        cb.Initial(nu=lambda x: np.cos(2 * x[:1])),
    )  # fmt: skip


@pytest.mark.parametrize("case", cases(IMPLICIT, "midpoint", "forces"))
def test_implicit(comm, shared_path, case):
    kind, quartic, method = IMPLICIT[case]
    scene = busy(comm, 2, kind, quartic)
    whole_and_cut(comm, scene, method, 17.4 * method.step, shared_path, 5, (0, 2))


PEERS = {
    "assembly": (True, cb.AssembledLeapfrog(step=0.02)),
    "matrix": (False, cb.AssembledLeapfrog("matrix", step=0.02)),
    "newmark": (False, cb.Newmark(0.03)),
    "nonlinear newmark": (True, cb.Newmark(0.03)),
}


@pytest.mark.parametrize("case", cases(PEERS, "matrix", "newmark"))
def test_peers(comm, shared_path, case):
    nonlinear, method = PEERS[case]
    scene = plain_scene(comm, nonlinear)
    whole_and_cut(comm, scene, method, 17 * method.step, shared_path, 5, (0, 2))


def test_petsc_keeps_its_state_to_itself(comm, shared_path):
    scene, output = plain_scene(comm), cb.Output(shared_path)
    with refused(CheckpointError, "PetscRun", "--checkpoint-every 0"):
        cb.simulate(
            scene, cb.PetscTS(step=0.02), until=0.1, output=output, checkpoint=cb.Checkpoint()
        )


@pytest.mark.parametrize(
    "method",
    [cb.Synchronous(), cb.AVI(), pytest.param(cb.AVI(balanced=False), marks=SLOW)],
    ids=("one step", "avi", "plain"),
)
def test_quiet_cells(comm, shared_path, method):
    """A pulse that has reached a part of the body: what is quiet stays so, and no bit changes."""

    def energy(U, nu, N):
        squares = sum(U[0, j] ** 2 + N[0, j] ** 2 for j in range(3))
        return 0.5 * squares + 0.2 * (U[0, 0] + nu[0]) ** 2

    mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (12, 1), (240, 6)), 0.2)
    scene = cb.Scene(
        mesh, cb.Body(1, energy, 1.0, 1.0, 0.1, displacement=1),
        loads=[cb.Traction(lambda x: x[0] < 1e-9, (1.0,), cb.ricker(2.0))],
    )  # fmt: skip
    whole = whole_and_cut(comm, scene, method, 2.0, shared_path, 20, (0, 1))
    assert 0.2 < whole.stats.quiet < 0.95


OTHER = ("synchronous", "balanced", "real steps", "implicit", "newmark")


@pytest.mark.parametrize("case", cases(OTHER, "synchronous", "balanced"))
def test_other_numbers_of_ranks(comm, shared_path, case):
    """1 to all, all to 1, and 3 to 2 ranks: the same to round-off."""
    method = {
        "synchronous": cb.Synchronous(0.01), "balanced": cb.AVI(), "newmark": cb.Newmark(0.03),
        "real steps": cb.AVI(schedule="exact"), "implicit": cb.Implicit(0.01, forces="implicit"),
    }[case]  # fmt: skip
    until, keep = 0.6, cb.Checkpoint(None, 2, keep=1000)

    def run(ranks, folder, **more):
        scene = plain_scene(ranks) if case == "newmark" else busy(ranks, 2, "numbers")
        return simulated(scene, method, until, folder, checkpoint=keep, **more)

    reference = run(MPI.COMM_SELF, shared_path / f"alone-{comm.rank}")
    numbers, _ = by_number(reference.u)
    assert np.array_equal(np.sort(numbers), np.arange(len(numbers)))

    def same(result, ranks):
        if case != "newmark":  # whose linear solver takes more iterations on more ranks
            assert result.stats.updates == pytest.approx(reference.stats.updates, rel=0.01)
        for name in FIELDS:
            numbers, known = by_number(getattr(reference, name))
            expected = np.empty_like(known)
            expected[numbers] = known
            mine, found = by_number(getattr(result, name))
            scale = 1e-11 if case != "newmark" else 1e-8
            assert largest(ranks, found - expected[mine]) < scale * abs(known).max(), name
        rows, known = np.array(result.ledger.rows), np.array(reference.ledger.rows)
        np.testing.assert_allclose(rows, known, rtol=1e-7, atol=1e-8 * np.nanmax(abs(known)))

    cut(comm, shared_path / "alone-0", shared_path / "onto-all", 1)
    same(run(comm, shared_path / "onto-all", resume=True), comm)
    run(comm, shared_path / "all")
    cut(comm, shared_path / "all", shared_path / "onto-one", 1)
    if comm.rank == 0:
        same(run(MPI.COMM_SELF, shared_path / "onto-one", resume=True), MPI.COMM_SELF)
    cut(comm, shared_path / "all", shared_path / "onto-two", 1)
    two = sub(comm, 2) if comm.size > 2 else None
    if two is not None:
        same(run(two, shared_path / "onto-two", resume=True), two)
        two.Free()
    comm.barrier()
