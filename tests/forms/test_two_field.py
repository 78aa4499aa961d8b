# SPDX-License-Identifier: LGPL-3.0-or-later
"""The isotropic two-field model: coercivity in each dimension, isotropy, wave moduli."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from complexbody.errors import BodyError, CoercivityError
from complexbody.forms import isotropic_two_field
from complexbody.forms.two_field import _energy

BASE = {"lam": 0.8, "mu": 0.9, "k0": 0.7, "k1": 0.5, "k2": 0.6, "k2_skew": 0.3}
BASE |= {"k3": 0.2, "k3_sym": 0.25}
# mostly admissible signs, so that both verdicts come up
constants = st.fixed_dictionaries(
    {name: st.floats(-0.3, 2.0) for name in ("mu", "k2", "k2_skew", "k0")}
    | {name: st.floats(-1.5, 2.0) for name in ("lam", "k1", "k3", "k3_sym")}
)


@pytest.fixture(scope="module")
def unit_hessians(hessian):
    """H of each constant alone, for d = 1, 2, 3: the energy is linear in its constants."""
    zero = dict.fromkeys(BASE, 0.0)
    return {
        d: {name: hessian(_energy(d, **(zero | {name: 1.0})), d, d, d, True) for name in BASE}
        for d in (1, 2, 3)
    }


def total(unit, c):
    """H for the constants c, from the H of each."""
    return sum(c[name] * H for name, H in unit.items())


@given(d=st.sampled_from([1, 2, 3]), c=constants)
@settings(max_examples=300, derandomize=True, database=None, deadline=None)
def test_coercive_iff_hessian_is(d, c, unit_hessians):
    """The constants are accepted exactly when H on (sym U, ν, N) is positive definite."""
    eigenvalue = np.linalg.eigvalsh(total(unit_hessians[d], c)).min()
    assume(abs(eigenvalue) > 1e-9)
    try:
        isotropic_two_field(d=d, **c)
    except CoercivityError:
        assert eigenvalue < 0
    else:
        assert eigenvalue > 0


@pytest.mark.parametrize("d", [1, 2, 3])
def test_energy_is_linear_in_its_constants(d, hessian, unit_hessians):
    """What the tests of coercivity rely on."""
    H = hessian(isotropic_two_field(d=d, **BASE).energy, d, d, d, True)
    np.testing.assert_allclose(H, total(unit_hessians[d], BASE), atol=1e-14)


def boundaries():
    """(d, inequality, constants on the boundary, which to move, which way is inward)."""
    for d in (1, 2, 3):
        own = 0.5 + 2 * 0.6 / d
        bulk = "(k3 + k3_sym"
        edge = math.sqrt((0.8 + 1.8 / d) * own) - 0.25 / d
        yield d, bulk, BASE | {"k3": edge}, "k3", -1
        yield d, bulk, BASE | {"lam": (0.2 + 0.25 / d) ** 2 / own - 1.8 / d}, "lam", +1
        uncoupled = BASE | {"k3": 0.0, "k3_sym": 0.0}
        yield d, f"lam + 2*mu/{d} > 0", uncoupled | {"lam": -1.8 / d}, "lam", +1
        yield d, f"k1 + 2*k2/{d} > 0", uncoupled | {"k1": -1.2 / d}, "k1", +1
        yield d, "k0 >= 0", BASE | {"k0": 0.0}, "k0", +1
        if d > 1:
            shear = math.sqrt(4 * 0.9 * 0.6)
            yield d, "k3_sym**2", BASE | {"k3": -shear / d, "k3_sym": shear}, "k3_sym", -1
            yield d, "k2_skew > 0", BASE | {"k2_skew": 0.0}, "k2_skew", +1
            yield d, "mu > 0", uncoupled | {"mu": 0.0}, "mu", +1
            yield d, "k2 > 0", uncoupled | {"k2": 0.0}, "k2", +1


@pytest.mark.parametrize(("d", "inequality", "edge", "constant", "inward"), list(boundaries()))
def test_coercive_exactly_inside(d, inequality, edge, constant, inward, unit_hessians, lowest):
    """1e-6 inside: accepted and H > 0; 1e-6 outside: refused, and H is indefinite."""
    inside, outside = (edge | {constant: edge[constant] + s * 1e-6 * inward} for s in (1, -1))
    assert isotropic_two_field(d=d, **inside).constants == inside
    assert lowest(total(unit_hessians[d], inside)) > 0
    with pytest.raises(CoercivityError) as error:
        isotropic_two_field(d=d, **outside)
    assert inequality in str(error.value)
    assert lowest(total(unit_hessians[d], outside)) < 0


def test_two_negative_pressures_do_not_make_a_positive(hessian, lowest):
    """(λ + 2μ/3)(k1 + 2k2/3) > (k3 + k3'/3)² alone would let this indefinite body pass."""
    c = BASE | {"lam": -2.0, "k1": -2.0}
    assert (-2.0 + 0.6) * (-2.0 + 0.4) > (0.2 + 0.25 / 3) ** 2
    assert lowest(hessian(_energy(3, **c), 3, 3, 3, True)) < 0
    with pytest.raises(CoercivityError, match="lam"):
        isotropic_two_field(**c)


def test_the_plane_allows_more(hessian, lowest):
    """λ between −μ and −2μ/3: coercive for d = 2, not for d = 3."""
    c = BASE | {"lam": -0.7, "k3": 0.0, "k3_sym": 0.0}
    assert lowest(hessian(isotropic_two_field(d=2, **c).energy, 2, 2, 2, True)) > 0
    with pytest.raises(CoercivityError, match=r"lam \+ 2\*mu/3"):
        isotropic_two_field(d=3, **c)


def test_k0_may_vanish(hessian):
    """k0 = 0 is accepted and leaves the constant ν as the only null mode."""
    H = hessian(isotropic_two_field(k0=0.0).energy, 3, 3, 3, True)
    eigenvalues = np.linalg.eigvalsh(H)
    np.testing.assert_allclose(eigenvalues[:3], 0.0, atol=1e-14)
    assert eigenvalues[3] > 0.1


@pytest.mark.parametrize("d", [2, 3])
def test_isotropic(d, value):
    """Rotations and mirrors act on u and ν alike, and change nothing."""
    rng = np.random.default_rng(1)
    energy = _energy(d, **BASE)
    for _ in range(5):
        Q = np.linalg.qr(rng.normal(size=(d, d)))[0]
        U, N = np.zeros((2, d, 3))
        V, W = np.zeros((2, d, 3))
        U[:, :d], N[:, :d], nu = (
            rng.normal(size=(d, d)),
            rng.normal(size=(d, d)),
            rng.normal(size=d),
        )
        V[:, :d], W[:, :d] = Q @ U[:, :d] @ Q.T, Q @ N[:, :d] @ Q.T
        assert value(energy, V, Q @ nu, W) == pytest.approx(value(energy, U, nu, N), rel=1e-12)


def test_descriptor_turns_with_the_body(value):
    """With ν left unturned the energy does change: the test above can fail."""
    rng = np.random.default_rng(2)
    Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    U, N = rng.normal(size=(2, 3, 3))
    energy = _energy(3, **BASE)
    after = value(energy, Q @ U @ Q.T, np.zeros(3), N @ Q.T)
    assert abs(after - value(energy, U, np.zeros(3), N)) > 1e-2


@pytest.mark.parametrize(
    ("amplitude", "moduli"),
    [
        ((1, 0, 0), (0.8 + 2 * 0.9, 0.5 + 2 * 0.6, 0.2 + 0.25)),
        ((0, 1, 0), (0.9, 0.6 + 0.3, 0.25 / 2)),
    ],
)
def test_wave_moduli(amplitude, moduli, value):
    """Longitudinal (λ+2μ, k1+2k2, k3+k3') and transverse (μ, k2+k2', k3'/2) plane waves."""
    wave, zero = np.outer(amplitude, (1, 0, 0)), np.zeros((3, 3))
    energy = _energy(3, **BASE)
    own = [2 * value(energy, wave, zero[0], zero), 2 * value(energy, zero, zero[0], wave)]
    both = value(energy, wave, zero[0], wave) - sum(own) / 2
    np.testing.assert_allclose([*own, both], moduli, rtol=1e-13)


def test_plane_body_ignores_what_it_has_not(value):
    """With d = 2 the third column of U and N is not read."""
    energy = isotropic_two_field(d=2).energy
    third = np.zeros((2, 3))
    third[:, 2] = 1.0
    assert value(energy, third, np.zeros(2), third) == 0.0


@pytest.mark.parametrize("d", [0, 4, True, 2.5, "3"])
def test_dimension(d):
    """Only one, two or three dimensions."""
    with pytest.raises(BodyError, match="Give d=1, 2 or 3"):
        isotropic_two_field(d=d)


@pytest.mark.parametrize("constant", BASE)
def test_constants_are_finite_numbers(constant):
    """NaN is refused by the name of the constant."""
    with pytest.raises(BodyError, match=rf"{constant} is nan"):
        isotropic_two_field(**(BASE | {constant: math.nan}))
