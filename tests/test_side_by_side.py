# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes that live at once in one process: compiled code is shared, nothing else is."""

import gc

import numpy as np
import pytest
from dense import prepared
from harness import everywhere

import complexbody as cb
from complexbody import meshes
from complexbody.integrators.local_leapfrog import LocalLeapfrog

METHODS = {
    "synchronous": cb.Synchronous(0.01),
    "local leapfrog": LocalLeapfrog(),
    "plain": cb.AVI(balanced=False),
    "balanced": cb.AVI(),
}


def scene(comm, factor):
    """A density that is not quadratic: its library's source does not depend on the factor."""

    def energy(U, nu, N):
        return 0.5 * (U[0, 0] ** 2 + N[0, 0] ** 2 + nu[0] ** 2) + factor * nu[0] ** 4

    sizes = np.linspace(1, 3, 9)
    mesh = meshes.graded_interval(comm, sizes / sizes.sum())
    body = cb.Body(1, energy, 1.0, 1.0, displacement=1)
    return cb.Scene(mesh, body, initial=cb.Initial(lambda x: x[:1] ** 2, lambda x: 1 - x[:1]))


def told(run):
    """Everything a run says at its end, to the bit."""
    fields, rates = run.sample()
    return fields.copy(), rates.copy(), run.entries().array()


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_runs_do_not_meet(comm, method):
    """A run is the same alone, beside another one, and after that one is gone."""
    alone = prepared(scene(comm, 1.0), method)
    alone.advance(4)
    expected = told(alone)
    run, other = prepared(scene(comm, 1.0), method), prepared(scene(comm, 5.0), method)
    run.advance(2)
    other.advance(4)
    differ = not np.array_equal(told(other)[2], expected[2])
    assert everywhere(comm, differ), "the other run must be another one"
    del other
    gc.collect()
    garbage = [np.full(size, 1e3) for size in range(1, 400)]  # where the other run was
    run.advance(2)
    for mine, one in zip(told(run), expected, strict=True):
        assert everywhere(comm, np.array_equal(mine, one, equal_nan=True))
    assert len(garbage) == 399
