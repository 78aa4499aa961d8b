# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Lumped masses, viscosities and supports of nodes, grouped into classes of equal nodes.

Per unit of a node's lumped volume a node has a mass matrix M = diag(ρ, …, ρ, Ω), a damping matrix
D = diag(0, …, 0, η), to which absorbing boundaries add theirs in all components, and a set of
prescribed components. Few combinations occur (regions times supports; nodes of an absorbing
boundary are mostly their own), so matrices are kept per class. Every dissipation scheme is then one
recursion with an effective mass

.. math:: (\hat M + hD/2)\,v^+ = (\hat M - hD/2)\,v^- + h f,\qquad x \mathrel{+}= h v^+,

v the *mean* rate of a drift: :math:`\hat M = M` ("symmetric"), :math:`M + hD/2` ("forward"),
:math:`(hD/2)\coth(hD/(2M))` ("exact": the exact flow of ρ̄ν̈ + ην̇ = 0 between kicks; its limit
M → 0 is hD/2, that of "forward"). Hence one stability criterion, 4M̂ − h²K ≻ 0, and one energy.
A damper's hD/M is about one on any mesh, so that M̂ would not tend to M: those of absorbing
boundaries are in D alone, "symmetric" in all schemes. They change no critical step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.sparse.csgraph

from complexbody.discretisation import Discretisation
from complexbody.errors import IntegratorError

if TYPE_CHECKING:
    from complexbody.dampers import Dampers

Array = npt.NDArray[np.float64]
SCHEMES = ("exact", "symmetric", "forward")


def pencil_basis(mass: Array, viscosity: Array) -> tuple[Array, Array, Array]:
    """Basis in which M and D of one body are both diagonal.

    Args:
        mass: Ω, shape (k, k), positive semidefinite.
        viscosity: η, shape (k, k), positive semidefinite; M + D definite on a common scale.

    Returns:
        (V, m, d): columns of V with VᵀΩV = diag(m) and Vᵀ η V = diag(d), V of shape (k, k).
    """
    if not len(mass):  # of a scene without ν
        return mass, np.zeros(0), np.zeros(0)
    a, b = float(np.trace(mass)), float(np.trace(viscosity))
    # Scaled by their traces, M and D add up to a well-scaled definite matrix.
    first = mass / a if a > 0 else np.zeros_like(mass)
    second = viscosity / b if b > 0 else np.zeros_like(viscosity)
    _, vectors = scipy.linalg.eigh(first if a > 0 else second, first + second)
    m = np.einsum("ji,jk,ki->i", vectors, mass, vectors)
    d = np.einsum("ji,jk,ki->i", vectors, viscosity, vectors)
    # Round-off must not turn a missing inertia into a tiny one.
    return vectors, np.where(m > 1e-13 * a, m, 0.0), np.where(d > 1e-13 * b, d, 0.0)


def damped_basis(mass: Array, damping: Array) -> tuple[Array, Array, Array]:
    """The same of all components of a node, (n, n), whatever the units of u and ν.

    Components that nothing couples stay apart; those coupled are taken in units of their own.
    """
    n, scale = len(mass), np.sqrt(np.where(np.diag(mass) > 0, np.diag(mass), np.diag(damping)))
    V, m, d = np.zeros((n, n)), np.zeros(n), np.zeros(n)
    linked = scipy.sparse.csr_matrix((mass != 0) | (damping != 0))
    count, label = scipy.sparse.csgraph.connected_components(linked, directed=False)
    for part in range(count):
        at = np.flatnonzero(label == part)
        ix, s = np.ix_(at, at), np.outer(scale[at], scale[at])
        basis, m[at], d[at] = pencil_basis(mass[ix] / s, damping[ix] / s)
        V[ix] = basis / scale[at][:, None]
    return V, m, d


