# SPDX-License-Identifier: LGPL-3.0-or-later
"""Random bodies on random meshes that a run and the slow reference can both be made of."""

import itertools
from dataclasses import dataclass

import numpy as np
from dense import halves, quadratic, random_hessian, state, whole
from dolfinx import fem
from verification.windows_reference import Quadratic, Quartic, Windows

import complexbody as cb
from complexbody import _compat, meshes

SCHEMES = ("exact", "symmetric", "forward")
LEFT, RIGHT = (lambda x: x[0] < 1e-9), (lambda x: x[0] > 1 - 1e-9)
QUARTIC = (2.0, 0.7, 0.3)


# --- random bodies on random meshes, for both ----------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A scene that a run and the reference can both be made of."""

    dim: int = 1
    n_u: int = 1
    k: int = 1
    inertia: tuple = (0.8,)  # per region
    viscosity: tuple = (0.0,)
    lumped: bool = False
    quartic: tuple = (False, False)  # per region
    varying: bool = False  # DG0 factor of the energy, DG0 density
    potential: bool = False
    supports: str = "fixed"
    loads: bool = False

    @property
    def n(self):
        """Components."""
        return self.n_u + self.k


def graded(comm, dim, cells=None, amount=0.2, pull=2.0, seed=0):
    """Scattered vertices, and cells that grow along x by a factor of e^pull."""
    if dim == 1:
        sizes = np.random.default_rng(seed).uniform(1, 3.5, cells or 13)
        return meshes.graded_interval(comm, sizes / sizes.sum())
    cells = cells or ((5, 3) if dim == 2 else (4, 2, 2))
    make = meshes.rectangle if dim == 2 else meshes.box
    mesh = meshes.jiggled(make(comm, [0] * dim, [1] * dim, cells), amount, seed)
    x = mesh.geometry.x
    x[:, 0] = np.expm1(pull * x[:, 0]) / np.expm1(pull)
    return mesh


def wave(n, seed, size=1.0):
    """A smooth field of n components as a callable of x."""
    a = size * np.random.default_rng(seed).normal(size=(2, n, 1))
    return lambda x: np.sin(3 * x[:1] + 2 * x[1:2] + a[0]) * a[1] + 0.2 * size * x[1:2]


def factor(x):
    return 1 + 0.4 * np.sin(5 * x[0])


def heaviness(x):
    return 1.5 + np.cos(4 * x[0])


def cellwise(mesh, function):
    out = fem.Function(_compat.cell_space(mesh))
    out.interpolate(lambda x: function(x))
    return out


def parts(case, r):
    """Numbers of region r: H of the energy, C and l of the potential."""
    H = random_hessian(7 * r + 10 * case.n + case.dim, case.n_u, case.k, case.dim)
    rng = np.random.default_rng(100 + r)
    C = rng.normal(size=(case.n, case.n))
    return H, 0.3 * C @ C.T, rng.normal(size=case.n)


def matrix(value, k):
    return np.asarray(value, float) * (np.eye(k) if np.ndim(value) == 0 else 1)


HISTORY = {"ramp": cb.ramp(0.8), "sine": cb.sine(0.7, 0.4)}


def build(comm, case, mesh=None):
    """The scene."""
    mesh = graded(comm, case.dim) if mesh is None else mesh
    stiff, rho = cellwise(mesh, factor), cellwise(mesh, heaviness)
    bodies = []
    for r, (inertia, viscosity) in enumerate(zip(case.inertia, case.viscosity, strict=True)):
        H, C, l = parts(case, r)  # noqa: E741

        base = quadratic(H, case.dim)

        def energy(U, nu, N, r=r, base=base):
            value = base(U, nu, N)
            if case.quartic[r]:
                b, c, s = QUARTIC
                value += b / 4 * nu[0] ** 4 + c * nu[0] ** 2 * U[0, 0] + s / 4 * U[0, 0] ** 4
            return stiff * value if case.varying else value

        def potential(u, nu, C=C, l=l):  # noqa: E741
            q = [u[i] for i in range(case.n_u)] + [nu[i] for i in range(case.k)]
            pairs = itertools.product(range(case.n), repeat=2)
            square = sum(0.5 * float(C[i, j]) * q[i] * q[j] for i, j in pairs)
            return square + sum(float(l[i]) * q[i] for i in range(case.n))

        bodies.append(
            cb.Body(
                case.k, energy, rho if case.varying else 1.5 - 0.4 * r, inertia, viscosity,
                potential if case.potential else None, case.n_u,
            )
        )  # fmt: skip
    body = {"body": bodies[0]}
    if len(bodies) > 1:
        body = {"body": {1: bodies[0], 2: bodies[1]}, "cell_tags": halves(mesh)}
    supports, loads = [], []
    if case.supports == "fixed":
        supports = [cb.Fix("u", LEFT), cb.Fix("nu", RIGHT)]
    if case.supports == "partial":
        supports = [cb.Fix("u", LEFT, components=0), cb.Fix("nu", LEFT, 0.2, components=0)]
        supports.append(cb.Fix("nu", RIGHT, components=case.k - 1))
    if case.supports == "moving":
        supports = [
            cb.Fix("u", LEFT, 0.3 + np.arange(case.n_u), history=HISTORY["ramp"]),
            cb.Fix("nu", RIGHT, 0.4, components=0, history=HISTORY["sine"]),
        ]
    if case.loads:
        loads = [
            cb.BodyForce(0.7 + np.arange(case.n_u), HISTORY["sine"]),
            cb.BodyForce(-0.4 * np.ones(case.k), field="nu"),
            cb.Traction(RIGHT, 0.5 - np.arange(case.n_u), HISTORY["ramp"]),
        ]
    size = 0.4 if any(case.quartic) else 1.0  # the step is that of the initial state
    initial = cb.Initial(*(wave(n, s, size) for s, n in enumerate((case.n_u, case.k) * 2)))
    action = "lumped" if case.lumped else "consistent"
    given = {"supports": supports, "loads": loads, "initial": initial, "self_action": action}
    return cb.Scene(mesh, **given, **body)


