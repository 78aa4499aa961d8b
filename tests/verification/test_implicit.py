# SPDX-License-Identifier: LGPL-3.0-or-later
"""``cb.Implicit`` against exact solutions, the explicit integrator and a plain reference."""


import dolfinx
import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import ufl
from dense import halves
from harness import largest, refused
from mpi4py import MPI
from verification.general_inertia import bubble, collapsing, line, powers, stretching

import complexbody as cb
from complexbody.errors import BodyError, IntegratorError, StepError

QUADRATURES = ("vertex", "consistent")


B, K = 0.8, 2.0


def gyroscope(comm):
    """½|ν̇|² + b/2 (ν₁ν̇₂ − ν₂ν̇₁): z = ν₁ + iν₂ obeys z̈ = −ib ż − kz."""
    body = cb.Body(
        2, stretching, 1.0,
        lambda nu, v: 0.5 * ufl.inner(v, v) + B / 2 * (nu[0] * v[1] - nu[1] * v[0]),
        displacement=1, potential=lambda u, nu: 0.5 * K * ufl.inner(nu, nu),
    )  # fmt: skip
    return cb.Scene(line(comm), body, initial=cb.Initial(nu=(1.0, 0.0), nu_dot=(0.3, -0.2)))


def gyroscope_at(t):
    """z(t)."""
    roots = np.roots([1, B, -K])
    amounts = np.linalg.solve([[1, 1], 1j * roots], [1.0, 0.3 - 0.2j])
    return np.sum(amounts * np.exp(1j * roots * t))


def errors(make, exact, counts, until, **options):
    """Largest error of ν, and of the energy's balance, for numbers of steps."""
    out = []
    for n in counts:
        scene = make()
        result = cb.simulate(scene, cb.Implicit(until / n, **options), until=until, ledger_steps=1)
        values = result.nu.x.array.reshape(-1, scene.descriptor)
        out.append([largest(scene.mesh.comm, values - exact),
                    np.abs(result.ledger["balance"]).max()])  # fmt: skip
    return np.array(out), result


@pytest.mark.parametrize("quadrature", QUADRATURES)
@pytest.mark.parametrize("order", (1, 2))
def test_order_where_inertia_depends_on_the_state(comm, quadrature, order):
    """The oscillator in ν^{5/2}: slope of the field's error and of the energy's."""
    exact = (1 + 0.5 * np.cos(2.6)) ** 0.4
    found, result = errors(
        lambda: powers(comm), exact, (80, 160), 1.3, order=order, quadrature=quadrature
    )
    slopes = np.log2(found[0] / found[1])
    assert np.all(np.abs(slopes - order) < (0.25 if order == 1 else 0.02)), slopes
    assert found[1, 0] < (4e-4 if order == 1 else 2e-5)
    assert "Newton iterations per step" in result.solving and "T₀" in result.solving


@pytest.mark.parametrize("order", (1, 2))
def test_gyroscope(comm, order):
    """Momenta that depend on ν; linear, so that one Newton iteration is enough."""
    z = gyroscope_at(1.5)
    found, result = errors(
        lambda: gyroscope(comm), np.array([z.real, z.imag]), (60, 120), 1.5, order=order
    )
    slope = np.log2(found[0, 0] / found[1, 0])
    assert abs(slope - order) < (0.1 if order == 1 else 0.02), slope
    assert "at most 1;" in result.solving


