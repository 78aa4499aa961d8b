# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forces and energies of all kernels equal dolfinx's assembly of independently written forms."""

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from harness import Machine, Quadratic, Reference, bent, everywhere, largest, vertex_rule, wavy
from hypothesis import given, settings
from hypothesis import strategies as st

import complexbody as cb
from complexbody import _compat, native
from complexbody.errors import BodyError

TOLERANCE = 1e-12


def check(machine, reference, values, stored, potential=None):
    """Forces and total energies of both agree for the UFL integrals ``stored``, ``potential``."""
    comm = machine.disc.comm
    machine.set(values)
    reference.set(values)
    total = stored if potential is None else stored + potential
    expected = machine.disc.gather(reference.forces(total))
    scale = largest(comm, expected)
    assert scale > 1e-3, "the reference says nothing"
    assert largest(comm, machine.forces() - expected) < TOLERANCE * scale
    energies = machine.energies().sum(axis=0)
    for found, form in zip(energies, (stored, potential), strict=True):
        if form is None:
            assert found == 0.0
        else:
            known = reference.energy(form)
            assert abs(known) > 1e-4
            assert found == pytest.approx(known, rel=TOLERANCE)


@pytest.mark.parametrize(
    "cells, n_u, k, lanes, self_action",
    [
        ((23,), 1, 1, 8, "consistent"),
        ((23,), 1, 1, 4, "lumped"),
        ((5, 4), 2, 1, 4, "consistent"),
        ((5, 4), 2, 1, 8, "lumped"),
        ((5, 4), 3, 2, 8, "consistent"),
        ((3, 2, 3), 3, 3, 4, "lumped"),
        ((3, 2, 3), 3, 3, 8, "consistent"),
        ((3, 2, 3), 3, 6, 4, "consistent"),
        ((3, 2, 3), 3, 6, 8, "consistent"),
    ],
)
def test_quadratic_energies(comm, monkeypatch, cells, n_u, k, lanes, self_action):
    """Records of 2, 4, 8 and 16 doubles, four and eight cells at a time, two self-actions."""
    monkeypatch.setattr(native, "lanes", lambda: lanes)
    mesh, density = bent(comm, cells), Quadratic(n_u, k, seed=len(cells))
    body = cb.Body(k, density.energy, 1.0, 1.0, displacement=n_u)
    machine, reference = Machine(mesh, body, self_action=self_action), Reference(mesh, n_u, k)
    assert machine.kernels.densities.generated == [True]
    assert machine.disc.cells.shape[1:] == (len(cells) + 1, lanes)
    rule = vertex_rule(mesh) if self_action == "lumped" else None
    form = density.form(density.constants(mesh), reference.U, reference.nu, reference.N, rule)
    check(machine, reference, wavy(mesh, n_u + k), form)
    machine.close()


@settings(derandomize=True, database=None, deadline=None, max_examples=5)
@given(
    shape=st.sampled_from([((5, 4), 2, 1), ((23,), 1, 1), ((3, 2, 3), 3, 3)]),
    seed=st.integers(0, 99),
    rank=st.integers(0, 3),
)
def test_any_coercive_hessian(comm, shape, seed, rank):
    """Equal to dolfinx; symmetric; blind to translations; a free body pulls on itself in vain."""
    (cells, n_u, k), n = shape, shape[1] + shape[2]
    mesh, density = bent(comm, cells), Quadratic(n_u, k, seed, rank)
    density.factor = np.concatenate([density.factor, np.zeros((3 - rank, density.factor.shape[1]))])
    machine = Machine(mesh, cb.Body(k, density.energy, 1.0, 1.0, displacement=n_u))
    reference = Reference(mesh, n_u, k)
    form = density.form(density.constants(mesh), reference.U, reference.nu, reference.N)
    x, y = (wavy(mesh, n, seed + i) for i in (1, 2))
    check(machine, reference, x, form)

    fx = machine.forces()
    moved = x.copy()
    moved[:, :n_u] += [3.0, -2.0, 0.5][:n_u]
    machine.set(moved)
    scale = largest(comm, fx)
    assert largest(comm, machine.forces() - fx) < 1e-13 * largest(comm, moved) * scale * 10
    assert largest(comm, machine.total(fx)[:n_u]) < 1e-13 * scale * 10
    machine.set(y)
    fy = machine.forces()
    one, other = (machine.total(machine.disc.gather(a) * b) for a, b in ((y, fx), (x, fy)))
    size = machine.total(np.abs(machine.disc.gather(y) * fx)).sum()
    assert one.sum() == pytest.approx(other.sum(), abs=1e-13 * size)
    assert machine.total(machine.disc.gather(y) * fy).sum() < 0  # y·Ky > 0
    machine.close()


