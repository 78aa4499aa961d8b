# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Is an energy objective? Invariance under rotations, and the balance of moments that follows.

An energy is objective under an action of rotations on ν if e(QF, a_Q(ν), Da_Q(ν)N) = e(F, ν, N) for
all Q. Differentiated along Q = exp(sq×) this is, for all q,

.. math:: P\cdot(q\times F) + z\cdot\mathcal A q + S\cdot(D\mathcal A[q])N = 0,
          \quad\text{or}\quad
          \mathsf e_{ijk}(PF^{\mathsf T})_{ij} = (\mathcal A^*z + (D\mathcal A)^*S)_k,

that is skw(PFᵀ) = ½ **e**(𝒜*z + (D𝒜)*S), with skw M = ½(M − Mᵀ). The paper (§2) prints it without
the ½, its skw being M − Mᵀ. An energy quadratic in ∇u cannot be objective: it only knows small
rotations, e(U + q×, ν + 𝒜q, N) = e(U, ν, N), with e_ijk P_ij = 𝒜*z; actions made by
:meth:`RotationAction.about` ask for that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.body import Body
from complexbody.errors import BodyError
from complexbody.pointwise import Expansion
from complexbody.rotations import RotationAction, axial, rotation

Array = npt.NDArray[np.float64]
#: (U, ν, N), of shapes (n_u, 3), (k,), (k, 3).
State = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Check:
    """One identity at all states: its largest residual, relative to its terms, and where."""

    name: str
    residual: float
    state: State
    tolerance: float

    @property
    def holds(self) -> bool:
        """Whether the residual is round-off."""
        return self.residual <= self.tolerance


@dataclass(frozen=True)
class Objectivity:
    """What :func:`objectivity` found: truthy if all checks hold; printed, it says which fail."""

    body: str
    action: RotationAction
    states: int
    checks: tuple[Check, ...]

    @property
    def holds(self) -> bool:
        """Whether all checks hold."""
        return all(check.holds for check in self.checks)

    def __bool__(self) -> bool:
        return self.holds

    def __str__(self) -> str:
        lines = [f"{self.body} under {self.action.name}, {self.states} random states:"]
        for check in self.checks:
            verdict = "holds" if check.holds else "FAILS"
            lines.append(f"  {verdict}  {check.residual:.1e}  {check.name}")
            if not check.holds:
                U, nu, N = (np.array2string(a, precision=3).replace("\n", "") for a in check.state)
                lines.append(f"         worst at U = {U}, ν = {nu}, N = {N}")
        if not self.holds and not self.action.infinitesimal:
            lines.append(
                "  An energy quadratic in ∇u is objective for small rotations only: check that by "
                "action.about(nu)."
            )
        return "\n".join(lines)