def divisions_of(run):
    """N_K of all cells, in the order of ``whole``."""
    disc = run.problem.disc
    real = disc.source_cell >= 0
    out = np.zeros(real.sum(), int)
    out[disc.source_cell[real]] = np.broadcast_to(disc.group[:, None], real.shape)[real]
    return np.concatenate(disc.comm.allgather(out))


def blend_of(run):
    """k of all cells and components, in the order of ``whole``; what it should be: another test."""
    disc, balance = run.problem.disc, run.balance
    if balance is None:
        return None
    out = np.zeros((disc.count, disc.n))
    for i in range(run.plan.count):
        cells = disc.source_cell[run.plan.groups[i].first : run.plan.groups[i].last]
        out[cells[cells >= 0]] = balance.blend[i, : disc.n]
    return np.concatenate(disc.comm.allgather(out))


def traction_nodes(points, cells):
    """∫N_a over the side x = 1."""
    out, dim = np.zeros(len(points)), points.shape[1]
    for c in cells:
        side = c[points[c, 0] > 1 - 1e-9]
        if len(side) == dim:
            edges = points[side[1:]] - points[side[:1]]
            size = np.sqrt(np.linalg.det(edges @ edges.T)) if dim > 1 else 1.0
            out[side] += size / max(dim - 1, 1) / dim
    return out


def reference(run, case, make=None):
    """The same scene for the reference, windows by default; ``make`` is given its parts."""
    method, mesh = run.method, run.problem.scene.mesh
    points, cells = whole(mesh)
    x = np.pad(points, ((0, 0), (0, 3 - case.dim))).T
    n, n_u, k, nd = case.n, case.n_u, case.k, case.n * case.dim
    potentials, masses, viscosities = [], [], []
    for c in cells:
        corners = points[c]
        r = 0 if len(case.inertia) == 1 or (corners[:, 0] < 0.5 + 1e-9).all() else 1
        middle = np.pad(corners.mean(axis=0), (0, 3 - case.dim))
        energy, C, l = parts(case, r)  # noqa: E741
        scale = factor(middle) if case.varying else 1.0
        H, ix = np.zeros((nd + n, nd + n)), np.r_[:nd, nd + n_u : nd + n]
        H[np.ix_(ix, ix)] = scale * energy
        linear = np.zeros(nd + n)
        if case.potential:
            H[nd:, nd:] += C
            linear[nd:] = l
        if case.quartic[r]:
            potentials.append(Quartic(corners, H, n, n_u, scale * np.array(QUARTIC)))
        else:
            potentials.append(Quadratic(corners, H, linear, n, case.lumped))
        rho = heaviness(middle) if case.varying else 1.5 - 0.4 * r
        M, D = rho * np.eye(n), np.zeros((n, n))
        M[n_u:, n_u:] = matrix(case.inertia[r], k)
        D[n_u:, n_u:] = matrix(case.viscosity[r], k)
        masses.append(M)
        viscosities.append(D)
    fixed, value, history = np.zeros((len(points), n), bool), np.zeros((len(points), n)), {}
    left, right = LEFT(x)[:, None], RIGHT(x)[:, None]
    if case.supports == "fixed":
        fixed[:, :n_u], fixed[:, n_u:] = left, right
    if case.supports == "partial":
        fixed[:, :1], fixed[:, n_u : n_u + 1] = left, left
        value[:, n_u : n_u + 1] = 0.2 * left
        fixed[:, -1:] |= right
    if case.supports == "moving":
        fixed[:, :n_u], fixed[:, n_u : n_u + 1] = left, right
        value[:, :n_u] = left * (0.3 + np.arange(n_u))
        value[:, n_u : n_u + 1] = 0.4 * right
        history = {"ramp": slice(0, n_u), "sine": slice(n_u, n)}

    def targets(t):
        out = value.copy()
        for name, columns in history.items():
            out[:, columns] *= float(HISTORY[name](t))
        return out

    size = 0.4 if any(case.quartic) else 1.0
    given = [wave(m, s, size)(x).T for s, m in enumerate((n_u, k) * 2)]
    q, rates = np.hstack(given[:2]), np.hstack(given[2:])
    given = {
        "cells": cells, "potentials": potentials, "window": run.step, "masses": masses,
        "viscosities": viscosities, "q": q, "rates": rates, "fixed": fixed, "targets": targets,
        "scheme": method.dissipation,
    }  # fmt: skip
    out = make(**given) if make else Windows(
        divisions=divisions_of(run), balanced=method.balanced, blend=blend_of(run),
        start=method.start, **given,
    )  # fmt: skip
    if case.loads:
        side, zero = traction_nodes(points, cells), np.zeros((len(points), n))
        for weight, columns, vector, name in (
            (out.volume, slice(0, n_u), 0.7 + np.arange(n_u), "sine"),
            (out.volume, slice(n_u, n), -0.4 * np.ones(k), None),
            (side, slice(0, n_u), 0.5 - np.arange(n_u), "ramp"),
        ):
            force = zero.copy()
            force[:, columns] = np.outer(weight, vector)
            history_of = HISTORY[name] if name else (lambda t: 1.0)
            out.loads.append((force, history_of))
    return out


