# SPDX-License-Identifier: LGPL-3.0-or-later
"""Point sources: exact forces and moments, impulses, d'Alembert's solution, what is refused."""

import dolfinx
import numpy as np
import pytest
import ufl
from harness import bent, refused
from mpi4py import MPI

import complexbody as cb
from complexbody.errors import SceneError
from complexbody.points import point_load

COMM = MPI.COMM_WORLD


def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + 0.5 * ufl.inner(nu, nu) + 0.3 * U[0, 0] * N[0, 0]


def total(mesh, source, components):
    """Sum of the nodal forces and of their moments Σ f_i x_j over all ranks."""
    body = cb.Body(2, energy, 1.0, 1.0, displacement=3)
    node, component, value = point_load(cb.Scene(mesh, body), source)
    forces = np.zeros((len(mesh.geometry.x), 5))
    np.add.at(forces, (node, component), value)
    forces = forces[:, components]
    return (
        COMM.allreduce(forces.sum(axis=0)),
        COMM.allreduce(np.einsum("ai,aj->ij", forces, mesh.geometry.x)),
    )


@pytest.mark.parametrize("ghosts", [False, True])
@pytest.mark.parametrize("cells", [(7,), (4, 5), (3, 2, 3)])
def test_forces_and_moments_are_exact_on_all_ranks(cells, ghosts):
    dim, mesh = len(cells), bent(COMM, cells, ghosts)
    F, M = np.array([1.0, -2.0, 0.5]), np.arange(9.0).reshape(3, 3) - 3
    x = mesh.geometry.x[:, :dim]
    parts = COMM.allgather(x[np.lexsort(x.T)][: min(len(x), 2)])
    vertex = next(p for p in parts if len(p))[0]
    middle = np.full(dim, 0.43)
    for at in (vertex, middle, 0.5 * (vertex + middle), [*middle, 0.0][: min(dim + 1, 3)]):
        force, moment = total(mesh, cb.PointSource(at, F), [0, 1, 2])
        place = np.zeros(3)
        place[:dim] = np.ravel(at)[:dim]
        assert np.abs(force - F).max() < 1e-13
        assert np.abs(moment - np.outer(F, place)).max() < 1e-13
        force, moment = total(mesh, cb.PointSource(at, moment=M), [0, 1, 2])
        assert np.abs(force).max() < 1e-12
        assert np.abs(moment - M)[:, :dim].max() < 1e-12
    force, moment = total(mesh, cb.PointSource(middle, (0.0, 3.0), field="nu"), [3, 4])
    assert np.abs(force - [0.0, 3.0]).max() < 1e-13


def pair():
    return cb.Body(
        1, lambda U, v, N: 2 * U[0, 0] ** 2 + N[0, 0] ** 2 + 0.5 * U[0, 0] * N[0, 0], 1.5, 0.7,
        displacement=1,
    )  # fmt: skip


@pytest.mark.parametrize("method", [cb.Synchronous(), cb.AVI(), cb.LocalLeapfrog()], ids=repr)
def test_impulse_is_momentum_on_all_ranks(method):
    mesh = bent(COMM, (6, 5))
    body = cb.Body(2, energy, 1.3, 0.8, displacement=2)
    source = cb.PointSource((0.31, 0.47), (2.0, -1.0))
    ledger = cb.simulate(
        cb.Scene(mesh, body, loads=[source]), method, until=0.5, progress=False
    ).ledger
    momentum = [ledger["momentum_1"][-1], ledger["momentum_2"][-1]]
    assert np.abs(np.array(momentum) - [1.0, -0.5]).max() < 1e-12