def objectivity(
    body: Body | Callable[[Any, Any, Any], Any],
    action: RotationAction | None = None,
    *,
    states: int | Sequence[State] = 8,
    amplitude: float = 0.3,
    nu: float | Sequence[float] = 0.0,
    displacement: int = 3,
    tolerance: float = 1e-9,
    seed: int = 0,
) -> Objectivity:
    """Check that an energy is objective under an action of rotations on ν.

    Args:
        body: A body, or its energy f(U, nu, N).
        action: How ν turns; the body's own ``rotation`` by default. Made by
            :meth:`RotationAction.about` it stands for small rotations, which is what an energy
            quadratic in ∇u can be objective under.
        states: How many random states, or the states (U, ν, N) themselves.
        amplitude: Size of random U, ν − ν̄ and N.
        nu: ν̄, about which descriptors are drawn.
        displacement: n_u, where ``body`` is a function. With two components the body turns in its
            plane.
        tolerance: Largest residual, relative to its terms, that counts as round-off.
        seed: Of the random states and rotations.

    Returns:
        Two checks: invariance of e, and the balance of moments between P, z and S.

    Raises:
        BodyError: for an energy that has no number there, or an action that does not fit.
    """
    if isinstance(body, Body):
        name, energy = body.name, body.energy
        n_u, action = int(body.displacement), action or body.rotation
        k = int(body.descriptor)
    else:
        name, energy, n_u = "a body", body, displacement
        k = action.components if action is not None else 0
    if action is None:
        raise BodyError(
            f"objectivity: how ν of {name} turns is not known. Give action=cb.rotations.vector() "
            "or another one."
        )
    if action.components != k or n_u not in (2, 3):
        raise BodyError(
            f"objectivity: {action.name!r} acts on {action.components} components, {name} has "
            f"k = {k} and n_u = {n_u}. Give an action that fits, and n_u = 2 or 3."
        )
    axes = (2,) if n_u == 2 else action.axes
    rng = np.random.default_rng(seed)
    drawn = _drawn(rng, states, n_u, k, amplitude, nu) if isinstance(states, int) else states
    shapes = ((n_u, 3), (k,), (k, 3))
    first, plain = (Expansion(f"energy of {name}", energy, shapes, order) for order in (1, 0))
    energies, changes, torques, terms = [], [], [], []
    for U, value, N in drawn:
        e, slope, _ = first.at((U, value, N))
        turned = _turned(action, axes, rng, U, value, N)
        other = plain.at(turned)[0]
        if not all(isinstance(v, float) for v in (e, other, *slope)):
            raise BodyError(
                f"objectivity: the energy of {name} has coefficients that vary from cell to cell. "
                "Give numbers in their place."
            )
        energies.append(e)
        changes.append(abs(other - e))
        parts = _torques(action, n_u, (U, value, N), np.array(slope))
        torques.append(float(np.abs(sum(parts))[list(axes)].max()))
        terms.append(max(float(np.abs(part).max()) for part in parts[1:]))
        P, F = _full(np.array(slope)[: 3 * n_u].reshape(n_u, 3)), np.eye(3) + _full(U)
        terms[-1] = max(terms[-1], float(np.linalg.norm(P) * np.linalg.norm(F)))
    size = max(max(energies) - min(energies), 1e-6 * float(np.abs(energies).max()), 1e-300)
    words = (
        ("e(U + q×, ν + 𝒜q, N) = e(U, ν, N)", "e_ijk P_ij = 𝒜*z")
        if action.infinitesimal
        else ("e(QF, Qν, QN) = e(F, ν, N)", "skw(PFᵀ) = ½ e(𝒜*z + (D𝒜)*S)")
    )
    found = ((changes, size), (torques, max(*terms, 1e-300)))
    return Objectivity(
        name, action, len(drawn),
        tuple(
            Check(word, max(values) / scale, drawn[int(np.argmax(values))], tolerance)
            for word, (values, scale) in zip(words, found, strict=True)
        ),
    )  # fmt: skip


def _drawn(
    rng: np.random.Generator, count: int, n_u: int, k: int, amplitude: float, nu: Any
) -> list[State]:
    """Random states with det F > 0.1."""
    out: list[State] = []
    while len(out) < count:
        U, N = amplitude * rng.normal(size=(n_u, 3)), amplitude * rng.normal(size=(k, 3))
        value = np.asarray(nu, dtype=np.float64) + amplitude * rng.normal(size=k)
        if np.linalg.det(np.eye(3) + _full(U)) > 0.1:
            out.append((U, value, N))
    return out


def _turned(
    action: RotationAction, axes: tuple[int, ...], rng: np.random.Generator,
    U: Array, nu: Array, N: Array,
) -> State:  # fmt: skip
    """The state as a turned observer sees it."""
    q = np.zeros(3)
    q[list(axes)] = rng.normal(size=len(axes))
    q *= rng.uniform(0.3, 2.8) / np.linalg.norm(q)
    if action.infinitesimal:
        # Not small: a quadratic energy invariant to first order is so to all.
        W = np.cross(np.eye(3), q)
        return U + W[: len(U)], nu + action.generator(nu[None])[0] @ q, N
    Q = rotation(q)
    F = Q @ (np.eye(3) + _full(U))
    J = action.gradient(Q, nu[None])[0]
    return (F - np.eye(3))[: len(U)], action.act(Q, nu[None])[0], J @ N


def _torques(action: RotationAction, n_u: int, state: State, slope: Array) -> list[Array]:
    """−e_ijk (PFᵀ)_ij, (𝒜*z)_k and ((D𝒜)*S)_k: their sum vanishes."""
    U, nu, N = state
    P, z, S = np.split(slope, [3 * n_u, 3 * n_u + len(nu)])
    P, S = _full(P.reshape(n_u, 3)), S.reshape(N.shape)
    F = np.eye(3) if action.infinitesimal else np.eye(3) + _full(U)
    generator, change = action.generator(nu[None])[0], action.generator_gradient(nu[None])[0]
    return [
        axial(P @ F.T),
        generator.T @ z,
        np.einsum("iaj,jm,im->a", change, N, S),
    ]


def _full(rows: Array) -> Array:
    """Three rows, those that are not there being zero."""
    return np.pad(rows, ((0, 3 - len(rows)), (0, 0)))
