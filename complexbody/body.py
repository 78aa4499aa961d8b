# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a complex body is made of: energy, potential, density, inertia and viscosity.

A :class:`Body` is what the user says about a material and nothing else: it knows no mesh and no
integrator. Its energy is a function of UFL expressions, evaluated when a scene is built.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.errors import BodyError
from complexbody.given import is_finite, is_number, is_whole, numbers, short

Number = float | int
Matrix = npt.NDArray[np.float64]

#: More components, or points of quadrature, are a mistake: kernels would take for ever to compile.
MOST_COMPONENTS, MOST_DEGREE = 1000, 40


@dataclass(frozen=True)
class Body:
    r"""A material with displacement ``u`` (n_u components) and descriptor ``nu`` (k components).

    The action (paper (action), (potential), written per unit volume) is

    .. math:: \mathcal A = \int\int \tfrac12\rho|\dot u|^2 + \chi(\nu,\dot\nu)
              - \rho e(\nabla u,\nu,\nabla\nu) - \rho w(u,\nu)\,dx\,dt,

    and the principle is :math:`\delta\mathcal A - \int\int \eta\dot\nu\cdot\phi = 0`. The sign of
    the dissipation is minus: with the plus of the paper's (dAL), taking the variation along the
    motion gives :math:`dE/dt = +\int\eta|\dot\nu|^2`, an energy that grows.

    Attributes:
        descriptor: k, the number of components of ``nu`` (at least 1).
        energy: ``f(U, nu, N)``, the stored energy per volume ρe [J/m³] as a scalar UFL expression
            of U = ∇u, shape (n_u, 3), ν, shape (k,), and N = ∇ν, shape (k, 3). Columns of
            directions the mesh does not have are zero.
        density: ρ [kg/m³], positive; a number or a scalar piecewise constant (DG0) Function.
        inertia: ρ̄ with χ = ½ρ̄|ν̇|², or the symmetric k×k matrix Ω with χ = ½ν̇·Ων̇, or
            ``f(nu, nu_dot)`` giving χ in UFL; 0 is allowed where ``viscosity`` is positive.
        viscosity: η in z^v = ην̇, a number ≥ 0 or a symmetric positive semidefinite k×k matrix.
        potential: ``f(u, nu)``, the potential of external actions ρw [J/m³], or None.
        displacement: n_u, the number of components of ``u`` (at least 1).
        quadrature_degree: Degree of the rule for densities that are not quadratic; by default the
            one UFL estimates.
        name: What to call it in tables and messages.
        constants: The constants it was made of, by name, for tables and result files.
        orientation: Stop a run in which a cell turns inside out, det(I + ∇u) ≤ 0; asked only of
            energies that are not quadratic in U. False for those that mean something there.

    Raises:
        BodyError: for shapes, signs or values that no body can have.
    """

    descriptor: int
    energy: Callable[[Any, Any, Any], Any]
    density: Any
    inertia: Any
    viscosity: Any = 0.0
    potential: Callable[[Any, Any], Any] | None = None
    displacement: int = 3
    quadrature_degree: int | None = None
    name: str = "body"
    constants: Mapping[str, float] = field(default_factory=dict)
    orientation: bool = True

    def __post_init__(self) -> None:
        for name in ("descriptor", "displacement"):
            value = getattr(self, name)
            if not (is_whole(value) and 1 <= value <= MOST_COMPONENTS):
                raise BodyError(
                    f"Body: {name} is {short(value)}, not a whole number of components. "
                    f"Give {name}=1 or more."
                )
        if not callable(self.energy):
            raise BodyError(
                "Body: energy is not a function. Give energy=f(U, nu, N) returning a scalar UFL "
                "expression in J/m³."
            )
        if self.potential is not None and not callable(self.potential):
            raise BodyError(
                "Body: potential is not a function. Give potential=f(u, nu) returning a scalar UFL "
                "expression in J/m³, or None."
            )
        if not (is_number(self.density) or hasattr(self.density, "function_space")):
            raise BodyError(
                f"Body: density is {short(self.density)}, neither a number nor a DG0 Function. "
                "Give ρ > 0 in kg/m³."
            )
        if is_number(self.density) and not (is_finite(self.density) and self.density > 0):
            raise BodyError(
                f"Body: density is {short(self.density)}, but mass must be positive. Give ρ > 0 in "
                "kg/m³."
            )
        self._check_manners()
        if not callable(self.inertia):
            _check_psd("inertia", self.inertia_matrix, self.inertia)
        _check_psd("viscosity", self.viscosity_matrix, self.viscosity)
        if not callable(self.inertia):
            total = self.inertia_matrix + self.viscosity_matrix
            if np.linalg.eigvalsh(_scaled(total)).min(initial=1.0) <= 1e-14:
                raise BodyError(
                    "Body: a component of the descriptor has neither inertia nor viscosity, so "
                    "nothing determines its rate. Give inertia > 0 or viscosity > 0 for it."
                )

    def _check_manners(self) -> None:
        """What no equation sees."""
        degree = self.quadrature_degree
        if degree is not None and not (is_whole(degree) and 0 <= degree <= MOST_DEGREE):
            raise BodyError(
                f"Body: quadrature_degree is {short(degree)}. Give None or a whole number from 0 "
                f"to {MOST_DEGREE}."
            )
        for name, kind, what in (
            ("name", str, "a text"), ("constants", Mapping, "a dict"),
            ("orientation", bool, "True or False"),
        ):  # fmt: skip
            if not isinstance(getattr(self, name), kind):
                raise BodyError(f"Body: {name} is {short(getattr(self, name))}. Give {what}.")

    @property
    def components(self) -> int:
        """n_u + k, the number of unknowns per node."""
        return int(self.displacement + self.descriptor)

    @property
    def inertia_matrix(self) -> Matrix:
        """Ω, shape (k, k) [kg/m³ × (descriptor's unit)⁻²·m²]; a number ρ̄ gives ρ̄I.

        Raises:
            BodyError: if the inertia is a function of (ν, ν̇), which has no constant matrix.
        """
        if callable(self.inertia):
            raise BodyError(
                "Body: this inertia is a function of (nu, nu_dot), which only an implicit "
                "integrator can take. Give a number or a k×k matrix for explicit integrators."
            )
        return self._square("inertia", self.inertia)

    @property
    def viscosity_matrix(self) -> Matrix:
        """η as a (k, k) matrix."""
        return self._square("viscosity", self.viscosity)

    def _square(self, name: str, value: Any) -> Matrix:
        k = int(self.descriptor)
        # Texts, truth values and complex numbers would be converted without a word.
        array = numbers(value)
        if array is None:
            raise BodyError(
                f"Body: {name} is {short(value)}. Give a number or a {k}×{k} matrix of numbers."
            )
        if array.ndim == 0:
            return np.diag(np.full(k, float(array)))
        if array.shape != (k, k):
            raise BodyError(
                f"Body: {name} has shape {array.shape}, but the descriptor has {k} components. "
                f"Give a number or a {k}×{k} matrix."
            )
        return array


def _scaled(matrix: Matrix) -> Matrix:
    """The matrix with ±1 or 0 on its diagonal, so that units do not matter."""
    d = np.sqrt(np.abs(np.diag(matrix)))
    d = np.where(d > 0, d, 1.0)
    return matrix / d / d[:, None]


def _check_psd(name: str, matrix: Matrix, given: Any) -> None:
    if not np.all(np.isfinite(matrix)):
        raise BodyError(
            f"Body: {name} is {short(given)}, which is not finite. Give finite numbers."
        )
    scale = np.abs(matrix).max(initial=0.0)
    if np.abs(matrix - matrix.T).max(initial=0.0) > 1e-12 * scale:
        raise BodyError(
            f"Body: the {name} matrix is not symmetric. Give its symmetric part: the rest "
            "contributes neither to the kinetic energy nor to the dissipation."
        )
    part = 0.5 * matrix + 0.5 * matrix.T
    alone = np.diag(part) == 0  # a row of a semidefinite matrix whose diagonal is zero is zero
    if np.any(part[alone]) or np.linalg.eigvalsh(_scaled(part)).min(initial=0.0) < -1e-12:
        raise BodyError(f"Body: {name} is negative ({short(given)}). Give {name} ≥ 0.")