def moved(comm):
    """A bar of two materials with viscosity, loads and a moving support of u and ν."""
    mesh = line(comm, 12)
    cells = np.arange(mesh.topology.index_map(1).size_local, dtype=np.int32)
    centres = dolfinx.mesh.compute_midpoints(mesh, 1, cells)[:, 0]
    tags = dolfinx.mesh.meshtags(mesh, 1, cells, np.where(centres < 0.5, 1, 2).astype(np.int32))
    omega = np.array([[1.0, 0.2], [0.2, 0.7]])

    def body(factor, eta):
        return cb.Body(
            2, lambda U, nu, N: factor * stretching(U, nu, N) + 0.3 * U[0, 0] * nu[0]
            + 0.5 * ufl.inner(nu, nu), 1.3, factor * omega, eta, displacement=1,
        )  # fmt: skip

    return cb.Scene(
        mesh, {1: body(1.0, 0.4), 2: body(2.0, 0.0)}, cell_tags=tags,
        supports=[cb.Fix("u", lambda x: x[0] < 1e-9, 0.1, history=cb.sine(0.6)),
                  cb.Fix("nu", lambda x: x[0] < 1e-9, (0.05, -0.1), history=cb.sine(0.4))],
        loads=[cb.BodyForce(1.0, history=cb.sine(0.9)),
               cb.BodyForce((0.5, 0.2), history=cb.sine(0.3), field="nu")],
        initial=cb.Initial(nu=lambda x: np.stack([np.sin(3 * x[0]), x[0] ** 2]), nu_dot=(0.2, 0.1)),
    )  # fmt: skip


@pytest.mark.parametrize("order", (1, 2))
def test_quadratic_inertia_is_the_explicit_scheme(comm, order):
    """Solving where nothing needs solving gives ``Synchronous``; unasked, it is that."""
    explicit = (
        cb.Synchronous(0.02, dissipation="symmetric") if order == 2 else
        cb.Synchronous(0.02, dissipation="forward", start="one-sided")
    )  # fmt: skip
    one = cb.simulate(moved(comm), explicit, until=1.0, ledger_steps=1)
    two = cb.simulate(
        moved(comm), cb.Implicit(0.02, order=order, solve="always"), until=1.0, ledger_steps=1
    )
    three = cb.simulate(moved(comm), cb.Implicit(0.02, order=order), until=1.0)
    for name in ("u", "nu", "u_dot", "nu_dot"):
        values = [getattr(r, name).x.array for r in (one, two, three)]
        if order == 2 or name in ("u", "nu"):
            assert largest(comm, values[0] - values[1]) < 1e-11, name
        assert largest(comm, values[0] - values[2]) < 1e-14, name
    assert not three.solving and two.solving


def test_books_balance_to_second_order(comm):
    """Work of loads and moving supports, dissipation and energies at a step's own time."""
    balance = []
    for n in (50, 100):
        result = cb.simulate(
            moved(comm), cb.Implicit(1 / n, solve="always"), until=1.0, ledger_steps=1
        )
        balance.append(np.abs(result.ledger["balance"]).max())
    assert 1.8 < np.log2(balance[0] / balance[1]) < 2.2, balance


@pytest.mark.parametrize("quadrature", QUADRATURES)
def test_books_know_regions(comm, quadrature):
    """Kinetic energies of two regions that differ in density and inertia."""
    mesh = line(comm, 10)
    bodies = [cb.Body(1, stretching, rho, omega, displacement=1)
              for rho, omega in ((1.0, 2.0), (5.0, 7.0))]  # fmt: skip
    scene = cb.Scene(mesh, dict(enumerate(bodies, 1)), cell_tags=halves(mesh),
                     initial=cb.Initial(u_dot=1.0, nu_dot=2.0))  # fmt: skip
    method = cb.Implicit(1e-3, quadrature=quadrature, solve="always")
    ledger = cb.simulate(scene, method, until=1e-2, ledger_steps=1).ledger
    for name, energy in (("kinetic_u", 1.5), ("kinetic_nu", 9.0)):
        assert np.abs(ledger[name] - energy).max() < 1e-11, name


