# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Cosserat (micropolar) solids: displacement u, descriptor φ, the rotation of points [rad].

With ε = sym ∇u and r = ½ curl u,

.. math:: \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2
          + (\mu + \tfrac12\kappa)|\varepsilon|^2 + \kappa|r - \varphi|^2
          + \tfrac12[\alpha(\mathrm{div}\,\varphi)^2
          + \beta\,\varphi_{i,j}\varphi_{j,i} + \gamma|\nabla\varphi|^2],
          \qquad \chi = \tfrac12\rho j|\dot\varphi|^2,

Eringen's constants. Lakes' technical ones (:func:`cosserat_constants`): G = μ + κ/2,
ν = λ/(2λ + 2G), N² = κ/(2(μ + κ)), l_t² = (β + γ)/(2G), l_b² = γ/(4G), Ψ = (β + γ)/(α + β + γ).

Coercive on (sym U, r − φ, ∇φ) iff 3λ + 2μ + κ, 2μ + κ, κ, 3α + β + γ, γ + β, γ − β > 0. Ψ = 3/2,
which foams often suggest, is 3α + β + γ = 0: accepted, but semidefinite. ∇φ ∝ I then costs nothing;
no plane wave is of that kind, so all keep their stiffness; scenes in space warn of the mode.

Waves along q: longitudinal ω² = (λ + 2μ + κ)q²/ρ; microrotation along q
ω² = ((α + β + γ)q² + 2κ)/(ρj); and, twice, u and φ across q,

.. math:: (\rho\omega^2 - (\mu + \kappa)q^2)(\rho j\omega^2 - \gamma q^2 - 2\kappa) = \kappa^2q^2.

