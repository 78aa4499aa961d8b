# SPDX-License-Identifier: LGPL-3.0-or-later
"""Angular momentum, ν's share included, of free objective bodies that spin and swing.

Every cell's potential is invariant when all its nodes turn, u and ν together, so kicks change no
L; nor do drifts. Where old forces act on new positions, L is kept to the order of the scheme.
"""

import dataclasses

import nonlinear
import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from harness import bent, largest, vertex_rule

import complexbody as cb
from complexbody import _compat, rotations
from complexbody.problem import Problem

CELLS = {2: (4, 3), 3: (2, 2, 2)}


def history(comm, method, n=2, until=3.0, **more):
    """L against time (rows, axes), and the result."""
    scene = cb.Scene(
        bent(comm, CELLS[n]), nonlinear.body(n, **more), initial=nonlinear.spinning(n)
    )
    result = cb.simulate(scene, method, until=until, ledger_steps=1)
    columns = [name for name in result.ledger.columns if name.startswith("angular_momentum")]
    assert len(columns) == (1 if n == 2 else 3)
    return np.array([result.ledger[name] for name in columns]).T, result


def lost(L):
    """Largest change of L, relative to it."""
    return np.abs(L - L[0]).max() / np.abs(L[0]).max()


def assembled(result, action):
    """∫ (x+u) × ρu̇ + 𝒜(ν)*Ων̇ by dolfinx with the vertex rule, another way than by lumps."""
    square, n = result.scene.mesh, result.scene.displacement
    body = result.scene.bodies[0]
    omega = ufl.as_matrix(body.inertia_matrix.tolist())
    pad = lambda f: ufl.as_vector([f[i] if i < n else 0.0 for i in range(3)])  # noqa: E731
    x = ufl.SpatialCoordinate(square)
    x = ufl.as_vector([x[i] if i < square.geometry.dim else 0.0 for i in range(3)])
    L = body.density * ufl.cross(x + pad(result.u), pad(result.u_dot))
    if action == "vector":
        L += ufl.cross(pad(result.nu), pad(ufl.dot(omega, result.nu_dot)))
    parts = [fem.assemble_scalar(_compat.form(L[i] * vertex_rule(square))) for i in range(3)]
    return square.comm.allreduce(np.array(parts))


EXACT = {
    "synchronous": cb.Synchronous(),
    "windows": cb.AVI(balanced=False),
    "real steps": cb.AVI(schedule="exact", corrected=False),
    "as published": cb.AVI.as_published(),
    "implicit": cb.Implicit(),
}


@pytest.mark.parametrize("name", EXACT)
def test_kept_to_round_off_on_ranks(comm, name):
    """It is kept whatever the step, while it goes to and fro between u and ν."""
    L, result = history(comm, EXACT[name])
    assert lost(L) < 1e-12
    assert largest(comm, result.u.x.array) > 1  # it turned by more than a radian
    np.testing.assert_allclose(cb.angular_momentum(result)[2], L[-1, 0], rtol=1e-12)
    if name == "synchronous":
        found = assembled(result, "vector")
        np.testing.assert_allclose(cb.angular_momentum(result), found, atol=1e-12)
        # Neither share is kept for itself.
        orbit = cb.angular_momentum(result, rotations.scalar(2))
        np.testing.assert_allclose(orbit, assembled(result, "scalar"), atol=1e-12)
        assert abs(orbit[2] - L[-1, 0]) > 1e-2 * abs(L[0, 0])


@pytest.mark.slow
@pytest.mark.parametrize("name", EXACT)
def test_kept_to_round_off_in_space(comm, name):
    L, _ = history(comm, EXACT[name], n=3)
    assert lost(L) < 1e-12


@pytest.mark.serial
def test_kept_to_the_order_of_the_scheme(comm):
    """Balanced windows: order 2. Corrected cells: higher, since potentials are nearly theirs."""
    for make, low, high in (
        (lambda a: cb.AVI(safety=a), 1.8, 2.3),
        (lambda a: cb.AVI(safety=a, schedule="exact"), 3.0, 5.0),
    ):
        losses = [lost(history(comm, make(a))[0]) for a in (0.4, 0.2, 0.1)]
        slopes = np.log2(np.array(losses[:-1]) / losses[1:])
        assert (slopes > low).all() and (slopes < high).all(), (losses, slopes)
        assert losses[-1] < 1e-4


