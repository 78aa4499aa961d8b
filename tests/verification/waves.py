# SPDX-License-Identifier: LGPL-3.0-or-later
"""The scalar pair (u, ν), its standing mode, and motions exact in time."""


import numpy as np
import scipy.linalg
import scipy.spatial

import complexbody as cb

STIFF = np.array([[1.0, 0.3], [0.3, 0.6]])  # of the pair (u, ν) in gradients
OWN = 0.5  # of ν itself


def pair(dim, viscosity=0.0, own=OWN, stiff=STIFF):
    """The scalar pair: ½∇q·A∇q + ½k₀ν², q = (u, ν)."""

    def energy(U, nu, N):
        value = 0.5 * own * nu[0] ** 2
        for i in range(dim):
            value += 0.5 * stiff[0, 0] * U[0, i] ** 2 + 0.5 * stiff[1, 1] * N[0, i] ** 2
            value += stiff[0, 1] * U[0, i] * N[0, i]
        return value

    return cb.Body(1, energy, 1.0, 1.0, viscosity, displacement=1)


SIDES = (cb.Fix("u", "boundary"), cb.Fix("nu", "boundary"))


def mode_error(run, viscosity):
    """Errors of q of a standing mode, L2 (lumped) and energy norm."""
    problem, disc, dim = run.problem, run.problem.disc, run.problem.disc.dim
    stiff = STIFF * dim * np.pi**2 + np.diag([0, OWN])
    zero, eye = np.zeros((2, 2)), np.eye(2)
    rates = np.block([[zero, eye], [-stiff, -np.diag([0, viscosity])]])
    exact = scipy.linalg.expm(run.time * rates) @ [1.0, 0.5, 0, 0]
    mode = np.prod(np.sin(np.pi * disc.position[:-1, :dim]), axis=1)
    wrong = run.sample()[0][:-1, :2] - np.outer(mode, exact[:2])
    problem.kernels.x[:] = 0.0
    problem.kernels.x[:-1, :2] = wrong
    return np.sqrt([np.sum(wrong**2 * disc.volume[:, None]), 2 * problem.kernels.energies().sum()])


def semidiscrete(plain):
    """(q, q̇) at t of the equations discrete in space only, from the initial state."""
    shape, start, momenta = plain.q.shape, plain.q.copy(), plain.p.copy()
    free = ~plain.fixed.ravel()

    def force(q):
        parts = [p.force(q[c]) for c, p in zip(plain.cells, plain.potentials, strict=True)]
        return plain._assemble(parts)

    constant = (force(np.where(plain.fixed, start, 0.0)) + plain.load(0.0)).ravel()[free]
    K = np.array([-force(e.reshape(shape)).ravel()[free] for e in np.eye(start.size)[free]]).T
    M, D = (
        scipy.linalg.block_diag(*(getattr(node, name) for node in plain.nodes)) for name in "MD"
    )
    inverse, size = np.linalg.inv(M), len(M)
    rows = np.zeros((2 * size + 1, 2 * size + 1))
    rows[:size, size:-1], rows[size:-1, :size] = np.eye(size), -inverse @ K
    rows[size:-1, size:-1], rows[size:-1, -1] = -inverse @ D, inverse @ constant
    q0, v0 = start.ravel()[free], inverse @ momenta.ravel()[free]
    values, basis = np.linalg.eig(rows)
    weights = np.linalg.solve(basis, np.concatenate([q0, v0, [1.0]]))

    def solve(t):
        y = (basis @ (np.exp(values * t) * weights)).real
        out = np.stack([start, np.zeros(shape)]).reshape(2, -1)
        out[:, free] = y[:-1].reshape(2, -1)
        return out.reshape(2, *shape)

    return solve
