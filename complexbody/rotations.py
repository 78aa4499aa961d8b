# SPDX-License-Identifier: LGPL-3.0-or-later
r"""How a descriptor turns with the body: actions of rotations on ν.

An observer turned by Q sees F as QF and ν as a_Q(ν), so ∇ν as Da_Q(ν)∇ν; the right index of both
gradients belongs to the reference place and does not turn. The generator of the action,

.. math:: \mathcal A(\nu)\,q = \tfrac{d}{ds}\, a_{\exp(s\,q\times)}(\nu)\big|_{s=0},

is the paper's 𝒜 (§2, before (dAL)'s boundary conditions), shape (k, 3). A descriptor enters the
balance of moments by it and in no other way. Numbers only: knows no UFL and no mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from complexbody.errors import BodyError

Array = npt.NDArray[np.float64]

__all__ = [
    "RotationAction",
    "angle",
    "axial",
    "linear",
    "microrotation",
    "perpendicular",
    "rotation",
    "scalar",
    "tensor",
    "together",
    "vector",
]

#: Central difference of order six: (offset, weight).
_STENCIL = ((1, 45 / 60), (2, -9 / 60), (3, 1 / 60))
_STEP = 1e-2


@dataclass(frozen=True)
class RotationAction:
    """An action of rotations on ν: a_Q(ν), with a_Q a_R = a_QR and a_I = identity.

    Attributes:
        name: What to call it.
        act: ``f(Q, nu)`` of Q, shape (3, 3), and descriptors (m, k), giving (m, k).
        components: k.
        planar: Only rotations about the third axis act.
        matrix: ``A(Q)``, shape (k, k), where the action is ν → A(Q)ν.
        infinitesimal: ν is a small departure: rotations by small q add 𝒜q to it, 𝒜 being constant,
            and Q − I to F. So do the rotations that energies quadratic in ∇u know.
    """

    name: str
    act: Callable[[Array, Array], Array]
    components: int
    planar: bool = False
    matrix: Callable[[Array], Array] | None = None
    infinitesimal: bool = False

    @property
    def axes(self) -> tuple[int, ...]:
        """Axes (from 0) of the rotations that act."""
        return (2,) if self.planar else (0, 1, 2)

    def about(self, nu: npt.ArrayLike = 0.0) -> RotationAction:
        """What this action does to small departures from a state ν̄ with F̄ = I: 𝒜 = 𝒜(ν̄)."""
        at = np.broadcast_to(np.asarray(nu, dtype=np.float64), (self.components,))
        generator = self.generator(at[None])[0]

        def act(Q: Array, nu: Array) -> Array:
            return nu + generator @ axial(Q) / 2

        name = f"{self.name}, infinitesimal"
        return RotationAction(name, act, self.components, self.planar, infinitesimal=True)

    def gradient(self, Q: Array, nu: Array) -> Array:
        """Da_Q(ν), what ∇ν is multiplied by, shape (m, k, k); by differences if not linear."""
        if self.matrix is not None:
            return np.broadcast_to(self.matrix(Q), (len(nu), self.components, self.components))
        columns = []
        for i in range(self.components):
            columns.append(_slope(partial(self._beside, Q, nu, np.eye(self.components)[i])))
        return np.stack(columns, axis=-1)

    def generator(self, nu: Array) -> Array:
        """𝒜(ν) of descriptors (m, k), shape (m, k, 3); zero for rotations that do not act."""
        out = np.zeros((*nu.shape, 3))
        for axis in self.axes:
            out[..., axis] = _slope(partial(self._turned, self.act, np.eye(3)[axis], nu))
        return out

    def generator_gradient(self, nu: Array) -> Array:
        """D𝒜(ν), shape (m, k, 3, k): 𝒜(ν)q changes by D𝒜(ν)[q, dν]."""
        out = np.zeros((*nu.shape, 3, self.components))
        for axis in self.axes:
            slope = _slope(partial(self._turned, self.gradient, np.eye(3)[axis], nu))
            out[..., axis, :] = slope
        return out

    def _beside(self, Q: Array, nu: Array, direction: Array, s: float) -> Array:
        return self.act(Q, nu + s * direction)

    @staticmethod
    def _turned(f: Callable[[Array, Array], Array], axis: Array, nu: Array, s: float) -> Array:
        return f(rotation(s * axis), nu)


def _slope(f: Callable[[float], Array]) -> Array:
    """f'(0) to about 1e-13 for functions that vary over lengths of one."""
    parts = [w * (f(i * _STEP) - f(-i * _STEP)) for i, w in _STENCIL]
    return np.asarray(sum(parts)) / _STEP


def rotation(vector: Array) -> Array:
    """exp(φ×), the rotation about φ by |φ| [rad], shape (3, 3)."""
    phi = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(phi))
    W = np.cross(np.eye(3), phi)  # W x = φ × x
    # sin(t)/t and (1 − cos t)/t², the second by the half angle, which loses no digits.
    first, half = np.sinc(angle / np.pi), np.sinc(angle / (2 * np.pi))
    return np.eye(3) + first * W + 0.5 * half**2 * (W @ W)


def axial(M: Array) -> Array:
    """Vector −ε_ijk M_ij of tensors (…, 3, 3), shape (…, 3): 2q of the tensor q×."""
    parts = [M[..., k, j] - M[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1))]
    return np.stack(parts, axis=-1)


