# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The kinetic co-energy χ(ν, ν̇): recognised as quadratic, or compiled with its derivatives.

A user's χ is differentiated by UFL: the momentum p = ∂χ/∂ν̇, q = ∂χ/∂ν and the second derivatives
that a Newton method needs. Where these say that χ = ½ν̇·Ων̇ with a constant Ω, the body is one of
constant inertia, which every integrator takes. Knows no mesh arrays and no time stepping.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cffi
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.algorithms import extract_coefficients
from ufl.algorithms.analysis import extract_constants
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from complexbody import _compat, hessian
from complexbody.body import Body
from complexbody.densities import scalar
from complexbody.errors import IntegratorError

Array = npt.NDArray[np.float64]


def recognised(body: Body, mesh: Any) -> Body:
    """The body with the matrix Ω for its inertia if its χ(ν, ν̇) is ½ν̇·Ων̇, else itself.

    Raises:
        BodyError: if χ cannot be evaluated, is no scalar, or Ω is not positive semidefinite.
    """
    if not callable(body.inertia):
        return body
    k = int(body.descriptor)
    chi = body.inertia
    what = f"kinetic co-energy of {body.name}"
    found = hessian.read(lambda nu, rate: scalar(what, chi, nu, rate), mesh, k, k, "fields")
    if found is None or found.linear or found.expressions():
        return body
    omega, first = np.zeros((k, k)), 3 * 2 * k + k  # behind gradients and ν itself
    for (i, j), value in found.hessian.items():
        if min(i, j) < first:
            return body
        omega[i - first, j - first] = value
    return dataclasses.replace(body, inertia=omega)


def co_energy(body: Body, nu: Any, rate: Any) -> Any:
    """χ(ν, ν̇) in UFL [J/m³]; constant inertia gives ½ν̇·Ων̇."""
    if callable(body.inertia):
        return scalar(f"kinetic co-energy of {body.name}", body.inertia, nu, rate)
    omega = ufl.as_matrix(body.inertia_matrix.tolist())
    return 0.5 * ufl.dot(rate, ufl.dot(omega, rate))


def derivatives(body: Body, nu: Any, rate: Any) -> tuple[Any, ...]:
    """χ, p = ∂χ/∂ν̇, q = ∂χ/∂ν (paper §5; shape (k,)), then ∂p/∂ν̇, ∂p/∂ν, ∂q/∂ν (k, k) in UFL."""
    nu, rate = ufl.variable(nu), ufl.variable(rate)
    chi = co_energy(body, nu, rate)
    p, q = ufl.diff(chi, rate), ufl.diff(chi, nu)
    return chi, p, q, ufl.diff(p, rate), ufl.diff(p, nu), ufl.diff(q, nu)


class NodalKinetics:
    """χ of one body and all its derivatives up to the second at one (ν, ν̇), compiled by FFCx.

    The compiled function writes χ, p, q (k each), then ∂²χ/∂ν̇∂ν̇, ∂²χ/∂ν̇∂ν (rows by ν̇) and
    ∂²χ/∂ν∂ν (k² each); it reads ν and ν̇ among the form's constants.

    Attributes:
        function: Address of the compiled function.
        constants: Values of all constants; ν at ``at_nu``, ν̇ at ``at_rate``.

    Raises:
        IntegratorError: if χ reads a Function, which has no value at a node alone.
    """

    def __init__(self, body: Body, mesh: Any) -> None:
        k = int(body.descriptor)
        nu_c, rate_c = (fem.Constant(mesh, np.zeros(k)) for _ in range(2))
        chi, p, q, *second = derivatives(body, nu_c, rate_c)
        parts = [chi, *(p[i] for i in range(k)), *(q[i] for i in range(k))]
        parts += [m[i, j] for m in second for i in range(k) for j in range(k)]
        if extract_coefficients(chi):
            raise IntegratorError(
                f"The kinetic co-energy of {body.name} reads a Function, which "
                "quadrature='vertex' cannot take. Use quadrature='consistent'."
            )
        expression = apply_derivatives(apply_algebra_lowering(ufl.as_vector(parts)))
        point = np.zeros((1, mesh.topology.dim))
        self._keep, kernel = _compat.expression_kernel(expression, point, mesh.comm)
        self.function = int(cffi.FFI().cast("uintptr_t", kernel))
        values: list[Array] = []
        at: dict[int, int] = {}
        for c in extract_constants(expression):
            at[id(c)] = sum(v.size for v in values)
            values.append(np.ravel(np.asarray(c.value, dtype=np.float64)))
        self.constants = np.concatenate([*values, np.zeros(1)])
        # A χ that does not depend on ν leaves it out.
        self.at_nu, self.at_rate = at.get(id(nu_c), -1), at.get(id(rate_c), -1)
