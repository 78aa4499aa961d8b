# SPDX-License-Identifier: LGPL-3.0-or-later
"""Case 7: χ(ν, ν̇) where a step has no solution, or a bubble closes: a clear stop and no NaN."""

import re

import numpy as np
import pytest
from harness import largest, refused
from verification.bubbles import collapse_time
from verification.general_inertia import bubble, collapsing, powers

import complexbody as cb
from complexbody.errors import IntegratorError, SolverError, StepError

QUADRATURES = ("vertex", "consistent")


def fast(comm):
    """χ = ½ν³ν̇² at ν = 1, ν̇ = 10, where ∂V/∂ν = 0: T₀ = γ/Ξ = 1/30 s."""
    scene = powers(comm)
    return cb.Scene(scene.mesh, scene.body, initial=cb.Initial(nu=1.0, nu_dot=10.0))


@pytest.mark.parametrize("quadrature", QUADRATURES)
def test_steps_above_the_limit(comm, quadrature):
    """A step above T₀ is refused. The first step solves v − (3h/2)v² = 10, singular at h = T₀/2."""
    given = {"order": 1, "quadrature": quadrature}
    with refused(StepError, "T₀", "0.0333333"):
        cb.simulate(fast(comm), cb.Implicit(1.001 / 30, **given), until=0.5)
    for factor in (0.9, 0.999):
        h = factor / 60
        result = cb.simulate(fast(comm), cb.Implicit(h, **given), until=h, growth=None)
        exact = 1 + (1 - np.sqrt(1 - factor)) / 3
        assert largest(comm, result.nu.x.array - exact) < 1e-9
    for factor in (1.001, 1.5):
        with refused(SolverError, "t = 0 s"):
            cb.simulate(fast(comm), cb.Implicit(factor / 60, **given), until=0.5, growth=None)
    result = cb.simulate(fast(comm), cb.Implicit(**given), until=0.01)
    assert result.stats.step <= 1 / 60  # the default stays below


def test_explicit_integrators_refuse(comm):
    """By name, with the one that takes it."""
    for method in (cb.Synchronous(), cb.AVI(), cb.LocalLeapfrog()):
        with refused(IntegratorError, type(method).__name__, "Implicit()"):
            cb.simulate(powers(comm), method, until=1.0)


@pytest.mark.parametrize("quadrature", QUADRATURES)
def test_collapse_stops_with_the_last_state(comm, shared_path, quadrature):
    """A clear stop, with time and state; what was reached is returned and written."""
    seen = []

    def run():
        try:
            cb.simulate(
                collapsing(comm), cb.Implicit(0.01, quadrature=quadrature), until=3.0,
                ledger_steps=5, output=cb.Output(shared_path / quadrature, every=0.5),
            )  # fmt: skip
        except SolverError as error:
            seen.append(error)
            raise

    with refused(SolverError, "t = ", "ν = " if quadrature == "vertex" else ""):
        run()
    kept = seen[0].result
    assert 0.3 < kept.time < 1.5 and np.all(np.isfinite(kept.nu.x.array))
    assert np.all((kept.nu.x.array > 0) & (kept.nu.x.array < 0.9))
    text = (shared_path / quadrature / "nu.xdmf").read_text()
    written = [float(t) for t in re.findall(r'<Time Value="([^"]+)"', text)]
    assert abs(written[-1] - kept.time) < 1e-12, written


def test_rayleigh_collapse(comm):
    """A bubble of 8 R0 falls in about Rayleigh's time; large steps are refused at its bottom."""
    scene, reference = bubble(comm, 8.0)
    fall = reference.period(8e-3) / 2
    assert abs(fall / collapse_time(8e-3, 1000.0, 101325.0) - 1) < 0.1
    step = fall / 4000
    result = cb.simulate(scene, cb.Implicit(step), until=0.98 * fall)
    exact = reference.trajectory(8e-3, [0.0, 0.98 * fall])[0, -1]
    assert largest(comm, (result.nu.x.array + 1e-3) / exact - 1) < 1e-3
    with refused(SolverError, "t = ", "ν"):
        cb.simulate(bubble(comm, 8.0)[0], cb.Implicit(fall / 100), until=1.2 * fall, growth=None)
