# SPDX-License-Identifier: LGPL-3.0-or-later
"""The synchronous integrator is the discrete principle, scheme by scheme; its limits; its ends.

Trajectories equal a plain recursion (tests/dense.py) to round-off. Limits of stability are those of
DESIGN §2 on the damped oscillator: hω = 2(√(1+ζ²)+ζ) for "forward", 2 for "symmetric", and the
root of x = 4ζ coth(ζx) for "exact".
"""

import numpy as np
import pytest
from dense import Dense, Plain, halves, prepared, quadratic, random_hessian, state
from harness import everywhere, refused

import complexbody as cb
from complexbody import meshes
from complexbody.errors import IntegratorError

SCHEMES = ("exact", "symmetric", "forward")
OMEGA = np.array([[1.3, 0.4], [0.4, 0.7]])
ETA = np.array([[0.5, -0.3], [-0.3, 2.0]])
INERTIA = {
    "number": [(1, 0.8, 1.7)],
    "blocks": [(2, OMEGA, ETA)],
    "regions": [(2, OMEGA, ETA), (2, np.diag([0.5, 1.2]), np.zeros((2, 2)))],
    "no inertia": [(2, 0.0, ETA)],
    "half of it": [(2, np.diag([0.9, 0.0]), np.diag([0.4, 1.5]))],
    "undamped": [(1, 0.8, 0.0)],
}
LEFT = lambda x: x[0] < 1e-9  # noqa: E731


def wave(n, seed):
    """A smooth field of n components as a callable of x."""
    a = np.random.default_rng(seed).normal(size=(2, n, 1))
    return lambda x: np.sin(3 * x[:1] + a[0]) * a[1] + 0.2 * x[1]


@pytest.mark.parametrize("start", ["trapezoidal", "one-sided"])
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("kind", INERTIA)
@pytest.mark.parametrize("dim", [1, 2])
def test_trajectories(comm, dim, kind, scheme, start):
    """Fields and rates after every step, loads, supports and regions included."""
    assert not np.allclose(OMEGA @ ETA, ETA @ OMEGA)
    k, n_u = INERTIA[kind][0][0], 2
    singular = kind in ("no inertia", "half of it")
    if dim == 1:
        mesh = meshes.graded_interval(comm, np.linspace(0.5, 1.5, 14) / 14)
    else:
        mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 1), (4, 3)), 0.2)
    H = random_hessian(dim, n_u, k, dim)
    bodies = [
        cb.Body(k, quadratic(H, dim), 1.5 - 0.4 * r, inertia, viscosity, displacement=n_u)
        for r, (_, inertia, viscosity) in enumerate(INERTIA[kind])
    ]
    regions = {"body": bodies[0]}
    if len(bodies) > 1:
        regions = {"body": {1: bodies[0], 2: bodies[1]}, "cell_tags": halves(mesh)}
    force, history = np.array([0.7, -0.4]), cb.sine(0.4, 0.3)
    scene = cb.Scene(
        mesh,
        supports=[cb.Fix("u", LEFT), cb.Fix("nu", LEFT)],
        loads=[cb.BodyForce(force, history), cb.BodyForce(force[:k], field="nu")],
        initial=cb.Initial(wave(n_u, 1), wave(k, 2), wave(n_u, 3), wave(k, 4)),
        **regions,
    )
    method = cb.Synchronous(dissipation=scheme, start=start, safety=0.8)
    if singular and scheme == "symmetric":
        with refused(IntegratorError, "symmetric"):
            prepared(scene, method)
        return
    run = prepared(scene, method)
    dense = Dense(mesh, bodies, hessians=[H] * len(bodies))
    fixed = np.repeat((dense.points[:, 0] < 1e-9)[:, None], n_u + k, axis=1)
    ix, h = dense.free(fixed), run.step
    M, D, K = (A[np.ix_(ix, ix)] for A in (dense.full(dense.M), dense.full(dense.D), dense.K))
    plain = Plain(M, D, h, scheme, start)
    const = np.outer(dense.volume, np.concatenate([0 * force, force[:k]])).ravel()[ix]
    moving = np.outer(dense.volume, np.concatenate([force, 0 * force[:k]])).ravel()[ix]

    def forces(x, t):
        return -K @ x + const + moving * float(history(t))

    q, rate = state(run)
    assert not q[fixed].any() and not rate[fixed].any()
    x, v = q.ravel()[ix], rate.ravel()[ix]
    exact = np.concatenate([f(dense_points(dense)) for f in (wave(n_u, 3), wave(k, 4))]).T
    heavy = plain.heavy
    np.testing.assert_allclose(v[heavy], exact.ravel()[ix][heavy], rtol=0, atol=1e-14)
    scales = np.array([abs(x).max(), abs(v).max()])
    for step in range(1, 41):
        f = forces(x, (step - 1) * h)
        x = plain.begin(x, v, f) if step == 1 else plain.step(x, f)
        run.advance(1)
        q, rate = state(run)
        v = plain.rate(forces(x, step * h))
        scales = np.maximum(scales, [abs(x).max(), abs(v).max()])
        assert abs(q.ravel()[ix] - x).max() < 1e-12 * scales[0], f"step {step}"
        assert abs(rate.ravel()[ix] - v).max() < 1e-12 * scales[1], f"step {step}"
    # Steps in one go are the same steps.
    again = prepared(scene, method)
    again.advance(40)
    assert everywhere(comm, np.array_equal(state(again)[0], q))


def dense_points(dense):
    """Points as a callable of x takes them, shape (3, nodes)."""
    return np.pad(dense.points, ((0, 0), (0, 3 - dense.dim))).T