@pytest.mark.parametrize("lanes", [4, 8])
def test_equal_and_opposite_columns(comm, monkeypatch, lanes):
    """The generated code merges them: of symmetric and skew parts, sums and differences."""
    monkeypatch.setattr(native, "lanes", lambda: lanes)
    mesh = bent(comm, (5, 4))
    lam = cellwise(mesh)

    def energy(U, nu, N):
        return (
            ufl.inner(ufl.sym(U), ufl.sym(U))
            + 1.7 * ufl.inner(ufl.skew(U), ufl.skew(U))
            + 0.6 * (N[0, 1] - N[1, 0]) ** 2
            + lam * (N[0, 0] + N[1, 1]) ** 2
            + (nu[0] - nu[1]) * (U[0, 1] - U[1, 0] - 2 * nu[0] + 2 * nu[1])
        )

    machine, reference = Machine(mesh, cb.Body(2, energy, 1.0, 1.0)), Reference(mesh, 3, 2)
    assert "- g" in machine.kernels.source(True, False)  # or there was nothing to merge
    form = energy(reference.U, reference.nu, reference.N) * ufl.dx
    check(machine, reference, wavy(mesh, 5), form)
    machine.close()


def test_rotations_of_an_objective_energy(comm):
    """An energy of sym U has no force under an infinitesimal rotation, and one under a stretch."""
    mesh = bent(comm, (3, 2, 3))

    def energy(U, nu, N):
        return ufl.inner(ufl.sym(U), ufl.sym(U)) + ufl.inner(N, N) + nu[0] * ufl.tr(U)

    machine = Machine(mesh, cb.Body(1, energy, 1.0, 1.0))
    x = np.asarray(mesh.geometry.x)
    state = np.zeros((len(x), 4))
    state[:, :3] = np.cross([0.3, -1.0, 0.7], x)
    machine.set(state)
    assert largest(comm, machine.forces()) < 1e-14
    state[:, :3] = x * [1.0, 0.0, 0.0]
    machine.set(state)
    assert largest(comm, machine.forces()) > 1e-2
    machine.close()


def tags_by(mesh, classify):
    """Cell tags 1 + classify(midpoints (3, cells)), of owned cells and ghosts."""
    tdim = mesh.topology.dim
    cells = np.arange(_compat.cell_count(mesh)[1], dtype=np.int32)
    middle = np.asarray(mesh.geometry.x)[_compat.cell_nodes(mesh)].mean(axis=1)
    return dolfinx.mesh.meshtags(mesh, tdim, cells, 1 + classify(middle.T).astype(np.int32))


def cellwise(mesh):
    """A positive DG0 function of the cells' positions."""
    function = fem.Function(_compat.cell_space(mesh))
    function.interpolate(lambda x: 2.0 + np.sin(5 * x[0] + 3 * x[1]))
    return function


def nodal(mesh, components=1):
    """A P1 function of positions, positive in each component."""
    function = fem.Function(_compat.vector_space(mesh, components))
    function.x.array[:] = 2.0 + wavy(mesh, components, seed=9).ravel()
    return function


def basic(U, nu, N):
    """A coercive energy that couples everything: to be scaled and added to."""
    return (
        ufl.inner(U, U)
        + ufl.inner(N, N)
        + ufl.inner(nu, nu)
        + 0.5 * ufl.tr(U) * nu[0]
        + 0.3 * U[0, 1] * N[0, 0]
    )


def coefficient_densities(mesh):
    """Name -> (densities with coefficients, whether straight-line code is generated)."""
    x, c = ufl.SpatialCoordinate(mesh), fem.Constant(mesh, 1.7)
    lam, mu, director, later = cellwise(mesh), nodal(mesh), nodal(mesh, 2), []

    def after(U, nu, N):
        if not later:
            later.append(nodal(mesh))  # numbered behind the unknowns of the action
        return basic(U, nu, N) * (1 + lam * later[0][0] ** 2) + mu[0] * nu[0] ** 2

    stretch = lambda U: director[0] * U[0, 0] + director[1] * U[1, 1]  # noqa: E731
    return {
        "cellwise": (
            lambda U, nu, N: (
                lam * basic(U, nu, N) + ufl.sqrt(lam) * U[0, 0] ** 2 + nu[1] ** 2 / lam
            ),
            True,
        ),
        "constant": (lambda U, nu, N: c * basic(U, nu, N) + c**2 * U[0, 0] ** 2, True),
        "position": (lambda U, nu, N: (1 + x[0] ** 2) * basic(U, nu, N) * lam, False),
        "nodal": (lambda U, nu, N: mu[0] * basic(U, nu, N) + lam * stretch(U) ** 2, False),
        "gradient": (lambda U, nu, N: (2 + ufl.grad(mu)[0, 1]) * basic(U, nu, N), False),
        "after": (after, False),
    }


