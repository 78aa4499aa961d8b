# SPDX-License-Identifier: LGPL-3.0-or-later
"""The synchronous integrator is the discrete principle, scheme by scheme; its limits; its ends.

Trajectories equal a plain recursion (tests/dense.py) to round-off. Limits of stability are those of
DESIGN §2 on the damped oscillator: hω = 2(√(1+ζ²)+ζ) for "forward", 2 for "symmetric", and the
root of x = 4ζ coth(ζx) for "exact".
"""

import numpy as np
import pytest
from dense import Dense, Plain, amplification, halves, prepared, quadratic, random_hessian, state
from harness import everywhere, refused
from mpi4py import MPI
from scipy.optimize import brentq

import complexbody as cb
from complexbody import meshes
from complexbody.errors import IntegratorError, StepError
from complexbody.problem import Problem
from complexbody.timesets import critical_step

SCHEMES = ("exact", "symmetric", "forward")
OMEGA = np.array([[1.3, 0.4], [0.4, 0.7]])
ETA = np.array([[0.5, -0.3], [-0.3, 2.0]])
INERTIA = {
    "number": [(1, 0.8, 1.7)],
    "blocks": [(2, OMEGA, ETA)],
    "regions": [(2, OMEGA, ETA), (2, np.diag([0.5, 1.2]), np.zeros((2, 2)))],
    "no inertia": [(2, 0.0, ETA)],
    "half of it": [(2, np.diag([0.9, 0.0]), np.diag([0.4, 1.5]))],
    "undamped": [(1, 0.8, 0.0)],
}
LEFT = lambda x: x[0] < 1e-9  # noqa: E731


def wave(n, seed):
    """A smooth field of n components as a callable of x."""
    a = np.random.default_rng(seed).normal(size=(2, n, 1))
    return lambda x: np.sin(3 * x[:1] + a[0]) * a[1] + 0.2 * x[1]


@pytest.mark.parametrize("start", ["trapezoidal", "one-sided"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("kind", INERTIA)
@pytest.mark.parametrize("dim", [1, 2])
def test_trajectories(comm, dim, kind, scheme, start):
    """Fields and rates after every step, loads, supports and regions included."""
    assert not np.allclose(OMEGA @ ETA, ETA @ OMEGA)
    k, n_u = INERTIA[kind][0][0], 2
    singular = kind in ("no inertia", "half of it")
    if dim == 1:
        mesh = meshes.graded_interval(comm, np.linspace(0.5, 1.5, 14) / 14)
    else:
        mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 1), (4, 3)), 0.2)
    H = random_hessian(dim, n_u, k, dim)
    bodies = [
        cb.Body(k, quadratic(H, dim), 1.5 - 0.4 * r, inertia, viscosity, displacement=n_u)
        for r, (_, inertia, viscosity) in enumerate(INERTIA[kind])
    ]
    regions = {"body": bodies[0]}
    if len(bodies) > 1:
        regions = {"body": {1: bodies[0], 2: bodies[1]}, "cell_tags": halves(mesh)}
    force, history = np.array([0.7, -0.4]), cb.sine(0.4, 0.3)
    scene = cb.Scene(
        mesh,
        supports=[cb.Fix("u", LEFT), cb.Fix("nu", LEFT)],
        loads=[cb.BodyForce(force, history), cb.BodyForce(force[:k], field="nu")],
        initial=cb.Initial(wave(n_u, 1), wave(k, 2), wave(n_u, 3), wave(k, 4)),
        **regions,
    )
    method = cb.Synchronous(dissipation=scheme, start=start, safety=0.8)
    if singular and scheme == "symmetric":
        with refused(IntegratorError, "symmetric"):
            prepared(scene, method)
        return
    run = prepared(scene, method)
    dense = Dense(mesh, bodies, hessians=[H] * len(bodies))
    fixed = np.repeat((dense.points[:, 0] < 1e-9)[:, None], n_u + k, axis=1)
    ix, h = dense.free(fixed), run.step
    M, D, K = (A[np.ix_(ix, ix)] for A in (dense.full(dense.M), dense.full(dense.D), dense.K))
    plain = Plain(M, D, h, scheme, start)
    const = np.outer(dense.volume, np.concatenate([0 * force, force[:k]])).ravel()[ix]
    moving = np.outer(dense.volume, np.concatenate([force, 0 * force[:k]])).ravel()[ix]

    def forces(x, t):
        return -K @ x + const + moving * float(history(t))

    q, rate = state(run)
    assert not q[fixed].any() and not rate[fixed].any()
    x, v = q.ravel()[ix], rate.ravel()[ix]
    exact = np.concatenate([f(dense_points(dense)) for f in (wave(n_u, 3), wave(k, 4))]).T
    heavy = plain.heavy
    np.testing.assert_allclose(v[heavy], exact.ravel()[ix][heavy], rtol=0, atol=1e-14)
    scales = np.array([abs(x).max(), abs(v).max()])
    for step in range(1, 41):
        f = forces(x, (step - 1) * h)
        x = plain.begin(x, v, f) if step == 1 else plain.step(x, f)
        run.advance(1)
        q, rate = state(run)
        v = plain.rate(forces(x, step * h))
        scales = np.maximum(scales, [abs(x).max(), abs(v).max()])
        assert abs(q.ravel()[ix] - x).max() < 1e-12 * scales[0], f"step {step}"
        assert abs(rate.ravel()[ix] - v).max() < 1e-12 * scales[1], f"step {step}"
    # Steps in one go are the same steps.
    again = prepared(scene, method)
    again.advance(40)
    assert everywhere(comm, np.array_equal(state(again)[0], q))