def test_not_kept_where_it_should_not_be(comm):
    """Viscosity ην̇ is not objective; nor is an energy that fixes a direction in space."""
    assert lost(history(comm, cb.Synchronous(), viscosity=0.5)[0]) > 1e-3
    aligned = lambda U, nu, N: nonlinear.energy(U, nu, N) + 0.3 * nu[0] ** 2  # noqa: E731
    square = bent(comm, CELLS[2])
    body = cb.Body(2, aligned, 1.0, 1.0, displacement=2, rotation=rotations.vector(2))
    scene = cb.Scene(square, body, initial=nonlinear.spinning(2))
    result = cb.simulate(scene, until=1.0)
    assert lost(result.ledger["angular_momentum_3"][:, None]) > 1e-2


def test_linear_bodies_keep_theirs(comm):
    """x × ρu̇ + 𝒜(ν̄)*Ων̇, of a linearised body and of plane Cosserat; (x + u) × ρu̇ is not kept."""
    m = nonlinear.DIRECTION[:2]
    whole = nonlinear.spinning(2)
    start = dataclasses.replace(whole, nu=lambda x: whole.nu(x) - m[:, None])
    square = bent(comm, CELLS[2])
    scene = cb.Scene(square, cb.linearise(nonlinear.body(2), m), initial=start)
    result = cb.simulate(scene, until=3.0, ledger_steps=1)
    L = result.ledger["angular_momentum_3"]
    assert lost(L[:, None]) < 1e-12
    finite = cb.angular_momentum(result, rotations.vector(2))[2]
    assert abs(finite - L[-1]) > 1e-2 * abs(L[-1])

    def cosserat(U, nu, N):
        e = ufl.sym(U)
        turn = 0.5 * (U[1, 0] - U[0, 1])
        return ufl.inner(e, e) + 0.4 * (turn - nu[0]) ** 2 + ufl.inner(N, N)

    body = cb.Body(1, cosserat, 1.0, 0.2, rotation=rotations.angle().about())
    initial = cb.Initial(u_dot=lambda x: np.array([-x[1], x[0] ** 2, 0 * x[0]]), nu_dot=1.0)
    result = cb.simulate(cb.Scene(square, body, initial=initial), until=3.0, ledger_steps=1)
    assert lost(result.ledger["angular_momentum_3"][:, None]) < 1e-12
    assert result.ledger.units()[-1] == "N m s"


def test_bodies_of_several_regions_and_left_out_components(comm):
    """Different densities meet at nodes; components at rest are left out of runs, not of L."""
    square = bent(comm, CELLS[2])
    cells = np.arange(_compat.cell_count(square)[0], dtype=np.int32)
    tags = mesh.meshtags(square, 2, cells, (1 + cells % 2).astype(np.int32))
    bodies = {1: nonlinear.body(2), 2: nonlinear.body(2, density=3.0, inertia=np.diag([0.7, 0.7]))}
    scene = cb.Scene(square, bodies, cell_tags=tags, initial=nonlinear.spinning(2))
    result = cb.simulate(scene, until=1.0, ledger_steps=1)
    L = result.ledger["angular_momentum_3"]
    assert lost(L[:, None]) < 1e-12
    np.testing.assert_allclose(cb.angular_momentum(result)[2], L[-1], rtol=1e-12)

    plain = cb.Body(
        3, lambda U, nu, N: ufl.inner(ufl.sym(U), ufl.sym(U)) + ufl.inner(nu, nu), 1.0, 1.0,
        rotation=rotations.vector().about(),
    )  # fmt: skip
    initial = cb.Initial(u_dot=lambda x: np.array([-x[1], x[0] ** 2, 0 * x[0]]))
    scene = cb.Scene(square, plain, initial=initial)
    assert not Problem(scene, reduce=True).live.all
    result = cb.simulate(scene, until=1.0)
    L = result.ledger["angular_momentum_3"]
    assert lost(L[:, None]) < 1e-12
    np.testing.assert_allclose(cb.angular_momentum(result)[2], L[-1], rtol=1e-12)
    # A body that does not say how it turns has no such column.
    silent = cb.simulate(cb.Scene(square, cb.Body(3, plain.energy, 1.0, 1.0)), until=0.1)
    assert not any(name.startswith("angular") for name in silent.ledger.columns)
