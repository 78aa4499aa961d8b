# SPDX-License-Identifier: LGPL-3.0-or-later
"""Case 1: asynchronous steps h₁ = n h₂ of two springs on one mass resonate.

With Ω = √(k₂/m) h₂, θ = 2 asin(Ω/2) and c = h₁h₂k₁/(m sin θ) the map over h₁ has the trace
2cos nθ − c sin nθ: unstable iff jπ − 2atan(c/2) < nθ < jπ, growth at most c/2 + √(1 + c²/4).
"""

import numpy as np
import pytest
from dense import prepared
from harness import refused
from verification.cases import divisions_of
from verification.step_maps import radius, string, window_map

import complexbody as cb
from complexbody.errors import DivergenceError

BANDS = [(2, [(1.155, 1.414)]), (3, [(0.902, 1.0), (1.581, 1.732)])]


def springs(ratio, omega):
    """Two cells of length 1 around a mass 1: k₂ = 1, k₁ = 1/n², critical steps n and 1."""
    scene = string([1.0, 1.0], (1.0 / ratio**2, 1.0))
    return prepared(scene, cb.AVI(safety=omega, balanced=False), ratio * omega)


@pytest.mark.serial
@pytest.mark.parametrize("ratio, bands", BANDS)
def test_bands_and_rates(ratio, bands):
    """Unstable where predicted, at the predicted rate of the map and of its powers."""
    found, best = [], 0.0
    for omega in np.linspace(0.8, 1.75, 39):
        run, window = springs(ratio, omega), ratio * omega
        assert run.step == pytest.approx(window) and sorted(divisions_of(run)) == [1, ratio]
        matrix = window_map(run)
        theta = 2 * np.arcsin(omega / 2)
        c = window * omega / ratio**2 / np.sin(theta)
        trace = 2 * np.cos(ratio * theta) - c * np.sin(ratio * theta)
        assert np.trace(matrix) == pytest.approx(trace, abs=1e-12)
        predicted = abs(np.roots([1, -trace, 1])).max()
        growth = abs(np.linalg.eigvals(matrix)).max()
        assert growth == pytest.approx(predicted, abs=1e-7)
        found.append((omega, growth))
        peak = 0.5 * c + np.sqrt(1 + 0.25 * c**2)
        assert growth <= peak + 1e-9
        best = max(best, growth / peak)
        if growth > 1.05:
            rows = np.array([np.linalg.matrix_power(matrix, k) @ [1.0, 0.3] for k in (50, 51)])
            first, second = np.linalg.norm(rows, axis=1)
            assert second / first == pytest.approx(growth, rel=0.02)
    for omega, growth in found:
        distance = min(abs(omega - end) for band in bands for end in band)
        if distance > 2e-3:
            inside = any(low < omega < high for low, high in bands)
            assert (growth > 1 + 1e-6) == inside, (omega, growth)
    assert best > 0.98  # the peak c/2 + √(1 + c²/4) is met


@pytest.mark.serial
def test_no_resonance_at_the_default():
    """α = 0.45 lies below the first band for every n: nθ < π − 2atan(c/2)."""
    for ratio in (1, 2, 3, 5, 12):
        assert radius(springs(ratio, cb.AVI().safety)) < 1 + 1e-12


@pytest.mark.serial
def test_the_run_is_stopped():
    """In the band the ledger sees energy from nowhere; beside it the same run ends."""
    middle = cb.Initial(nu=lambda x: np.where(abs(x[:1] - 1) < 0.1, 1.0, 0.0))
    scene = string([1.0, 1.0], (0.25, 1.0), initial=middle)
    told = pytest.warns(UserWarning, match="the steps of neighbouring cells differ by up to 2")
    with told:
        cb.simulate(scene, cb.AVI(safety=1.1, balanced=False), until=220.0)
    with told, refused(DivergenceError, "nowhere", "t = "):
        cb.simulate(scene, cb.AVI(safety=1.3, balanced=False), until=260.0)
