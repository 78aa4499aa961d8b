# SPDX-License-Identifier: LGPL-3.0-or-later
"""Icosahedral quasicrystals: coercivity at its boundary, point group, moduli, time scales."""

from __future__ import annotations

import math

import numpy as np
import pytest

from complexbody.errors import BodyError, CoercivityError
from complexbody.forms import (
    icosahedral_quasicrystal,
    phason_moduli,
    scaled_icosahedral_quasicrystal,
)
from complexbody.forms.icosahedral import _energy

TAU = (1.0 + math.sqrt(5.0)) / 2.0
BASE = {"lam": 1.1, "mu": 0.9, "k4": 1.3, "k5": 0.6, "R": 0.2}
R_BOUND = math.sqrt(0.9 * 0.6 / 3)


def rotation(axis, angle):
    """Rodrigues' formula."""
    n = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    K = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


def conjugate(Q):
    """Q with √5 replaced by −√5; the entries of 2Q are 0, ±1, ±2, ±τ, ±1/τ."""
    table = {0.0: 0.0, 1.0: 1.0, 2.0: 2.0, TAU: -1 / TAU, 1 / TAU: -TAU}
    result = np.empty_like(Q)
    for index, q in np.ndenumerate(2 * Q):
        (match,) = [b for a, b in table.items() if abs(abs(q) - a) < 1e-12]
        result[index] = 0.5 * math.copysign(1.0, q) * match
    return result


GENERATORS = {
    "three-fold": np.roll(np.eye(3), 1, axis=0),
    "two-fold": np.diag([1.0, -1.0, -1.0]),
    "five-fold (0,1,τ)": rotation((0, 1, TAU), 2 * math.pi / 5),
    "five-fold (τ,0,1)": rotation((TAU, 0, 1), 2 * math.pi / 5),
    "five-fold (1,τ,0)": rotation((1, TAU, 0), 2 * math.pi / 5),
}


@pytest.mark.parametrize("name", GENERATORS)
def test_point_group(name, value):
    """e(QUQᵀ, Q'wQᵀ) = e(U, w) to round-off, for Q in the icosahedral group."""
    Q = GENERATORS[name]
    P = conjugate(Q)
    np.testing.assert_allclose(P @ P.T, np.eye(3), atol=1e-14)
    rng = np.random.default_rng(1)
    energy = _energy(**BASE)
    for _ in range(5):
        U, w = rng.normal(size=(2, 3, 3))
        before = value(energy, U, np.zeros(3), w)
        after = value(energy, Q @ U @ Q.T, np.zeros(3), P @ w @ Q.T)
        assert abs(after - before) <= 1e-12 * max(1.0, abs(before))


@pytest.mark.parametrize("constant", ["k4", "R"])
def test_not_isotropic(constant, value):
    """The phason part (k4 ≠ k5) and the coupling each tell a generic rotation from no rotation."""
    constants = dict.fromkeys(BASE, 0.0) | {constant: 1.0}
    rng = np.random.default_rng(2)
    Q, P = rotation((1, 2, 3), 0.7), rotation((1, 2, 3), 0.7)
    U, w = rng.normal(size=(2, 3, 3))
    change = value(_energy(**constants), Q @ U @ Q.T, np.zeros(3), P @ w @ Q.T) - value(
        _energy(**constants), U, np.zeros(3), w
    )
    assert abs(change) > 1e-2


def test_phason_turns_with_the_conjugate(value):
    """With Q in place of Q' a five-fold rotation is not a symmetry."""
    Q = GENERATORS["five-fold (0,1,τ)"]
    w = np.random.default_rng(3).normal(size=(3, 3))
    zero = np.zeros((3, 3))
    before, after = (value(_energy(**BASE), zero, zero[0], v) for v in (w, Q @ w @ Q.T))
    assert abs(after - before) > 1e-2


def test_rigid_rotation_costs_nothing(value):
    """Only sym U enters."""
    rng = np.random.default_rng(4)
    U, w, A = rng.normal(size=(3, 3, 3))
    before, after = (value(_energy(**BASE), V, np.zeros(3), w) for V in (U, U + A - A.T))
    assert after == pytest.approx(before, rel=1e-12)


BOUNDARIES = [
    ("lam + 2*mu/3 > 0", "lam", -0.6, +1),
    ("k4 > 0", "k4", 0.0, +1),
    ("mu*k5 > 3*R**2", "R", R_BOUND, -1),
    ("mu*k5 > 3*R**2", "R", -R_BOUND, +1),
    ("mu*k5 > 3*R**2", "k5", 3 * 0.04 / 0.9, +1),
    ("mu*k5 > 3*R**2", "mu", 3 * 0.04 / 0.6, +1),
]


@pytest.mark.parametrize(("inequality", "constant", "bound", "inward"), BOUNDARIES)
def test_coercive_exactly_inside(inequality, constant, bound, inward, hessian, lowest):
    """1e-6 inside: accepted and H > 0; 1e-6 outside: refused, and H is indefinite."""
    inside = BASE | {constant: bound + 1e-6 * inward}
    outside = BASE | {constant: bound - 1e-6 * inward}
    assert lowest(hessian(icosahedral_quasicrystal(**inside).energy, 3, 3)) > 0
    with pytest.raises(CoercivityError) as error:
        icosahedral_quasicrystal(**outside)
    assert inequality in str(error.value)
    assert lowest(hessian(_energy(**outside), 3, 3)) < 0


