# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The isotropic two-field model: a vector descriptor ν that turns with the body, n_u = k = d.

With ε = sym ∇u and w = ∇ν (leading d×d blocks of U and N),

.. math::

    \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2 + \mu|\varepsilon|^2
           + \tfrac12 k_1(\mathrm{tr}\,w)^2 + k_2|\mathrm{sym}\,w|^2 + k_2'|\mathrm{skw}\,w|^2
           + k_3\,\mathrm{tr}\,\varepsilon\,\mathrm{tr}\,w + k_3'\,\varepsilon:\mathrm{sym}\,w
           + \tfrac12 k_0|\nu|^2.

The general quadratic energy of two vector fields, ν turning like u, that all rotations and mirrors
leave alone (they forbid a coupling of ν itself to ε). Waves are longitudinal, with the moduli
(λ+2μ, k1+2k2, k3+k3') of (u, ν, coupling), and transverse, with (μ, k2+k2', k3'/2); k0 gives ν a
cut-off frequency √(k0/ρ̄).

Coercive on (sym U, ν, N) iff

* pressure: λ + 2μ/d > 0, k1 + 2k2/d > 0 and (λ + 2μ/d)(k1 + 2k2/d) > (k3 + k3'/d)²;
* shear (d > 1): μ > 0, k2 > 0 and 4μk2 > k3'²;
* rotation (d > 1): k2' > 0;
* k0 > 0. k0 = 0 is accepted: then a constant ν costs nothing, and the scene must hold it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import ufl

from complexbody.body import Body
from complexbody.errors import BodyError
from complexbody.forms._admissible import Energy, finite, require, require_positive

NAMES = ("lam", "mu", "k0", "k1", "k2", "k2_skew", "k3", "k3_sym")


def _energy(
    d: int,
    lam: float,
    mu: float,
    k0: float,
    k1: float,
    k2: float,
    k2_skew: float,
    k3: float,
    k3_sym: float,
) -> Energy:
    """The energy above as ``f(U, nu, N)``, whatever the constants."""

    def block(A: Any) -> Any:
        return ufl.as_tensor([[A[i, j] for j in range(d)] for i in range(d)])

    def energy(U: Any, nu: Any, N: Any) -> Any:
        e, w = ufl.sym(block(U)), block(N)
        sym, skw = ufl.sym(w), ufl.skew(w)
        phonon = 0.5 * lam * ufl.tr(e) ** 2 + mu * ufl.inner(e, e)
        descriptor = (
            0.5 * k1 * ufl.tr(w) ** 2
            + k2 * ufl.inner(sym, sym)
            + k2_skew * ufl.inner(skw, skw)
            + 0.5 * k0 * ufl.inner(nu, nu)
        )
        coupling = k3 * ufl.tr(e) * ufl.tr(w) + k3_sym * ufl.inner(e, sym)
        return phonon + descriptor + coupling

    return energy


def admissible(family: str, d: int, given: Mapping[str, Any]) -> dict[str, float]:
    """The constants of :func:`isotropic_two_field` as floats.

    Raises:
        CoercivityError: unless the inequalities above hold.
        BodyError: for constants that are not finite numbers, or a d other than 1, 2 or 3.
    """
    if isinstance(d, bool) or d not in (1, 2, 3):
        raise BodyError(f"{family}: d is {d!r}, not a dimension. Give d=1, 2 or 3.")
    constants = finite(family, given)
    lam, mu, k0, k1, k2, _, k3, k3_sym = (constants[name] for name in NAMES)
    require(family, "k0 >= 0", k0, 0.0, "Give k0 a value of zero or more.", strict=False)
    if d > 1:
        require_positive(family, constants, ("mu", "k2", "k2_skew"))
        remedy = "Choose a smaller |k3_sym|, or a larger mu or k2."
        require(family, "4*mu*k2 > k3_sym**2", 4 * mu * k2, k3_sym**2, remedy)
    pressure, own, shared = lam + 2 * mu / d, k1 + 2 * k2 / d, k3 + k3_sym / d
    require(family, f"lam + 2*mu/{d} > 0", pressure, 0.0, "Choose a larger lam.")
    require(family, f"k1 + 2*k2/{d} > 0", own, 0.0, "Choose a larger k1.")
    inequality = f"(lam + 2*mu/{d})*(k1 + 2*k2/{d}) > (k3 + k3_sym/{d})**2"
    remedy = f"Bring k3 nearer to {-k3_sym / d:.9g}, or choose a larger lam or k1."
    require(family, inequality, pressure * own, shared**2, remedy)
    return constants


def isotropic_two_field(
    lam: float = 1.0,
    mu: float = 1.0,
    k0: float = 1.0,
    k1: float = 0.5,
    k2: float = 0.5,
    k2_skew: float = 0.25,
    k3: float = 0.2,
    k3_sym: float = 0.2,
    density: float = 1.0,
    inertia: float = 1.0,
    viscosity: float = 0.0,
    d: int = 3,
    name: str = "isotropic two-field body",
) -> Body:
    """Isotropic two-field body; the defaults are dimensionless and belong to no material.

    Args:
        lam: λ [Pa].
        mu: μ [Pa].
        k0: Self-action of ν [Pa/(unit of ν)²].
        k1: k1 [Pa·m²/(unit of ν)²].
        k2: k2, on sym w [as k1].
        k2_skew: k2', on skw w [as k1].
        k3: k3, coupling of tr ε and tr w [Pa·m/(unit of ν)].
        k3_sym: k3', coupling of ε and sym w [as k3].
        density: ρ [kg/m³].
        inertia: ρ̄ [kg/m³·m²/(unit of ν)²] in χ = ½ρ̄|ν̇|².
        viscosity: η [as ρ̄, per s].
        d: Number of components of u and of ν, 1 to 3. The mesh should have at most d dimensions:
            derivatives along further axes cost nothing.
        name: What to call it.

    Raises:
        CoercivityError: unless the inequalities above hold.
        BodyError: for constants that are not finite numbers, a d other than 1, 2 or 3, or masses no
            body can have.
    """
    family = "isotropic_two_field"
    descriptor = {"k0": k0, "k1": k1, "k2": k2, "k2_skew": k2_skew, "k3": k3, "k3_sym": k3_sym}
    constants = admissible(family, d, {"lam": lam, "mu": mu, **descriptor})
    energy = _energy(d, **constants)
    return Body(
        d, energy, density, inertia, viscosity, displacement=d, name=name, constants=constants,
        parity="polar",
    )  # fmt: skip
