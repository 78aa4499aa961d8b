# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Plane waves in a body with a constant Hessian, and the times of its fields that follow.

Fields ∝ exp i(q·x − ωt) obey (K(q) − iωD − ω²M) a = 0, M = diag(ρ, …, Ω), D = diag(0, …, η), with

.. math:: K_{ab}(q) = \sum_{jk} q_j q_k H_{aj,bk} + i\sum_j q_j (H_{a,bj} - H_{aj,b}) + H_{a,b},

Hermitian and positive for a coercive energy (A1). H is ordered as in :mod:`complexbody.hessian`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.linalg

Array = npt.NDArray[np.float64]


def wave_matrix(H: Array, q: Array) -> npt.NDArray[np.complex128]:
    """K(q), shape (n, n).

    Args:
        H: Hessian, shape (4n, 4n).
        q: Wave vector, up to three components [1/m].
    """
    n = len(H) // 4
    k = np.zeros(3)
    k[: len(q)] = q
    G = np.kron(np.eye(n), k[:, None])  # gradient of unit amplitudes, without the factor i
    HGG, HGv, Hvv = H[: 3 * n, : 3 * n], H[: 3 * n, 3 * n :], H[3 * n :, 3 * n :]
    mixed = G.T @ HGv
    return np.asarray(G.T @ HGG @ G + Hvv + 1j * (mixed.T - mixed), dtype=np.complex128)


def dispersion(H: Array, M: Array, D: Array, q: Array) -> npt.NDArray[np.complex128]:
    """Frequencies ω of plane waves [1/s], 2n less one per missing inertia, by real part.

    −Im ω is the rate of decay. Waves in the opposite direction have −Re ω.

    Args:
        H: Hessian (4n, 4n).
        M: Mass per volume (n, n), positive semidefinite.
        D: Viscosity (n, n), positive semidefinite.
        q: Wave vector [1/m].
    """
    n, K = len(M), wave_matrix(H, q)
    zero, eye = np.zeros((n, n)), np.eye(n)
    # With s = −iω: (K + sD + s²M) a = 0.
    A = np.block([[zero, eye], [-K, -D.astype(np.complex128)]])
    B = np.block([[eye, zero], [zero, M]])
    alpha, beta = scipy.linalg.eigvals(A, B, homogeneous_eigvals=True)
    finite = np.abs(beta) > 1e-13 * np.abs(alpha)
    omega = 1j * alpha[finite] / beta[finite]
    return np.asarray(omega[np.lexsort((omega.imag, omega.real))], dtype=np.complex128)


@dataclass(frozen=True)
class Scale:
    """A time of a field: whose, of what, how long [s]."""

    field: str
    what: str
    seconds: float


def scales(
    H: Array, M: Array, D: Array, n_u: int, cell: float, size: float, dim: int
) -> list[Scale]:
    """The shortest times of u and of ν, each alone: waves or diffusion, oscillation or relaxation.

    Args:
        H: Hessian (4n, 4n).
        M: Mass per volume (n, n).
        D: Viscosity (n, n).
        n_u: Components of u.
        cell: Size of a cell [m].
        size: Of the body [m].
        dim: Dimension of the mesh, along whose axes waves run.
    """
    n, out = len(M), []
    for name, part in (("u", slice(0, n_u)), ("nu", slice(n_u, n))):
        m, d = M[part, part], D[part, part]
        if not len(m):
            continue
        own = H[3 * n :, 3 * n :][part, part]
        gradients = np.zeros_like(H)
        gradients[: 3 * n, : 3 * n] = H[: 3 * n, : 3 * n]
        waves = [wave_matrix(gradients, axis)[part, part].real for axis in np.eye(3)[:dim]]
        inert, viscous = (np.linalg.eigvalsh(a)[0] > 0 for a in (m, d))
        found: list[tuple[str, float]] = []
        if inert:
            found.append(("viscosity stops inertia", _over(1.0, _largest(d, m))))
        for length, where in ((cell, "a cell"), (size, "the body")):
            wave = _over(length, np.sqrt(max(_largest(K, m) for K in waves))) if inert else 0.0
            spread = _over(length**2, max(_largest(K, d) for K in waves)) if viscous else 0.0
            # Where diffusion takes longer than a wave would, viscosity rules.
            found.append((f"diffusion across {where}", spread) if spread > wave
                         else (f"a wave crosses {where}", wave))  # fmt: skip
        period = _over(2 * np.pi, np.sqrt(_largest(own, m))) if inert else 0.0
        relaxed = _over(1.0, _largest(own, d)) if viscous else 0.0
        found.append(("relaxation", relaxed) if relaxed > period
                     else ("optical modes, a period", period))  # fmt: skip
        out += [Scale(name, what, float(t)) for what, t in found if 0 < t < np.inf]
    return out


def _largest(K: Array, m: Array) -> float:
    """Largest eigenvalue of Kx = λmx, 0 if K is round-off."""
    return max(0.0, float(scipy.linalg.eigh(K, m, eigvals_only=True)[-1]))


def _over(a: float, b: float) -> float:
    return a / b if b > 0 else np.inf

