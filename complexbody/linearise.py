# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Linearisation of a nonlinear body about a natural state (paper §3).

With ς = (F, ν, N) at the state ς̄ = (F̄, ν̄, 0), UFL gives P̄, z̄, S̄ and the linear forms L of

.. math:: P \approx \bar P + L^{(P)}(\nabla u,\nu',\nabla\nu'),\quad
          z \approx \bar z + L^{(z)},\quad S \approx \bar S + L^{(S)},

hence the energy ½ g·Hg (+ l·g) of the increments g = (∇u, ν' = ν − ν̄, ∇ν'), constant H. The new
body's descriptor *is* the increment ν': it rests at zero, and its kernels are generated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from ufl.algorithms import extract_coefficients

from complexbody import _compat
from complexbody.body import Body
from complexbody.errors import BodyError, PrestressError
from complexbody.pointwise import Expansion

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Prestress:
    """What a body's energy does at a state.

    Attributes:
        stress: P̄ [J/m³], shape (n_u, 3); self_action: z̄ (k,); microstress: S̄ (k, 3). Where a
            coefficient varies from cell to cell, the entries of largest magnitude.
        relative: The strain that could feel them: the largest magnitude of P̄ over √(H_PP) (of z̄
            and S̄ likewise, each by its own stiffness) over √H of a unit strain; no units.
    """

    stress: Array
    self_action: Array
    microstress: Array
    relative: float

    def __str__(self) -> str:
        """The largest entries of each, one line."""
        named = ("P̄", "U", self.stress), ("z̄", "nu", self.self_action), (
            "S̄", "N", self.microstress
        )  # fmt: skip
        parts = []
        for symbol, name, values in named:
            at = np.unravel_index(int(np.argmax(np.abs(values))), values.shape)
            index = "".join(str(i + 1) for i in at)
            parts.append(f"{symbol}: {values[at]:.6g} at {name}{index}")
        return f"{', '.join(parts)}; relative {self.relative:.3g}"


def prestress(body: Body, nu: float | Sequence[float] = 0.0, U: Any = None) -> Prestress:
    """P̄, z̄, S̄ of a body at a state (U, ν, 0); collective if its energy reads Functions.

    Args:
        body: A body, nonlinear or not.
        nu: ν̄, a number or one per component.
        U: ∇ū, shape (n_u, 3); zero (F̄ = I) by default.

    Raises:
        BodyError: if the state is no state of this body, or the energy is not differentiable there.
    """
    return _State(body, nu, U).prestress


def linearise(
    body: Body,
    nu: float | Sequence[float] = 0.0,
    U: Any = None,
    *,
    prestress: str = "refuse",
    tolerance: float = 1e-8,
) -> Body:
    r"""The quadratic body of small departures from a state (F̄ = I + Ū, ν̄, N̄ = 0), by UFL.

    Its energy is ½ g·Hg with g = (∇u, ν − ν̄, ∇ν) and H = ∂²e/∂(F, ν, N)² at the state, its
    descriptor is ν − ν̄. Energies count from the state. A potential w(u, ν) is expanded about
    (0, ν̄) to second order, its slope there being the load it is; a general χ(ν, ν̇) about (ν̄, 0).
    Constants, density and viscosity are kept; the action of rotations is that of small ones. Where
    the motion of the nonlinear body is of size a, that of the linear one differs by O(a²).

    Args:
        body: The nonlinear body; its energy may be written in F by :func:`deformation`.
        nu: ν̄, a number or one per component.
        U: ∇ū of the state, shape (n_u, 3); zero by default.
        prestress: "refuse" a state where P̄, z̄ or S̄ is not zero, or "keep" them as the linear
            term P̄·∇u + z̄·(ν − ν̄) + S̄·∇ν. P̄ is then also in H: the stiffness of a body under
            stress, which may well be no longer coercive.
        tolerance: :attr:`Prestress.relative` up to which a state is natural.

    Raises:
        PrestressError: for a state that is not natural, with P̄, z̄ and S̄.
        BodyError: if the energy is not twice differentiable there, or for arguments that make no
            sense.
    """
    if prestress not in ("refuse", "keep"):
        raise BodyError(f"linearise: prestress is {prestress!r}. Give 'refuse' or 'keep'.")
    state = _State(body, nu, U)
    found = state.prestress
    if prestress == "refuse" and not found.relative <= tolerance:
        raise PrestressError(
            f"The state of {body.name} to linearise about is not natural: {found} (paper §3 wants "
            f"zero). Give the nu and U where the energy has its least value, or prestress='keep'.",
            found,
        )
    slope = state.slope if prestress == "keep" else [0.0] * len(state.slope)
    changes: dict[str, Any] = {
        "energy": _Quadratic(slope, state.hessian),
        "name": f"{body.name}, linearised",
    }
    if body.rotation is not None:
        # A rotated state F̄ ≠ I turns otherwise.
        changes["rotation"] = None if U is not None else body.rotation.about(state.nu)
    if body.potential is not None:
        origin = [np.zeros(body.displacement), state.nu]
        _, outer, second = _at(f"potential of {body.name}", body.potential, origin)
        changes["potential"] = _Quadratic(outer, second)
    if callable(body.inertia):
        changes["inertia"] = _inertia(body, state.nu)
    return replace(body, **changes)


