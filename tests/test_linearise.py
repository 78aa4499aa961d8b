# SPDX-License-Identifier: LGPL-3.0-or-later
"""Linearisation: Hessians against differences by numpy, prestress, and runs that come close."""

import dataclasses
import functools

import nonlinear
import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from harness import bent, largest, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat, hessian
from complexbody.action import Action
from complexbody.errors import BodyError, PrestressError
from complexbody.kernels.library import Densities
from complexbody.linearise import linearise, prestress

M = nonlinear.DIRECTION


def split(g, n):
    """(U, ν, N) of a flat array, for n components of u and of ν."""
    U, nu, N = np.split(g, [3 * n, 4 * n])
    return U.reshape(n, 3), nu, N.reshape(n, 3)


def slopes(n, g):
    """Gradient of the energy written in numpy, by complex steps: exact to round-off."""
    steps = 1e-30j * np.eye(len(g))
    return np.array([nonlinear.by_hand(*split(g + step, n)).imag / 1e-30 for step in steps])


def curvatures(n, g, h=1e-4):
    """Its Hessian: complex steps within central differences of order four."""
    rows = []
    for e in np.eye(len(g)):
        one, two = (slopes(n, g + i * h * e) - slopes(n, g - i * h * e) for i in (1, 2))
        rows.append((8 * one - two) / (12 * h))
    return np.array(rows)


def dense(body, domain, n):
    """H of (U, ν, N) row by row as the kernels read it, and the linear terms."""
    found = hessian.read(body.energy, domain, n, n, "gradients")
    assert found is not None and found.cellwise
    order = [*range(3 * n), *range(7 * n, 8 * n), *range(3 * n, 6 * n)]
    place = {index: row for row, index in enumerate(order)}
    H, slope = np.zeros((7 * n, 7 * n)), np.zeros(7 * n)
    for (i, j), value in found.hessian.items():
        H[place[i], place[j]] = value
    for i, value in found.linear.items():
        slope[place[i]] = value
    return H, slope


@pytest.mark.serial
@pytest.mark.parametrize("n", [2, 3])
def test_hessian_is_the_second_derivative(n):
    """About the natural state, and about a strained one with what it carries kept."""
    domain = mesh.create_unit_cube(MPI.COMM_SELF, 1, 1, 1)
    rng = np.random.default_rng(n)
    for U, nu in ((np.zeros((n, 3)), M[:n]), (0.2 * rng.normal(size=(n, 3)), rng.normal(size=n))):
        natural = not U.any()
        keep = "refuse" if natural else "keep"
        body = linearise(nonlinear.body(n), nu, U, prestress=keep)
        H, slope = dense(body, domain, n)
        g = np.concatenate([U.ravel(), nu, np.zeros(3 * n)])
        np.testing.assert_allclose(H, curvatures(n, g), rtol=0, atol=1e-9)
        np.testing.assert_allclose(slope, slopes(n, g) * (not natural), rtol=0, atol=1e-12)
        found = prestress(nonlinear.body(n), nu, U)
        parts = [found.stress.ravel(), found.self_action, found.microstress.ravel()]
        np.testing.assert_allclose(np.concatenate(parts), slopes(n, g), rtol=0, atol=1e-12)
        assert (found.relative < 1e-15) == natural


@pytest.mark.serial
def test_kernels_are_generated():
    """What FFCx had to do for the nonlinear body is straight-line code for the linear one."""
    domain = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    for body, expected in ((nonlinear.body(2), False), (_small(), True)):
        found = Densities(Action(cb.Scene(domain, body)))
        assert found.generated == [expected] and found.linear == expected


def test_what_a_body_keeps():
    """Names, constants and numbers stay; ν is counted from ν̄, and turns by little."""
    body = nonlinear.body(3, density=2.0, inertia=np.diag([1.0, 2.0, 3.0]), viscosity=0.5)
    made = linearise(body, M)
    assert made.name == "director, linearised" and made.constants == body.constants
    assert (made.density, made.viscosity, made.displacement) == (2.0, 0.5, 3)
    np.testing.assert_array_equal(made.inertia_matrix, body.inertia_matrix)
    assert made.rotation.infinitesimal
    # ν turns by q × ν̄, whatever small ν is.
    spins = made.rotation.generator(np.zeros((1, 3)))[0]
    np.testing.assert_allclose(spins @ [0.1, 0.2, 0.3], np.cross([0.1, 0.2, 0.3], M), atol=1e-13)


def test_potential_and_general_inertia():
    """W is expanded about (0, ν̄), its slope kept as a load; χ has its Ω at ν̄."""
    domain = mesh.create_unit_interval(MPI.COMM_SELF, 2)

    def energy(U, nu, N):
        return U[0, 0] ** 2 + (nu[0] - 2) ** 4 + (nu[0] - 2) ** 2 * (1 + U[0, 0]) + N[0, 0] ** 2

    body = cb.Body(
        1, energy, 1.0, lambda nu, rate: 0.5 * nu[0] ** 3 * rate[0] ** 2, displacement=1,
        potential=lambda u, nu: ufl.exp(nu[0]) + u[0] * nu[0],
    )  # fmt: skip
    made = linearise(body, 2.0)
    np.testing.assert_allclose(made.inertia_matrix, [[8.0]])
    w = hessian.read(made.potential, domain, 1, 1, "fields")
    assert w.linear == {6: 2.0, 7: pytest.approx(np.exp(2))}
    assert w.hessian[6, 7] == 1.0 and w.hessian[7, 7] == pytest.approx(np.exp(2))
    e = hessian.read(made.energy, domain, 1, 1, "gradients")
    assert e.hessian == {(0, 0): 2.0, (7, 7): 2.0, (3, 3): 2.0} and not e.linear


