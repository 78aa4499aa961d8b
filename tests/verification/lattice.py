# SPDX-License-Identifier: LGPL-3.0-or-later
"""The stiffness that plane waves see on a lattice of Kuhn's simplices."""

import itertools

import numpy as np
from dense import element_matrices, hessian_of

import complexbody as cb


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


def chiral(dim):
    """Two fields whose values and gradients are coupled: K_h(q) is complex."""

    def energy(U, nu, N):
        squares = 1.1 * U[0, 0] ** 2 + 0.4 * N[0, 0] ** 2 + 0.8 * nu[0] ** 2
        if dim > 1:
            squares += 0.7 * U[0, 1] ** 2 + 0.5 * N[0, 1] ** 2 + 0.3 * U[0, 1] * N[0, 0]
        return squares + 0.5 * nu[0] * U[0, 0] + (-0.6 * nu[0] * U[0, 1] if dim > 1 else 0.0)

    return cb.Body(1, energy, 1.2, 0.7, displacement=1, name=f"chiral {dim}D")
