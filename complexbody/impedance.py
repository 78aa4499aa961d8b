# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Impedance of plane waves: which traction goes with which rate in a wave that runs along n.

A wave q(x·n − ct) has the traction (Pn, Sn) = −Z q̇. Where gradients alone store energy,
A a = c²M a with the acoustic tensor A_{ab} = n_j n_k H_{aj,bk}, and Z is the geometric mean

.. math:: Z = M^{1/2}\,(M^{-1/2} A\, M^{-1/2})^{1/2}\,M^{1/2}:

ρc for each of the body's waves, all at once. This is the limit of high frequencies ω of the
general case, with C the self-action, G_{ab} = n_j H_{aj,b} and the viscosity D,

.. math:: (q^2A + iq(G^T - G) + C - iωD - ω^2M)\,a = 0, \qquad
          Z = \tfrac1{iω}\,[(iq_1A + G)a_1, \dots]\,[a_1, \dots]^{-1},

over the waves that run or decay along n (those with Im q > 0 at ω(1 + i0)). A damper takes the
symmetric real part of that Z. Knows no mesh.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.sparse.csgraph

from complexbody.errors import SceneError

Array = npt.NDArray[np.float64]

#: Entries below this, relative to their diagonals, are round-off of rotated normals.
ROUND_OFF = 1e-14
#: Im ω/ω by which waves along n are told from those against it.
CAUSAL = 1e-8


def impedance(
    H: Array, M: Array, D: Array, normal: Array, frequency: float | None = None
) -> Array:
    """Z of plane waves along ``normal``, symmetric and positive semidefinite, shape (n, n).

    Args:
        H: Hessian of the energy density, (4n, 4n), ordered as in :mod:`complexbody.hessian`.
        M: Mass per volume, (n, n).
        D: Viscosity, (n, n).
        normal: Unit vector n, shape (3,).
        frequency: f [Hz] of the waves; None for the limit of high frequencies.

    Raises:
        SceneError: where that limit does not exist, for a component without inertia.
    """
    n = len(M)
    N = np.kron(np.eye(n), np.asarray(normal, dtype=np.float64)[:, None])
    A = N.T @ H[: 3 * n, : 3 * n] @ N
    A = _clean(0.5 * (A + A.T), np.diag(A))
    out, used = np.zeros((n, n)), np.zeros_like(M)
    if frequency is not None:
        G, C = N.T @ H[: 3 * n, 3 * n :], H[3 * n :, 3 * n :]
        used = np.abs(G) + np.abs(G.T) + np.abs(C) + np.abs(D)
    links = scipy.sparse.csr_matrix((np.abs(A) + np.abs(M) + used) > 0)
    # Parts that nothing couples stay apart to the bit.
    count, label = scipy.sparse.csgraph.connected_components(links, directed=False)
    for part in range(count):
        at = np.flatnonzero(label == part)
        ix = np.ix_(at, at)
        if not np.any(A[ix]):
            continue
        if frequency is None:
            out[ix] = _limit(A[ix], M[ix])
        else:
            omega = 2 * np.pi * frequency
            out[ix] = _at(A[ix], G[ix], C[ix], D[ix], M[ix], omega)
    return out


def _clean(A: Array, diagonal: Array) -> Array:
    scale = np.sqrt(np.abs(np.outer(diagonal, diagonal)))
    return np.where(np.abs(A) > ROUND_OFF * scale, A, 0.0)


def _limit(A: Array, M: Array) -> Array:
    """The geometric mean of A and M."""
    heavy = np.diag(M) > 0
    if np.any(np.diag(A)[~heavy] > 0):
        raise SceneError(
            "Absorb: a component of ν has no inertia, and no waves at high frequencies. Give the "
            "frequency= to match, or field='u'."
        )
    out = np.zeros_like(A)
    ix = np.ix_(heavy, heavy)
    L = np.linalg.cholesky(M[ix])
    half = scipy.linalg.solve_triangular(L, A[ix], lower=True)
    c2, V = np.linalg.eigh(scipy.linalg.solve_triangular(L, half.T, lower=True))
    W = L @ V
    Z = W @ np.diag(np.sqrt(np.maximum(c2, 0.0))) @ W.T
    out[ix] = 0.5 * (Z + Z.T)
    return out


def _at(A: Array, G: Array, C: Array, D: Array, M: Array, omega: float) -> Array:
    """The damper that matches waves of one angular frequency."""
    n = len(A)
    # Units in which A and M have the size one.
    t = 1.0 / np.sqrt(np.where(np.diag(A) > 0, np.diag(A), np.maximum(np.diag(M), 1e-300)))
    c = 1.0 / np.sqrt(max(np.max(np.diag(M) * t**2), 1e-300))
    s = omega / c  # the unit of q
    T = np.outer(t, t)
    A, G = A * T, G * T / s
    w = 1.0 + 1j * CAUSAL
    own = (C * T - 1j * w * omega * (D * T) - (w * omega) ** 2 * (M * T)) / s**2
    # With p = iq: (−p²A + p(Gᵀ − G) + own) a = 0.
    eye, zero = np.eye(n), np.zeros((n, n))
    left = np.block([[zero, eye], [own, G.T - G]]).astype(complex)
    right = np.block([[eye, zero], [zero, A]]).astype(complex)
    (alpha, beta), vectors = scipy.linalg.eig(left, right, homogeneous_eigvals=True)
    finite = np.flatnonzero(np.abs(beta) > 1e-10 * np.abs(alpha))
    p = alpha[finite] / beta[finite]
    along = p.real < 0  # Im q > 0
    a, p = vectors[:n, finite[along]], p[along]
    traction = A @ a * p + G @ a
    # What has no gradients of its own has no traction, and follows the others.
    size, Q = np.linalg.eigh(A)
    Q = Q[:, size > 1e-12] if np.any(size <= 1e-12) else eye
    Z = Q @ (Q.T @ traction) @ np.linalg.pinv(Q.T @ a) @ Q.T / (1j * w)
    real = 0.5 * (Z + Z.T).real
    values, V = np.linalg.eigh(real)
    real = V @ np.diag(np.where(values > 1e-10 * values.max(initial=0.0), values, 0.0)) @ V.T
    # Back to units: tractions in A s, rates in omega.
    return np.asarray((0.5 * (real + real.T)) * (s / omega) / T)
