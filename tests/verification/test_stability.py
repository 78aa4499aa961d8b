# SPDX-License-Identifier: LGPL-3.0-or-later
"""Known-unstable runs grow at the predicted rate and are stopped; known-stable ones stay.

What is predicted comes from dense matrices and the plain recursions of tests/dense.py: the spectral
radius of one step. The cells' bound of the critical step must never be above the body's own.
"""

import re

import numpy as np
import pytest
from dense import Dense, amplification, halves, prepared, quadratic, random_hessian, state
from harness import refused

import complexbody as cb
from complexbody import meshes
from complexbody.errors import DivergenceError, StepError
from complexbody.problem import Problem
from complexbody.timesets import critical_step

OMEGA = np.array([[1.3, 0.4], [0.4, 0.7]])
ETA = np.array([[0.5, -0.3], [-0.3, 2.0]])
LEFT = lambda x: x[0] < 1e-9  # noqa: E731
DAMPING = {"undamped": 0.0, "damped": ETA, "stiff": 400 * ETA}


def noise(n):
    """A rough field, the same on all ranks, in which every mode has its part."""
    factors = np.arange(1, n + 1)[:, None] * 37.0 + 11
    return lambda x: np.sin(factors * (x[:1] + 1.7 * x[1:2] + x[2:]))


def body_of(dim, seed, inertia=OMEGA, viscosity=0.0, density=1.3):
    H = random_hessian(seed, 2, 2, dim)
    return cb.Body(2, quadratic(H, dim), density, inertia, viscosity, displacement=2), H


def box(comm, dim, cells, amount=0.2):
    if dim == 1:
        sizes = 1 + amount * np.sin(7.0 * np.arange(cells[0]))
        return meshes.graded_interval(comm, sizes / sizes.sum())
    make = (meshes.rectangle, meshes.box)[dim - 2]
    return meshes.jiggled(make(comm, [0] * dim, [1] * dim, cells), amount)


def radius(dense, h, scheme, fixed=None):
    """Spectral radius of one step of the whole body."""
    ix = dense.free(fixed)
    matrices = (A[np.ix_(ix, ix)] for A in (dense.full(dense.M), dense.full(dense.D), dense.K))
    return abs(np.linalg.eigvals(amplification(*matrices, h, scheme))).max()


def true_step(dense, scheme, start, fixed=None):
    """The body's own critical step to 1e-4, from ``start`` (stable) upwards."""
    low, high = start, start
    while radius(dense, high, scheme, fixed) < 1 + 1e-6:
        low, high = high, 1.2 * high
    while high / low > 1 + 1e-4:
        middle = np.sqrt(low * high)
        stable = radius(dense, middle, scheme, fixed) < 1 + 1e-6
        low, high = (middle, high) if stable else (low, middle)
    return low


@pytest.mark.parametrize("scheme", ["exact", "symmetric", "forward"])
@pytest.mark.parametrize("damping", DAMPING)
def test_above_the_critical_step(comm, damping, scheme):
    """2 % too much is refused; if it is wanted, it grows as predicted and is stopped."""
    body, H = body_of(2, 5, viscosity=DAMPING[damping])
    mesh = box(comm, 2, (4, 3))
    scene = cb.Scene(
        mesh, body, [cb.Fix("u", LEFT), cb.Fix("nu", LEFT)],
        initial=cb.Initial(nu=noise(2), u_dot=noise(2)),
    )  # fmt: skip
    dense = Dense(mesh, body, hessians=[H])
    fixed = np.repeat(dense.points[:, :1] < 1e-9, 4, axis=1)
    cells = critical_step(Problem(scene), scheme)
    step = 1.02 * true_step(dense, scheme, cells, fixed)
    with refused(StepError, "critical", "unstable_ok"):
        cb.simulate(scene, cb.Synchronous(step, dissipation=scheme), until=10 * step)

    method = cb.Synchronous(step, dissipation=scheme, unstable_ok=True)
    growth = np.log(radius(dense, step, scheme, fixed))
    assert growth > 1e-3
    run, steps = prepared(scene, method), int(60 / growth)
    run.advance(steps)
    before = np.linalg.norm(state(run)[0])
    run.advance(40)
    found = np.log(np.linalg.norm(state(run)[0]) / before) / 40
    assert found == pytest.approx(growth, rel=1e-3)

    until = step * int(30 / growth)
    with refused(DivergenceError, "nowhere", "of the critical one", "smaller") as told:
        cb.simulate(scene, method, until=until, ledger_steps=5)
    time = float(re.search(r"t = ([0-9.e+-]+) s", told[0])[1])
    assert 0 < time < until
    if damping == "undamped":  # which needs the fewest steps to infinity
        with refused(DivergenceError, "non-finite", "smaller"):
            until = step * int(800 / growth)
            cb.simulate(scene, method, until=until, growth=None, ledger_steps=200)


