# SPDX-License-Identifier: LGPL-3.0-or-later
"""A scene in which everything happens at once, the same for every number of ranks."""

import numpy as np
from dense import halves, quadratic, random_hessian
from dolfinx import fem

import complexbody as cb
from complexbody import _compat, meshes

OMEGA = np.array([[1.3, 0.4], [0.4, 0.7]])
ETA = np.array([[0.5, -0.3], [-0.3, 2.0]])
INERTIA = {  # (inertia, viscosity) of two regions
    "numbers": ((0.8, 1.7), (1.2, 0.0)),
    "blocks": ((OMEGA, ETA), (np.diag([0.5, 1.2]), 0.1 * np.eye(2))),
    "no inertia": ((0.0, 20 * ETA), (0.0, 20 * np.eye(2))),
}
LEFT, RIGHT = (lambda x: x[0] < 1e-9), (lambda x: x[0] > 1 - 1e-9)


def waves(n, seed):
    a = np.random.default_rng(seed).normal(size=(2, n, 1))
    return lambda x: 0.3 * np.sin(3 * x[:1] + 2 * x[1:2] + a[0]) * a[1]


def cellwise(mesh, function):
    out = fem.Function(_compat.cell_space(mesh))
    out.interpolate(lambda x: function(x))
    return out


def busy(comm, dim, kind, quartic=0.0):
    """Regions, DG0 coefficients, prestress, potential, loads with histories, moving supports.

    Args:
        comm: Communicator.
        dim: Dimension of the mesh, graded or with scattered vertices.
        kind: Key of INERTIA.
        quartic: Factor of ν1⁴ in the first region.
    """
    if dim == 1:
        mesh = meshes.graded_interval(comm, np.linspace(0.5, 1.5, 15) / 15)
    elif dim == 2:
        mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 0.8), (6, 4)), 0.2)
    else:
        mesh = meshes.jiggled(meshes.box(comm, (0, 0, 0), (1, 0.8, 0.7), (4, 3, 3)), 0.15)
    n_u, k = (3 if dim == 3 else 2), 2
    stiff = cellwise(mesh, lambda x: 1 + 0.5 * np.sin(5 * x[0]))
    density = cellwise(mesh, lambda x: 1.5 + np.cos(3 * x[0]))
    bodies = []
    for r, (inertia, viscosity) in enumerate(INERTIA[kind]):
        base = quadratic(random_hessian(10 * dim + r, n_u, k, dim), dim)

        def energy(U, nu, N, base=base, r=r):
            varying = 0.5 * stiff * (N[0, 0] + U[1, 0]) ** 2 if r == 0 else 0.0
            value = base(U, nu, N) + varying + 0.3 * U[0, 0] - 0.2 * nu[1]
            return value + quartic * nu[0] ** 4 if quartic and r == 0 else value

        def potential(u, nu, r=r):
            return 0.4 * (u[0] + nu[1]) ** 2 + 0.2 * u[1] - 0.1 * r * nu[0]

        rho = density if r == 0 else 1.3
        bodies.append(
            cb.Body(k, energy, rho, inertia, viscosity, potential, n_u, name=f"region {r}")
        )
    load = np.arange(1.0, n_u + 1)
    supports = [
        cb.Fix("u", LEFT, 0.05 * load, history=cb.sine(0.6)),
        cb.Fix("nu", LEFT, (0.1, -0.05), history=cb.sine(0.4, 0.5)),
        cb.Fix("nu", RIGHT, components=0),
    ]
    loads = [
        cb.Traction(RIGHT, 0.2 * load, cb.ricker(1.0)),
        cb.Traction(RIGHT, (0.1, 0.2), cb.sine(0.7), field="nu"),
        cb.BodyForce(waves(n_u, 1), cb.ramp(0.8)),
        cb.BodyForce((0.0, -0.3), field="nu"),
    ]
    initial = cb.Initial(waves(n_u, 2), waves(k, 3), waves(n_u, 4), waves(k, 5))
    tags = halves(mesh)
    return cb.Scene(mesh, {1: bodies[0], 2: bodies[1]}, supports, loads, initial, cell_tags=tags)