def effective(m: Array, d: Array, h: float | Array, scheme: str) -> Array:
    """M̂(h) of a diagonal pencil: m, d ≥ 0 per component, h [s]; elementwise.

    Raises:
        IntegratorError: if the scheme cannot take a component without inertia.
    """
    m, d = np.asarray(m, dtype=np.float64), np.asarray(d, dtype=np.float64)
    if scheme == "symmetric":
        if np.any(m == 0):
            raise IntegratorError(
                'dissipation="symmetric" has no limit for a descriptor without inertia. Use '
                'dissipation="exact" or "forward".'
            )
        return m + 0 * d * h
    half = 0.5 * d * h
    if scheme == "forward":
        return m + half
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(m > 0, half / np.where(m > 0, m, 1.0), np.inf)
        # s coth s = 1 + s²/3 − … near 0, → s at infinity.
        factor = np.where(s < 1e-4, 1.0 + s**2 / 3.0, s / np.tanh(np.minimum(s, 1e3)))
        return np.where(m > 0, m * np.where(np.isfinite(factor), factor, 1.0), half)


@dataclass
class Recursion:
    """Matrices per class (classes, n, n), per unit volume, for one step h.

    Attributes:
        alpha, beta: v⁺ = α v⁻ + β f / volume on free components; identity and 0 on prescribed.
        mean: M̂; viscosity: D; mass: M.
        to_rate, force_to_rate: q̇ at the step's own time = A v⁻ + B f / volume.
        massless: Part of ``force_to_rate`` that no kick carries: D q̇ = f where there is no inertia.
        from_rate: v⁺ of the first step = C q̇₀ + w β f / volume with w = ½ (trapezoidal) or 1.
    """

    alpha: Array
    beta: Array
    mean: Array
    viscosity: Array
    mass: Array
    to_rate: Array
    force_to_rate: Array
    massless: Array
    from_rate: Array


@dataclass
class Diagonal:
    """A basis per class, rates = vectors @ y, with diagonal inertia and viscosity.

    Attributes:
        vectors, inverse: Shape (classes, n, n); identity on u and on prescribed components.
        mass, viscosity: Diagonals per unit volume, shape (classes, n).
    """

    vectors: Array
    inverse: Array
    mass: Array
    viscosity: Array