def test_gyroscopic_inertia():
    """A χ that couples ν and ν̇ stays a function, quadratic in both."""
    body = cb.Body(
        2, lambda U, nu, N: ufl.inner(U, U) + ufl.inner(N, N) + ufl.inner(nu, nu), 1.0,
        lambda nu, rate: 0.5 * ufl.exp(nu[0]) * ufl.inner(rate, rate)
        + 0.3 * (ufl.sin(nu[0]) * rate[1] - nu[1] * rate[0]),
    )  # fmt: skip
    made = linearise(body)
    domain = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    chi = hessian.read(made.inertia, domain, 2, 2, "fields")
    first = 3 * 4
    assert chi.hessian == {
        (first + 2, first + 2): 1.0, (first + 3, first + 3): 1.0,
        (first, first + 3): 0.3, (first + 3, first): 0.3,
        (first + 1, first + 2): -0.3, (first + 2, first + 1): -0.3,
    }  # fmt: skip


def test_states_that_are_not_natural_are_refused(comm):
    """With the numbers, and what to do."""
    body = nonlinear.body(3)
    with refused(PrestressError, "P̄", "z̄: -0.8 at nu1", "natural") as told:
        linearise(body, 0.0)
    assert "prestress='keep'" in told[0]
    with pytest.raises(PrestressError) as caught:
        linearise(body, M, np.diag([0.1, 0, 0]))
    found = caught.value.prestress
    F = np.diag([1.1, 1, 1])
    lost = M - F @ M
    P = nonlinear.MU * (F - np.linalg.inv(F)) + nonlinear.LAM * np.log(1.1) * np.linalg.inv(F)
    P -= nonlinear.A * np.outer(lost, M)
    np.testing.assert_allclose(found.stress, P, atol=1e-14)
    np.testing.assert_allclose(found.self_action, nonlinear.A * lost, atol=1e-14)
    # The tolerance is a strain: units of ν do not matter.
    near = linearise(body, M + 1e-10)
    assert near.name.endswith("linearised")
    for wrong in ({"nu": np.nan}, {"nu": [1, 2]}, {"U": np.eye(2)}, {"prestress": "drop"}):
        with refused(BodyError):
            linearise(body, **{"nu": M, **wrong})
    with refused(BodyError, "not differentiable"):
        linearise(cb.Body(1, lambda U, nu, N: ufl.sqrt(nu[0] ** 2), 1.0, 1.0))
    with refused(BodyError, "no finite value"):
        linearise(cb.Body(1, lambda U, nu, N: ufl.ln(nu[0]), 1.0, 1.0))


def test_coefficients_that_vary(comm):
    """DG0 coefficients stay in H, and prestress is looked for in every cell of every rank."""
    square = mesh.create_unit_square(comm, 3, 3)
    stiff = fem.Function(_compat.cell_space(square))
    stiff.interpolate(lambda x: 1 + 5 * x[0] * x[1])

    def energy(U, nu, N, shift=0.0):
        F = cb.deformation(U)
        J = ufl.det(F)
        return (
            stiff * (0.5 * (ufl.inner(F, F) - 3) - ufl.ln(J) + shift * (J - 1))
            + ufl.inner(nu, nu) + ufl.inner(N, N)
        )  # fmt: skip

    made = linearise(cb.Body(1, energy, 1.0, 1.0))
    found = hessian.read(made.energy, square, 3, 1, "gradients")
    assert found.cellwise and len(found.expressions()) > 0
    most = comm.allreduce(stiff.x.array.max(), MPI.MAX)
    strained = cb.Body(1, lambda U, nu, N: energy(U, nu, N, 0.1), 1.0, 1.0)
    assert prestress(strained).stress[1, 1] == pytest.approx(0.1 * most)
    with refused(PrestressError):
        linearise(strained)


@functools.cache
def _small():
    return linearise(nonlinear.body(2), M[:2])


@pytest.mark.parametrize(
    "method",
    [
        cb.Synchronous(),
        cb.AVI(balanced=False),
        cb.AVI(),
        cb.AVI(schedule="exact"),
        cb.Implicit(),
    ],
    ids=["synchronous", "windows", "balanced", "exact", "implicit"],
)
def test_small_motions_are_those_of_the_linear_body_on_ranks(comm, method):
    """The difference falls like amplitude squared, in every integrator."""
    square, n = bent(comm, (4, 3)), 2
    whole, small = nonlinear.body(n), _small()
    differences = []
    for a in (2e-3, 1e-3):
        runs = []
        for body in (whole, small):
            start = nonlinear.spinning(n, a, spin=0.0)
            if body is small:
                start = dataclasses.replace(start, nu=lambda x, s=start: s.nu(x) - M[:n, None])
            runs.append(cb.simulate(cb.Scene(square, body, initial=start), method, until=1.5))
        shift = np.tile(M[:n], len(runs[0].nu.x.array) // n)
        parts = [
            runs[0].u.x.array - runs[1].u.x.array,
            runs[0].nu.x.array - shift - runs[1].nu.x.array,
        ]
        differences.append(largest(comm, np.concatenate(parts)))
        assert largest(comm, runs[1].u.x.array) > a  # it did move
        assert differences[-1] < 20 * a**2
    assert differences[0] / differences[1] == pytest.approx(4.0, rel=0.05)
