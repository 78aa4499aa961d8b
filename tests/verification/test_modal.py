# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Standing modes of the coupled scalar pair: orders of convergence in time and in space.

u and ν ∝ Π sin πx_i with e = ½A|∇u|² + R∇u·∇ν + ½K|∇ν|² + ½k0ν², ν damped, follow

    ρü + (AQ)u + (RQ)ν = 0,  ρ̄ν̈ + ην̇ + (RQ)u + (KQ + k0)ν = 0,  Q = dπ²,

whose solution is a matrix exponential. On a uniform mesh the P1 operator has the same modes with
Q_h = d (4/Δ²) sin²(πΔ/2): against *that* solution only the error in time is seen, and its slope can
be read without a mesh. Nonlinear problems follow, since linear ones may converge too well.
"""

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import ufl
from dense import Dense, prepared, quadratic, slopes, state, whole
from dolfinx import fem

import complexbody as cb
from complexbody import _compat, meshes

A, K, R, K0 = 1.0, 0.6, 0.3, 0.5
H1 = np.array([[A, R, 0], [R, K, 0], [0, 0, K0]])
SIDES = (cb.Fix("u", "boundary"), cb.Fix("nu", "boundary"))


def energy(U, nu, N):
    coupling = ufl.inner(U[0, :], N[0, :])
    gradients = 0.5 * A * ufl.inner(U, U) + 0.5 * K * ufl.inner(N, N) + R * coupling
    return gradients + 0.5 * K0 * nu[0] ** 2


def amplitudes(Q, inertia, viscosity, t, start):
    """(u, ν, u̇, ν̇) at t of the mode with −∇² = Q, from ``start`` = (u, ν, u̇, ν̇) at 0."""
    stiff = np.array([[A * Q, R * Q], [R * Q, K * Q + K0]])
    if inertia > 0:
        back, damping = np.diag([1, 1 / inertia]), np.diag([0, viscosity])
        zero, eye = np.zeros((2, 2)), np.eye(2)
        return scipy.linalg.expm(
            t * np.block([[zero, eye], [-back @ stiff, -back @ damping]])
        ) @ np.asarray(start)
    # Without inertia ν obeys ην̇ = −(RQ u + (KQ + k0)ν) and has no initial rate.
    rows = np.zeros((3, 3))
    rows[0, 2] = 1.0
    rows[2, :2], rows[1, :2] = -stiff[0], -stiff[1] / viscosity
    u, nu, u_dot = scipy.linalg.expm(t * rows) @ np.asarray(start)[:3]
    return np.array([u, nu, u_dot, -stiff[1] @ [u, nu] / viscosity])


def mode(x, dim):
    return np.prod(np.sin(np.pi * x[:dim]), axis=0)[None]


def box(comm, dim, cells):
    if dim == 1:
        return meshes.interval(comm, 0, 1, cells)
    return (meshes.rectangle, meshes.box)[dim - 2](comm, [0] * dim, [1] * dim, cells)


def standing(comm, dim, cells, inertia, viscosity, start, self_action="lumped"):
    """The scene whose initial data are ``start`` times the mode."""
    names = ("u", "nu", "u_dot", "nu_dot")
    given = {n: (lambda x, a=a: a * mode(x, dim)) for n, a in zip(names, start, strict=True)}
    body = cb.Body(1, energy, 1.0, inertia, viscosity, displacement=1)
    return cb.Scene(
        box(comm, dim, cells), body, SIDES, initial=cb.Initial(**given), self_action=self_action
    )


START = (1.0, 0.5, -0.7, 1.1)
CRITICAL = 2 * np.sqrt(K * np.pi**2 + K0)  # of ν alone, for ρ̄ = 1
DAMPING = {
    "undamped": (1.0, 0.0),
    "underdamped": (1.0, 2.0),
    "critically damped": (1.0, CRITICAL),
    "overdamped": (1.0, 5 * CRITICAL),
    "light": (0.05, 2.0),
    "no inertia": (0.0, 3.0),
}


@pytest.mark.parametrize("start", ["trapezoidal", "one-sided"])
@pytest.mark.parametrize(
    "damping, scheme",
    [
        (damping, scheme)
        for damping in DAMPING
        for scheme in ("exact", "symmetric", "forward")
        if (damping, scheme) != ("no inertia", "symmetric")  # refused
    ],
)
def test_order_in_time(comm, damping, scheme, start):
    """Order 2, but 1 for "forward", the one-sided start, and a descriptor without inertia."""
    (inertia, viscosity), cells, until = DAMPING[damping], 12, 1.0
    Q = 4 * cells**2 * np.sin(np.pi / (2 * cells)) ** 2
    expected = amplitudes(Q, inertia, viscosity, until, START)
    scene = standing(comm, 1, cells, inertia, viscosity, START)
    errors, steps = [], []
    for count in (800, 1600, 3200):
        run = prepared(scene, cb.Synchronous(until / count, dissipation=scheme, start=start))
        run.advance(count)
        found = np.concatenate(state(run), axis=1)
        points, _ = whole(scene.mesh)
        errors.append(abs(found - mode(points.T, 1).T * expected).max(axis=0))
        steps.append(run.step)
    first = (scheme == "forward" and viscosity > 0) or start == "one-sided" or inertia == 0
    order = 1 if first else 2
    if viscosity > 0 and inertia > 0:
        assert cb.Synchronous(dissipation=scheme, start=start).order == order
    errors = np.array(errors)
    assert errors.min(axis=1).max() > 1e-9, "errors are round-off"
    measured = slopes(steps, np.linalg.norm(errors, axis=1))
    assert abs(measured[-1] - order) < 0.03, measured
    assert errors[0].max() < (0.05 if order == 1 else 2e-3)


@pytest.mark.parametrize("dim, cells", [(1, (20, 40, 80)), (2, (10, 20, 40)), (3, (6, 12, 18))])
def test_order_in_space(comm, dim, cells):
    """L2 order 2 and H1 order 1 of u and ν; step and mesh size fall together."""
    until, viscosity = 0.45, 0.8
    expected = amplitudes(dim * np.pi**2, 1.0, viscosity, until, START)
    errors = []
    for n in cells:
        scene = standing(comm, dim, n, 1.0, viscosity, START, "consistent")
        result = cb.simulate(scene, cb.Synchronous(safety=0.8), until=until)
        errors.append([norms(result.u, expected[0]), norms(result.nu, expected[1])])
    errors = np.array(errors)  # (meshes, fields, norms)
    measured = slopes(1 / np.array(cells)[:, None, None], errors)[-1]
    assert np.all(abs(measured[:, 0] - 2) < 0.12), measured
    assert np.all(abs(measured[:, 1] - 1) < 0.06), measured


def norms(function, amplitude):
    """L2 norm and H1 seminorm of the difference to amplitude·mode; collective."""
    mesh = function.function_space.mesh
    x, dim = ufl.SpatialCoordinate(mesh), mesh.geometry.dim
    exact = fem.Constant(mesh, float(amplitude))
    for i in range(dim):
        exact = exact * ufl.sin(ufl.pi * x[i])
    dx, out = ufl.dx(domain=mesh, metadata={"quadrature_degree": 4}), []
    for part in (function[0] - exact, ufl.grad(function[0]) - ufl.grad(exact)):
        square = fem.assemble_scalar(_compat.form(ufl.inner(part, part) * dx))
        out.append(np.sqrt(mesh.comm.allreduce(square)))
    return out


# --- nonlinear ------------------------------------------------------------------------------------

BETA = 30.0
GAUSS = np.polynomial.legendre.leggauss(4)


def quartic(U, nu, N):
    return energy(U, nu, N) + 0.25 * BETA * nu[0] ** 4


@pytest.mark.parametrize("scheme, order", [("exact", 2), ("symmetric", 2), ("forward", 1)])
def test_nonlinear_order_in_time(comm, scheme, order):
    """ν⁴ self-action with damping, against the semi-discrete equations solved to 1e-12."""
    mesh = meshes.jiggled(meshes.interval(comm, 0, 1, 10), 0.2)
    eta, until = 1.5, 1.0
    body = cb.Body(1, quartic, 1.0, 0.8, eta, displacement=1)
    initial = cb.Initial(u=lambda x: mode(x, 1), nu=lambda x: 1.5 * mode(x, 1))
    scene = cb.Scene(mesh, body, SIDES, initial=initial)
    linear = cb.Body(1, quadratic(H1, 1), 1.0, 0.8, eta, displacement=1)
    dense = Dense(mesh, linear, hessians=[H1])
    points, cells = dense.points[:, 0], dense.cells
    free = (points > 1e-9) & (points < 1 - 1e-9)
    size, mass = len(points), dense.volume[:, None] * [1.0, 0.8]
    weights, places = GAUSS[1] / 2, np.stack([(1 - GAUSS[0]) / 2, (1 + GAUSS[0]) / 2])
    length = abs(points[cells[:, 1]] - points[cells[:, 0]])

    def derivative(_, y):
        q, v = y.reshape(2, size, 2)
        f = -(dense.K @ q.ravel()).reshape(size, 2)
        cube = (q[cells, 1] @ places) ** 3
        own = BETA * length[:, None] * np.einsum("cg,g,ag->ca", cube, weights, places)
        np.add.at(f[:, 1], cells, -own)
        f[:, 1] -= eta * dense.volume * v[:, 1]
        return np.concatenate([v, f / mass * free[:, None]]).ravel()

    start = np.stack([mode(points[None], 1)[0], 1.5 * mode(points[None], 1)[0]], axis=1)
    start[~free] = 0.0
    y0 = np.concatenate([start, 0 * start]).ravel()
    solution = scipy.integrate.solve_ivp(
        derivative, (0, until), y0, method="DOP853", rtol=1e-12, atol=1e-13
    )
    expected = solution.y[:, -1].reshape(2, size, 2)
    largest = abs(solution.y.reshape(2, size, 2, -1)[0, :, 1]).max()
    assert BETA * largest**2 > 10 * K0, "hardly nonlinear"
    errors, steps = [], []
    for count in (200, 400, 800):
        run = prepared(scene, cb.Synchronous(until / count, dissipation=scheme))
        run.advance(count)
        errors.append(np.linalg.norm(np.array(state(run)) - expected))
        steps.append(run.step)
    measured = slopes(steps, errors)
    assert abs(measured[-1] - order) < 0.03, (measured, errors)


@dataclass(frozen=True)
class Power:
    """cosⁿ(ωt)."""

    omega: float
    power: int

    def __call__(self, t):
        """The factor at the times ``t``."""
        return np.cos(self.omega * np.asarray(t, dtype=np.float64)) ** self.power


@pytest.mark.parametrize("dim, cells", [(1, (16, 32, 64)), (2, (8, 16, 32))])
def test_manufactured(comm, dim, cells):
    """ν⁴ self-action: sources make u and ν ∝ mode·cos ωt; L2 order 2, H1 order 1."""
    U0, V0, omega, Q, eta, until = 0.7, 0.9, 4.0, dim * np.pi**2, 0.6, 0.5
    body = cb.Body(1, quartic, 1.0, 1.0, eta, displacement=1)
    sources = [
        ("u", -(omega**2) * U0 + Q * (A * U0 + R * V0), 1, Power(omega, 1)),
        ("nu", -(omega**2) * V0 + Q * (K * V0 + R * U0) + K0 * V0, 1, Power(omega, 1)),
        ("nu", -eta * omega * V0, 1, cb.sine(omega / (2 * np.pi))),
        ("nu", BETA * V0**3, 3, Power(omega, 3)),
    ]
    loads = [
        cb.BodyForce(lambda x, a=a, p=p: a * mode(x, dim) ** p, history, field=field)
        for field, a, p, history in sources
    ]
    initial = cb.Initial(lambda x: U0 * mode(x, dim), lambda x: V0 * mode(x, dim))
    errors = []
    for n in cells:
        scene = cb.Scene(box(comm, dim, n), body, SIDES, loads, initial)
        result = cb.simulate(scene, cb.Synchronous(safety=0.8), until=until)
        factor = np.cos(omega * until)
        errors.append([norms(result.u, U0 * factor), norms(result.nu, V0 * factor)])
    measured = slopes(1 / np.array(cells)[:, None, None], np.array(errors))[-1]
    assert np.all(abs(measured[:, 0] - 2) < 0.1), measured
    assert np.all(abs(measured[:, 1] - 1) < 0.05), measured
