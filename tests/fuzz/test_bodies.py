"""Bodies that no body can be: each is refused by name, at once or when its scene is made ready."""

import numpy as np
import pytest
import ufl
from fuzzing import (
    FEW,
    MANY,
    NO_NUMBERS,
    examples,
    failing,
    negative,
    no_numbers,
    not_a_count,
    not_positive,
    told,
    wild,
)
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import complexbody as cb
from complexbody import meshes

K = 2


def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + ufl.inner(nu, nu)


GOOD = {"descriptor": K, "energy": energy, "density": 1.0, "inertia": 1.0, "viscosity": 0.1}

#: What a density may return that is no energy.
WRONG = [
    lambda U, nu, N: U, lambda U, nu, N: nu, lambda U, nu, N: N[0, :], lambda U, nu, N: U[ufl.i, 0],
    lambda U, nu, N: nu[ufl.i] * nu[ufl.j], lambda U, nu, N: None, lambda U, nu, N: "energy",
    lambda U, nu, N: [nu[0]], lambda U, nu, N: (U, nu), lambda U, nu, N: nu[K], lambda U: U[0, 0],
    lambda U, nu, N: U[3, 0], lambda U, nu, N: U[0, 3], lambda U, nu, N: ufl.inner(U, N),
    lambda U, nu, N: ufl.det(N), lambda U, nu, N: ufl.tr(nu), lambda U, nu, N: energy,
    lambda U, nu, N: ufl.inner(U, U) * ufl.dx, lambda U, nu, N: 1j * nu[0], lambda U, nu, N: {},
    lambda U, nu, N: nu[0] / 0, lambda U, nu, N: np.nan * ufl.inner(U, U), lambda U, nu, N: ufl.dx,
    lambda U, nu, N: np.inf * ufl.inner(U, U) + energy(U, nu, N), lambda U, nu, N: b"x",
    lambda U, nu, N: -energy(U, nu, N), lambda U, nu, N: energy(U, nu, N) - 9 * nu[0] ** 2,
    lambda U, nu, N: ufl.inner(N, N) - 2 * ufl.inner(U, U), lambda U, nu, N: np.zeros(2),
    lambda U, nu, N: U.x, lambda U, nu, N: U @ 3, lambda U, nu, N: ufl.inner(U, U) > 0,
    lambda U, nu, N, more: nu[0], lambda U, nu, N: np.array([nu[0], "a"]), lambda: 1.0,
    lambda U, nu, N: (yield nu[0]), lambda U, nu, N: 10**400 * nu[0] ** 2, lambda *, U: U,
]  # fmt: skip
WRONG_OUTER = [
    lambda u, nu: u, lambda u, nu: nu, lambda u, nu: u[3], lambda u, nu: None, lambda u: u[0],
    lambda u, nu: ufl.inner(u, nu), lambda u, nu: "w", lambda u, nu: u[ufl.i], lambda u, nu: 1j,
    lambda u, nu: ufl.grad(u), lambda u, nu: [], lambda u, nu, N: nu[0], lambda u, nu: {},
]  # fmt: skip
WRONG_CHI = [
    lambda nu, rate: rate, lambda nu, rate: None, lambda nu: nu[0], lambda nu, rate: rate[K],
    lambda nu, rate: -ufl.inner(rate, rate), lambda nu, rate: "χ", lambda nu, rate: 1j * rate[0],
    lambda nu, rate: ufl.outer(rate, rate), lambda nu, rate: nu[ufl.i], lambda nu, rate: [],
]  # fmt: skip

matrices = arrays.arrays(
    np.float64, arrays.array_shapes(min_dims=0, max_dims=3, max_side=3), elements=st.floats(-2, 2)
)


def indefinite(matrix):
    """Whether no k×k inertia could be this."""
    if matrix.shape not in ((), (K, K)):
        return True
    full = np.diag(np.full(K, float(matrix))) if matrix.shape == () else matrix
    scale = np.abs(full).max(initial=0.0)
    asymmetric = np.abs(full - full.T).max() > 1e-9 * scale
    return bool(asymmetric or np.linalg.eigvalsh(full + full.T).min() < -1e-9 * scale)


broken = st.sampled_from([
    np.full((K, K), np.nan), np.diag([1.0, np.inf]), np.array([["1", "0"], ["0", "1"]]),
    np.eye(K) * 1j, np.eye(K, dtype=bool), np.eye(K, dtype=object) * 10**400, [[1, 0], [0]],
])  # fmt: skip
bad_matrix = st.one_of(
    no_numbers, wild, negative, broken, matrices.filter(lambda m: m.size and indefinite(m))
)
junk_function = st.sampled_from([x for x in NO_NUMBERS if x is not None and not callable(x)])
BAD = {
    "descriptor": not_a_count | st.just(10**9) | st.just(10**400),
    "displacement": not_a_count | st.just(10**9) | st.just(10**400),
    "energy": st.one_of(junk_function, st.none(), failing, st.sampled_from(WRONG)),
    "potential": st.one_of(junk_function, failing, st.sampled_from(WRONG_OUTER)),
    "density": st.one_of(no_numbers, wild, not_positive, matrices.filter(lambda m: m.ndim > 0)),
    "inertia": st.one_of(
        bad_matrix.filter(lambda m: not callable(m)), failing, st.sampled_from(WRONG_CHI)
    ),
    "viscosity": bad_matrix | failing,
    "quadrature_degree": st.one_of(
        no_numbers.filter(lambda q: q is not None), wild, negative, st.sampled_from([1.5, 10**6])
    ),
    "name": st.sampled_from([None, 3, b"x", [], {}, 1.5]),
    "constants": st.sampled_from([None, 3, "x", [1], 1.5]),
    "orientation": st.sampled_from([None, "no", [], 1.5, 2]),
}


@st.composite
def bad_bodies(draw):
    """One to three wrong arguments; the rest is right."""
    names = draw(st.lists(st.sampled_from(sorted(BAD)), min_size=1, max_size=3, unique=True))
    return {name: draw(BAD[name]) for name in names}


@pytest.mark.parametrize("count", [FEW, pytest.param(2 * MANY, marks=pytest.mark.slow)])
def test_bad_bodies_are_refused_on_all_ranks(comm, count):
    mesh, kinds = meshes.rectangle(comm, (0, 0), (1, 1), (2, 2)), []

    @examples(count)
    @given(bad_bodies())
    def one(change):
        def case():
            scene = cb.Scene(mesh, cb.Body(**GOOD | change))
            cb.simulate(scene, cb.Synchronous(safety=0.5), until=1e-6, ledger_steps=1)

        kinds.append(told(case))

    one()
    assert len(kinds) >= count
