# SPDX-License-Identifier: LGPL-3.0-or-later
"""1D-hexagonal quasicrystals in antiplane motion: shapes, energy, coercivity."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from complexbody.errors import BodyError, CoercivityError
from complexbody.forms import hexagonal_quasicrystal
from complexbody.forms.hexagonal import _energy

number = st.floats(-2.0, 3.0)


def test_two_coupled_membranes(value, hessian):
    """Scalar u and ν; H is [[C44, R3], [R3, K2]] in each direction."""
    body = hexagonal_quasicrystal(C44=2.0, K2=1.5, R3=0.7)
    assert (body.displacement, body.descriptor) == (1, 1)
    assert value(body.energy, [[1.0, 2.0, 0.0]], [9.0], [[3.0, -1.0, 0.0]]) == pytest.approx(
        0.5 * 2.0 * 5 + 0.5 * 1.5 * 10 + 0.7 * 1
    )
    H = hessian(body.energy, 1, 1, d=2)
    np.testing.assert_allclose(H, np.kron([[2.0, 0.7], [0.7, 1.5]], np.eye(2)), atol=1e-14)


@given(C44=number, K2=number, R3=number)
@settings(max_examples=60, derandomize=True, database=None, deadline=None)
def test_coercive_iff_hessian_is(C44, K2, R3, hessian):
    """The constants are accepted exactly when H is positive definite."""
    eigenvalue = np.linalg.eigvalsh(hessian(_energy(C44, K2, R3), 1, 1, d=2)).min()
    assume(abs(eigenvalue) > 1e-9)
    try:
        hexagonal_quasicrystal(C44, K2, R3)
    except CoercivityError:
        assert eigenvalue < 0
    else:
        assert eigenvalue > 0


@pytest.mark.parametrize(
    ("inequality", "constants", "constant", "inward"),
    [
        ("C44*K2 > R3**2", {"C44": 2.0, "K2": 1.5, "R3": math.sqrt(3.0)}, "R3", -1),
        ("C44*K2 > R3**2", {"C44": 2.0, "K2": 1.5, "R3": -math.sqrt(3.0)}, "R3", +1),
        ("C44 > 0", {"C44": 0.0, "K2": 1.5, "R3": 0.0}, "C44", +1),
        ("K2 > 0", {"C44": 2.0, "K2": 0.0, "R3": 0.0}, "K2", +1),
    ],
)
def test_coercive_exactly_inside(inequality, constants, constant, inward, hessian, lowest):
    """1e-6 inside: accepted and H > 0; 1e-6 outside: refused, and H is indefinite."""
    inside, outside = (
        constants | {constant: constants[constant] + s * 1e-6 * inward} for s in (1, -1)
    )
    assert lowest(hessian(hexagonal_quasicrystal(**inside).energy, 1, 1, d=2)) > 0
    with pytest.raises(CoercivityError) as error:
        hexagonal_quasicrystal(**outside)
    assert inequality in str(error.value)
    assert lowest(hessian(_energy(**outside), 1, 1, d=2)) < 0


def test_message_tells_the_bound():
    """The remedy is a number that, taken, is accepted."""
    with pytest.raises(CoercivityError, match=r"\|R3\| < 1\.73205081"):
        hexagonal_quasicrystal(2.0, 1.5, 2.0)
    hexagonal_quasicrystal(2.0, 1.5, 1.732)


def test_constants_are_finite_numbers():
    """NaN is refused by the name of the constant."""
    with pytest.raises(BodyError, match="R3 is nan"):
        hexagonal_quasicrystal(R3=math.nan)
