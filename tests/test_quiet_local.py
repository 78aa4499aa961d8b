# SPDX-License-Identifier: LGPL-3.0-or-later
"""Local leapfrog skips cells at rest at every level, and no bit of any result tells."""

import numpy as np
import pytest
from busy import busy
from dense import prepared
from harness import everywhere
from resting import bar, pair, quartic, small_chunks  # noqa: F401

import complexbody as cb
from complexbody.growth import RunMap

pytestmark = pytest.mark.usefixtures("small_chunks")
LOCAL = cb.LocalLeapfrog()


def local(comm, scene, steps, method=LOCAL, **given):
    """The share of quiet updates of a run with local steps, after comparing all of it."""
    assert everywhere(comm, prepared(scene, method).levels >= 2)
    return pair(comm, scene, method, steps, **given)


@pytest.mark.parametrize("dim, fine", [(1, 0.9), (1, -0.9), (2, 0.85), (2, -0.85), (3, 0.8)])
def test_point_pulse(comm, dim, fine):
    """A pulse that comes to the fine cells, or starts there: it pays for what it has reached."""
    assert local(comm, bar(comm, dim, "traction", fine=fine), 6, ledger_steps=3) > 0.2


@pytest.mark.parametrize("source", ["later", "force", "bump", "support", "held"])
@pytest.mark.parametrize("fine", [0.9, -0.9])
def test_sources(comm, source, fine):
    """Whatever sets cells moving: loads, at work or not yet, initial data, supports."""
    assert local(comm, bar(comm, 1, source, fine=fine), 3) > 0.15


def test_until_all_is_awake(comm):
    """A run that starts quiet and ends with all cells awake, long after the watch is given up."""
    assert 0 < local(comm, bar(comm, 2, "bump", fine=0.85), 40) < 0.6


def test_nothing_happens(comm):
    """A body at rest stays there, and costs nothing."""
    assert local(comm, bar(comm, 1, "nothing", fine=0.9), 3) == 1.0


@pytest.mark.parametrize("kind, scheme, start", [
    ("numbers", "exact", "one-sided"), ("numbers", "symmetric", "trapezoidal"),
    ("blocks", "exact", "trapezoidal"), ("blocks", "forward", "one-sided"),
    ("no inertia", "exact", "trapezoidal"),
])  # fmt: skip
def test_viscosity(comm, kind, scheme, start):
    """All dissipation schemes, with inertia and viscosity in blocks, and without inertia."""
    method = cb.LocalLeapfrog(dissipation=scheme, start=start)
    assert local(comm, bar(comm, 1, "bump", kind, fine=0.9), 3, method) > 0.2


def test_any_density(comm):
    """A density that is not quadratic in ν has no force at zero either."""
    scene = bar(comm, 1, "traction", extra=lambda U, nu: nu[0] ** 4, fine=0.9)
    assert local(comm, scene, 3) > 0.3
    with pytest.raises(cb.errors.IntegratorError):
        pair(comm, bar(comm, 1, "traction", extra=quartic, fine=0.9), LOCAL, 3)


def test_prestress(comm):
    """Forces at zero move all cells at once."""
    scene = bar(comm, 1, "traction", extra=lambda U, nu: 0.3 * U[0, 0] - 0.2 * nu[1], fine=0.9)
    assert local(comm, scene, 3) == 0.0


def test_implicit_self_action(comm):
    """Stiffer inertia of nodes changes nothing of who moves."""
    scene = bar(comm, 1, "bump", fine=0.9, self_action="implicit")
    assert local(comm, scene, 3) > 0.3


def test_everything_at_once(comm):
    """Where all cells are awake from the start nothing is watched."""
    assert local(comm, bar(comm, 1, "everywhere", fine=0.9), 3) == 0.0
    assert prepared(busy(comm, 1, "numbers"), LOCAL).activity is None


@pytest.mark.serial
def test_moved_by_hand(comm):
    """Who sets cells moving by hand (a run's linear map) has all of them act."""
    maps = []
    for quiet in (True, False):
        run = prepared(bar(comm, 1, "bump", fine=0.9), LOCAL)
        if not quiet:
            run.wake()
        maps.append(RunMap(run)(np.random.default_rng(0).normal(size=RunMap(run).size)))
    np.testing.assert_array_equal(*maps)
