# SPDX-License-Identifier: LGPL-3.0-or-later
"""A nonlinear objective body for several tests: a neo-Hookean solid with a director ν.

ρe = ½μ(|F|² − 3) − μ ln J + ½λ(ln J)² + ½a|ν − Fm|² + ½b|∇ν|², J = det F: the director is drawn to
the image Fm of a material direction m. ν turns as a vector; F = I, ν = m is a natural state.
"""

import numpy as np
import ufl

import complexbody as cb

MU, LAM, A, B = 1.0, 1.5, 0.8, 0.3
DIRECTION = np.array([1.0, 0.3, -0.2])


def energy(U, nu, N, cost=A):
    """ρe of U (n, 3), ν (n,) and N (n, 3), n = 2 or 3."""
    n = nu.ufl_shape[0]
    F = cb.deformation(U)
    J = ufl.det(F)
    lost = ufl.as_vector(
        [nu[i] - sum(float(DIRECTION[j]) * F[i, j] for j in range(n)) for i in range(n)]
    )
    elastic = 0.5 * MU * (ufl.inner(F, F) - 3) - MU * ufl.ln(J) + 0.5 * LAM * ufl.ln(J) ** 2
    return elastic + 0.5 * cost * ufl.inner(lost, lost) + 0.5 * B * ufl.inner(N, N)


def by_hand(U, nu, N):
    """The same by numpy, of numbers that may be complex."""
    n = len(nu)
    F = np.eye(3, dtype=np.result_type(U, nu, N))
    F[:n] += U
    J = np.linalg.det(F)
    lost = nu - F[:n, :n] @ DIRECTION[:n]
    elastic = 0.5 * MU * ((F * F).sum() - 3) - MU * np.log(J) + 0.5 * LAM * np.log(J) ** 2
    return elastic + 0.5 * A * (lost * lost).sum() + 0.5 * B * (N * N).sum()


def body(n=2, density=1.3, inertia=0.4, **more):
    """The body, n components of u and of ν."""
    given = {"rotation": cb.rotations.vector(n), "name": "director", "constants": {"mu": MU}}
    return cb.Body(n, energy, density, inertia, displacement=n, **(given | more))


def spinning(n, amplitude=0.1, spin=0.5):
    """Initial data: a rotation as a whole, and waves in u, ν and their rates."""
    w = np.array([0.0, 0.0, spin]) if n == 2 else spin * np.array([0.6, -0.5, 0.8])

    def turned(values):
        return np.cross(w, values.T).T[:n]

    def waves(x, seed):
        rows = [np.sin((2 + i + seed) * x[0] + 1.7 * x[1] - 1.1 * x[2] + i) for i in range(n)]
        return amplitude * np.array(rows)

    m = DIRECTION * (np.arange(3) < n)
    return cb.Initial(
        u=lambda x: waves(x, 0.3),
        nu=lambda x: m[:n, None] + waves(x, 1.1),
        u_dot=lambda x: turned(x) + waves(x, 0.7),
        nu_dot=lambda x: turned(np.tile(m[:, None], x.shape[1])) + waves(x, 1.9),
    )
