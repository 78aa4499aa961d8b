# SPDX-License-Identifier: LGPL-3.0-or-later
"""The guard on energy from nowhere: silent where little is put in, not where runs blow up."""

import json
from dataclasses import replace

import numpy as np
import pytest
import ufl
from harness import refused

import complexbody as cb
from complexbody import forms, meshes
from complexbody.errors import DivergenceError
from complexbody.ledger import Bookkeeper
from complexbody.problem import Problem

LEFT = lambda x: x[0] < 1e-9  # noqa: E731


def growing(nu, rate):
    """A general χ: momenta are solved for."""
    return 0.5 * (1 + nu[0] ** 2) * rate[0] ** 2


def pushed(nu, rate):
    """One that gives energy away by itself, 0.1 ν, like a constant force."""
    return 0.5 * rate[0] ** 2 + 0.1 * nu[0]


def energy(U, nu, N):
    return 0.5 * (ufl.inner(U, U) + ufl.inner(N, N) + nu[0] ** 2) + 0.3 * nu[0] * U[0, 0]


def late(size):
    """A load that is zero at first and sets in with a jump."""
    return [cb.Traction(LEFT, (size,), lambda t: 1.0 * (np.asarray(t) > 0.05))]


def scene(comm, inertia=1.0, **data):
    mesh = meshes.graded_interval(comm, np.full(20, 0.05))
    return cb.Scene(mesh, cb.Body(1, energy, 1.0, inertia, displacement=1), **data)


METHODS = {
    "synchronous": (cb.Synchronous(), 1.0), "windows": (cb.AVI(), 1.0),
    "exact": (cb.AVI(schedule="exact"), 1.0), "local": (cb.LocalLeapfrog(), 1.0),
    "order 1": (cb.Implicit(order=1), growing), "order 2": (cb.Implicit(), growing),
    "split": (cb.Implicit(forces="implicit"), 1.0),
}  # fmt: skip


def test_what_was_put_in_is_known_after_a_checkpoint(comm):
    """All that the guard's bound depends on goes through a checkpoint, χ(ν, 0) at the start too."""
    problem = Problem(cb.Scene(meshes.interval(comm, 0.0, 1.0, 4), forms.isotropic_two_field(d=1)))
    run = cb.Synchronous().prepare(problem, 1.0)
    books, later = (Bookkeeper(problem, run) for _ in range(2))
    books.row()
    books._put, books._still, books._size = 3.0, (-2.0, -2.0), 5.0
    later.restore(json.loads(json.dumps(books.state())), np.array(books.ledger.rows))
    assert later.state() == books.state() and later.state()["still"] == -2.0
    later._still = later._still[0], -7.0  # as a later row finds it
    assert later._bound() == 5.0
    run.close()
    problem.close()


@pytest.mark.parametrize("name", METHODS)
def test_silent_where_nothing_was_put_in(comm, name):
    """No energy at the start, then a load of any size; supports that only hold, a body at rest."""
    method, inertia = METHODS[name]
    for data in ({"loads": late(1.0)}, {"loads": late(1e-30)},
                 {"supports": [cb.Fix("u", LEFT, 0.1)]}, {}):  # fmt: skip
        ledger = cb.simulate(scene(comm, inertia, **data), method, until=0.5, ledger_steps=1).ledger
        assert np.isfinite(ledger["balance"]).all()
        assert ("loads" in data) == (ledger["work"][-1] > 0)


@pytest.mark.parametrize("order", [1, 2])
def test_a_push_of_the_inertia(comm, order):
    """What χ(ν, 0) gives away has been put in: ν starts as 0.05 t²."""
    run = cb.simulate(scene(comm, pushed), cb.Implicit(order=order), until=0.2, ledger_steps=1)
    values = run.nu.x.array
    np.testing.assert_allclose(values, 0.05 * 0.2**2, rtol=0.03 if order == 2 else 0.3)


def test_work_of_a_kick(comm):
    """The first kick of a load works exactly what it gives u: nothing is missing at that row."""
    method = cb.Implicit(step=0.02)
    loads = [cb.BodyForce((1.0,), history=lambda t: 1.0 * (np.asarray(t) > 0.01))]
    ledger = cb.simulate(
        scene(comm, growing, loads=loads), method, until=0.04, ledger_steps=1
    ).ledger
    given = 0.5 * (0.5 * 0.02) ** 2  # half a kick of a unit force on a unit mass
    np.testing.assert_allclose(ledger["kinetic_u"][1], given, rtol=1e-12)
    np.testing.assert_allclose(ledger["work"][1], given, rtol=1e-12)


@pytest.mark.parametrize("name", ["synchronous", "order 1", "order 2"])
def test_blow_ups_are_stopped(comm, name):
    """A late load with a step far above the critical one, for constant and general inertia."""
    method, inertia = METHODS[name]
    method = replace(method, step=0.12, unstable_ok=True)
    with refused(DivergenceError, "Energy appeared from nowhere", "All was well at t = "):
        cb.simulate(scene(comm, inertia, loads=late(1e-4)), method, until=60.0, ledger_steps=1)