@pytest.mark.parametrize("name", ["cellwise", "constant", "position", "nodal", "gradient", "after"])
def test_coefficients(comm, name):
    """Cell by cell, a constant, of the position, nodal, a gradient; packed before and behind q."""
    mesh = bent(comm, (5, 4))
    energy, generated = coefficient_densities(mesh)[name]
    machine = Machine(mesh, cb.Body(2, energy, 1.0, 1.0))
    reference = Reference(mesh, 3, 2)
    assert machine.kernels.densities.generated == [generated]
    assert machine.kernels.densities.linear
    form = energy(reference.U, reference.nu, reference.N) * ufl.dx
    check(machine, reference, wavy(mesh, 5), form)
    machine.close()


def potentials(mesh):
    """Name -> (w, whether forces stay affine)."""
    lam = cellwise(mesh)
    return {
        "linear": (lambda u, nu: 3.0 * u[0] - lam * u[2] + 2 * nu[1] + 0.7, True),
        "quadratic": (lambda u, nu: 2 * u[0] ** 2 + lam * u[1] * nu[0] + (nu[1] - 1) ** 2, True),
        "quartic": (lambda u, nu: (nu[0] ** 2 - 1) ** 2 + 0.5 * u[1] ** 2, False),
    }


@pytest.mark.parametrize("name", ["linear", "quadratic", "quartic"])
def test_potentials_and_prestress(comm, name):
    """Potentials of degree 1, 2 and 4, on an energy with constant stresses."""
    mesh = bent(comm, (3, 2, 2))
    w, linear = potentials(mesh)[name]

    def energy(U, nu, N):
        return basic(U, nu, N) + 0.4 * U[0, 1] - 0.2 * N[1, 2] + 0.6 * nu[1] + 0.25

    machine = Machine(mesh, cb.Body(2, energy, 1.0, 1.0, potential=w))
    reference = Reference(mesh, 3, 2)
    assert machine.kernels.densities.generated == [linear]
    assert machine.kernels.densities.linear == linear
    stored = energy(reference.U, reference.nu, reference.N) * ufl.dx
    values = wavy(mesh, 5)
    check(machine, reference, values, stored, w(reference.u, reference.nu) * ufl.dx)
    # At rest only the constant part is left, and repeated evaluations do not add it up.
    check(machine, reference, 0 * values, stored, w(reference.u, reference.nu) * ufl.dx)
    machine.close()


@pytest.mark.parametrize("degree", [None, 2])
def test_nonlinear_densities(comm, degree):
    """Exponential, determinant and quartic, at UFL's own and at a given quadrature degree."""
    mesh = bent(comm, (3, 2, 2))
    lam = cellwise(mesh)

    def energy(U, nu, N):
        F = ufl.Identity(3) + 0.1 * U
        return (
            lam * ufl.exp(0.1 * ufl.inner(U, U))
            + (ufl.det(F) - 1) ** 2
            + ufl.ln(1 + nu[0] ** 2)
            + nu[1] ** 4 * (1 + ufl.inner(N, N))
        )

    body = cb.Body(2, energy, 1.0, 1.0, quadrature_degree=degree)
    machine, reference = Machine(mesh, body), Reference(mesh, 3, 2)
    assert machine.kernels.densities.generated == [False]
    assert not machine.kernels.densities.linear
    measure = ufl.dx if degree is None else ufl.dx(degree=degree)
    form = energy(reference.U, reference.nu, reference.N) * measure
    check(machine, reference, wavy(mesh, 5), form)
    machine.close()


