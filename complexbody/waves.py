# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Plane waves in a body with a constant Hessian, and the times of its fields that follow.

Fields ∝ exp i(q·x − ωt) obey (K(q) − iωD − ω²M) a = 0, M = diag(ρ, …, Ω), D = diag(0, …, η), with

.. math:: K_{ab}(q) = \sum_{jk} q_j q_k H_{aj,bk} + i\sum_j q_j (H_{a,bj} - H_{aj,b}) + H_{a,b},

Hermitian and positive for a coercive energy (A1). H is ordered as in :mod:`complexbody.hessian`.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
import scipy.linalg

from complexbody.errors import BodyError

Array = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]


def wave_matrix(H: Array, q: Array) -> Complex:
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


def dispersion(H: Array, M: Array, D: Array, q: Array) -> Complex:
    """Frequencies ω of plane waves [1/s], 2n less one per missing inertia, by real part.

    −Im ω is the rate of decay. Waves in the opposite direction have −Re ω.

    Args:
        H: Hessian (4n, 4n).
        M: Mass per volume (n, n), positive semidefinite.
        D: Viscosity (n, n), positive semidefinite.
        q: Wave vector [1/m].
    """
    return plane_waves(wave_matrix(H, q), M, D)[0]


def plane_waves(K: Complex, M: Array, D: Array) -> tuple[Complex, Complex]:
    """Frequencies ω [1/s] and polarisations a of (K − iωD − ω²M) a = 0, sorted by Re ω, then Im ω.

    Fields of a body may differ by many decades in stiffness and speed. Without damping the least
    frequency is as accurate as the largest (relatively: Demmel and Veselić, SIAM J. Matrix Anal.
    Appl. 13, 1992); with damping, roots of a companion matrix are polished by Newton's method.

    Args:
        K: Stiffness (n, n), Hermitian.
        M: Mass per volume (n, n), symmetric, positive semidefinite.
        D: Viscosity (n, n), positive semidefinite on the null space of M; its antisymmetric part
            is a gyroscopic force.

    Returns:
        ω, shape (b,), b = 2n less the nullity of M, and a, shape (n, b), columns of length one
        whose largest component is real and positive.

    Raises:
        BodyError: if a component has neither inertia nor viscosity.
    """
    K, M, D, basis, heavy = _normal_form(K, M, D)
    if heavy == len(M) and not D.any():
        omega, a = _undamped(K)
    else:
        omega, a = _damped(K, D, heavy)
    a = basis @ a
    largest = a[np.argmax(np.abs(a), axis=0), np.arange(a.shape[1])]
    a = a / (np.linalg.norm(a, axis=0) * largest / np.abs(largest))
    order = np.lexsort((omega.imag, omega.real))
    return omega[order], a[:, order]


def _normal_form(K: Complex, M: Array, D: Array) -> tuple[Complex, Array, Array, Array, int]:
    """K, M, D in a basis where M = diag(1, …, 0), stiff components first; basis, rank of M."""
    weight = np.where(np.diag(M) > 0, np.diag(M), np.diag(D))
    if not (weight > 0).all():
        raise BodyError(
            "A component has neither inertia nor viscosity, so that nothing determines its rate. "
            "Give inertia > 0 or viscosity > 0 for it."
        )
    scale = 1 / np.sqrt(weight)
    masses, vectors = np.linalg.eigh(M * np.outer(scale, scale))
    if not np.any(M - np.diag(np.diag(M))):  # components stay themselves, to the bit
        masses, vectors = (np.diag(M) > 0).astype(float), np.eye(len(M))
    inert = masses > 1e-12
    basis = scale[:, None] * vectors / np.sqrt(np.where(inert, masses, 1.0))
    stiff = np.einsum("ia,ij,ja->a", basis, K, basis).real
    order = np.lexsort((-stiff, ~inert))
    basis, heavy = basis[:, order], int(inert.sum())
    D, D_light = basis.T @ D @ basis, vectors[:, ~inert].T @ (D * np.outer(scale, scale))
    if heavy < len(M) and np.linalg.cond(D_light @ vectors[:, ~inert]) > 1e12:
        raise BodyError(
            "A combination of components has neither inertia nor viscosity, so that nothing "
            "determines its rate. Give inertia > 0 or viscosity > 0 for it."
        )
    return basis.T @ K @ basis, np.diag((np.arange(len(M)) < heavy) * 1.0), D, basis, heavy


def _undamped(K: Complex) -> tuple[Complex, Complex]:
    """±ω of (K − ω²) a = 0: relative accuracy for a positive K, however graded."""
    n, d = len(K), np.sqrt(np.abs(np.diag(K).real))
    d = np.where(d > 0, d, 1.0)
    L = _semidefinite_root(K / np.outer(d, d))
    if L is None:  # unstable: the fastest growth matters, no slow wave
        squares, a = np.linalg.eigh(K)
    else:
        a, squares = _jacobi(d[:, None] * L)
    omega = np.sqrt(squares.astype(np.complex128))
    assert len(omega) == n
    return np.concatenate([-omega.conj(), omega]), np.concatenate([a, a], axis=1)


