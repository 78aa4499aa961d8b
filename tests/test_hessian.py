# SPDX-License-Identifier: LGPL-3.0-or-later
"""Densities read as polynomials equal the same formulas in numpy; A1 is checked mode by mode."""


import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from harness import bent
from hypothesis import given, settings
from hypothesis import strategies as st

from complexbody import _compat, hessian
from complexbody.hessian import names, read

E = np.array([0.3, -1.2, 0.7])
A = np.array([[1.0, 0.4, -0.3], [0.2, 2.0, 0.1], [0.5, -0.6, 1.5]])
e, a = ufl.as_vector(E.tolist()), ufl.as_matrix(A.tolist())
i, j, k = ufl.indices(3)


@pytest.fixture(scope="module")
def cube(comm):
    return bent(comm, (2, 2, 2))


def sym(M):
    return 0.5 * (M + M.T)


def skew(M):
    return 0.5 * (M - M.T)


def dev(M):
    return M - np.trace(M) / 3 * np.eye(3)


def det2(M):
    return M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]


def through_diff(U, nu, N):
    """½ ∂ψ/∂ε : ε = ψ for a quadratic ψ."""
    strain = ufl.variable(ufl.sym(U))
    psi = ufl.inner(strain, strain) + 0.4 * ufl.tr(strain) ** 2
    return 0.5 * ufl.inner(ufl.diff(psi, strain), ufl.sym(U))


#: name -> (UFL, numpy), both of (U, nu, N)
QUADRATICS = {
    "parts of tensors": (
        lambda U, nu, N: (
            ufl.inner(ufl.sym(U), ufl.sym(U))
            + 2 * ufl.inner(ufl.skew(U), ufl.skew(N))
            + ufl.inner(ufl.dev(U), ufl.dev(N))
            + ufl.tr(U) ** 2
        ),
        lambda U, nu, N: (
            (sym(U) ** 2).sum()
            + 2 * (skew(U) * skew(N)).sum()
            + (dev(U) * dev(N)).sum()
            + np.trace(U) ** 2
        ),
    ),
    "products of tensors": (
        lambda U, nu, N: (
            ufl.inner(ufl.outer(nu, nu), a)
            + ufl.dot(nu, ufl.dot(U, e))
            + ufl.dot(e, U * N * e)
            + ufl.inner(U.T * N, a)
            + ufl.dot(ufl.cross(nu, e), U * e)
        ),
        lambda U, nu, N: (
            nu @ A @ nu
            + nu @ U @ E
            + E @ U @ N @ E
            + (U.T @ N * A).sum()
            + np.cross(nu, E) @ (U @ E)
        ),
    ),
    "determinant of a block": (
        lambda U, nu, N: ufl.det(ufl.as_matrix([[U[0, 0], U[0, 1]], [U[1, 0], U[1, 1]]])),
        lambda U, nu, N: det2(U),
    ),
    "indices": (
        lambda U, nu, N: (
            U[i, j] * U[j, i]
            + a[i, j] * U[i, k] * N[j, k]
            + ufl.PermutationSymbol(3)[i, j, k] * U[i, j] * nu[k]
            + ufl.Identity(3)[i, j] * nu[i] * nu[j]
        ),
        lambda U, nu, N: (
            (U * U.T).sum()
            + (A * (U @ N.T)).sum()
            + nu @ [U[1, 2] - U[2, 1], U[2, 0] - U[0, 2], U[0, 1] - U[1, 0]]
            + nu @ nu
        ),
    ),
    "products of sums": (
        lambda U, nu, N: (
            (U[0, 0] + 2 * nu[1] - N[2, 2] + 3) * (nu[0] - 0.5 * U[0, 0] + 4 * N[1, 0] - 1)
        ),
        lambda U, nu, N: (
            (U[0, 0] + 2 * nu[1] - N[2, 2] + 3) * (nu[0] - 0.5 * U[0, 0] + 4 * N[1, 0] - 1)
        ),
    ),
    "powers and quotients": (
        lambda U, nu, N: (
            (nu[0] ** 2) ** 1
            + ufl.as_ufl(2.0) ** 3 * U[0, 1] ** 2.0 / 7
            + (U[2, 2] - nu[2]) ** 2 / (2 + ufl.cos(ufl.as_ufl(1.0)))
            + U[0, 0] ** 0
            - (-nu[1]) ** 1 * 5
        ),
        lambda U, nu, N: (
            nu[0] ** 2
            + 8 * U[0, 1] ** 2 / 7
            + (U[2, 2] - nu[2]) ** 2 / (2 + np.cos(1.0))
            + 1
            + 5 * nu[1]
        ),
    ),
    "derivatives": (
        through_diff,
        lambda U, nu, N: (sym(U) ** 2).sum() + 0.4 * np.trace(U) ** 2,
    ),
    "inverse of a constant": (
        lambda U, nu, N: ufl.dot(nu, ufl.inv(a) * nu),
        lambda U, nu, N: nu @ np.linalg.inv(A) @ nu,
    ),
    "long sums": (
        lambda U, nu, N: sum(
            0.01 * (m + 1) * U[m % 3, m % 2] * N[(m + 1) % 3, m % 3] for m in range(400)
        ),
        lambda U, nu, N: sum(
            0.01 * (m + 1) * U[m % 3, m % 2] * N[(m + 1) % 3, m % 3] for m in range(400)
        ),
    ),
}


