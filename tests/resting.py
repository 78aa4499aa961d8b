# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies at rest in which something happens, and runs of them with and without quiet cells."""

import numpy as np
import pytest
from busy import INERTIA, LEFT
from dense import halves, prepared, quadratic, random_hessian
from harness import everywhere

import complexbody as cb
from complexbody import discretisation, meshes
from complexbody.forms import isotropic_two_field, scaled_icosahedral_quasicrystal
from complexbody.integrators import windows
from complexbody.kernels import events
from complexbody.scene import FIELDS

CELLS = {1: 240, 2: (48, 5), 3: (24, 2, 2)}
PATCH = lambda x: (x[0] < 1e-9) & (x[1] < 0.12)  # noqa: E731


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


def bar(
    comm, dim, source, kind="numbers", extra=None, potential=None, fine=0.0, inertia=None, **given
):
    """A long body of two regions at rest, in which one thing happens at an end.

    With 0 < ``fine`` < 1 its cells are the finer the nearer to the middle, with −1 < ``fine`` < 0
    the nearer to the ends. ``inertia`` is a χ(ν, ν̇) in place of that ``kind``.
    """
    if dim == 1:
        mesh = meshes.graded_interval(comm, np.linspace(0.8, 1.2, CELLS[1]) / CELLS[1])
    elif dim == 2:
        mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 0.1), CELLS[2]), 0.2)
    else:
        mesh = meshes.jiggled(meshes.box(comm, (0, 0, 0), (1, 0.2, 0.1), CELLS[3]), 0.15)
    x = mesh.geometry.x
    x[:, 0] += fine * np.sin(2 * np.pi * x[:, 0]) / (2 * np.pi)
    kinds = INERTIA[kind] if inertia is None else ((inertia, 0.3), (inertia, 0.0))
    n_u, k = (3, 3) if dim == 3 else (2, 2)
    base = {
        1: quadratic(random_hessian(10, n_u, k, dim), dim),
        2: isotropic_two_field(d=2).energy,
        3: scaled_icosahedral_quasicrystal().energy,
    }[dim]

    def energy(U, nu, N):
        return base(U, nu, N) + (extra(U, nu) if extra else 0.0)

    bodies = {
        1 + r: cb.Body(k, energy, 1.3, *parts, potential, n_u, name=f"region {r}")
        for r, parts in enumerate(kinds)
    }
    return cb.Scene(mesh, bodies, **SOURCES[source](n_u, k), cell_tags=halves(mesh), **given)


def pair(comm, scene, method, steps, **given):
    """The share of quiet updates, after comparing all of a result with and without."""
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


def quartic(U, nu):
    """A density whose force is zero at zero, but not linear."""
    return nu[0] ** 4 + U[0, 0] ** 2 * nu[1] ** 2


@pytest.fixture
def small_chunks(monkeypatch):
    """Bodies of some hundred cells must have some dozen chunks."""
    monkeypatch.setattr(discretisation, "BLOCKS_PER_CHUNK", 2)
    for module in (events, windows):
        monkeypatch.setattr(module, "CHUNK", 2)
