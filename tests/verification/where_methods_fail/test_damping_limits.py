# SPDX-License-Identifier: LGPL-3.0-or-later
"""Case 3: limits of the dissipation schemes; ρ̄ → 0 and η → ∞.

The damped oscillator is the difference of ν at the two ends of one cell. Limits are those of
DESIGN §2: hω = 2(√(1+ζ²)+ζ) for "forward", 2 for "symmetric", the root of x = 4ζ coth(ζx) for
"exact".
"""

import numpy as np
import pytest
from dense import amplification, prepared, quadratic, random_hessian, state
from harness import refused
from mpi4py import MPI
from scipy.optimize import brentq
from verification.cases import wave

import complexbody as cb
from complexbody import meshes
from complexbody.errors import StepError
from complexbody.problem import Problem
from complexbody.timesets import critical_step

SCHEMES = ("exact", "symmetric", "forward")
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
