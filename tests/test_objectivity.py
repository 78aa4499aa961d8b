# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rotations of descriptors, and energies that are objective under them or are not."""

import nonlinear
import numpy as np
import pytest
import scipy.linalg
import ufl
from harness import refused

import complexbody as cb
from complexbody import rotations
from complexbody.errors import BodyError
from complexbody.forms import decagonal_quasicrystal, isotropic_two_field
from complexbody.pointwise import Expansion
from complexbody.rotations import rotation

M = nonlinear.DIRECTION


def cross(q):
    """The tensor q×."""
    return np.array([[0, -q[2], q[1]], [q[2], 0, -q[0]], [-q[1], q[0], 0]])


ACTIONS = {
    "scalar": rotations.scalar(2),
    "vector": rotations.vector(),
    "plane vector": rotations.vector(2),
    "tensor": rotations.tensor(),
    "plane tensor": rotations.tensor(2),
    "perpendicular": rotations.perpendicular(3),
    "angle": rotations.angle(),
    "microrotation": rotations.microrotation(),
    "several": rotations.together(rotations.vector(), rotations.scalar(), rotations.tensor()),
}


def test_rotation_is_the_exponential():
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-9, 0.3, 3.0):
        q = size * rng.normal(size=3)
        np.testing.assert_allclose(rotation(q), scipy.linalg.expm(cross(q)), atol=1e-14)


@pytest.mark.parametrize("name", ACTIONS)
def test_actions_are_actions(name):
    """a_I is the identity, a_Q a_R = a_QR; gradients and generators are those of a_Q."""
    action, rng = ACTIONS[name], np.random.default_rng(1)
    axis = np.array([0, 0, 1.0]) if action.planar else np.ones(3)
    Q, R = (rotation(axis * rng.uniform(-0.7, 0.7, 3)) for _ in range(2))
    nu = rng.uniform(-0.7, 0.7, (4, action.components))
    np.testing.assert_allclose(action.act(np.eye(3), nu), nu, atol=1e-14)
    np.testing.assert_allclose(action.act(Q, action.act(R, nu)), action.act(Q @ R, nu), atol=1e-14)
    h, d = 1e-5, rng.normal(size=nu.shape)
    change = (action.act(Q, nu + h * d) - action.act(Q, nu - h * d)) / (2 * h)
    np.testing.assert_allclose(
        np.einsum("mij,mj->mi", action.gradient(Q, nu), d), change, atol=1e-9
    )
    q = axis * rng.normal(size=3)
    spun = (action.act(rotation(h * q), nu) - action.act(rotation(-h * q), nu)) / (2 * h)
    np.testing.assert_allclose(action.generator(nu) @ q, spun, atol=1e-9)
    change = (action.generator(nu + h * d) - action.generator(nu - h * d)) / (2 * h)
    found = np.einsum("miaj,mj->mia", action.generator_gradient(nu), d)
    np.testing.assert_allclose(found, change, atol=1e-8)


def test_generators_by_hand():
    """Vectors q × ν, tensors q×T − Tq×, phasons thrice, microrotations q at ν = 0."""
    q, rng = np.array([0.3, -0.2, 0.5]), np.random.default_rng(2)
    v, T = rng.normal(size=3), rng.normal(size=(3, 3))
    for action, nu, expected in (
        (rotations.vector(), v, np.cross(q, v)),
        (rotations.tensor(), T.ravel(), (cross(q) @ T - T @ cross(q)).ravel()),
        (rotations.perpendicular(3), v[:2], 1.5 * np.array([-v[1], v[0]])),
        (rotations.angle(), v[:1], q[2:]),
        (rotations.microrotation(), np.zeros(3), q),
        (rotations.scalar(3), v, np.zeros(3)),
    ):
        np.testing.assert_allclose(action.generator(nu[None])[0] @ q, expected, atol=1e-12)


def test_large_microrotations():
    """exp(ν×) of the composed vector is the product, near a half turn too."""
    action = rotations.microrotation()
    for nu, Q in ((np.array([3.0, 0.2, -0.5]), rotation(np.array([-1.0, 2.0, 0.1]))),
                  (np.zeros(3), rotation(np.array([0, np.pi - 1e-9, 0])))):  # fmt: skip
        found = action.act(Q, nu[None])[0]
        assert np.linalg.norm(found) <= np.pi
        np.testing.assert_allclose(rotation(found), Q @ rotation(nu), atol=1e-13)


