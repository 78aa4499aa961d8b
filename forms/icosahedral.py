# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Icosahedral quasicrystals: phonon u and phason ν, both with three components.

With ε = sym ∇u, w = ∇ν (w_ij = ∂_jν_i), τ = (1+√5)/2 and the axes of x along two-fold axes,

.. math::

    \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2 + \mu|\varepsilon|^2
             + \tfrac12 k_4 Q_4 + \tfrac12 k_5(|w|^2 - Q_4) + R\,e_c,

    Q_4 = \tfrac13[(\mathrm{tr}\,w)^2 + (w_{12}/\tau + \tau w_{21})^2
          + (w_{23}/\tau + \tau w_{32})^2 + (w_{31}/\tau + \tau w_{13})^2],

    e_c = w_{11}(\varepsilon_{11} - \tau\varepsilon_{22} + \varepsilon_{33}/\tau)
        + w_{22}(\varepsilon_{11}/\tau + \varepsilon_{22} - \tau\varepsilon_{33})
        + w_{33}(-\tau\varepsilon_{11} + \varepsilon_{22}/\tau + \varepsilon_{33})
        + 2\varepsilon_{12}(w_{21}/\tau - \tau w_{12})
        + 2\varepsilon_{23}(w_{32}/\tau - \tau w_{23})
        + 2\varepsilon_{13}(w_{13}/\tau - \tau w_{31}).

