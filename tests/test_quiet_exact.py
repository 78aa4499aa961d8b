# SPDX-License-Identifier: LGPL-3.0-or-later
"""Exact schedules leave out events that nothing can have reached, and no bit of any result tells.

Where steps grow from cell to cell the next cell always acts a little later: motion, if ever so
little, crosses many of them in one step. Shares are lower than with common steps.
"""

import numpy as np
import pytest
from busy import busy
from dense import prepared
from harness import everywhere
from resting import bar, pair, quartic, small_chunks  # noqa: F401

import complexbody as cb
from complexbody.growth import RunMap
from complexbody.integrators import exact_schedule

EXACT = cb.AVI(schedule="exact")
AS_PUBLISHED = cb.AVI.as_published()


@pytest.fixture(autouse=True)
def short_spans(monkeypatch, small_chunks):  # noqa: F811
    """Spans much shorter than a cell's step, so that cells wait for several of them."""
    monkeypatch.setattr(exact_schedule, "EVENTS", 20)
    monkeypatch.setattr(exact_schedule, "PER_CELL", 0.3)


@pytest.mark.parametrize("dim, fine, spans", [
    (1, 0.9, 40), (1, -0.9, 30), (2, 0.6, 30), (3, 0.0, 12),
])  # fmt: skip
def test_point_pulse(comm, dim, fine, spans):
    """A pulse that enters at one end pays for what it has reached."""
    assert pair(comm, bar(comm, dim, "traction", fine=fine), EXACT, spans, ledger_steps=7) > 0.2


@pytest.mark.parametrize("source", ["later", "force", "bump", "support", "held"])
def test_sources(comm, source):
    """Whatever sets cells moving: loads, at work or not yet, initial data, supports."""
    assert pair(comm, bar(comm, 1, source, fine=0.7), EXACT, 20) > 0.3


def test_equal_steps(comm):
    """Where all cells act at once activity spreads by a layer per step, no further."""
    scene = bar(comm, 1, "traction", fine=0.0)
    cells = prepared(scene, EXACT).problem.disc.count
    method = cb.AVI(schedule="exact", steps=np.full(cells, 1e-3), unstable_ok=True)
    assert pair(comm, scene, method, 9) > 0.7


@pytest.mark.parametrize("dim, steps", [(1, 700), (2, 150)])
def test_until_all_is_awake(comm, dim, steps):
    """A run that starts quiet and ends with all cells awake, long after the watch is given up."""
    assert 0 < pair(comm, bar(comm, dim, "bump"), EXACT, steps) < 0.75


def test_long_spans(comm, monkeypatch):
    """Motion is followed through a span of many events of each cell."""
    monkeypatch.setattr(exact_schedule, "EVENTS", 5000)
    assert 0.05 < pair(comm, bar(comm, 1, "traction", fine=0.9), EXACT, 6)


def test_nothing_happens(comm):
    """A body at rest costs nothing but the cells at nodes that ranks share."""
    scene = bar(comm, 1, "nothing", fine=0.7)
    disc = prepared(scene, EXACT).problem.disc
    quiet = pair(comm, scene, EXACT, 10)
    assert quiet == 1.0 if comm.size == 1 else quiet > 0.9
    assert everywhere(comm, disc.count > 0)


@pytest.mark.parametrize("kind, scheme, start", [
    ("numbers", "exact", "one-sided"), ("numbers", "symmetric", "trapezoidal"),
    ("numbers", "forward", "one-sided"), ("blocks", "exact", "trapezoidal"),
    ("blocks", "forward", "one-sided"), ("no inertia", "exact", "trapezoidal"),
])  # fmt: skip
def test_viscosity(comm, kind, scheme, start):
    """All dissipation schemes, with inertia and viscosity in blocks, and without inertia."""
    method = cb.AVI(schedule="exact", dissipation=scheme, start=start)
    assert pair(comm, bar(comm, 1, "bump", kind, fine=0.9), method, 20) > 0.3


def test_as_published(comm):
    """The paper's scheme, whose cells are not corrected."""
    assert pair(comm, bar(comm, 2, "traction", "numbers", fine=0.6), AS_PUBLISHED, 20) > 0.3


def test_any_density(comm):
    """A density that is not quadratic has no force at zero either."""
    assert pair(comm, bar(comm, 1, "traction", extra=quartic, fine=0.9), EXACT, 20) > 0.3


@pytest.mark.parametrize("extra", [
    lambda U, nu: 0.3 * U[0, 0] - 0.2 * nu[1],
    lambda U, nu: 0.3 * U[0, 0] - 0.2 * nu[1] + quartic(U, nu),
], ids=["quadratic", "any"])  # fmt: skip
def test_prestress(comm, extra):
    """Forces at zero move all cells at once."""
    assert pair(comm, bar(comm, 1, "traction", extra=extra), EXACT, 5) == 0.0


def test_implicit_self_action(comm):
    """Stiffer inertia of nodes changes nothing of who moves."""
    scene = bar(comm, 1, "bump", fine=0.7, self_action="implicit")
    assert pair(comm, scene, EXACT, 20) > 0.3


def test_everything_at_once(comm):
    """Where all cells are awake from the start nothing is watched."""
    assert pair(comm, bar(comm, 1, "everywhere"), EXACT, 3) == 0.0
    assert prepared(busy(comm, 1, "numbers"), EXACT).reached is None


@pytest.mark.serial
def test_moved_by_hand(comm):
    """Who sets cells moving by hand (a run's linear map) has all of them act."""
    maps, given = [], None
    for quiet in (True, False):
        scene = bar(comm, 1, "bump")
        run = prepared(scene, EXACT)
        if not quiet:
            run.wake()
        step = RunMap(run)
        given = np.random.default_rng(0).normal(size=step.size) if given is None else given
        maps.append(step(given))
    np.testing.assert_array_equal(*maps)
    assert np.count_nonzero(maps[0]) > 0.9 * len(maps[0])