def test_bodies_by_region(comm):
    """A quadratic body under two tags, a nonlinear one and a third, each with its own potential."""
    mesh = bent(comm, (7, 6))
    tags = tags_by(mesh, lambda x: (x[0] > 0.4).astype(int) + 2 * (x[1] > 0.6))  # 1, 2, 3, 4
    lam = cellwise(mesh)

    def quartic(U, nu, N):
        return basic(U, nu, N) + nu[0] ** 4

    def pull(u, nu):
        return 3.0 * u[0] - lam * nu[0] + u[1] ** 2

    twice = cb.Body(2, basic, 1.0, 1.0, potential=pull)
    bodies = {
        1: twice,
        2: cb.Body(2, quartic, 1.0, 1.0, potential=lambda u, nu: u[0] ** 3),
        3: cb.Body(2, lambda U, nu, N: lam * basic(U, nu, N) + U[0, 0], 1.0, 1.0),
        4: twice,
    }
    machine = Machine(mesh, bodies, cell_tags=tags)
    assert machine.kernels.densities.generated == [True, False, True, True]
    reference, dx = Reference(mesh, 3, 2), ufl.dx(domain=mesh, subdomain_data=tags)
    stored, potential = {}, {}
    for tag, body in bodies.items():
        stored[tag] = body.energy(reference.U, reference.nu, reference.N) * dx(tag)
        if body.potential is not None:
            potential[tag] = body.potential(reference.u, reference.nu) * dx(tag)
    check(machine, reference, wavy(mesh, 5), sum(stored.values()), sum(potential.values()))
    energies = machine.energies()
    for row, tag in enumerate(sorted(bodies)):
        assert energies[row, 0] == pytest.approx(reference.energy(stored[tag]), rel=TOLERANCE)
        outer = reference.energy(potential[tag]) if tag in potential else 0.0
        assert energies[row, 1] == pytest.approx(outer, rel=TOLERANCE, abs=0.0)
    # The package's own form is one more way to say the same.
    action = machine.action
    action.q.x.array[:] = wavy(mesh, 5).ravel()
    own = comm.allreduce(fem.assemble_scalar(_compat.form(action.potential_energy(action.q))))
    assert own == pytest.approx(energies.sum(), rel=TOLERANCE)
    machine.close()


@pytest.mark.parametrize("quartic", [False, True])
def test_ranks_without_cells(comm, quartic):
    """More ranks than cells: their kernels, generated or not, have nothing to do."""
    mesh = bent(comm, (2,))
    lam = cellwise(mesh)

    def energy(U, nu, N):
        return lam * (U[0, 0] ** 2 + N[0, 0] ** 2) + nu[0] ** (4 if quartic else 2)

    machine = Machine(mesh, cb.Body(1, energy, 1.0, 1.0, displacement=1))
    reference = Reference(mesh, 1, 1)
    form = energy(reference.U, reference.nu, reference.N) * ufl.dx
    check(machine, reference, wavy(mesh, 2), form)
    machine.close()


def test_lumping_covers_the_potential(comm):
    """Self-action of ρe and quadratic ρw alike; affine parts stay exact."""
    mesh = bent(comm, (5, 4))

    def w(u, nu):
        return u[0] ** 2 + 0.5 * u[1] * nu[0]

    body = cb.Body(2, basic, 1.0, 1.0, potential=w)
    machine, reference = Machine(mesh, body, self_action="lumped"), Reference(mesh, 3, 2)
    own, u = ufl.inner(reference.nu, reference.nu), reference.u
    rest = basic(reference.U, reference.nu, reference.N) - own
    stored = rest * ufl.dx + own * vertex_rule(mesh)
    check(machine, reference, wavy(mesh, 5), stored, w(u, reference.nu) * vertex_rule(mesh))
    machine.close()


def test_an_energy_blind_to_everything(comm):
    """No force, and the constant energy density times the volume."""
    mesh = bent(comm, (5, 4))
    machine = Machine(mesh, cb.Body(1, lambda U, nu, N: 2.5, 1.0, 1.0))
    machine.set(wavy(mesh, 4))
    assert everywhere(comm, not machine.forces().any())
    volume = comm.allreduce(machine.disc.volume[machine.disc.owned].sum())
    assert machine.energies()[0] == pytest.approx([2.5 * volume, 0.0], rel=1e-13)
    machine.close()


def test_coefficient_that_cannot_be_packed(comm):
    """A function of a space with oriented degrees of freedom is refused, not misread."""
    mesh = bent(comm, (3, 2))
    space = getattr(fem, "functionspace", fem.FunctionSpace)  # dolfinx 0.5 knows the latter only
    edge = fem.Function(space(mesh, ("N1curl", 1)))
    body = cb.Body(1, lambda U, nu, N: (1 + edge[0]) * nu[0] ** 2, 1.0, 1.0)
    with pytest.raises(BodyError, match="Interpolate it into a Lagrange or DG space"):
        Machine(mesh, body)
