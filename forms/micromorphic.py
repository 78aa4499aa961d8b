# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Micromorphic solids: displacement u, descriptor ψ, the deformation of the micro-medium.

Mindlin's isotropic medium with microstructure, its 15 moduli of ∇ψ reduced to one. With ε = sym ∇u
and the relative deformation g = ∇u − ψ (ψ_ij is component d·i + j of ν, both indices from 0),

.. math:: \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2 + \mu|\varepsilon|^2
          + \tfrac12b_1(\mathrm{tr}\,g)^2 + \tfrac12b_2|g|^2 + \tfrac12b_3\,g:g^T
          + g_1\,\mathrm{tr}\,g\,\mathrm{tr}\,\varepsilon + 2g_2\,g:\varepsilon
          + \tfrac12C|\nabla\psi|^2, \qquad \chi = \tfrac12\bar\rho|\dot\psi|^2.

Coercive on (ε, g, ∇ψ) iff

* shear (d > 1): μ > 0, b2 + b3 > 0 and μ(b2 + b3) > 2g2²;
* pressure: dλ + 2μ > 0, db1 + b2 + b3 > 0 and (dλ + 2μ)(db1 + b2 + b3) > (dg1 + 2g2)²;
* rotation (d > 1): b2 > b3;
* C > 0.

For d = 1, with A = λ + 2μ, B = b1 + b2 + b3 and no g1, g2, it is
e = ½Au'² + ½B(u' − ψ)² + ½Cψ'² (:func:`mindlin_bar`), whose waves obey

.. math:: (\rho\omega^2 - (A + B)q^2)(\bar\rho\omega^2 - Cq^2 - B) = B^2q^2:

an acoustic branch, √(A/ρ) q at long waves, an optical one from the cut-off √(B/ρ̄). In d dimensions
ψ has three cut-offs: dilatation (db1 + b2 + b3)/ρ̄, shear (b2 + b3)/ρ̄ and rotation (b2 − b3)/ρ̄,
all squared frequencies. Source: Mindlin, Arch. Rat. Mech. Anal. 16 (1964) 51, his letters.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import ufl

from complexbody.body import Body
from complexbody.errors import BodyError
from complexbody.forms._admissible import Energy, finite, require, require_positive


def _energy(
    d: int, lam: float, mu: float, b1: float, b2: float, b3: float, g1: float, g2: float, C: float
) -> Energy:
    """The energy above as ``f(U, nu, N)``, whatever the constants."""

    def energy(U: Any, nu: Any, N: Any) -> Any:
        grad = ufl.as_tensor([[U[i, j] for j in range(d)] for i in range(d)])
        psi = ufl.as_tensor([[nu[d * i + j] for j in range(d)] for i in range(d)])
        e, g = ufl.sym(grad), grad - psi
        return (
            0.5 * lam * ufl.tr(e) ** 2
            + mu * ufl.inner(e, e)
            + 0.5 * b1 * ufl.tr(g) ** 2
            + 0.5 * b2 * ufl.inner(g, g)
            + 0.5 * b3 * ufl.inner(g, g.T)
            + g1 * ufl.tr(g) * ufl.tr(e)
            + 2 * g2 * ufl.inner(g, e)
            + 0.5 * C * ufl.inner(N, N)
        )

    return energy


def micromorphic(
    lam: float = 1.0,
    mu: float = 1.0,
    b1: float = 0.3,
    b2: float = 1.0,
    b3: float = 0.2,
    g1: float = 0.1,
    g2: float = 0.1,
    C: float = 0.1,
    density: float = 1.0,
    inertia: float = 0.1,
    viscosity: float = 0.0,
    d: int = 3,
    name: str = "micromorphic body",
) -> Body:
    """Micromorphic body (``displacement=d``, ``descriptor=d²``), by default dimensionless.

    Args:
        lam: λ [Pa].
        mu: μ [Pa].
        b1: b1 [Pa].
        b2: b2 [Pa].
        b3: b3 [Pa].
        g1: g1, coupling of the traces [Pa].
        g2: g2, coupling of the symmetric parts [Pa].
        C: C, of ∇ψ [N].
        density: ρ [kg/m³].
        inertia: ρ̄ [kg/m]; of micro-cubes with edges 2a and density ρ', ρ'a²/3.
        viscosity: η [Pa·s].
        d: Components of u, 1 to 3. The mesh should have at most d dimensions.
        name: What to call it.

    Raises:
        CoercivityError: unless the inequalities above hold.
        BodyError: for constants that are not finite numbers, a d other than 1, 2 or 3, or masses no
            body can have.
    """
    family = "micromorphic"
    if isinstance(d, bool) or d not in (1, 2, 3):
        raise BodyError(f"{family}: d is {d!r}, not a dimension. Give d=1, 2 or 3.")
    constants = finite(family, {"lam": lam, "mu": mu, "b1": b1, "b2": b2, "b3": b3,
                                "g1": g1, "g2": g2, "C": C})  # fmt: skip
    require_positive(family, constants, ("C",))
    if d > 1:
        require_positive(family, constants, ("mu",))
        require(family, "b2 > b3", b2, b3, "Choose a smaller b3.")
        require(family, "b2 + b3 > 0", b2 + b3, 0.0, "Choose a larger b2.")
        remedy = "Choose a smaller |g2|, or a larger mu or b2."
        require(family, "mu*(b2 + b3) > 2*g2**2", mu * (b2 + b3), 2 * g2**2, remedy)
    macro, micro, shared = d * lam + 2 * mu, d * b1 + b2 + b3, d * g1 + 2 * g2
    require(family, f"{d}*lam + 2*mu > 0", macro, 0.0, "Choose a larger lam.")
    require(family, f"{d}*b1 + b2 + b3 > 0", micro, 0.0, "Choose a larger b1.")
    inequality = f"({d}*lam + 2*mu)*({d}*b1 + b2 + b3) > ({d}*g1 + 2*g2)**2"
    remedy = f"Bring g1 nearer to {-2 * g2 / d:.9g}, or choose a larger lam or b1."
    require(family, inequality, macro * micro, shared**2, remedy)
    return Body(d * d, _energy(d, **constants), density, inertia, viscosity, displacement=d,
                name=name, constants=constants, parity="tensor")  # fmt: skip


def mindlin_bar(
    A: float = 1.0,
    B: float = 1.0,
    C: float = 0.1,
    density: float = 1.0,
    inertia: float = 0.1,
    viscosity: float = 0.0,
) -> Body:
    """Mindlin's bar, e = ½Au'² + ½B(u' − ψ)² + ½Cψ'² (n_u = k = 1), by default dimensionless.

    Args:
        A: Stiffness at long waves [Pa].
        B: Of u' − ψ [Pa].
        C: Of ψ' [N].
        density: ρ [kg/m³].
        inertia: ρ̄ [kg/m].
        viscosity: η [Pa·s].

    Raises:
        CoercivityError: unless A, B, C > 0.
        BodyError: as :func:`micromorphic`.
    """
    require_positive("mindlin_bar", finite("mindlin_bar", {"A": A, "B": B, "C": C}), "ABC")
    body = micromorphic(A, 0.0, B, 0.0, 0.0, 0.0, 0.0, C, density, inertia, viscosity, 1)
    return dataclasses.replace(body, name="Mindlin's bar", constants={"A": A, "B": B, "C": C})