@pytest.mark.serial
def test_consistent_inertia_is_leapfrog_with_the_full_mass(comm):
    """SNES with a quadratic χ against M x_{n+1} = M(2x_n − x_{n−1}) − h²Kx_n, M and K by hand."""
    n, h, steps = 12, 0.01, 40
    body = cb.Body(1, lambda U, nu, N: stretching(U, nu, N) + 0.5 * nu[0] ** 2, 1.0, 1.7,
                   displacement=1)  # fmt: skip
    scene = cb.Scene(line(comm, n), body, initial=cb.Initial(nu=lambda x: np.cos(3 * x[0])))
    result = cb.simulate(
        scene, cb.Implicit(h, quadrature="consistent", solve="always"), until=h * steps
    )
    ones = np.ones(n)
    mass = sp.diags([np.r_[1, 2 * ones[1:], 1] / 3, ones / 6, ones / 6], (0, 1, -1)) / n
    stiff = n * sp.diags([np.r_[1, 2 * ones[1:], 1], -ones, -ones], (0, 1, -1)) + mass
    solve = spla.factorized((1.7 * mass).tocsc())
    at = np.linspace(0, 1, n + 1)
    x, v = np.cos(3 * at), np.zeros(n + 1)
    for i in range(steps):
        v -= (0.5 if i == 0 else 1.0) * h * solve(stiff @ x)
        x = x + h * v
    order = np.argsort(scene.mesh.geometry.x[:, 0])
    assert np.abs(result.nu.x.array[order] - x).max() < 1e-10


def swelling(comm, cells, **more):
    """Coupled u and ν, χ = ½(1 + ν)³ν̇², a field that varies in space."""
    body = cb.Body(
        1, lambda U, nu, N: stretching(U, nu, N) + 0.4 * U[0, 0] * nu[0] + nu[0] ** 2, 1.0,
        lambda nu, v: 0.5 * (1 + nu[0]) ** 3 * v[0] ** 2, displacement=1, **more,
    )  # fmt: skip
    return cb.Scene(
        line(comm, cells), body, supports=[cb.Fix("u", "boundary")],
        initial=cb.Initial(nu=lambda x: 0.3 * np.cos(np.pi * x[0])),
    )  # fmt: skip


def test_quadratures_converge_to_each_other(comm):
    """With order 2 in mesh size."""
    gaps = []
    for cells in (16, 32):
        both = [
            cb.simulate(swelling(comm, cells), cb.Implicit(0.005, quadrature=q), until=0.5).nu
            for q in QUADRATURES
        ]
        gaps.append(largest(comm, both[0].x.array - both[1].x.array))
    assert 1.8 < np.log2(gaps[0] / gaps[1]) < 2.2, gaps


@pytest.mark.parametrize("quadrature", QUADRATURES)
def test_ranks_agree(comm, quadrature):
    """With one rank that has it all."""
    method = cb.Implicit(0.01, quadrature=quadrature)
    alone = cb.simulate(swelling(MPI.COMM_SELF, 24, viscosity=0.3), method, until=0.3)
    shared = cb.simulate(swelling(comm, 24, viscosity=0.3), method, until=0.3)

    def at(result):
        return np.round(24 * result.scene.mesh.geometry.x[:, 0]).astype(int)

    for name in ("u", "nu", "u_dot", "nu_dot"):
        whole = np.zeros(25)
        whole[at(alone)] = getattr(alone, name).x.array
        assert largest(comm, getattr(shared, name).x.array - whole[at(shared)]) < 1e-10, name
    for column in ("kinetic_nu", "dissipated"):
        difference = alone.ledger[column][-1] - shared.ledger[column][-1]
        assert abs(difference) < 1e-10, column


@pytest.mark.serial
def test_energy_stays_and_rates_are_of_bounded_variation(comm):
    """Over 60 periods no drift beside the oscillation; pV does not grow with 1/h (Prop. 3)."""
    balance = cb.simulate(powers(comm), cb.Implicit(0.05), until=60 * np.pi, ledger_steps=3).ledger[
        "balance"
    ]
    half = len(balance) // 2
    assert abs(balance[:half].mean() - balance[half:].mean()) < 0.01 * np.ptp(balance)
    variation = [
        cb.simulate(swelling(comm, 16), cb.Implicit(h), until=1.0).ledger["variation_nu"][-1]
        for h in (0.02, 0.005)
    ]
    assert abs(variation[1] / variation[0] - 1) < 0.05