def _semidefinite_root(B: Complex) -> Complex | None:
    """L, shape (n, n), with LLᴴ = B, by Cholesky's method with pivots; None if B has a negative."""
    n, rest, L = len(B), B.astype(np.complex128), np.zeros((len(B), len(B)), np.complex128)
    for column in range(n):
        p = int(np.argmax(np.diag(rest).real))
        if rest[p, p].real <= 1e-14:
            break
        L[:, column] = rest[:, p] / np.sqrt(rest[p, p].real)
        rest = rest - np.outer(L[:, column], L[:, column].conj())
    return L if np.diag(rest).real.min() > -1e-13 else None


def _jacobi(G: Complex) -> tuple[Complex, Array]:
    """Left singular vectors and squares of the singular values of G, by one-sided rotations."""
    n, U = len(G), G.copy()
    for _ in range(60):
        worst = 0.0
        for i, j in itertools.combinations(range(n), 2):
            a, b, c = U[:, i], U[:, j], np.vdot(U[:, i], U[:, j])
            aa, bb = np.vdot(a, a).real, np.vdot(b, b).real
            if abs(c) <= 1e-15 * np.sqrt(aa * bb) or aa * bb == 0:
                continue
            worst = max(worst, abs(c) / np.sqrt(aa * bb))
            zeta = (bb - aa) / (2 * abs(c))
            t = (1.0 if zeta >= 0 else -1.0) / (abs(zeta) + np.hypot(1.0, zeta))
            cosine = 1 / np.hypot(1.0, t)
            sine, phase = cosine * t, c / abs(c)
            U[:, i], U[:, j] = (cosine * a - sine * b * phase.conj(),
                                sine * a * phase + cosine * b)  # fmt: skip
        if worst < 1e-14:
            break
    squares = np.sum(np.abs(U) ** 2, axis=0)
    null = squares <= 0
    U[:, ~null] /= np.sqrt(squares[~null])
    if null.any():  # any orthonormal rest will do
        U[:, null] = scipy.linalg.null_space(U[:, ~null].conj().T)
    return U, squares


def _damped(K: Complex, D: Array, heavy: int) -> tuple[Complex, Complex]:
    """All finite ω of (K − iωD − ω² diag(1, …, 0)) a = 0."""
    n, h = len(K), heavy
    if not K.imag.any():
        K = cast(Complex, K.real)  # roots of real matrices come in pairs
    rates = np.zeros((n + h, n + h), K.dtype)  # of the state (a, ȧ of what has inertia)
    light = -np.linalg.solve(D[h:, h:], np.concatenate([K[h:], D[h:, :h]], axis=1))
    rates[:h, n:] = np.eye(h)
    rates[h:n] = light
    rates[n:, :n], rates[n:, n:] = -K[:h], -D[:h, :h]
    rates[n:] -= D[:h, h:] @ light
    s, vectors = scipy.linalg.eig(rates)
    size = np.abs(s)
    if size.min() < 1e-6 * size.max() and (slow := _slowest(K, D, h)) is not None:
        # Each half of the spectrum from the matrix in which it is the larger part.
        order = np.argsort(-size)
        cut = 1 + int(np.argmin(np.diff(np.log(np.maximum(size[order], 1e-300)))))
        s = np.concatenate([s[order[:cut]], slow[0][: n + h - cut]])
        vectors = np.concatenate([vectors[:n, order[:cut]], slow[1][:, : n + h - cut]], axis=1)
    return 1j * s, vectors[:n]


def _slowest(K: Complex, D: Array, h: int) -> tuple[Complex, Complex] | None:
    """s = −iω and a, slowest first, from (K/s² + D/s + diag(1, …, 0)) a = 0; None if K is singular.

    Relatively accurate where the fastest waves are faster by many decades.
    """
    n, d = len(K), np.sqrt(np.abs(np.diag(K).real))
    if not d.all() or np.linalg.cond(K / np.outer(d, d)) > 1e12:
        return None
    inverse = np.linalg.inv(K / np.outer(d, d)) / np.outer(d, d)
    rates = np.zeros((n + h, n + h), K.dtype)
    rates[:n, :n], rates[:n, n:] = -inverse @ D, -inverse[:, :h]
    rates[n:, :h] = np.eye(h)
    inverse_s, vectors = scipy.linalg.eig(rates)
    order = np.argsort(-np.abs(inverse_s))
    return 1 / inverse_s[order], vectors[:n, order]


@dataclass(frozen=True)
class Scale:
    """A time of a field: whose, of what, how long [s]."""

    field: str
    what: str
    seconds: float


class Scales(tuple[Scale, ...]):
    """Times of fields; as text a table, shortest first."""

    def __str__(self) -> str:
        rows = sorted(self, key=lambda s: s.seconds)
        return "\n".join(f"{s.field:<4s}{s.seconds:10.3g} s  {s.what}" for s in rows)


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