@pytest.mark.parametrize("constant", ["mu", "k5"])
def test_positive_without_coupling(constant, hessian, lowest):
    """At R = 0 the sign of μ and of k5 decides."""
    inside, outside = (BASE | {"R": 0.0, "lam": 5.0, constant: sign * 1e-6} for sign in (1, -1))
    assert lowest(hessian(icosahedral_quasicrystal(**inside).energy, 3, 3)) > 0
    with pytest.raises(CoercivityError, match=f"{constant} > 0"):
        icosahedral_quasicrystal(**outside)
    assert lowest(hessian(_energy(**outside), 3, 3)) < 0


@pytest.mark.parametrize("value_given", [math.nan, math.inf, "0.1", None])
@pytest.mark.parametrize("constant", BASE)
def test_constants_are_finite_numbers(constant, value_given):
    """NaN, infinity and non-numbers are refused by the name of the constant."""
    with pytest.raises(BodyError, match=rf"{constant} is .*not a finite number"):
        icosahedral_quasicrystal(**(BASE | {constant: value_given}))


def test_phason_moduli_are_dings():
    """K1 − 2K2 (four times) and K1 + K2 (five times) are the eigenvalues of Ding's 9×9 matrix."""
    K1, K2 = 72.0, -37.0
    # order of the gradients: 11, 22, 33, 23, 31, 12, 32, 13, 21 (five-fold axis along x3)
    K = np.diag([K1, K1, K1 + K2, K1 - K2, K1 - K2, K1, K1 - K2, K1 - K2, K1])
    for i, j, sign in [(0, 4, 1), (0, 7, 1), (1, 4, -1), (1, 7, 1), (3, 5, 1), (3, 8, -1)]:
        K[i, j] = K[j, i] = sign * K2
    for i, j, sign in [(5, 6, -1), (6, 8, -1)]:
        K[i, j] = K[j, i] = sign * K2
    k4, k5 = phason_moduli(K1, K2)
    np.testing.assert_allclose(np.linalg.eigvalsh(K), sorted([k4] * 4 + [k5] * 5), rtol=1e-12)


def test_phason_moduli_are_the_energys(hessian):
    """The phason block of the density has k4 four times and k5 five times."""
    H = hessian(_energy(0.0, 0.0, 1.3, 0.6, 0.0), 3, 3)[6:, 6:]
    np.testing.assert_allclose(np.linalg.eigvalsh(H), [0.6] * 5 + [1.3] * 4, rtol=1e-12)


def acoustic(H, q):
    """Γ_ik = H_ijkl q_j q_l of a phason block H (9×9)."""
    return np.einsum("ijkl,j,l->ik", H.reshape(3, 3, 3, 3), q, q)


def test_which_phasons_negative_K2_softens(hessian):
    """As the docstring says: five-fold for Ding's K1, K2; three-fold at −3/4 for the other pair."""
    five, three = np.array([0, 1, TAU]) / math.hypot(1, TAU), np.ones(3) / math.sqrt(3)

    def soft(k4, k5, q):
        H = hessian(_energy(0.0, 0.0, k4, k5, 0.0), 3, 3)[6:, 6:]
        return np.linalg.eigvalsh(acoustic(H, q))[0]

    assert soft(*phason_moduli(1.0, -0.75), five) < 0.5 * soft(*phason_moduli(1.0, -0.75), three)
    k4, k5 = 1 - 5 / 3 * 0.75, 1 + 4 / 3 * 0.75
    assert abs(soft(k4, k5, three)) < 1e-12 < soft(k4, k5, five)


def test_real_phason_is_diffusive():
    """Defaults: no inertia, η = 1/Γ_w, and K1/η of the order of 1e-11 m²/s."""
    body = icosahedral_quasicrystal()
    assert body.inertia == 0.0
    assert body.viscosity == pytest.approx(1 / 4.8e-19)
    K1 = (body.constants["k4"] + 2 * body.constants["k5"]) / 3
    assert pytest.approx(72e6) == K1
    assert 1e-11 < K1 / body.viscosity < 1e-10
    # even with ρ̄ = ρ, a wave of one nanometre would be overdamped a hundredfold
    omega = 2 * math.pi / 1e-9 * math.sqrt(K1 / body.density)
    assert body.viscosity / (2 * body.density * omega) > 100


def test_scaled_phason_moves(hessian):
    """The scaled body says so; phasons are as fast as phonons, and neither rigid nor overdamped."""
    body = scaled_icosahedral_quasicrystal()
    assert "scaled" in body.name
    assert "not a real material" in scaled_icosahedral_quasicrystal.__doc__
    assert body.constants["R"] == pytest.approx(0.5 * math.sqrt(body.constants["k5"] / 3))
    H = hessian(body.energy, 3, 3)[6:, 6:] / body.inertia
    directions = np.random.default_rng(5).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    speeds = np.sqrt([np.linalg.eigvalsh(acoustic(H, q)) for q in directions])
    assert 0.55 < speeds.min() < speeds.max() < 1.25  # shear phonons: 1
    damping = body.viscosity / (2 * body.inertia * 2 * math.pi * speeds)
    assert 0.02 < damping.min() < damping.max() < 0.1


@pytest.mark.parametrize("coupling", [1.0, -1.0, 1.5])
def test_scaled_coupling_is_bounded(coupling):
    """At its bound the coupling is refused; a little inside it is taken."""
    with pytest.raises(CoercivityError, match="coupling"):
        scaled_icosahedral_quasicrystal(coupling=coupling)
    scaled_icosahedral_quasicrystal(coupling=math.copysign(1 - 1e-6, coupling))