def dense_points(dense):
    """Points as a callable of x takes them, shape (3, nodes)."""
    return np.pad(dense.points, ((0, 0), (0, 3 - dense.dim))).T


# --- one oscillator: the difference of ν at the two ends of one cell ------------------------------

STIFF, SELF = 1.0, 0.7


def oscillator(inertia, zeta=None, viscosity=0.0):
    """A cell of length 1 whose fastest motion is ν = ±1 at its ends, and its ω; on one rank."""
    omega = np.sqrt((4 * STIFF + SELF) / inertia) if inertia else np.inf
    eta = viscosity if zeta is None else 2 * zeta * omega * inertia

    def energy(U, nu, N):
        return 0.5e-12 * U[0, 0] ** 2 + 0.5 * STIFF * N[0, 0] ** 2 + 0.5 * SELF * nu[0] ** 2

    body = cb.Body(1, energy, 1.0, inertia, eta, displacement=1)
    initial = cb.Initial(nu=lambda x: 1 - 2 * x[:1])
    mesh = meshes.graded_interval(MPI.COMM_SELF, [1.0])
    return cb.Scene(mesh, body, initial=initial, self_action="lumped"), omega, eta


def limit(scheme, zeta):
    """hω at which the scheme becomes unstable."""
    if scheme == "symmetric":
        return 2.0
    if scheme == "forward":
        return 2 * (np.sqrt(1 + zeta**2) + zeta)
    return brentq(lambda x: x - 4 * zeta / np.tanh(zeta * x), 1.0, 10 + 8 * zeta) if zeta else 2.0


@pytest.mark.parametrize("inertia", [1.0, 1e-3, 1e-6])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_critical_steps(scheme, inertia):
    """Light or heavy, hardly or overdamped: never above the table's limit, nor 1e-6 below it."""
    for zeta in 10.0 ** np.arange(-4, 5):
        scene, omega, _ = oscillator(inertia, zeta)
        ratio = critical_step(Problem(scene), scheme) * omega / limit(scheme, zeta)
        assert 1 - 1e-6 < ratio <= 1 + 1e-12, zeta


