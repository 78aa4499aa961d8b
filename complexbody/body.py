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
from complexbody.rotations import RotationAction

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
        rotation: How ν turns with the body (:mod:`complexbody.rotations`): then runs book angular
            momentum, and ``cb.objectivity`` checks the energy.
        parity: How ν goes under a mirror, if a :class:`complexbody.Symmetry` is to know: "polar",
            "axial", "even", "odd", "tensor", ``f(Q)`` giving the k×k matrix of a mirror Q, or None.
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
    rotation: RotationAction | None = None
    parity: str | Callable[[Matrix], Matrix] | None = None
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
        if self.rotation is not None and self.rotation.components != self.descriptor:
            raise BodyError(
                f"Body: rotation {self.rotation.name!r} acts on {self.rotation.components} "
                f"components, but the descriptor has {self.descriptor}. Give one that fits."
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

    def dispersion(
        self,
        q: Any,
        *,
        polarisations: bool = False,
        u: Any = 0.0,
        U: Any = 0.0,
        nu: Any = 0.0,
        N: Any = 0.0,
    ) -> Any:
        r"""Frequencies of the plane waves a exp i(q·x − ωt) of the body in space, in any direction.

        .. math:: (K(q) - i\omega D - \omega^2 M)\,a = 0,

        with K(q) from the Hessian of ρe and ρw, M = diag(ρ, …, Ω), D = diag(0, …, η). Re ω is the
        angular frequency, −Im ω the rate of decay (of growth if negative: the state is unstable).
        Where ``inertia`` is a χ(ν, ν̇), its second derivatives at ν̇ = 0 take its place, with the
        gyroscopic force that may come of them.

        A body with a quadratic e, w and χ has the same waves at any state. Any other one is
        linearised at the uniform state (u, U, ν, N), which must be at rest: e + w is stationary in
        u and ν. Where ν and N ≠ 0 both enter the Hessian, that is a local statement.

        Args:
            q: Wave vector [1/m]: a number (along x), or the last axis of an array, of 1 to 3
                components.
            polarisations: Whether to return a as well.
            u: Displacement of the state [m], a number or shape (n_u,).
            U: Its gradient, a number or shape (n_u, 3).
            nu: ν of the state, a number or shape (k,).
            N: Its gradient, a number or shape (k, 3).

        Returns:
            ω [rad/s], shape (…, b) for q of shape (…, m), b = 2(n_u + k) less one for each
            direction of ν without inertia, by real part. With ``polarisations`` also a, shape
            (…, n_u + k, b): of length 1 in the fields' own units, the largest component positive.

        Raises:
            BodyError: for a q or a state that makes no sense, coefficients that vary in space, a
                density without second derivatives at the state, a state that is not at rest, or a
                component with neither inertia nor viscosity.
        """
        from complexbody import dispersion  # it stands above, and reads the energy

        state = {"u": u, "U": U, "nu": nu, "N": N}
        return dispersion.of_body(self, q, state, polarisations)

    def scales(self, cell: float, size: float, dim: int = 3) -> Any:
        """Times of the fields on cells and bodies of a given size; ``print`` makes a table of them.

        Of u and ν, each alone: the time a wave takes across a cell and across the body, √(ρL²/H),
        or, where that is longer, diffusion, ηL²/H; periods 2π√(Ω/H_νν) or relaxation η/H_νν; and
        Ω/η, in which viscosity stops inertia (:func:`complexbody.waves.scales`).

        Args:
            cell: Size of a cell [m].
            size: Of the body [m].
            dim: Dimension of the mesh, along whose axes waves run.

        Raises:
            BodyError: as :meth:`dispersion` at the state zero, or for sizes that are not positive.
        """
        from complexbody import dispersion

        return dispersion.scales_of(self, cell, size, dim)

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