def linear(
    name: str, matrix: Callable[[Array], Array], components: int, planar: bool = False
) -> RotationAction:
    """ν → A(Q)ν for a representation A of the rotations.

    Raises:
        BodyError: if A(Q) is not of shape (k, k), or is no representation: A(Q)A(R) ≠ A(QR).
    """
    first, second = (rotation(np.array([0.0, 0.0, a])) for a in (0.7, -0.4))
    if not planar:
        second = rotation(np.array([0.3, 0.5, -0.2]))
    A, B, AB = (np.asarray(matrix(Q)) for Q in (first, second, first @ second))
    if A.shape != (components, components) or not np.allclose(A @ B, AB, rtol=0, atol=1e-10):
        raise BodyError(
            f"Rotations: {name!r} is no action on {components} components: A(Q) has shape "
            f"{A.shape}, or A(Q)A(R) is not A(QR). Give A with A(Q)A(R) = A(QR)."
        )
    return RotationAction(name, lambda Q, nu: nu @ matrix(Q).T, components, planar, matrix)


def scalar(components: int = 1) -> RotationAction:
    """Every component the same for all observers: voids, lengths, phases, densities of cracks."""
    return linear("scalar", lambda Q: np.eye(components), components)


def vector(components: int = 3) -> RotationAction:
    """ν → Qν: a polarisation, a director, what cracks add to u; 2 components turn in the plane."""
    if components not in (2, 3):
        raise BodyError(f"Rotations: a vector has 2 or 3 components, not {components}. Give one.")
    m = components
    return linear("vector", lambda Q: Q[:m, :m], m, planar=m == 2)


def tensor(dimension: int = 3) -> RotationAction:
    """T → QTQᵀ of second-order tensors T, ν being T row by row (9 or, in the plane, 4)."""
    if dimension not in (2, 3):
        raise BodyError(f"Rotations: a tensor is of dimension 2 or 3, not {dimension}. Give one.")
    d = dimension
    return linear("tensor", lambda Q: np.kron(Q[:d, :d], Q[:d, :d]), d * d, planar=d == 2)


def perpendicular(turns: int = 3) -> RotationAction:
    """Plane phasons: a rotation by θ about the third axis turns ν (2 components) by ``turns``·θ.

    3 for decagonal quasicrystals: a fifth of a turn in the physical plane, by which the tiling goes
    over into itself, is three fifths in perpendicular space.
    """

    def matrix(Q: Array) -> Array:
        t = turns * np.arctan2(Q[1, 0], Q[0, 0])
        return np.array([[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]])

    return linear(f"perpendicular space, {turns} turns", matrix, 2, planar=True)


def angle() -> RotationAction:
    """ν → ν + θ: an angle of direction or microrotation in the plane."""
    return RotationAction(
        "angle", lambda Q, nu: nu + np.arctan2(Q[1, 0], Q[0, 0]), components=1, planar=True
    )


def microrotation() -> RotationAction:
    """Rotation vectors: exp(ν×) → Q exp(ν×), as Cosserat's triads turn; |ν| < π.

    At ν = 0 its generator is the identity: small microrotations add up.
    """
    return RotationAction("microrotation", _composed, components=3)


def together(*actions: RotationAction) -> RotationAction:
    """ν = (ν₁, ν₂, …), each part with an action of its own."""
    ends = np.cumsum([a.components for a in actions])

    def act(Q: Array, nu: Array) -> Array:
        parts = np.split(nu, ends[:-1], axis=-1)
        return np.concatenate([a.act(Q, p) for a, p in zip(actions, parts, strict=True)], axis=-1)

    return RotationAction(
        ", ".join(a.name for a in actions), act, int(ends[-1]), any(a.planar for a in actions)
    )


def _composed(Q: Array, nu: Array) -> Array:
    """Rotation vectors of Q exp(ν×), by quaternions: nothing is lost near 0 or π."""
    a, b = _quaternion(Q), np.empty((*nu.shape[:-1], 4))
    half = 0.5 * np.linalg.norm(nu, axis=-1, keepdims=True)
    b[..., :1], b[..., 1:] = np.cos(half), 0.5 * np.sinc(half / np.pi) * nu
    real = a[0] * b[..., :1] - (b[..., 1:] @ a[1:])[..., None]
    rest = a[0] * b[..., 1:] + b[..., :1] * a[1:] + np.cross(a[1:], b[..., 1:])
    sign = np.where(real < 0, -1.0, 1.0)
    size = np.linalg.norm(rest, axis=-1, keepdims=True)
    full = 2 * np.arctan2(size, sign * real)
    # angle/sin(angle/2) → 2 at 0.
    return sign * rest * np.where(size > 1e-300, full / np.where(size > 1e-300, size, 1.0), 2.0)


def _quaternion(Q: Array) -> Array:
    """The unit quaternion (real part first, ≥ 0) of a rotation."""
    K = np.zeros((4, 4))
    K[0, 0] = np.trace(Q)
    K[0, 1:] = K[1:, 0] = Q[2, 1] - Q[1, 2], Q[0, 2] - Q[2, 0], Q[1, 0] - Q[0, 1]
    K[1:, 1:] = Q + Q.T - np.trace(Q) * np.eye(3)
    # Bar-Itzhack (2000): the eigenvector of the largest eigenvalue.
    q = np.linalg.eigh(K)[1][:, -1]
    return q if q[0] >= 0 else -q
