# SPDX-License-Identifier: LGPL-3.0-or-later
"""A1 is checked mode by mode; what the potential holds; when cells lock."""

import warnings
from functools import partial

import numpy as np
import pytest
import ufl
from dolfinx import fem
from harness import bent, everywhere, refused

import complexbody as cb
from complexbody import _compat
from complexbody.coercivity import check_coercive, least_eigenvalue, locking_ratio
from complexbody.errors import CoercivityError
from complexbody.forms.two_field import _energy as two_field
from complexbody.hessian import read
from complexbody.problem import Problem


@pytest.fixture(scope="module")
def cube(comm):
    return bent(comm, (2, 2, 2))


def dense(mesh, energy, n_u, k):
    """H as check_coercive takes it."""
    out = np.zeros((1, 4 * (n_u + k), 4 * (n_u + k)))
    for key, entry in read(energy, mesh, n_u, k, "gradients").hessian.items():
        out[0][key] = entry
    return out


def coercive(mesh, energy, n_u, k):
    """Null modes of an energy on a mesh."""
    return check_coercive(dense(mesh, energy, n_u, k), n_u, k, mesh.geometry.dim, "gum")


def test_rotations_are_no_news(comm):
    """The skew part of U is what objectivity leaves free; one rotation in the plane."""
    for cells in ((3,), (3, 2), (2, 2, 2)):
        mesh = bent(comm, cells)
        modes = coercive(
            mesh, lambda U, nu, N: ufl.inner(ufl.sym(U), ufl.sym(U)) + ufl.inner(N, N), 3, 2
        )
        assert modes == []


def test_a_descriptor_may_turn_with_the_body(comm):
    """Cosserat: a rotation with ν = ½ curl u is rigid. A ν that no rotation needs is told."""
    for cells in ((3, 2), (2, 2, 2)):
        mesh, k = bent(comm, cells), 3 if len(cells) == 3 else 1

        def energy(U, nu, N, k=k):
            turns = [U[1, 0] - U[0, 1], U[2, 1] - U[1, 2], U[0, 2] - U[2, 0]]
            relative = sum((0.5 * turns[i] - nu[i]) ** 2 for i in range(k))
            strain = ufl.inner(ufl.sym(U), ufl.sym(U))
            return strain + 1e-6 * relative + 1e4 * ufl.inner(N, N)

        assert coercive(mesh, energy, 3, k) == []
        assert 1e-3 < least_eigenvalue(dense(mesh, energy, 3, k), 3, k, len(cells)) < 1

    def even(U, nu, N):
        strain = ufl.inner(ufl.sym(U), ufl.sym(U))
        return strain + (nu[0] - nu[1]) ** 2 + ufl.inner(N, N)

    assert coercive(mesh, even, 3, 2) in (["+1 nu1 +1 nu2"], ["+1 nu2 +1 nu1"])
    assert abs(least_eigenvalue(dense(mesh, even, 3, 2), 3, 2, 3)) < 1e-14


def test_null_modes_are_told(cube):
    """Five strains without volume change; a gradient that the energy misses; no rotation."""
    modes = coercive(cube, lambda U, nu, N: ufl.tr(U) ** 2 + ufl.inner(N, N), 3, 1)
    assert len(modes) == 5 and not any("N" in mode or "nu" in mode for mode in modes)
    modes = coercive(
        cube,
        lambda U, nu, N: ufl.inner(ufl.sym(U), ufl.sym(U)) + N[0, 0] ** 2 + N[0, 1] ** 2,
        3, 1,
    )  # fmt: skip
    assert modes == ["+1 N13"]
    # nu1 and a strain that compensate each other.
    modes = coercive(
        cube,
        lambda U, nu, N: ufl.inner(ufl.dev(ufl.sym(U)), ufl.dev(ufl.sym(U)))
        + (ufl.tr(U) - 2 * nu[0]) ** 2
        + ufl.inner(N, N),
        3, 1,
    )  # fmt: skip
    assert len(modes) == 1
    found = dict(reversed(word.split()) for word in zip_pairs(modes[0]))
    numbers = {name: float(text) for name, text in found.items()}
    assert set(numbers) == {"U11", "U22", "U33", "nu1"}
    assert numbers["U11"] + numbers["U22"] + numbers["U33"] == pytest.approx(
        2 * numbers["nu1"], rel=1e-2
    )


def zip_pairs(text):
    """'+1 U11 -1 U22' -> ['+1 U11', '-1 U22']."""
    words = text.split()
    return [" ".join(words[m : m + 2]) for m in range(0, len(words), 2)]


def test_a_descriptor_without_self_action_is_fine(cube):
    assert coercive(cube, lambda U, nu, N: ufl.inner(U, U) + ufl.inner(N, N), 3, 2) == []