def compare(run, plain, windows, tolerance=1e-11):
    """Largest relative difference of positions and rates, at the end of every window."""
    worst, scales = np.zeros(2), np.zeros(2)
    for _ in range(windows):
        run.advance(1)
        plain.advance(1)
        expected = (plain.q, plain.rates())
        scales = np.maximum(scales, [abs(e).max() for e in expected])
        found = [abs(a - b).max() for a, b in zip(state(run), expected, strict=True)]
        worst = np.maximum(worst, found / scales)
        assert np.isfinite([*scales, *run.sums]).all(), f"window {plain.count}"
        assert worst.max() < tolerance, f"{worst}, window {plain.count}"
    return worst


OMEGA = np.array([[1.3, 0.4], [0.4, 0.7]])
ETA = np.array([[0.5, -0.3], [-0.3, 2.0]])
CASES = {
    "n2": Case(1, 1, 1, supports="none"),
    "n2 lumped": Case(1, 1, 1, (0.8,), (1.7,), lumped=True, loads=True, supports="moving"),
    "n2 plane": Case(2, 1, 1, (0.8,), (1.7,), potential=True),
    "n3": Case(1, 2, 1, (0.8,), (0.9,), supports="moving", loads=True),
    "n4": Case(2, 2, 2, (0.8,), (1.7,), lumped=True),
    "n4 partial": Case(2, 2, 2, (0.8,), (1.7,), supports="partial"),
    "n4 moving": Case(2, 2, 2, (0.8,), (1.7,), supports="moving", loads=True),
    "n4 unequal rates": Case(2, 2, 2, (np.diag([0.6, 1.1]),), (np.diag([0.0, 2.0]),)),
    "n4 blocks": Case(2, 2, 2, (OMEGA,), (ETA,), loads=True),
    "n4 no inertia": Case(1, 2, 2, (0.0,), (np.diag([1.0, 2.0]),), loads=True),
    "n4 half of it": Case(1, 2, 2, (np.diag([0.9, 0.0]),), (np.diag([0.4, 1.5]),)),
    "n6": Case(3, 3, 3, (0.8,), (0.0,), varying=True),
    "n6 regions": Case(2, 3, 3, (0.8, 1.1), (0.6, 0.0), loads=True, potential=True),
    "n7": Case(1, 3, 4, (0.8,), (0.5,), supports="moving"),
    "n8": Case(3, 3, 5, (0.8,), (1.2,), supports="none"),
    "n9": Case(2, 3, 6, (0.8,), (1.2,), supports="partial", varying=True),
    "quartic": Case(2, 2, 1, (0.8,), (0.7,), quartic=(True,), varying=True),
    "quartic region": Case(2, 2, 2, (0.8, 1.1), (0.6, 0.2), quartic=(True, False)),
    "quartic line": Case(1, 1, 2, (0.8,), (0.0,), quartic=(True,), potential=False, loads=True),
}


def schemes(case):
    damped = any(np.any(v) for v in case.viscosity)
    singular = any(np.linalg.matrix_rank(matrix(i, case.k)) < case.k for i in case.inertia)
    return [s for s in SCHEMES if (damped or s == "exact") and not (singular and s == "symmetric")]