def test_quadratic_is_recognised(comm):
    """χ given as a function: by its derivatives, with terms that differ by k; every integrator."""
    omega = np.array([[2.0, 0.4], [0.4, 1.0]])

    def chi(nu, v):
        return v[0] ** 2 + 0.4 * v[0] * v[1] + ufl.inner(v, v) / 2 - v[0] ** 2 / 2 + v[0] ** 2 / 2

    make = lambda inertia: cb.Scene(  # noqa: E731
        line(comm), cb.Body(2, lambda U, nu, N: stretching(U, nu, N) + ufl.inner(nu, nu), 1.0,
                            inertia, displacement=1),
        initial=cb.Initial(nu=(0.2, 0.1)),
    )  # fmt: skip
    scene = make(chi)
    assert np.allclose(scene.body.inertia, omega + np.diag([1.0, 0.0]), atol=1e-15)
    for method in (cb.Synchronous(), cb.AVI(), cb.Implicit()):
        one = cb.simulate(scene, method, until=0.5)
        two = cb.simulate(make(scene.body.inertia), method, until=0.5)
        assert largest(comm, one.nu.x.array - two.nu.x.array) == 0.0
    assert callable(gyroscope(comm).body.inertia)
    assert callable(make(lambda nu, v: ufl.inner(v, v) + 0.01 * nu[0] ** 2).body.inertia)


def test_refusals(comm):
    """Steps above T₀ or the critical one, inertia that is not convex or not finite, options."""
    fast = powers(comm)
    fast = cb.Scene(fast.mesh, fast.body, initial=cb.Initial(nu=1.0, nu_dot=10.0))
    for order, limit in ((1, 1 / 30), (2, 2 / np.sqrt(300))):
        with refused(StepError, "T₀", f"{limit:.6g}"):
            cb.simulate(fast, cb.Implicit(1.2 * limit, order=order), until=2.0)
    with refused(StepError, "critical"):
        cb.simulate(swelling(comm, 64), cb.Implicit(0.05), until=1.0)
    start = collapsing(comm)
    for nu, word in ((-1.0, "A5"), (0.0, "A5")):
        with refused(BodyError, word, "ν = "):
            cb.simulate(cb.Scene(start.mesh, start.body, initial=cb.Initial(nu=nu)),
                        cb.Implicit(0.1), until=1.0)  # fmt: skip
    singular = cb.Body(1, stretching, 1.0, lambda nu, v: v[0] ** 2 / nu[0], displacement=1)
    with refused(BodyError, "A4"):
        cb.simulate(cb.Scene(start.mesh, singular), cb.Implicit(0.1), until=1.0)
    massless = cb.Body(1, stretching, 1.0, 0.0, 1.0, displacement=1)
    with refused(IntegratorError, "without inertia"):
        cb.simulate(cb.Scene(start.mesh, massless), cb.Implicit(solve="always"), until=1.0)
    for name, value in (("order", 3), ("quadrature", "nodes"), ("solve", "never")):
        with refused(IntegratorError, name):
            cb.Implicit(**{name: value})
    for name in ("step", "tolerance", "safety"):
        with refused(StepError, name):
            cb.Implicit(**{name: 0.0})


def test_rayleigh_plesset(comm):
    """Free oscillation from 1.6 R0 down to half of it: radius in the period's course, order 2."""
    _, reference = bubble(comm, 1.6)
    until = 0.8 * reference.period(1.6e-3)
    exact = reference.trajectory(1.6e-3, [0.0, until])[0, -1] - 1e-3
    found = []
    for n in (200, 400):
        scene, _ = bubble(comm, 1.6)
        result = cb.simulate(scene, cb.Implicit(until / n), until=until)
        found.append(largest(comm, result.nu.x.array - exact))
    assert 1.9 < np.log2(found[0] / found[1]) < 2.1, found
    assert found[1] < 1e-7