@pytest.mark.parametrize("unit", [1.0, 1e-9, 1e12])
def test_the_negative_mode_is_named(cube, unit):
    """Coupling beyond its bound, whatever the unit of ν."""

    def energy(U, nu, N, coupling):
        known = 0.5 * ufl.inner(U, U) + 0.5 * ufl.inner(unit * N, unit * N) + 0.5 * nu[0] ** 2
        return known + coupling * unit * U[0, 1] * N[1, 2]

    assert coercive(cube, lambda *g: energy(*g, 0.999), 3, 2) == []
    with pytest.raises(CoercivityError) as caught:
        coercive(cube, lambda *g: energy(*g, -1.01), 3, 2)
    message = str(caught.value)
    assert "gum" in message and "(A1)" in message and "Change the constants" in message
    mode = message.split("along the mode ")[1].split(" it is negative")[0]
    numbers = {p.split()[1]: float(p.split()[0]) for p in zip_pairs(mode)}
    if unit == 1.0:
        assert set(numbers) == {"U12", "N23"} and numbers["U12"] * numbers["N23"] > 0
    assert float(message.split("relative eigenvalue ")[1].split(",")[0]) == pytest.approx(-0.01)


def test_a_zero_diagonal_is_no_excuse(cube):
    with pytest.raises(CoercivityError, match="U11"):
        coercive(cube, lambda U, nu, N: U[0, 0] * nu[0] + ufl.inner(N, N), 3, 1)


def test_not_a_number(cube):
    broken = dense(cube, lambda U, nu, N: ufl.inner(U, U), 3, 1)
    broken[0, 3, 4] = np.nan
    with pytest.raises(CoercivityError, match=r"gum .* not finite\. Check"):
        check_coercive(broken, 3, 1, 3, "gum")


def test_forms_beyond_their_bound(comm):
    """The two-field model with its coupling k3 too large, in a scene: on all ranks."""
    mesh = bent(comm, (3, 2))
    constants = {"lam": 0.8, "mu": 0.9, "k0": 0.7, "k1": 0.5, "k2": 0.6, "k2_skew": 0.3}
    constants |= {"k3": 4.0, "k3_sym": 0.25}
    body = cb.Body(2, two_field(2, **constants), 1.0, 1.0, displacement=2, name="two fields")
    with refused(CoercivityError, "two fields", "(A1)", "U11", "N11"):
        Problem(cb.Scene(mesh, body))


def test_one_weak_cell(comm):
    """A coefficient that is too small in one cell of one rank only."""
    mesh = bent(comm, (9, 8))
    stiffness = fem.Function(_compat.cell_space(mesh))
    stiffness.x.array[:] = 2.0

    def energy(U, nu, N):
        return 0.5 * stiffness * ufl.inner(U, U) + 0.5 * ufl.inner(N, N) + 1.2 * U[0, 0] * N[0, 0]

    body = cb.Body(1, energy, 1.0, 1.0, displacement=2, name="spotted")
    Problem(cb.Scene(mesh, body)).close()
    if comm.rank == comm.size - 1:
        stiffness.x.array[0] = 1.0
    with refused(CoercivityError, "spotted", "U11", "N11"):
        Problem(cb.Scene(mesh, body))
    if comm.rank == comm.size - 1:
        stiffness.x.array[0] = np.nan
    with refused(CoercivityError, "spotted", "not finite"):
        Problem(cb.Scene(mesh, body))


def test_null_modes_warn_once(comm):
    """On rank 0; they are kept on every rank."""
    mesh = bent(comm, (9, 8))
    body = cb.Body(1, lambda U, nu, N: ufl.inner(U, U) + N[0, 0] ** 2, 1.0, 1.0, name="striped")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem = Problem(cb.Scene(mesh, body))
    told = [str(w.message) for w in caught if w.category is UserWarning]
    assert everywhere(comm, len(told) == (comm.rank == 0))
    if told:
        assert "striped" in told[0] and "N12" in told[0] and "supports" in told[0]
    assert everywhere(comm, len(problem.warnings) == 1)
    problem.close()


def test_null_modes_of_another_rank(comm):
    """A mode that the energy misses in cells of the last rank only is told by rank 0."""
    mesh = bent(comm, (9, 8))
    stiffness = fem.Function(_compat.cell_space(mesh))
    stiffness.x.array[:] = 0.0 if comm.rank == comm.size - 1 else 2.0

    def energy(U, nu, N):
        return ufl.inner(U, U) + N[0, 0] ** 2 + stiffness * N[0, 1] ** 2

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem = Problem(cb.Scene(mesh, cb.Body(1, energy, 1.0, 1.0)))
    told = [str(w.message) for w in caught if w.category is UserWarning]
    assert everywhere(comm, len(told) == (comm.rank == 0) and "N12" in "".join(told or ["N12"]))
    assert everywhere(comm, len(problem.warnings) == 1 and "N12" in problem.warnings[0])
    problem.close()


# --- what the potential holds --------------------------------------------------------------------


def told(scene):
    """Warnings of a scene, the same on all ranks."""
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        problem = Problem(scene)
    problem.close()
    return problem.warnings


