# SPDX-License-Identifier: LGPL-3.0-or-later
"""Case 2: a bar of two rates, 10 + 10 cells, sizes and steps h_K = αL_K/c in a given ratio."""

from fractions import Fraction

import numpy as np
import pytest
from dense import prepared
from verification.cases import LEFT
from verification.step_maps import radius, spectral_radius, string

import complexbody as cb
from complexbody import _compat
from complexbody.integrators.window_run import WindowRun
from complexbody.problem import Problem

RATIOS = [("2", 0.726), ("3", 0.56), ("4", 0.467), ("3/2", 0.513)]


def lengths_of(ratio):
    """Of all cells; their sum is 1."""
    return np.repeat([float(ratio), 1.0], 10) / (10 + 10 * float(ratio))


def two_rates(ratio, safety, viscosity=0.0):
    """10 + 10 cells of lengths ``ratio`` to 1, c = 1, h_K = α L_K, plain windows; left end held."""
    ratio = Fraction(ratio)
    length = 1 / (10 + 10 * ratio)
    problem = Problem(string(lengths_of(ratio), where=LEFT, viscosity=viscosity))
    corner = problem.scene.mesh.geometry.x[_compat.cell_nodes(problem.scene.mesh), 0].min(axis=1)
    coarse = corner < float(10 * ratio * length) - 1e-9
    problem.arrange(np.where(coarse, ratio.denominator, ratio.numerator))
    window = safety * float(ratio * length) * ratio.denominator
    return WindowRun(problem, cb.AVI(balanced=False), window, 1.0)


@pytest.mark.serial
@pytest.mark.parametrize("ratio, first", RATIOS)
def test_first_alpha_that_fails(ratio, first):
    """Growth from there on, as fast in a run; none at 0.45; 2.5 times its rate as η/ρ̄ cures it."""
    growth = {a: radius(two_rates(ratio, a)) for a in (0.45, *(first + 2.5e-4 * np.arange(-3, 4)))}
    assert growth.pop(0.45) < 1 + 1e-9
    worst = max(growth, key=growth.get)
    assert 1 + 2e-4 < growth[worst] < 1 + 2e-3, growth
    run = two_rates(ratio, worst)
    # A run grows so: by e^(rate t), once the mode that does has left the others behind.
    run.record[:-1, 1] = np.random.default_rng(1).normal(size=run.problem.disc.nodes)
    run.record[:-1, 1] *= ~run.problem.masses.fixed[run.problem.masses.classes[:-1], 1]
    windows, norms = round(12 / (growth[worst] - 1)), []
    for _ in range(2):
        run.advance(windows)
        norms.append(np.linalg.norm(run.sample()[0][:-1, 1]))
    measured = (norms[1] / norms[0]) ** (1 / windows)
    assert measured - 1 == pytest.approx(growth[worst] - 1, rel=0.15)
    rate = (growth[worst] - 1) / run.step
    assert radius(two_rates(ratio, worst, viscosity=2.5 * rate)) < 1


@pytest.mark.serial
@pytest.mark.parametrize("ratio", [r for r, _ in RATIOS])
def test_balanced_windows_do_not(ratio):
    """Octaves and held forces: none at the default α, nor at 0.6."""
    for safety in (cb.AVI().safety, 0.6):
        scene = string(lengths_of(Fraction(ratio)), where=LEFT)
        assert radius(prepared(scene, cb.AVI(safety=safety), 1e3)) <= 1 + 1e-10


@pytest.mark.serial
@pytest.mark.parametrize("ratio", [r for r, _ in RATIOS])
def test_local_leapfrog_does_not(ratio):
    """Stabilised: none for any safety factor up to the default 0.9, with one level or two."""
    default = cb.LocalLeapfrog().safety
    for safety in np.append(np.arange(0.3, 0.9, 0.05), default):
        for levels in (1, 2):
            scene = string(lengths_of(Fraction(ratio)), where=LEFT)
            growth, _ = spectral_radius(scene, cb.LocalLeapfrog(safety, levels=levels))
            assert growth <= 1 + 1e-10, (safety, levels, growth)