def test_objective_energies_and_others(capsys):
    """The director's energy turns as a vector and not as scalars; the balance of moments says so.

    The other way round: a cost of ν along a fixed direction is not objective, and its torque is
    found.
    """
    body = nonlinear.body(3)
    found = cb.objectivity(body, nu=M)
    assert found and all(check.residual < 1e-13 for check in found.checks)
    assert str(found).count("holds") == 2 and "FAILS" not in str(found)
    plane = cb.objectivity(nonlinear.body(2), nu=M[:2])
    assert plane and plane.action.planar
    wrong = cb.objectivity(body, rotations.scalar(3), nu=M)
    assert not wrong and not any(check.holds for check in wrong.checks)
    assert str(wrong).count("FAILS") == 2 and "worst at U = " in str(wrong)
    field = cb.objectivity(
        lambda U, nu, N: nonlinear.energy(U, nu, N) + 0.1 * nu[0] ** 2, rotations.vector()
    )
    assert not field.holds
    # One check may fail alone: a part that the moments do not see at one state.
    at = (np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)))
    alone = cb.objectivity(lambda U, nu, N: nu[0] ** 2 + U[0, 0], rotations.vector(), states=[at])
    assert [check.holds for check in alone.checks] == [False, True]


@pytest.mark.parametrize(
    ("energy", "action", "wrong"),
    [
        # A tensor order parameter, drawn to FFᵀ; a scalar of voids; plane microrotation and angle.
        (
            lambda F, nu, N: _square(_matrix(nu) - F * F.T) + ufl.inner(N, N),
            rotations.tensor(),
            rotations.scalar(9),
        ),
        (
            lambda F, nu, N: (ufl.det(F) - 1 - nu[0]) ** 2 + _square(N * ufl.inv(F)),
            rotations.scalar(),
            rotations.angle(),
        ),
        (
            lambda F, nu, N: _square(_turn(nu[0]).T * F - ufl.Identity(3)) + ufl.inner(N, N),
            rotations.angle(),
            rotations.scalar(),
        ),
        (
            lambda F, nu, N: _cosserat(F, nu, N),
            rotations.microrotation(),
            rotations.vector(),
        ),
    ],
    ids=["tensor", "voids", "angle", "microrotation"],
)
def test_other_descriptors(energy, action, wrong):
    """Nonlinear actions too, with D𝒜; and the balance of moments has its ½ and its sign right."""
    density = lambda U, nu, N: energy(cb.deformation(U), nu, N)  # noqa: E731
    found = cb.objectivity(density, action, states=2)
    assert found, str(found)
    assert not cb.objectivity(density, wrong, states=2)
    # Written out once more, from what UFL gives: skw(PFᵀ) = ½ e(𝒜*z + (D𝒜)*S).
    rng, k = np.random.default_rng(5), action.components
    U, nu, N = (0.3 * rng.normal(size=shape) for shape in ((3, 3), (k,), (k, 3)))
    slope = np.array(Expansion("energy", density, [(3, 3), (k,), (k, 3)], 1).at((U, nu, N))[1])
    P, z, S = slope[:9].reshape(3, 3), slope[9 : 9 + k], slope[9 + k :].reshape(k, 3)
    A, DA = action.generator(nu[None])[0], action.generator_gradient(nu[None])[0]
    axis = A.T @ z + np.einsum("iaj,jm,im->a", DA, N, S)
    PF = P @ (np.eye(3) + U).T
    difference = 0.5 * (PF - PF.T) + 0.5 * cross(axis)  # −q× is e q
    if action.planar:
        difference = difference[:2, :2]
    assert np.abs(axis).max() > 1e-3 or action.name == "scalar"
    np.testing.assert_allclose(difference, 0, atol=1e-11)


def _square(A):
    return ufl.inner(A, A)


def _matrix(nu):
    return ufl.as_tensor([[nu[3 * i + j] for j in range(3)] for i in range(3)])