def fields(mesh, plan=True, quiet=None):
    body = cb.Body(1, energy_scalar, 1.0, 1.0, displacement=3)
    source = cb.PointSource((0.25, 0.5), (1.0, 0.0, 0.0), cb.ricker(3.0))
    scene = cb.Scene(mesh, body, loads=[source])
    result = cb.simulate(
        scene, cb.Synchronous(step=0.01), until=0.6, progress=False, plan=plan, quiet=quiet
    )
    x = mesh.geometry.x
    u = result.u.x.array.reshape(len(x), -1)
    mine = {tuple(np.round(p, 9)): v.copy() for p, v in zip(x, u, strict=True)}
    return {k: v for part in mesh.comm.allgather(mine) for k, v in part.items()}


def energy_scalar(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + 0.3 * U[0, 0] * N[0, 0]


def test_ranks_agree_and_nothing_that_moves_is_left_out():
    def rectangle(comm):
        return dolfinx.mesh.create_rectangle(comm, [[0, 0], [2, 1]], [24, 12])

    mesh = rectangle(COMM)
    alone, here = fields(rectangle(MPI.COMM_SELF)), fields(mesh)
    size = max(np.abs(v).max() for v in alone.values())
    assert size > 1e-3
    assert max(np.abs(alone[k] - v).max() for k, v in here.items()) < 1e-12 * size
    whole = fields(mesh, plan=False, quiet=False)
    assert max(np.abs(whole[k] - v).max() for k, v in here.items()) < 1e-13 * size
    quiet = fields(mesh, plan=True, quiet=True)
    assert all(np.array_equal(quiet[k], v) for k, v in here.items())


@pytest.mark.serial
def test_d_alembert():
    """u(x, t) = (1/2ρc) ∫ F g ds up to t − |x − x_s|/c, order 2; ends absorb."""
    body = cb.Body(1, lambda U, v, N: 0.5 * 4 * U[0, 0] ** 2 + N[0, 0] ** 2, 1.0, 1.0,
                   displacement=1)  # fmt: skip
    history, c, at, until, errors = cb.ricker(4.0), 2.0, 0.437, 0.6, []
    s = np.linspace(0, until, 20001)
    f = history(s)
    integral = np.concatenate([[0], np.cumsum(0.5 * np.diff(s) * (f[1:] + f[:-1]))])
    for cells in (160, 320):
        mesh = dolfinx.mesh.create_interval(MPI.COMM_SELF, cells, [0.0, 1.0])
        scene = cb.Scene(mesh, body, loads=[cb.PointSource(at, 3.0, history)],
                         absorbing=[cb.Absorb("boundary")])  # fmt: skip
        u = cb.simulate(scene, cb.Synchronous(safety=0.5), until=until, progress=False).u
        x = mesh.geometry.x[:, 0]
        exact = 3.0 / (2 * c) * np.interp(until - np.abs(x - at) / c, s, integral, left=0.0)
        size = 3.0 / (2 * c) * np.abs(integral).max()
        errors.append(np.sqrt(np.mean((u.x.array - exact) ** 2)) / size)
    assert errors[1] < 2e-3
    assert np.log2(errors[0] / errors[1]) > 1.7


def test_what_is_no_source_is_refused_on_all_ranks():
    mesh = bent(COMM, (4, 5))
    body = cb.Body(2, energy, 1.0, 1.0, displacement=2)

    def run(*arguments, **options):
        scene = cb.Scene(mesh, body, loads=[cb.PointSource(*arguments, **options)])
        cb.simulate(scene, until=0.1, progress=False)

    with refused(SceneError, "outside the body"):
        run((2.0, 0.5), (1.0, 0.0))
    with refused(SceneError, "2 dimensions"):
        run((0.5,), (1.0, 0.0))
    with refused(SceneError, "2 finite components"):
        run((0.5, 0.5), (1.0, 0.0, 0.0))
    with refused(SceneError, "no vector and no moment"):
        run((0.5, 0.5))
    with refused(SceneError, "one row for each", "Give"):
        run((0.5, 0.5), moment=np.eye(3))
    with refused(SceneError, "finite"):
        run((np.nan, 0.5), (1.0, 0.0))
