# SPDX-License-Identifier: LGPL-3.0-or-later
"""Uniform meshes as lattices: K_h(q) of plane waves, and one step of them, in plain numpy."""

import itertools

import numpy as np
from dense import Plain, element_matrices, hessian_of, square

import complexbody as cb
from complexbody import meshes


def lattice_mesh(comm, sides, cells):
    """Equal intervals, right triangles or Kuhn's tetrahedra from the origin to ``sides``."""
    if len(cells) == 1:
        return meshes.interval(comm, 0, sides[0], cells[0])
    make = (meshes.rectangle, meshes.box)[len(cells) - 2]
    return make(comm, [0] * len(cells), sides, cells)


def kuhn(size):
    """Corners of the d! simplices of one cell of the lattice, shape (d!, d+1, d)."""
    d = len(size)
    paths = [
        np.cumsum([np.zeros(d), *np.eye(d)[list(order)]], axis=0)
        for order in itertools.permutations(range(d))
    ]
    return np.array(paths) * size


def lattice_stiffness(body, size, q, lumped):
    """K_h(q) per node, shape (n, n): the sum over one lattice cell of K_ab e^{iq·(x_b − x_a)}."""
    dim, n = len(size), body.components
    corners = kuhn(size)
    local = element_matrices(corners, hessian_of(body, dim), n, body.descriptor, lumped)
    m = dim + 1
    local = local.reshape(len(corners), m, n, m, n)
    phase = np.exp(1j * (corners[:, None, :, :] - corners[:, :, None, :]) @ q)
    return np.einsum("caibj,cab->ij", local, phase)


def lattice_masses(body, size):
    """Mass and viscosity per node, shapes (n, n)."""
    n_u, k = body.displacement, body.descriptor
    M, D = np.zeros((2, n_u + k, n_u + k))
    M[:n_u, :n_u] = body.density * np.eye(n_u)
    M[n_u:, n_u:], D[n_u:, n_u:] = square(body.inertia, k), square(body.viscosity, k)
    return np.prod(size) * M, np.prod(size) * D


def lattice_step(body, size, q, h, scheme="exact"):
    """The map of (a, ȧ of what has inertia) at t to that at t + h; which components have inertia.

    Of any step but the first, in which what has no inertia goes half as far. A plane wave
    Re(a e^{iq·x}) stays one, and its a is stepped as if it were a body of one node.
    """
    K = lattice_stiffness(body, size, q, False)
    M, D = lattice_masses(body, size)
    plain, columns = Plain(M, D, h, scheme), []
    n, heavy = len(M), plain.heavy
    for unit in np.eye(n + len(heavy)):
        x, rate = unit[:n].astype(complex), np.zeros(n, complex)
        rate[heavy] = unit[n:]
        force = -K @ x
        x = plain.begin(x, rate, force)
        x[plain.light] += 0.5 * h * plain.mobility @ force[plain.light]
        columns.append(np.concatenate([x, plain.rate(-K @ x)[heavy]]))
    return np.array(columns).T, heavy


def chiral(dim):
    """Two fields whose values and gradients are coupled: K_h(q) is complex."""

    def energy(U, nu, N):
        squares = 1.1 * U[0, 0] ** 2 + 0.4 * N[0, 0] ** 2 + 0.8 * nu[0] ** 2
        if dim > 1:
            squares += 0.7 * U[0, 1] ** 2 + 0.5 * N[0, 1] ** 2 + 0.3 * U[0, 1] * N[0, 0]
        return squares + 0.5 * nu[0] * U[0, 0] + (-0.6 * nu[0] * U[0, 1] if dim > 1 else 0.0)

    return cb.Body(1, energy, 1.2, 0.7, displacement=1, name=f"chiral {dim}D")