Phason strains split into irreducible parts of dimension 4 and 5 under the icosahedral group; k4 and
k5 are their moduli, Q4 the squared length of the first. A rotation Q acts by U → QUQᵀ, w → Q'wQᵀ,
Q' being Q with √5 replaced by −√5. Coercive on (sym U, N) iff λ + 2μ/3, μ, k4, k5 > 0 and
μk5 > 3R². Constants marked (r) are recalled from the source, not re-read.
"""

from __future__ import annotations

import math
from typing import Any

import ufl

from complexbody.body import Body
from complexbody.forms._admissible import Energy, finite, require, require_positive

#: Γ_w of Al-Pd-Mn [m³s/kg] (r; T.-Y. Fan, Mathematical Theory of Elasticity of Quasicrystals, 2011)
PHASON_MOBILITY = 4.8e-19


def phason_moduli(K1: float, K2: float) -> tuple[float, float]:
    """(k4, k5) = (K1 - 2 K2, K1 + K2), for K1 and K2 as Ding et al. (1993) and Fan define them."""
    return K1 - 2.0 * K2, K1 + K2


_MU = 72.4e9
_K4, _K5 = phason_moduli(72e6, -37e6)


def _energy(lam: float, mu: float, k4: float, k5: float, R: float) -> Energy:
    """The energy above as ``f(U, nu, N)``, whatever the constants."""
    t = (1.0 + math.sqrt(5.0)) / 2.0

    def energy(U: Any, nu: Any, N: Any) -> Any:
        e, w = ufl.sym(U), N
        q4 = (
            ufl.tr(w) ** 2
            + (w[0, 1] / t + t * w[1, 0]) ** 2
            + (w[1, 2] / t + t * w[2, 1]) ** 2
            + (w[2, 0] / t + t * w[0, 2]) ** 2
        ) / 3.0
        coupling = (
            w[0, 0] * (e[0, 0] - t * e[1, 1] + e[2, 2] / t)
            + w[1, 1] * (e[0, 0] / t + e[1, 1] - t * e[2, 2])
            + w[2, 2] * (-t * e[0, 0] + e[1, 1] / t + e[2, 2])
            + 2.0 * e[0, 1] * (w[1, 0] / t - t * w[0, 1])
            + 2.0 * e[1, 2] * (w[2, 1] / t - t * w[1, 2])
            + 2.0 * e[0, 2] * (w[0, 2] / t - t * w[2, 0])
        )
        phonon = 0.5 * lam * ufl.tr(e) ** 2 + mu * ufl.inner(e, e)
        phason = 0.5 * k4 * q4 + 0.5 * k5 * (ufl.inner(w, w) - q4)
        return phonon + phason + R * coupling

    return energy


def icosahedral_quasicrystal(
    lam: float = 74.9e9,
    mu: float = _MU,
    k4: float = _K4,
    k5: float = _K5,
    R: float = 0.004 * _MU,
    density: float = 5100.0,
    inertia: float = 0.0,
    viscosity: float = 1.0 / PHASON_MOBILITY,
    name: str = "icosahedral quasicrystal",
) -> Body:
    r"""Icosahedral quasicrystal; the defaults are Al-Pd-Mn.

    *Inertia.* The phason of a real quasicrystal has no measured inertia: hydrodynamics (Lubensky,
    Ramaswamy, Toner 1985; Fan 2011) makes it diffuse, ην̇ = Div S. Hence ρ̄ = 0 and η = 1/Γ_w by
    default: *overdamped*, K1/η = 2e-11 (X-ray) to 3.5e-11 m²/s (neutron), or 3e4 s over 1 mm where
    sound takes 3e-7 s. It stands still in any wave experiment, and ρ̄ = ρ would not change that.
    (Speckles at 650 °C, Francoual et al. 2003 (r), point to 1e-16 m²/s, slower still.) Wave-like
    phasons (Bak 1985): ``inertia=density, viscosity=0``; :func:`scaled_icosahedral_quasicrystal`.

    *Doubtful.* Who measures diffuse scattering calls K2/K1 near −0.5 "close to a threefold
    instability" (Yamada et al. 2016, i-ScZn). With Ding's K1, K2, used here as Fan does, K2 < 0
    softens *five*-fold directions; a three-fold limit at K2/K1 = −3/4 (r; Widom 1991) belongs to
    k4 = K1 + 5K2/3, k5 = K1 − 4K2/3, and would make k4, k5 = 10.3, 121.3 MPa instead of 146, 35.

    Args:
        lam: λ [Pa]; 74.9e9 (r; Amazit et al. 1995, as in Fan 2011).
        mu: μ [Pa]; 72.4e9 (r; the same).
        k4: Modulus of the 4-dimensional phason strain [Pa]; K1 − 2K2 = 146e6, from K1 = 72e6,
            K2 = −37e6 (r; neutrons, room temperature, Letoublon et al. 2001, as in Fan 2011; X-rays
            gave 43e6, −22e6 (r), see :func:`phason_moduli`).
        k5: Modulus of the 5-dimensional phason strain [Pa]; K1 + K2 = 35e6, from the same.
        R: Phonon-phason coupling [Pa]; not measured. 0.004μ is an assumption (calculations take up
            to 0.01μ), 0.32 of the bound √(μk5/3).
        density: ρ [kg/m³]; 5100 (r; Fan 2011).
        inertia: ρ̄ [kg/m³] in χ = ½ρ̄|ν̇|².
        viscosity: η = 1/Γ_w [kg/(m³s)].
        name: What to call it.

    Raises:
        CoercivityError: unless λ + 2μ/3 > 0, μ > 0, k4 > 0, k5 > 0 and μk5 > 3R².
        BodyError: for constants that are not finite numbers, or masses no body can have.
    """
    family = "icosahedral_quasicrystal"
    constants = finite(family, {"lam": lam, "mu": mu, "k4": k4, "k5": k5, "R": R})
    require_positive(family, constants, ("mu", "k4", "k5"))
    require(family, "lam + 2*mu/3 > 0", lam + 2 * mu / 3, 0.0, f"Choose lam > {-2 * mu / 3:.9g}.")
    remedy = f"Choose |R| < {math.sqrt(mu * k5 / 3):.9g}, or a larger mu or k5."
    require(family, "mu*k5 > 3*R**2", mu * k5, 3 * R**2, remedy)
    energy = _energy(**constants)
    # The mirrors of two-fold axes have whole entries: √5 → −√5 leaves them as they are.
    return Body(
        3, energy, density, inertia, viscosity, name=name, constants=constants, parity="polar"
    )


def scaled_icosahedral_quasicrystal(coupling: float = 0.5, viscosity: float = 0.5) -> Body:
    """Icosahedral quasicrystal in *scaled*, dimensionless units: not a real material.

    Units are ρ, √(μ/ρ) and a length of the user's choice. λ/μ is that of Al-Pd-Mn to 4 %; k4/k5 is
    that of :func:`icosahedral_quasicrystal`, but both are 724 times larger against μ, and the
    phason has the inertia ρ̄ = ρ. Uncoupled, phonons run at 1.7 and 1 and phasons at 0.6 to 1.2; a
    wave of length 1 has a damping ratio η/(2ρ̄ω) near 0.05. Nothing here predicts a metal.

    Args:
        coupling: R as a fraction of its bound √(μk5/3), between −1 and 1.
        viscosity: η, in units of ρ̄ times velocity over length.

    Raises:
        CoercivityError: unless ``|coupling| < 1``.
    """
    family, (k4, k5) = "scaled_icosahedral_quasicrystal", phason_moduli(0.72, -0.37)
    finite(family, {"coupling": coupling})
    require(family, "1 > |coupling|", 1.0, abs(coupling), "Choose a coupling nearer to zero.")
    R, name = coupling * math.sqrt(k5 / 3), "icosahedral quasicrystal (scaled, dimensionless)"
    return icosahedral_quasicrystal(1.0, 1.0, k4, k5, R, 1.0, 1.0, viscosity, name)
