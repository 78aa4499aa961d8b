# SPDX-License-Identifier: LGPL-3.0-or-later
"""Decagonal quasicrystals: coercivity at its boundary, 10mm symmetry, K2 a null Lagrangian."""

from __future__ import annotations

import math

import dolfinx.fem.petsc  # noqa: F401  (fem.petsc is used)
import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

from complexbody import _compat
from complexbody.errors import BodyError, CoercivityError
from complexbody.forms import decagonal_quasicrystal
from complexbody.forms.decagonal import _energy

BASE = {"C11": 2.3, "C12": 0.6, "C13": 0.7, "C33": 2.2, "C44": 0.7}
BASE |= {"K1": 1.2, "K2": 0.3, "K3": 0.4, "R": 0.2}
M = (2.3 - 0.6) / 2
ZERO = dict.fromkeys(BASE, 0.0)


def turn(angle, size=3):
    """Rotation by ``angle`` about x3, or in the plane."""
    Q = np.eye(size)
    Q[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return Q


def change(value, energy, Q, P):
    """The largest |e(QUQᵀ, PwQᵀ) − e(U, w)| / max(1, |e|) over a few random states."""
    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(5):
        U, w = rng.normal(size=(3, 3)), rng.normal(size=(2, 3))
        before = value(energy, U, np.zeros(2), w)
        after = value(energy, Q @ U @ Q.T, np.zeros(2), P @ w @ Q.T)
        worst = max(worst, abs(after - before) / max(1.0, abs(before)))
    return worst


@pytest.mark.parametrize("m", range(1, 10))
def test_tenfold_rotations(m, value):
    """A rotation by θ = 2πm/10 turns the phason by 3θ."""
    theta = 2 * math.pi * m / 10
    assert change(value, _energy(**BASE), turn(theta), turn(3 * theta, 2)) < 1e-12


@pytest.mark.parametrize("multiple", [0, 1, 2, -3, 4])
def test_phason_turns_by_three_theta_only(multiple, value):
    """No other multiple of θ = 2π/10 that would make a representation will do."""
    theta = 2 * math.pi / 10
    assert change(value, _energy(**BASE), turn(theta), turn(multiple * theta, 2)) > 1e-2


def test_mirrors_and_a_rotation_that_is_none(value):
    """Mirrors x2 → −x2 (ν2 → −ν2) and x3 → −x3 are symmetries, a turn about x1 is not."""
    energy = _energy(**BASE)
    assert change(value, energy, np.diag([1.0, -1, 1]), np.diag([1.0, -1])) < 1e-12
    assert change(value, energy, np.diag([1.0, 1, -1]), np.eye(2)) < 1e-12
    about_x1 = np.roll(np.roll(turn(2 * math.pi / 10), 1, axis=0), 1, axis=1)
    assert change(value, energy, about_x1, np.eye(2)) > 1e-2


def test_plane_energy_is_that_of_the_plane(value):
    """With nothing along x3: ½L(tr ε)² + M|ε|² + ½K1|w|² + K2 det w + R[…], L = C12."""
    rng = np.random.default_rng(2)
    U, w = np.zeros((3, 3)), np.zeros((2, 3))
    U[:2, :2], w[:, :2] = rng.normal(size=(2, 2, 2))
    e, v = (U + U.T)[:2, :2] / 2, w[:, :2]
    expected = 0.5 * 0.6 * np.trace(e) ** 2 + M * np.sum(e**2) + 0.5 * 1.2 * np.sum(v**2)
    expected += 0.3 * np.linalg.det(v)
    expected += 0.2 * ((e[0, 0] - e[1, 1]) * np.trace(v) + 2 * e[0, 1] * (v[1, 0] - v[0, 1]))
    assert value(_energy(**BASE), U, np.zeros(2), w) == pytest.approx(expected, rel=1e-13)


def test_al_ni_co():
    """L = 57.41 and M = 88.46 GPa, as the plane problem quotes them."""
    c = decagonal_quasicrystal().constants
    assert pytest.approx(57.41e9) == c["C12"]
    assert (c["C11"] - c["C12"]) / 2 == pytest.approx(88.46e9, rel=1e-10)


BOUNDARIES = [
    ("C44 > 0", "C44", 0.0, +1),
    ("K3 > 0", "K3", 0.0, +1),
    ("(C11 + C12)*C33 > 2*C13**2", "C13", math.sqrt(2.9 * 2.2 / 2), -1),
    ("(C11 + C12)*C33 > 2*C13**2", "C13", -math.sqrt(2.9 * 2.2 / 2), +1),
    ("(C11 + C12)*C33 > 2*C13**2", "C12", 2 * 0.49 / 2.2 - 2.3, +1),
    ("(C11 + C12)*C33 > 2*C13**2", "C33", 2 * 0.49 / 2.9, +1),
    ("K1 > |K2|", "K2", 1.2, -1),
    ("K1 > |K2|", "K1", 0.3, +1),
    ("2*R**2", "R", math.sqrt(M * 1.5 / 2), -1),
    ("2*R**2", "R", -math.sqrt(M * 1.5 / 2), +1),
    ("2*R**2", "K2", 2 * 0.04 / M - 1.2, +1),
    ("2*R**2", "C12", 2.3 - 4 * 0.04 / 1.5, -1),
]


def check_boundary(inequality, inside, outside, hessian, lowest):
    """Inside: accepted and H > 0. Outside: refused, and H is indefinite."""
    assert lowest(hessian(decagonal_quasicrystal(**inside).energy, 3, 2)) > 0
    with pytest.raises(CoercivityError) as error:
        decagonal_quasicrystal(**outside)
    assert inequality in str(error.value)
    assert lowest(hessian(_energy(**outside), 3, 2)) < 0


@pytest.mark.parametrize(("inequality", "constant", "bound", "inward"), BOUNDARIES)
def test_coercive_exactly_inside(inequality, constant, bound, inward, hessian, lowest):
    """The boundary of the admissible constants, crossed by 1e-6 in each direction."""
    inside, outside = (BASE | {constant: bound + s * 1e-6 * inward} for s in (1, -1))
    check_boundary(inequality, inside, outside, hessian, lowest)


@pytest.mark.parametrize(
    ("inequality", "constant", "bound", "inward", "others"),
    [
        ("C33 > 0", "C33", 0.0, +1, {"C13": 0.0}),
        ("C11 > C12", "C12", 2.3, -1, {"R": 0.0}),
        ("K1 > |K2|", "K2", -1.2, +1, {"R": 0.0}),
    ],
)
def test_uncoupled_boundaries(inequality, constant, bound, inward, others, hessian, lowest):
    """Boundaries that a coupling would hide behind a tighter one."""
    inside, outside = (BASE | others | {constant: bound + s * 1e-6 * inward} for s in (1, -1))
    check_boundary(inequality, inside, outside, hessian, lowest)


@pytest.mark.parametrize("constant", BASE)
def test_constants_are_finite_numbers(constant):
    """NaN is refused by the name of the constant."""
    with pytest.raises(BodyError, match=rf"{constant} is nan"):
        decagonal_quasicrystal(**(BASE | {constant: math.nan}))


def phason_force(domain, constants):
    """Nodal forces ∂V/∂ν of a P1 field ν on ``domain``, and which nodes are on the boundary."""
    dim = domain.geometry.dim
    _compat.equispaced(domain)
    V = _compat.vector_space(domain, 2)
    nu = fem.Function(V)
    rng = np.random.default_rng(3)
    nu.x.array[:] = rng.normal(size=nu.x.array.size)
    gradient = ufl.grad(nu)
    N = ufl.as_tensor([[gradient[i, j] if j < dim else 0.0 for j in range(3)] for i in range(2)])
    U = ufl.as_tensor(np.zeros((3, 3)).tolist())
    total = _energy(**(ZERO | constants))(U, nu, N) * ufl.dx
    force = fem.petsc.assemble_vector(_compat.form(ufl.derivative(total, nu))).array.reshape(-1, 2)
    on_boundary = np.zeros(len(force), dtype=bool)
    facets = _compat.exterior_facets(domain)
    on_boundary[fem.locate_dofs_topological(V, dim - 1, facets)] = True
    return force, on_boundary


@pytest.mark.parametrize("dim", [2, 3])
def test_K2_is_a_null_lagrangian(dim):
    """A constant K2 pushes no interior node, whatever ν is; boundary nodes feel it."""
    if dim == 2:
        domain = mesh.create_unit_square(MPI.COMM_SELF, 4, 4)
    else:
        domain = mesh.create_unit_cube(MPI.COMM_SELF, 3, 3, 3)
    rng = np.random.default_rng(4)
    x = domain.geometry.x
    inner = np.all((x[:, :dim] > 1e-9) & (x[:, :dim] < 1 - 1e-9), axis=1)
    x[inner, :dim] += rng.uniform(-0.05, 0.05, size=(inner.sum(), dim))
    force, on_boundary = phason_force(domain, {"K2": 1.0})
    assert 0 < on_boundary.sum() < len(force)
    assert np.abs(force[~on_boundary]).max() < 1e-13
    assert np.median(np.abs(force[on_boundary])) > 1e-2
    # the same with K1, which is no null Lagrangian
    force, _ = phason_force(domain, {"K1": 1.0})
    assert np.abs(force[~on_boundary]).min() > 1e-3