class Masses:
    """Classes of nodes of a discretised scene with constant inertia.

    Args:
        disc: The scene's arrays.
        fixed: Prescribed components, shape (nodes, n).
        stiffness: S per body (bodies, k, k): Ω + h²S/4 is then the inertia
            (:mod:`complexbody.stiffness`).
        step: That h [s], for all nodes or of each (nodes,).
        dampers: Of absorbing boundaries (:mod:`complexbody.dampers`).

    Attributes:
        classes: Class of each node, shape (nodes + 1,), int32.
        density: ρ per class; inertia, viscosity: Ω, η per class (classes, k, k).
        damping: D per class (classes, n, n), with dampers.
        dampers: Classes whose damping is not η alone.
        fixed: Prescribed components per class (classes, n).
        diagonal: True if no class couples components by inertia or damping.
        only_dampers_couple: True if without dampers it would be.
        whole: True if dampers couple components, those of u too.
        damped: True if there is any damping; absorbing: if there are dampers. On any rank.

    Raises:
        BodyError: if a body's inertia is a function (explicit integrators cannot take it).
    """

    def __init__(
        self,
        disc: Discretisation,
        fixed: npt.NDArray[np.bool_],
        stiffness: Array | None = None,
        step: float | Array = 0.0,
        dampers: Dampers | None = None,
    ) -> None:
        bodies = disc.scene.bodies
        self.n, self.n_u = disc.n, disc.scene.displacement
        omega = np.array([body.inertia_matrix for body in bodies])
        extra = np.zeros_like(omega) if stiffness is None else 0.25 * stiffness
        h = np.broadcast_to(np.asarray(step, dtype=np.float64), (disc.nodes,)) + 0.0
        eta = np.array([body.viscosity_matrix for body in bodies])
        rho = disc.density()
        # A node of one region has that region's matrices to the bit; others their own averages.
        pure = disc.region_volume.max(axis=1) == disc.volume
        region = np.where(pure, disc.region_volume.argmax(axis=1), -1)
        mixed = np.flatnonzero(~pure)
        label = region.astype(np.int64)
        label[mixed] = len(bodies) + np.arange(len(mixed))
        bits = fixed @ (1 << np.arange(self.n, dtype=np.int64))
        columns = [label, bits, rho.view(np.int64), h.view(np.int64)]
        self.absorbing = dampers is not None
        if dampers is not None:
            added = dampers.per_volume(disc)
            columns += list(added.reshape(disc.nodes, -1).view(np.int64).T)
        keys = np.stack(columns, axis=1)
        _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        self.classes = np.zeros(disc.nodes + 1, np.int32)
        self.classes[:-1] = inverse.ravel()
        self.density, self.fixed = rho[first], fixed[first]
        weight = disc.region_volume[first] / disc.volume[first, None]
        weight[region[first] >= 0] = 0.0
        rows = np.flatnonzero(region[first] >= 0)
        weight[rows, region[first][rows]] = 1.0
        self.inertia = np.einsum("cr,rij->cij", weight, omega)
        self.inertia += np.einsum("c,cr,rij->cij", h[first] ** 2, weight, extra)
        self.viscosity = np.einsum("cr,rij->cij", weight, eta)
        self.damping, self.whole = self.full(self.viscosity), False
        self.damped = bool(np.any(eta)) or self.absorbing
        off = ~np.eye(disc.scene.descriptor, dtype=bool)
        self.diagonal = not (np.any((omega + extra)[:, off]) or np.any(eta[:, off]))
        self.only_dampers_couple = self.diagonal
        if dampers is not None:
            self.damping += added[first]
            self.whole = dampers.coupled
            self.diagonal &= not dampers.coupled
        self.dampers = np.any(self.damping != self.full(self.viscosity), axis=(1, 2))
        self.pure = region[first] >= 0
        self._bases = [
            pencil_basis(o, e) for o, e in zip(self.inertia, self.viscosity, strict=True)
        ]

    @property
    def one_rate(self) -> bool:
        """True if all components of a class that have a rate D/M > 0 have the same, and inertia.

        Prescribed components have the rate 0: they move as they are told.
        """
        mass = self.full(self.inertia, self.density)
        m, d = (np.einsum("cii->ci", a) for a in (mass, self.damping))
        if np.any(m == 0):
            return False
        rate = np.where(self.fixed, 0.0, d / m)
        most = rate.max(axis=1, keepdims=True)
        return bool(np.all((rate == 0) | (np.abs(rate - most) <= 1e-14 * most)))

    def diagonalised(self) -> Diagonal:
        """Per class a basis of the free components in which inertia and viscosity are diagonal."""
        count = len(self.density)
        mass, damping = self.full(self.inertia, self.density), self.damping
        vectors = np.tile(np.eye(self.n), (count, 1, 1))
        m, d = np.einsum("cii->ci", mass).copy(), np.einsum("cii->ci", damping).copy()
        if not self.diagonal:
            off = ~np.eye(self.n, dtype=bool)
            coupled = np.any(mass[:, off], axis=1) | np.any(damping[:, off], axis=1)
            for c in np.flatnonzero(coupled):
                fixed = self.fixed[c]
                start = 0 if self.dampers[c] else self.n_u
                free = start + np.flatnonzero(~fixed[start:])
                if free.size:
                    ix = np.ix_(free, free)
                    basis = pencil_basis if start else damped_basis
                    vectors[c][ix], m[c, free], d[c, free] = basis(mass[c][ix], damping[c][ix])
        return Diagonal(vectors, np.linalg.inv(vectors), m, d)

    def full(self, nu: Array, u: Array | None = None) -> Array:
        """(classes, n, n) with ``nu`` (classes, k, k) in its block and ``u`` (classes,) before."""
        out = np.zeros((len(nu), self.n, self.n))
        out[:, self.n_u :, self.n_u :] = nu
        if u is not None:
            out[:, range(self.n_u), range(self.n_u)] = u[:, None]
        return out

    def effective(self, h: float, scheme: str) -> Array:
        """M̂ of every class for the step h, shape (classes, n, n)."""
        blocks = np.zeros_like(self.inertia)
        for c, (vectors, m, d) in enumerate(self._bases):
            if scheme == "symmetric" or not self.damped:
                effective(m, d, h, scheme)  # refuses missing inertia
                blocks[c] = self.inertia[c]
            elif scheme == "forward":
                blocks[c] = self.inertia[c] + 0.5 * h * self.viscosity[c]
            else:
                back = np.linalg.inv(vectors)
                blocks[c] = back.T @ np.diag(effective(m, d, h, scheme)) @ back
        return self.full(blocks, self.density)

    def recursion(self, h: float, scheme: str) -> Recursion:
        """Everything a step of length h needs, per class.

        Raises:
            IntegratorError: for an unknown scheme, or one that cannot take missing inertia.
        """
        if scheme not in SCHEMES:
            raise IntegratorError(f"dissipation is {scheme!r}. Give one of {', '.join(SCHEMES)}.")
        mean = self.effective(h, scheme)
        D, M = self.damping, self.full(self.inertia, self.density)
        plus, minus = mean + 0.5 * h * D, mean - 0.5 * h * D
        alpha, beta = np.zeros_like(M), np.zeros_like(M)
        to_rate, force_to_rate, massless, from_rate = (np.zeros_like(M) for _ in range(4))
        for c, fixed in enumerate(self.fixed):
            free = np.flatnonzero(~fixed)
            ix = np.ix_(free, free)
            alpha[c] = np.diag(fixed.astype(float))
            to_rate[c] = from_rate[c] = np.diag(fixed.astype(float))
            inverse = np.linalg.inv(plus[c][ix]) if free.size else np.zeros((0, 0))
            beta[c][ix] = h * inverse
            alpha[c][ix] = inverse @ minus[c][ix]
            # Rates at a step's own time: M q̇ = M̂v − (hD/2)v + (h/2) f; without inertia D q̇ = f.
            m, d = M[c][ix], D[c][ix]
            unit = _units(m, d)
            if np.linalg.matrix_rank(m * np.outer(unit, unit), tol=1e-13) == len(free):
                back = np.linalg.inv(m) if free.size else m
                to_rate[c][ix], force_to_rate[c][ix] = back @ minus[c][ix], 0.5 * h * back
            else:
                to_rate[c][ix], force_to_rate[c][ix], massless[c][ix] = _first_order(
                    m, d, minus[c][ix], h
                )
            from_rate[c][ix] = inverse @ m
        return Recursion(alpha, beta, mean, D, M, to_rate, force_to_rate, massless, from_rate)

    def pack(self, matrices: Array, record: int) -> Array:
        """Matrices as the C loops read them: diagonals (classes, NR), or blocks (classes, n, n)."""
        from complexbody import native

        if not self.diagonal:
            return np.ascontiguousarray(matrices)
        out = native.aligned((len(matrices), record))
        out[:, : self.n] = np.einsum("cii->ci", matrices)
        return out


def _units(m: Array, d: Array) -> Array:
    """Units of the components in which diagonals are one: ρ and ρ̄ may be 15 decades apart."""
    weight = np.where(np.diag(m) > 0, np.diag(m), np.diag(d))
    return 1 / np.sqrt(np.where(weight > 0, weight, 1.0))


def _first_order(m: Array, d: Array, minus: Array, h: float) -> tuple[Array, Array, Array]:
    """Rates where some components have no inertia: those obey D q̇ = f, the others momentum."""
    unit = _units(m, d)
    V, mm, dd = pencil_basis(m * np.outer(unit, unit), d * np.outer(unit, unit))
    V = unit[:, None] * V
    inertial = mm > 0
    inverse_m = np.where(inertial, 1.0 / np.where(inertial, mm, 1.0), 0.0)
    inverse_d = np.where(inertial, 0.0, 1.0 / np.where(dd > 0, dd, 1.0))
    back_m = V @ np.diag(inverse_m) @ V.T
    back_d = V @ np.diag(inverse_d) @ V.T
    return back_m @ minus, 0.5 * h * back_m + back_d, back_d