@pytest.mark.parametrize("zeta", [0.0, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_limits_of_stability(scheme, zeta):
    """The critical step is the table's; 0.1 % below it 10⁴ steps stay, above it ν grows as told."""
    inertia = 1.3
    scene, omega, eta = oscillator(inertia, zeta)
    known = limit(scheme, zeta) / omega
    critical = critical_step(Problem(scene), scheme)
    assert known * (1 - 1e-6) < critical <= known * (1 + 1e-12)

    stable = prepared(scene, cb.Synchronous(0.999 * known, dissipation=scheme))
    largest = 0.0
    for _ in range(100):
        stable.advance(100)
        largest = max(largest, abs(state(stable)[0][:, 1]).max())
    assert largest < 1.01

    with pytest.raises(StepError, match="critical"):
        prepared(scene, cb.Synchronous(1.001 * known, dissipation=scheme))
    method = cb.Synchronous(1.001 * known, dissipation=scheme, unstable_ok=True)
    unstable = prepared(scene, method)
    matrices = (np.array([[a]]) for a in (inertia, eta, omega**2 * inertia))
    growth = abs(np.linalg.eigvals(amplification(*matrices, unstable.step, scheme))).max()
    assert growth > 1 + 1e-5
    steps = int(12 / np.log(growth))
    unstable.advance(steps)
    before = state(unstable)[0][0, 1]
    unstable.advance(steps)
    found = np.log(abs(state(unstable)[0][0, 1] / before)) / steps
    assert found == pytest.approx(np.log(growth), rel=1e-4)


# --- limits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["exact", "forward"])
def test_inertia_to_zero(comm, scheme):
    """At a fixed step, ρ̄ = 1 … 1e-6 tends to ρ̄ = 0: like ρ̄ (forward), exponentially (exact)."""
    mesh, ends = meshes.interval(comm, 0, 1, 12), []
    H = random_hessian(5, 1, 1, 1)
    inertias = [10.0**-p for p in range(7)] + [0.0]
    step = None
    for inertia in reversed(inertias):
        body = cb.Body(1, quadratic(H, 1), 1.0, inertia, 20.0, displacement=1)
        supports = [cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")]
        initial = cb.Initial(u=wave(1, 7), nu=wave(1, 8))
        scene = cb.Scene(mesh, body, supports=supports, initial=initial)
        run = prepared(scene, cb.Synchronous(step, safety=0.5, dissipation=scheme))
        step = step or run.step
        run.advance(30)
        ends.append(state(run)[0])
    distance = [abs(end - ends[0]).max() for end in ends[1:]]  # from 1e-6 to 1
    assert distance[-1] > 1e-2
    if scheme == "exact":
        assert 20 * step / 1e-3 > 70
        assert max(distance[:4]) < 1e-13  # exp(−hη/ρ̄) is nothing
    else:
        np.testing.assert_allclose(np.log10(distance[1:3]) - np.log10(distance[:2]), 1, atol=0.02)
        assert distance[0] < 1e-6


def test_symmetric_has_no_limit_without_inertia(comm):
    """Its step falls like √ρ̄ and a step that "exact" takes is refused."""
    for inertia in (1e-2, 1e-4, 1e-6):
        scene, omega, eta = oscillator(inertia, viscosity=20.0)
        critical = critical_step(Problem(scene), "symmetric")
        assert critical == pytest.approx(2 / omega, rel=1e-6)
        exact = critical_step(Problem(scene), "exact")
        assert exact == pytest.approx(2 * eta / (omega**2 * inertia), rel=1e-2 + 5 * inertia)
        with refused(StepError, "critical"):
            prepared(scene, cb.Synchronous(0.9 * exact, dissipation="symmetric"))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_viscosity_to_infinity(scheme):
    """Increments tend to (h/η)f for "forward" and "exact"; those of "symmetric" alternate."""
    for eta in (1e4, 1e8):
        scene, omega, _ = oscillator(1.0, viscosity=eta)
        method = cb.Synchronous(1.0 / omega, dissipation=scheme, start="one-sided")
        run = prepared(scene, method)
        at = [state(run)[0][:, 1]]
        for _ in range(6):
            run.advance(1)
            at.append(state(run)[0][:, 1])
        force = -(4 * STIFF + SELF) * at[0]  # per inertia 1; ν hardly moves
        ratio = np.diff(at, axis=0) / (run.step / eta * force)
        expected = np.array([2, 0, 2, 0, 2, 0]) if scheme == "symmetric" else np.ones(6)
        np.testing.assert_allclose(ratio, expected[:, None] * [1, 1], atol=50 / eta)