def _turn(t):
    c, s = ufl.cos(t), ufl.sin(t)
    return ufl.as_tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _cosserat(F, nu, N):
    """|RᵀF − I|² + |Rᵀ∂_mR|² with R = exp(ν×), by Rodrigues' formula."""
    t = ufl.sqrt(ufl.inner(nu, nu))
    W = ufl.as_tensor([[0, -nu[2], nu[1]], [nu[2], 0, -nu[0]], [-nu[1], nu[0], 0]])
    R = ufl.Identity(3) + ufl.sin(t) / t * W + (1 - ufl.cos(t)) / t**2 * W * W
    rates = []
    for m in range(3):
        d = [N[i, m] for i in range(3)]
        dW = ufl.as_tensor([[0, -d[2], d[1]], [d[2], 0, -d[0]], [-d[1], d[0], 0]])
        dt = sum(nu[i] * d[i] for i in range(3)) / t
        a = (ufl.cos(t) * t - ufl.sin(t)) / t**2 * dt
        b = (ufl.sin(t) * t - 2 * (1 - ufl.cos(t))) / t**3 * dt
        dR = a * W + ufl.sin(t) / t * dW + b * W * W + (1 - ufl.cos(t)) / t**2 * (dW * W + W * dW)
        rates.append(_square(R.T * dR))
    return _square(R.T * F - ufl.Identity(3)) + sum(rates)


def test_linear_energies_know_small_rotations_only():
    """A linearised body, plane Cosserat and the isotropic two-field model."""
    made = cb.linearise(nonlinear.body(3), M)
    found = cb.objectivity(made)
    assert found and "infinitesimal" in str(found)
    finite = cb.objectivity(made, rotations.vector())
    assert not finite and "action.about(nu)" in str(finite)

    def cosserat(U, nu, N):
        return (
            ufl.inner(ufl.sym(U), ufl.sym(U))
            + 0.4 * (0.5 * (U[1, 0] - U[0, 1]) - nu[0]) ** 2
            + ufl.inner(N, N)
        )

    assert cb.objectivity(cosserat, rotations.angle().about())
    assert not cb.objectivity(cosserat, rotations.scalar().about())
    # A microdisplacement does not turn where it rests at zero.
    form = isotropic_two_field()
    action = rotations.vector(form.descriptor).about()
    assert cb.objectivity(form, action, displacement=form.displacement)


def test_decagonal_isotropy():
    """Turns of the reference with a threefold one of phasons leave the decagonal energy alone.

    That is its symmetry, by U → QUQᵀ and N → Q'NQᵀ; no other number of turns will do.
    """
    body, rng = decagonal_quasicrystal(), np.random.default_rng(3)
    n = body.displacement
    U, N = np.zeros((n, 3)), np.zeros((2, 3))
    U[:2, :2], N[:, :2] = rng.normal(size=(2, 2, 2))
    Q = rotation(np.array([0, 0, 0.7]))
    energy = Expansion("energy", body.energy, [(n, 3), (2,), (2, 3)], 0)
    e = energy.at((U, np.zeros(2), N))[0]
    for turns in (1, 2, 3):
        J = rotations.perpendicular(turns).gradient(Q, np.zeros((1, 2)))[0]
        turned = (Q[:n, :n] @ U @ Q.T, np.zeros(2), J @ N @ Q.T)
        other = energy.at(turned)[0]
        assert (abs(other - e) < 1e-12 * abs(e)) == (turns == 3)


def test_wrong_arguments(comm):
    for call, word in (
        (lambda: cb.objectivity(lambda U, nu, N: nu[0]), "not known"),
        (lambda: cb.objectivity(nonlinear.body(3), rotations.angle()), "does not|fits"),
        (lambda: cb.objectivity(lambda U, nu, N: nu[0], rotations.angle(), displacement=1), "n_u"),
        (lambda: rotations.linear("half", lambda Q: 0.5 * Q, 3), "no action"),
        (lambda: rotations.vector(4), "2 or 3"),
        (lambda: nonlinear.body(3, rotation=rotations.angle()), "components"),
    ):
        with refused(BodyError) as told:
            call()
        assert any(part in told[0] for part in word.split("|"))