def value(quadratic, U, nu, N):
    """Of what was read: c + l·g + ½ g·Hg."""
    g = np.concatenate([U.ravel(), N.ravel(), np.zeros(len(U)), nu])
    total = quadratic.constant + sum(c * g[m] for m, c in quadratic.linear.items())
    return total + 0.5 * sum(c * g[m] * g[n] for (m, n), c in quadratic.hessian.items())


@pytest.mark.parametrize("name", QUADRATICS)
def test_exact(cube, name):
    """At random states; symmetric."""
    density, formula = QUADRATICS[name]
    quadratic = read(density, cube, 3, 3, "gradients")
    assert quadratic is not None and quadratic.cellwise and not quadratic.expressions()
    for (m, n), entry in quadratic.hessian.items():
        assert quadratic.hessian[n, m] == entry
    rng = np.random.default_rng(3)
    for _ in range(3):
        state = rng.normal(size=(3, 3)), rng.normal(size=3), rng.normal(size=(3, 3))
        assert value(quadratic, *state) == pytest.approx(formula(*state), rel=1e-12)


@settings(derandomize=True, database=None, deadline=None, max_examples=25)
@given(
    n_u=st.integers(1, 3),
    components=st.integers(1, 4),
    seed=st.integers(0, 1000),
    offset=st.floats(-2, 2),
)
def test_random_quadratics(comm, n_u, components, seed, offset):
    """Every coefficient, in the order that names() tells; columns beyond the mesh are gone."""
    mesh = dolfinx.mesh.create_unit_square(comm, 2, 2)
    n, rng = n_u + components, np.random.default_rng(seed)
    unknowns = 3 * n_u + 4 * components
    H, linear = rng.integers(-4, 5, (unknowns, unknowns)) / 4, rng.integers(-4, 5, unknowns) / 4

    def energy(U, nu, N):
        g = [U[p] for p in np.ndindex(n_u, 3)] + [N[p] for p in np.ndindex(components, 3)]
        g += [nu[p] for p in range(components)]
        rows = [sum(H[p, q] * g[q] for q in range(unknowns)) + linear[p] for p in range(unknowns)]
        return 0.5 * sum(g[p] * rows[p] for p in range(unknowns)) + offset

    found = read(energy, mesh, n_u, components, "gradients")
    place = [p for p in range(3 * n)] + [3 * n + n_u + p for p in range(components)]
    dense, vector = np.zeros((4 * n, 4 * n)), np.zeros(4 * n)
    dense[np.ix_(place, place)] = 0.5 * (H + H.T)
    vector[place] = 0.5 * linear
    absent = [p for p in range(3 * n) if p % 3 == 2]  # of a plane mesh
    dense[absent] = dense[:, absent] = vector[absent] = 0.0
    keys = {(int(p), int(q)) for p, q in zip(*np.nonzero(dense), strict=True)}
    assert set(found.hessian) == keys  # no entry that is zero
    assert all(found.hessian[key] == dense[key] for key in keys)  # exact: small binary fractions
    assert found.linear == {int(p): vector[p] for p in np.flatnonzero(vector)}
    assert found.constant == pytest.approx(offset, abs=1e-300)
    labels = names(n_u, components)
    assert len(labels) == 4 * n
    assert labels[0] == "U11" and labels[3 * n_u] == "N11" and labels[3 * n] == "u1"
    assert labels[-1] == f"nu{components}" and labels[3 * n + n_u] == "nu1"


def test_cancellations_leave_nothing(cube):
    def energy(U, nu, N):
        square = (U[0, 0] + nu[0]) ** 2 - (U[0, 0] - nu[0]) ** 2
        return square + (1 + U[1, 1]) ** 2 - 2 * U[1, 1] - 1 - U[1, 1] ** 2 + N[0, 0] - N[0, 0]

    found = read(energy, cube, 3, 3, "gradients")
    assert found.hessian == {(0, 27 - 6 + 0): 4.0, (21, 0): 4.0}
    assert found.linear == {} and found.constant == 0.0
    nothing = read(lambda U, nu, N: 0.0, cube, 3, 3, "gradients")
    assert (nothing.constant, nothing.linear, nothing.hessian) == (0.0, {}, {})


def test_potentials_of_the_fields(cube):
    found = read(lambda u, nu: 3 * u[1] - u[0] * nu[2] + 2 * nu[0] ** 2 + 7, cube, 3, 3, "fields")
    assert found.constant == 7.0 and found.linear == {19: 3.0}
    assert found.hessian == {(18, 23): -1.0, (23, 18): -1.0, (21, 21): 4.0}


