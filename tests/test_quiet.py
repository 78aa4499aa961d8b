# SPDX-License-Identifier: LGPL-3.0-or-later
"""Cells at rest are skipped, and no bit of any result tells: trajectory, ledger, probes, output."""

import numpy as np
import pytest
from busy import ETA, INERTIA, LEFT, OMEGA, busy
from dense import halves, quadratic, random_hessian
from harness import everywhere

import complexbody as cb
from complexbody import discretisation, meshes
from complexbody.scene import FIELDS

CELLS = {1: 240, 2: (48, 5), 3: (16, 3, 2)}
PATCH = lambda x: (x[0] < 1e-9) & (x[1] < 0.05)  # noqa: E731


def bump(n, centre, width=0.06):
    """A tent across x = centre, exactly zero beyond its width."""
    return lambda x: np.maximum(0, 1 - abs(x[:1] - centre) / width) * np.arange(1.0, n + 1)[:, None]


SOURCES = {
    "traction": lambda n, k: {"loads": [cb.Traction(PATCH, np.ones(n), cb.ricker(1.0))]},
    "later": lambda n, k: {"loads": [cb.Traction(LEFT, np.ones(n), cb.sine(9.0, np.pi))]},
    "force": lambda n, k: {"loads": [cb.BodyForce(bump(k, 0.2), field="nu")]},
    "bump": lambda n, k: {"initial": cb.Initial(u=bump(n, 0.1), nu_dot=bump(k, 0.9))},
    "support": lambda n, k: {
        "supports": [cb.Fix("u", LEFT, 0.1, history=cb.sine(0.6)), cb.Fix("nu", LEFT)]
    },
    "held": lambda n, k: {"supports": [cb.Fix("nu", LEFT, np.ones(k))]},
    "everywhere": lambda n, k: {"loads": [cb.BodyForce(np.ones(n), cb.ricker(1.0))]},
    "nothing": lambda n, k: {},
}


def bar(comm, dim, source, kind="numbers", extra=None, potential=None):
    """A long body of two regions at rest, in which one thing happens at an end."""
    if dim == 1:
        mesh = meshes.graded_interval(comm, np.linspace(0.8, 1.2, CELLS[1]) / CELLS[1])
    elif dim == 2:
        mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 0.1), CELLS[2]), 0.2)
    else:
        mesh = meshes.jiggled(meshes.box(comm, (0, 0, 0), (1, 0.2, 0.1), CELLS[3]), 0.15)
    n_u, k = (3 if dim == 3 else 2), 2
    base = quadratic(random_hessian(10 * dim, n_u, k, dim), dim)

    def energy(U, nu, N):
        return base(U, nu, N) + (extra(U, nu) if extra else 0.0)

    bodies = {
        1 + r: cb.Body(k, energy, 1.3, *parts, potential, n_u, name=f"region {r}")
        for r, parts in enumerate(INERTIA[kind])
    }
    return cb.Scene(mesh, bodies, **SOURCES[source](n_u, k), cell_tags=halves(mesh))


def pair(comm, scene, method, steps, **given):
    """The share of quiet updates, after comparing all of a result with and without."""
    from dense import prepared

    until = (steps + 0.3) * prepared(scene, method).step
    one, two = (
        cb.simulate(scene, method, until=until, quiet=quiet, **given) for quiet in (True, False)
    )
    for name in FIELDS:
        for a in (one, two):
            assert np.isfinite(getattr(a, name).x.array).all()
        same = np.array_equal(getattr(one, name).x.array, getattr(two, name).x.array)
        assert everywhere(comm, same), name
    assert np.array_equal(one.ledger.rows, two.ledger.rows, equal_nan=True)
    for name, columns in one.probes.items():
        for column, values in columns.items():
            assert np.array_equal(values, two.probes[name][column]), (name, column)
    assert two.stats.quiet == 0.0
    done, every = one.stats.updates, two.stats.updates
    assert one.stats.quiet == pytest.approx(1 - done / every, rel=1e-12, abs=1e-15)
    return one.stats.quiet


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    """Bodies of some hundred cells must have some dozen chunks."""
    monkeypatch.setattr(discretisation, "BLOCKS_PER_CHUNK", 2)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("source", ["traction", "bump", "support"])
def test_same_bits(comm, dim, source):
    """Skipping changes nothing, and most of a long body can be skipped."""
    scene = bar(comm, dim, source)
    moved = pair(comm, scene, cb.Synchronous(), 10, ledger_steps=3)
    assert moved > 0.4