φ has the cut-off √(2κ/(ρj)). Sources: Eringen 1966; foam (r), recalled, not re-read: Lakes 1986.
"""

from __future__ import annotations

from typing import Any

import ufl

from complexbody.body import Body
from complexbody.errors import BodyError
from complexbody.forms._admissible import Energy, finite, require


def _energy(
    n_u: int, k: int, lam: float, mu: float, kappa: float, gamma: float, alpha: float = 0,
    beta: float = 0,
) -> Energy:  # fmt: skip
    """The energy above as ``f(U, nu, N)``; what u has not is zero, and with k = 1 φ = φ e3."""

    def energy(U: Any, nu: Any, N: Any) -> Any:
        grad = ufl.as_tensor([[U[i, j] if i < n_u else 0.0 for j in range(3)] for i in range(3)])
        rows = range(3) if k == 3 else (None, None, 0)
        phi = [0.0 if i is None else nu[i] for i in rows]
        w = ufl.as_tensor([[0.0 if i is None else N[i, j] for j in range(3)] for i in rows])
        turns = ((2, 1), (0, 2), (1, 0))
        lag = [0.5 * (grad[i, j] - grad[j, i]) - p for (i, j), p in zip(turns, phi, strict=True)]
        e = ufl.sym(grad)
        strain = 0.5 * lam * ufl.tr(e) ** 2 + (mu + 0.5 * kappa) * ufl.inner(e, e)
        curvature = gamma * ufl.inner(w, w)
        if k == 3:
            curvature += alpha * ufl.tr(w) ** 2 + beta * ufl.inner(w, w.T)
        return strain + kappa * sum(a**2 for a in lag) + 0.5 * curvature

    return energy


def cosserat_constants(
    G: float = 104e6, poisson: float = 0.4, N2: float = 0.04, l_t: float = 0.62e-3,
    l_b: float = 0.327e-3, Psi: float = 1.5,
) -> dict[str, float]:  # fmt: skip
    """λ, μ, κ [Pa], α, β, γ [N] of Lakes' technical constants, by default of dense polyurethane.

    Those are recalled (r) from Int. J. Solids Struct. 22 (1986) 55. G is in Pa, l_t and l_b in m.

    Raises:
        BodyError: unless all are finite, ν < ½, 0 < N² < 1 and 0 < Ψ ≤ 3/2.
    """
    given = {"G": G, "poisson": poisson, "N2": N2, "l_t": l_t, "l_b": l_b, "Psi": Psi}
    finite("cosserat_constants", given)
    if not (poisson < 0.5 and 0 < N2 < 1 and 0 < Psi <= 1.5):
        advice = "Give poisson < 0.5, 0 < N2 < 1 and 0 < Psi <= 1.5."
        raise BodyError(f"cosserat_constants: no body has {given}. {advice}")
    kappa, twist, gamma = 2 * N2 * G / (1 - N2), 2 * G * l_t**2, 4 * G * l_b**2
    lam, alpha = 2 * G * poisson / (1 - 2 * poisson), twist / Psi - twist
    return {"lam": lam, "mu": G - kappa / 2, "kappa": kappa,
            "alpha": alpha, "beta": twist - gamma, "gamma": gamma}  # fmt: skip


_FOAM = cosserat_constants()


def _stiff(family: str, bulk: int, c: dict[str, float]) -> None:
    """Of strain in ``bulk`` dimensions, and of κ."""
    shear = 2 * c["mu"] + c["kappa"]
    require(family, "kappa > 0", c["kappa"], 0.0, "Choose a larger kappa.")
    require(family, "2*mu + kappa > 0", shear, 0.0, "Choose a larger mu.")
    condition = f"{bulk}*lam + 2*mu + kappa > 0"
    require(family, condition, bulk * c["lam"] + shear, 0.0, "Choose a larger lam.")


def cosserat(
    lam: float = _FOAM["lam"], mu: float = _FOAM["mu"], kappa: float = _FOAM["kappa"],
    alpha: float = _FOAM["alpha"], beta: float = _FOAM["beta"], gamma: float = _FOAM["gamma"],
    density: float = 340.0, micro_inertia: float = 1e-8, viscosity: float = 0.0,
) -> Body:  # fmt: skip
    """Cosserat body (``displacement=3``, ``descriptor=3``), by default Lakes' foam.

    Args:
        lam: λ [Pa].
        mu: μ [Pa].
        kappa: κ [Pa].
        alpha: α [N].
        beta: β [N].
        gamma: γ [N].
        density: ρ [kg/m³]; the foam's (r).
        micro_inertia: j [m²]; not measured: (0.1 mm)², about a cell of the foam squared.
        viscosity: η of φ [Pa·s].

    Raises:
        CoercivityError: unless the inequalities above hold; 3α + β + γ = 0 is accepted.
        BodyError: for constants that are not finite numbers, or masses no body can have.
    """
    family, more = "cosserat", "Choose a larger gamma."
    given = {"lam": lam, "mu": mu, "kappa": kappa, "gamma": gamma}
    c = finite(family, given | {"alpha": alpha, "beta": beta})
    _stiff(family, 3, c)
    require(family, "gamma + beta > 0", gamma + beta, 0.0, more)
    require(family, "gamma - beta > 0", gamma - beta, 0.0, more)
    polar = 3 * alpha + beta + gamma + 1e-12 * gamma  # Ψ = 3/2 but for round-off
    remedy = "Choose a larger alpha."
    require(family, "3*alpha + beta + gamma >= 0", polar, 0.0, remedy, strict=False)
    inertia = density * finite(family, {"j": micro_inertia})["j"]
    return Body(3, _energy(3, 3, **c), density, inertia, viscosity, name=family, constants=c,
                parity="axial")  # fmt: skip


def plane_cosserat(
    lam: float = _FOAM["lam"], mu: float = _FOAM["mu"], kappa: float = _FOAM["kappa"],
    gamma: float = _FOAM["gamma"], density: float = 340.0, micro_inertia: float = 1e-8,
    viscosity: float = 0.0, d: int = 2,
) -> Body:  # fmt: skip
    """Plane strain, φ = φ e3 (k = 1); d = 2, or 3 for a u3 that moves while φ1 = φ2 = 0.

    Raises:
        CoercivityError: unless 2λ + 2μ + κ, 2μ + κ, κ, γ > 0.
        BodyError: as for :func:`cosserat`, or for another d.
    """
    family = "plane_cosserat"
    if isinstance(d, bool) or d not in (2, 3):
        raise BodyError(f"{family}: d is {d!r}. Give d=2, or d=3 for motions out of the plane too.")
    c = finite(family, {"lam": lam, "mu": mu, "kappa": kappa, "gamma": gamma})
    _stiff(family, 2, c)
    require(family, "gamma > 0", gamma, 0.0, "Choose a larger gamma.")
    inertia = density * finite(family, {"j": micro_inertia})["j"]
    energy = _energy(d, 1, **c)
    return Body(1, energy, density, inertia, viscosity, displacement=d, name=family, constants=c,
                parity="axial")  # fmt: skip