POTENTIALS = {
    "quadratic": (lambda u, nu: 0.3 * nu[0] ** 2, True),
    "varying": (lambda u, nu: (0.3 + u[0] ** 2) * nu[0] ** 2, True),
    "of degree four": (lambda u, nu: 0.1 * nu[0] ** 4, True),
    "unstable": (lambda u, nu: -0.3 * nu[0] ** 2, False),
    "linear": (lambda u, nu: 0.3 * nu[0], False),
    "of u alone": (lambda u, nu: u[0] ** 4, False),
}


@pytest.mark.parametrize("name", POTENTIALS)
def test_the_potential_holds_a_mode(comm, name):
    """∂²w at the start, ν = 0.5: div u = ν is held or told; shear without stiffness is told."""
    potential, holds = POTENTIALS[name]

    def energy(U, nu, N):
        return 0.5 * (U[0, 0] + U[1, 1] - nu[0]) ** 2 + 0.5 * ufl.inner(N, N)

    for n_u, cells in ((1, (5,)), (2, (3, 2))):
        mesh = bent(comm, cells)
        e = energy if n_u == 2 else lambda U, nu, N: 0.5 * (U[0, 0] - nu[0]) ** 2 + N[0, 0] ** 2
        body = cb.Body(1, e, 1.0, 1.0, 0.0, potential, n_u, name="foam")
        notes = told(cb.Scene(mesh, body, initial=cb.Initial(nu=0.5)))
        assert len(notes) == (not holds) + 2 * (n_u - 1), notes
        assert any("nu1" in note for note in notes) == (not holds), notes


def test_a_potential_that_holds_in_part(comm):
    """w = ¼ν⁴ holds nothing where ν = 0, even if that is on one rank only; a negative e is none."""
    mesh = bent(comm, (9, 8))
    quartic = lambda u, nu: 0.25 * nu[0] ** 4  # noqa: E731

    def body(factor):
        def energy(U, nu, N):
            shear = (U[0, 0] - U[1, 1]) ** 2 + (U[0, 1] + U[1, 0]) ** 2
            volume = U[0, 0] + U[1, 1] - nu[0]
            return 0.5 * shear + 0.5 * volume**2 + factor * ufl.inner(N, N)

        return cb.Body(1, energy, 1.0, 1.0, 0.0, quartic, 2, name="foam")

    corner = lambda x: np.where(x[:1] < 0.3, 0.0, 0.5)  # noqa: E731
    assert not told(cb.Scene(mesh, body(0.5), initial=cb.Initial(nu=0.5)))
    notes = told(cb.Scene(mesh, body(0.5), initial=cb.Initial(nu=corner)))
    assert len(notes) == 1 and "nu1" in notes[0] and "U11" in notes[0]
    with refused(CoercivityError, "N1"):
        Problem(cb.Scene(mesh, body(-0.5), initial=cb.Initial(nu=0.5)))


# --- locking -------------------------------------------------------------------------------------


@pytest.mark.parametrize("cells, dim", [((5,), 1), ((3, 2), 2), ((2, 2, 2), 3)])
@pytest.mark.parametrize("n_u", [1, 2, 3])
def test_locking_ratio(comm, cells, dim, n_u):
    """λ/μ exactly of isotropic bodies; nothing in 1D or where u has too few components."""
    mesh = bent(comm, cells)

    def energy(U, nu, N):
        block = ufl.as_tensor([[U[i, j] for j in range(n_u)] for i in range(n_u)])
        e = ufl.sym(block)
        own = 0.5 * ufl.inner(N, N) + 0.5 * nu[0] ** 2 + 0.3 * nu[0] * ufl.tr(e)
        return 0.5 * 7.0 * ufl.tr(e) ** 2 + 0.5 * ufl.inner(e, e) + own  # λ = 7, μ = 1/2

    ratio = locking_ratio(dense(mesh, energy, n_u, 1), n_u, dim)
    assert ratio == pytest.approx(14.0 if 1 < dim <= n_u else 0.0, rel=1e-12)


def test_locking_of_anisotropic_bodies_and_fluids(cube):
    """Cubic crystal: the softer of its shears counts. Without shear stiffness nothing locks."""

    def cubic(U, nu, N, c11, c12, c44):
        e = ufl.sym(U)
        normal = sum(0.5 * (c11 - c12) * e[i, i] ** 2 for i in range(3))
        shear = sum(2 * c44 * e[i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2)))
        return normal + 0.5 * c12 * ufl.tr(e) ** 2 + shear + ufl.inner(N, N)

    for c44 in (4.0, 0.05):
        crystal = partial(cubic, c11=3.0, c12=2.0, c44=c44)
        ratio = locking_ratio(dense(cube, crystal, 3, 1), 3, 3)
        assert ratio == pytest.approx(2 / 3 * (7.0 / min(1.0, 2 * c44) - 1))
    fluid = dense(cube, lambda U, nu, N: ufl.tr(U) ** 2 + ufl.inner(N, N), 3, 1)
    assert locking_ratio(fluid, 3, 3) == 0.0