@pytest.mark.parametrize(
    "density",
    [
        lambda U, nu, N: nu[0] ** 4,
        lambda U, nu, N: nu[0] ** 3,
        lambda U, nu, N: (nu[0] ** 2) ** 0.5,
        lambda U, nu, N: 2.0 ** nu[0],
        lambda U, nu, N: nu[0] * U[0, 0] * N[0, 0],
        lambda U, nu, N: nu[0] ** 2 / (1 + U[0, 0]),
        lambda U, nu, N: nu[0] ** 2 / (U[0, 0] - U[0, 0]),
        lambda U, nu, N: ufl.exp(U[0, 0]),
        lambda U, nu, N: ufl.sqrt(1 + ufl.inner(U, U)),
        lambda U, nu, N: abs(nu[0]),
        lambda U, nu, N: ufl.det(ufl.Identity(3) + U),
        lambda U, nu, N: ufl.conditional(ufl.gt(nu[0], 0.0), nu[0] ** 2, 2 * nu[0] ** 2),
        lambda U, nu, N: ufl.max_value(U[0, 0], 0.0) ** 2,
        lambda U, nu, N: ufl.inner(ufl.inv(ufl.Identity(3) + U), ufl.Identity(3)),
    ],
)
def test_not_quadratic(cube, density):
    assert read(density, cube, 3, 3, "gradients") is None


def test_what_is_cubic_in_space_may_be_quadratic_in_the_plane(comm):
    """Columns that the mesh does not have are zero before degrees are counted."""
    plane = dolfinx.mesh.create_unit_square(comm, 2, 2)
    found = read(lambda U, nu, N: ufl.det(ufl.Identity(3) + U), plane, 3, 1, "gradients")
    assert found.constant == 1.0 and found.linear == {0: 1.0, 4: 1.0}
    assert found.hessian == {(0, 4): 1.0, (4, 0): 1.0, (1, 3): -1.0, (3, 1): -1.0}


def test_coefficients(comm):
    """Constants become numbers; cell-wise ones stay symbols; others make code that varies."""
    mesh = bent(comm, (3, 2))
    c = fem.Constant(mesh, 3.0)
    matrix = fem.Constant(mesh, A[:2, :2].copy())
    lam = fem.Function(_compat.cell_space(mesh))
    vector = fem.Function(_compat.cell_space(mesh, (2,)))
    nodal = fem.Function(_compat.vector_space(mesh, 2))

    baked = read(
        lambda U, nu, N: ufl.sqrt(c + 1) * nu[0] ** 2 + c**2 * matrix[0, 1] * U[0, 0] * nu[1],
        mesh, 3, 2, "gradients",
    )  # fmt: skip
    assert baked.cellwise and not baked.expressions()
    assert baked.hessian[18, 18] == 4.0
    assert baked.hessian[0, 19] == baked.hessian[19, 0] == pytest.approx(9 * A[0, 1], rel=1e-15)

    symbols = read(
        lambda U, nu, N: lam * (nu[0] ** 2 + 0.5 * nu[1] ** 2)
        + vector[1] * U[0, 0] ** 2
        + ufl.exp(lam) * N[0, 0] ** 2
        + lam * nu[0]
        + 2 * U[1, 1] ** 2,
        mesh, 3, 2, "gradients",
    )  # fmt: skip
    assert symbols.cellwise and symbols.hessian[4, 4] == 4.0
    assert {9, 18} <= {m for m, _ in symbols.hessian} and len(symbols.expressions()) >= 4
    lam.x.array[:] = 0.5
    vector.x.array[:] = 3.0
    space = _compat.cell_space(mesh)
    cells = np.arange(_compat.cell_count(mesh)[0], dtype=np.int32)
    for key, expected in {
        (18, 18): 1.0, (19, 19): 0.5, (0, 0): 6.0, (9, 9): 2 * np.exp(0.5)
    }.items():  # fmt: skip
        compiled = _compat.expression(symbols.hessian[key], space)
        np.testing.assert_allclose(_compat.evaluate(compiled, mesh, cells), expected, rtol=1e-14)

    for varying in (nodal[1], ufl.SpatialCoordinate(mesh)[0], ufl.grad(nodal)[0, 1]):
        found = read(lambda U, nu, N, v=varying: v * nu[0] ** 2, mesh, 3, 2, "gradients")
        assert found is not None and not found.cellwise
    # A cell-wise function has no gradient.
    flat = read(lambda U, nu, N: ufl.grad(lam)[0] * nu[0] + nu[1] ** 2, mesh, 3, 2, "gradients")
    assert flat.cellwise and flat.linear == {} and flat.hessian == {(19, 19): 2.0}


def test_permutation_sign():
    assert hessian._permutation_sign((0, 1, 2)) == hessian._permutation_sign((2, 0, 1)) == 1
    assert hessian._permutation_sign((1, 0, 2)) == -1
    assert hessian._permutation_sign((1, 1, 2)) == 0
