# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a body may be made of, and each thing it may not."""

import dataclasses

import numpy as np
import pytest
import ufl
from harness import bent, refused

import complexbody as cb
from complexbody.errors import BodyError
from complexbody.problem import Problem


def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + ufl.inner(nu, nu)


GOOD = {"descriptor": 2, "energy": energy, "density": 1.0, "inertia": 1.0}


def test_matrices():
    """Numbers are multiples of the identity; matrices stay what they are."""
    omega = np.array([[2.0, 0.5], [0.5, 1.0]])
    body = cb.Body(**GOOD | {"inertia": 3.0, "viscosity": omega.tolist()})
    assert np.array_equal(body.inertia_matrix, 3 * np.eye(2))
    assert np.array_equal(body.viscosity_matrix, omega)
    assert body.components == 5 and cb.Body(**GOOD, displacement=1).components == 3
    assert np.array_equal(cb.Body(**GOOD).viscosity_matrix, np.zeros((2, 2)))
    with pytest.raises(dataclasses.FrozenInstanceError):
        body.density = 2.0


@pytest.mark.parametrize(
    "inertia, viscosity",
    [
        (0.0, 1.0),
        (0, np.eye(2)),
        (np.diag([1.0, 0.0]), np.diag([0.0, 1e-9])),
        (np.diag([1e-20, 1e20]), 0.0),  # units may differ by much
        (np.array([[1.0, 1.0], [1.0, 1.0]]), np.diag([1.0, 0.0])),
        (lambda nu, nu_dot: ufl.inner(nu_dot, nu_dot), 0.0),
    ],
)
def test_accepted(inertia, viscosity):
    """Inertia may vanish where viscosity does not."""
    assert cb.Body(**GOOD | {"inertia": inertia, "viscosity": viscosity}).descriptor == 2


@pytest.mark.parametrize(
    "change, words",
    [
        ({"descriptor": 0}, ("descriptor", "0")),
        ({"descriptor": 1.5}, ("descriptor", "1.5")),
        ({"descriptor": True}, ("descriptor", "True")),
        ({"displacement": 0}, ("displacement", "0")),
        ({"displacement": "3"}, ("displacement", "'3'")),
        ({"energy": 5.0}, ("energy", "f(U, nu, N)")),
        ({"potential": 5.0}, ("potential", "f(u, nu)")),
        ({"density": 0.0}, ("density", "0.0", "positive")),
        ({"density": -1}, ("density", "-1", "positive")),
        ({"density": np.nan}, ("density", "nan")),
        ({"density": "steel"}, ("density", "steel", "DG0")),
        ({"density": None}, ("density", "None")),
        ({"inertia": -1.0}, ("inertia", "negative", "-1.0")),
        ({"inertia": -1e-200}, ("inertia", "negative", "-1e-200")),
        ({"inertia": [[0.0, 1e-20], [1e-20, 1.0]]}, ("inertia", "negative")),
        ({"inertia": np.nan}, ("inertia", "finite")),
        ({"inertia": 10**400}, ("inertia", "2×2")),
        ({"inertia": "1"}, ("inertia", "'1'", "2×2")),
        ({"viscosity": 1j}, ("viscosity", "1j", "2×2")),
        ({"viscosity": True}, ("viscosity", "True", "2×2")),
        ({"density": True}, ("density", "True")),
        ({"density": 10**400}, ("density", "positive")),
        ({"descriptor": 10**9}, ("descriptor", "1000000000")),
        ({"quadrature_degree": -1}, ("quadrature_degree", "-1")),
        ({"quadrature_degree": 1.5}, ("quadrature_degree", "1.5")),
        ({"name": None}, ("name", "None", "text")),
        ({"constants": None}, ("constants", "dict")),
        ({"orientation": 1}, ("orientation", "True or False")),
        ({"inertia": "heavy"}, ("inertia", "heavy", "2×2")),
        ({"inertia": np.eye(3)}, ("inertia", "(3, 3)", "2 components")),
        ({"inertia": [1.0, 2.0]}, ("inertia", "(2,)")),
        ({"inertia": [[1.0, 0.5], [0.0, 1.0]]}, ("inertia", "symmetric")),
        ({"inertia": [[1.0, 2.0], [2.0, 1.0]]}, ("inertia", "negative")),
        ({"inertia": 0.0}, ("neither inertia nor viscosity",)),
        ({"inertia": np.diag([1.0, 0.0])}, ("neither inertia nor viscosity",)),
        ({"inertia": np.ones((2, 2))}, ("neither inertia nor viscosity",)),
        ({"viscosity": -1e-9}, ("viscosity", "negative")),
        ({"viscosity": np.inf}, ("viscosity", "finite")),
        ({"viscosity": [[1.0, 0.5], [0.4, 1.0]]}, ("viscosity", "symmetric")),
        ({"viscosity": np.eye(1)}, ("viscosity", "(1, 1)", "2 components")),
    ],
)
def test_refused(change, words):
    with refused(BodyError, *words):
        cb.Body(**GOOD | change)


def test_no_constant_matrix():
    """Of an inertia that is a function."""
    body = cb.Body(**GOOD | {"inertia": lambda nu, nu_dot: ufl.inner(nu_dot, nu_dot)})
    with refused(BodyError, "inertia", "function of (nu, nu_dot)", "implicit"):
        _ = body.inertia_matrix


@pytest.mark.parametrize(
    "change, words",
    [
        ({"energy": lambda U, nu, N: U}, ("energy of gum", "(3, 3)")),
        ({"energy": lambda U, nu, N: ufl.inner(U, U) + ufl.div(nu) ** 2}, ("div", "N for ∇ν")),
        ({"energy": lambda U, nu, N: ufl.inner(ufl.grad(nu), ufl.grad(nu))}, ("grad", "N for ∇ν")),
        ({"energy": lambda U, nu, N: nu[ufl.i] * 2.0}, ("energy of gum", "free indices")),
        ({"energy": lambda U, nu, N: nu[2] ** 2}, ("energy of gum", "nu of shape (k,)")),
        ({"energy": lambda U, nu, N: None}, ("energy of gum",)),
        ({"energy": lambda U, nu: nu[0]}, ("energy of gum", "TypeError")),
        ({"energy": lambda U, nu, N: 1 / 0}, ("energy of gum", "ZeroDivisionError")),
        ({"energy": lambda U, nu, N: 1j * nu[0] ** 2}, ("energy of gum", "finite real")),
        ({"energy": lambda U, nu, N: np.nan * nu[0] ** 2}, ("energy of gum", "finite real")),
        ({"energy": lambda U, nu, N: 10**400 * nu[0]}, ("energy of gum", "finite real")),
        ({"energy": lambda U, nu, N: U[0, 0] > 0}, ("energy of gum", "no number")),
        ({"potential": lambda u, nu: nu}, ("potential of gum", "(2,)")),
        ({"potential": lambda u, nu: u[3]}, ("potential of gum",)),
    ],
)
def test_densities_that_fail(comm, change, words):
    """Found when the scene is made ready: the message names the body and what is expected."""
    body = cb.Body(**GOOD | change, name="gum")
    with refused(BodyError, *words):
        Problem(cb.Scene(bent(comm, (3, 2)), body))
