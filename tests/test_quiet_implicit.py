# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes at rest are not solved for where rest solves their equation: no bit of a result tells."""

import pytest
import ufl
from resting import bar, pair, small_chunks  # noqa: F401

import complexbody as cb

pytestmark = pytest.mark.usefixtures("small_chunks")


def growing(nu, rate):
    """χ = ½(1 + |ν|²)|ν̇|² + ν₁ν̇₂/5: ∂χ/∂ν̇ = ∂χ/∂ν = 0 at rest."""
    return 0.5 * (1 + ufl.inner(nu, nu)) * ufl.inner(rate, rate) + 0.2 * nu[0] * rate[1]


def pushed(nu, rate):
    """One with ∂χ/∂ν ≠ 0 at rest, which sets everything moving."""
    return 0.5 * ufl.inner(rate, rate) + 0.1 * nu[0]


def turned(nu, rate):
    """One with a momentum at rest, ∂χ/∂ν̇ ≠ 0: only a total derivative, but not to the bit."""
    return 0.5 * ufl.inner(rate, rate) + 0.1 * rate[0]


@pytest.mark.parametrize("dim, order", [(1, 1), (1, 2), (2, 2)])
def test_point_pulse(comm, dim, order):
    """A pulse that enters at one end pays for what it has reached."""
    scene = bar(comm, dim, "traction", inertia=growing)
    assert pair(comm, scene, cb.Implicit(order=order), 8, ledger_steps=3) > 0.6


@pytest.mark.parametrize("source", ["later", "force", "bump", "support", "held"])
def test_sources(comm, source):
    """Whatever sets cells moving: loads, at work or not yet, initial data, supports."""
    scene = bar(comm, 1, source, inertia=growing)
    assert pair(comm, scene, cb.Implicit(), 8) > 0.4


def test_until_all_is_awake(comm):
    """A run that starts quiet and ends with all cells awake, long after the watch is given up."""
    assert 0 < pair(comm, bar(comm, 2, "bump", inertia=growing), cb.Implicit(), 60) < 0.7


@pytest.mark.parametrize("kind", ["numbers", "blocks"])
def test_constant_inertia(comm, kind):
    """Where the inertia is constant and solved for all the same."""
    assert pair(comm, bar(comm, 1, "bump", kind), cb.Implicit(solve="always"), 8) > 0.4


def test_rest_does_not_last(comm):
    """A kinetic co-energy that pushes, or has a momentum, at rest: nothing is skipped."""
    for chi in (pushed, turned):
        scene = bar(comm, 1, "nothing", inertia=chi)
        assert pair(comm, scene, cb.Implicit(), 3) == 0.0


@pytest.mark.slow
def test_consistent(comm):
    """χ integrated in full is solved for everywhere at once."""
    scene, method = bar(comm, 1, "traction", inertia=growing), cb.Implicit(quadrature="consistent")
    assert pair(comm, scene, method, 2) == 0.0