class _State:
    """A state (U, ν, 0), and the energy's gradient and Hessian there."""

    def __init__(self, body: Body, nu: float | Sequence[float], U: Any) -> None:
        k, n_u = int(body.descriptor), int(body.displacement)
        self.body, self.n_u, self.k = body, n_u, k
        self.nu = _shaped("nu", nu, (k,))
        gradient = _shaped("U", 0.0 if U is None else U, (n_u, 3))
        state = [gradient, self.nu, np.zeros((k, 3))]
        _, self.slope, self.hessian = _at(f"energy of {body.name}", body.energy, state)

    @property
    def prestress(self) -> Prestress:
        """P̄, z̄, S̄ as numbers."""
        n_u, k, size = self.n_u, self.k, len(self.slope)
        diagonal = [self.hessian.get((i, i), 0.0) for i in range(size)]
        values = _largest([*self.slope, *diagonal])
        slope, stiffness = values[:size], np.sqrt(np.abs(values[size:]))
        # The energy that a slope may release, l²/2H, over that of a unit strain: no unit of ν.
        unit = float(stiffness[: 3 * n_u].max()) or float(stiffness.max()) or 1.0
        own = np.where(stiffness > 1e-12 * unit, stiffness, unit)
        return Prestress(
            slope[: 3 * n_u].reshape(n_u, 3),
            slope[3 * n_u : 3 * n_u + k],
            slope[3 * n_u + k :].reshape(k, 3),
            float(np.max(np.abs(slope) / own) / unit),
        )


class _Quadratic:
    """l·g + ½ g·Hg of UFL tensors whose entries, row by row, are g."""

    def __init__(self, slope: Sequence[Any], hessian: dict[tuple[int, int], Any]) -> None:
        self._slope, self._hessian = slope, hessian

    def __call__(self, *parts: Any) -> Any:
        g = [part[i] for part in parts for i in np.ndindex(part.ufl_shape)]
        total = ufl.as_ufl(0.0)
        for i, value in enumerate(self._slope):
            if not (isinstance(value, float) and value == 0.0):
                total += value * g[i]
        for (i, j), value in self._hessian.items():
            if i <= j:
                total += (0.5 * value if i == j else value) * g[i] * g[j]
        return total


def _inertia(body: Body, nu: Array) -> Any:
    """Ω, or χ to second order in (ν − ν̄, ν̇) where it is not ½ν̇·Ων̇."""
    k = len(nu)
    inertia: Callable[..., Any] = body.inertia
    chi = f"kinetic co-energy of {body.name}"
    _, slope, second = _at(chi, inertia, [nu, np.zeros(k)])
    numbers = [v for v in (*slope, *second.values()) if isinstance(v, float)]
    if len(numbers) == len(slope) + len(second) and all(min(key) >= k for key in second):
        omega = np.zeros((k, k))
        for (i, j), value in second.items():
            omega[i - k, j - k] = value
        return omega
    return _Quadratic([0.0] * k + list(slope[k:]), second)


def _at(what: str, density: Callable[..., Any], state: Sequence[Array]) -> Any:
    """Value, slope and Hessian of a density at one state."""
    return Expansion(what, density, [part.shape for part in state], 2).at(state)


def _shaped(name: str, value: Any, shape: tuple[int, ...]) -> Array:
    try:
        array = np.broadcast_to(np.asarray(value, dtype=np.float64), shape)
    except (TypeError, ValueError):
        array = np.full(shape, np.nan)
    if not np.isfinite(array).all():
        raise BodyError(
            f"The state has {name}={value!r}, not finite numbers of shape {shape}. Give them."
        )
    return np.array(array)


def _largest(values: Sequence[Any]) -> Array:
    """Numbers as they are; of UFL scalars the value of largest magnitude over all cells."""
    varying = [i for i, v in enumerate(values) if not isinstance(v, float)]
    out = np.array([v if isinstance(v, float) else math.nan for v in values])
    if not varying:
        return out
    expression = ufl.as_vector([values[i] for i in varying])
    functions = [c for c in extract_coefficients(expression) if hasattr(c, "function_space")]
    if not functions:
        raise BodyError(
            "The energy depends on the place in a way that has no value here. Give its coefficients"
            " as piecewise constant (DG0) Functions to linearise it."
        )
    mesh = functions[0].function_space.mesh
    cells = np.arange(_compat.cell_count(mesh)[0], dtype=np.int32)
    compiled = _compat.expression(expression, _compat.cell_space(mesh))
    found = _compat.evaluate(compiled, mesh, cells)
    # A rank without cells has infinities of the sign that do not count.
    ends = np.array([found.max(axis=0, initial=-np.inf), -found.min(axis=0, initial=np.inf)])
    top, low = np.max(mesh.comm.allgather(ends), axis=0) * [[1.0], [-1.0]]
    out[varying] = np.where(np.abs(top) >= np.abs(low), top, low)
    return out