@pytest.mark.serial  # many steps of a few cells: only messages would be measured
@pytest.mark.parametrize("scheme", ["exact", "symmetric", "forward"])
@pytest.mark.parametrize("damping", DAMPING)
def test_below_the_critical_step(comm, damping, scheme):
    """2 % less than the body's own critical step, and 2·10⁴ steps stay bounded."""
    body, H = body_of(2, 5, viscosity=DAMPING[damping])
    mesh = box(comm, 2, (4, 3))
    initial = cb.Initial(nu=noise(2), u_dot=noise(2))
    scene = cb.Scene(mesh, body, [cb.Fix("u", LEFT), cb.Fix("nu", LEFT)], initial=initial)
    dense = Dense(mesh, body, hessians=[H])
    fixed = np.repeat(dense.points[:, :1] < 1e-9, 4, axis=1)
    cells = critical_step(Problem(scene), scheme)
    own = true_step(dense, scheme, cells, fixed)
    assert cells < 0.98 * own
    run = prepared(scene, cb.Synchronous(0.98 * own, dissipation=scheme, unstable_ok=True))
    largest = []
    for _ in range(200):
        run.advance(100)
        largest.append(abs(state(run)[0]).max())
    assert max(largest[100:]) < 1.2 * max(largest[:100])
    assert max(largest) < 20


MESHES = {1: [(9,), (23,)], 2: [(3, 4), (5, 2)], 3: [(1, 2, 2), (2, 2, 2)]}


@pytest.mark.parametrize("scheme", ["exact", "symmetric", "forward"])
@pytest.mark.parametrize("dim, which", [(d, w) for d in MESHES for w in range(2)])
def test_cells_bound_the_body(comm, dim, which, scheme):
    """Random bodies on random meshes, free, in one region or in two of different damping."""
    cells = MESHES[dim][which]
    mesh = box(comm, dim, cells, 0.15 + 0.05 * which)
    pairs = [body_of(dim, 20 + which, viscosity=3 * ETA)]
    if which:
        pairs.append(body_of(dim, 30, np.diag([0.4, 1.1]), 20 * np.eye(2), density=0.8))
    bodies, hessians = zip(*pairs, strict=True)
    given = {"body": bodies[0]}
    if which:
        given = {"body": dict(enumerate(bodies, 1)), "cell_tags": halves(mesh)}
    scene = cb.Scene(mesh, **given)
    step = critical_step(Problem(scene), scheme)
    dense = Dense(mesh, bodies, hessians=list(hessians))
    assert radius(dense, step, scheme) < 1 + 1e-6
    own = true_step(dense, scheme, step)
    assert step <= own * (1 + 1e-4)
    assert step > 0.5 * own, "a bound nobody wants"


@pytest.mark.parametrize("scheme", ["exact", "forward"])
def test_global_critical_step(comm, scheme):
    """SLEPc's critical step is the body's own."""
    pytest.importorskip("slepc4py")
    body, H = body_of(2, 5, viscosity=3 * ETA)
    mesh = box(comm, 2, (4, 3))
    dense, problem = Dense(mesh, body, hessians=[H]), Problem(cb.Scene(mesh, body))
    own = true_step(dense, scheme, critical_step(problem, scheme))
    assert critical_step(problem, scheme, "global") == pytest.approx(own, rel=1e-3)
