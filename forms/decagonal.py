# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Decagonal quasicrystals, Laue class 10mm: phonon u (three components), phason ν (two).

The ten-fold axis is x3; the plane of quasi-periodicity is (x1, x2). With ε = sym ∇u and w = ∇ν
(w_ij = ∂_jν_i, i = 1, 2),

.. math::

    \rho e = \tfrac12 C_{11}(\varepsilon_{11}^2 + \varepsilon_{22}^2)
           + C_{12}\varepsilon_{11}\varepsilon_{22} + (C_{11} - C_{12})\varepsilon_{12}^2
           + \tfrac12 C_{33}\varepsilon_{33}^2
           + C_{13}(\varepsilon_{11} + \varepsilon_{22})\varepsilon_{33}
           + 2C_{44}(\varepsilon_{13}^2 + \varepsilon_{23}^2)

           + \tfrac12 K_1(w_{11}^2 + w_{12}^2 + w_{21}^2 + w_{22}^2)
           + K_2(w_{11}w_{22} - w_{12}w_{21}) + \tfrac12 K_3(w_{13}^2 + w_{23}^2)

           + R[(\varepsilon_{11} - \varepsilon_{22})(w_{11} + w_{22})
           + 2\varepsilon_{12}(w_{21} - w_{12})].

Where nothing depends on x3 and u3 = 0 this is ½L(tr ε)² + M|ε|² + … with L = C12 and
M = (C11 − C12)/2. A rotation by θ about x3 turns ν by 3θ; the energy is invariant for every θ.

*K2 is a null Lagrangian*, in three dimensions too: w11w22 − w12w21 = ∂1(ν1∂2ν2) − ∂2(ν1∂1ν2) is a
divergence, so a constant K2 exerts no force inside the body. It acts where ν is free (a boundary)
and where K2 jumps, and it does enter the coercivity of the density.

Coercive on (sym U, N) iff C11 > C12, C44 > 0, C33 > 0, (C11 + C12)C33 > 2C13², K3 > 0, K1 > |K2|
and M(K1 + K2) > 2R². Constants marked (r) are recalled from the source, not re-read.
"""

from __future__ import annotations

import math
from typing import Any

import ufl

from complexbody.body import Body
from complexbody.forms._admissible import Energy, finite, require, require_positive
from complexbody.forms.icosahedral import PHASON_MOBILITY


def _energy(
    C11: float,
    C12: float,
    C13: float,
    C33: float,
    C44: float,
    K1: float,
    K2: float,
    K3: float,
    R: float,
) -> Energy:
    """The energy above as ``f(U, nu, N)``, whatever the constants."""

    def energy(U: Any, nu: Any, N: Any) -> Any:
        e, w = ufl.sym(U), N
        phonon = (
            0.5 * C11 * (e[0, 0] ** 2 + e[1, 1] ** 2)
            + C12 * e[0, 0] * e[1, 1]
            + (C11 - C12) * e[0, 1] ** 2
            + 0.5 * C33 * e[2, 2] ** 2
            + C13 * (e[0, 0] + e[1, 1]) * e[2, 2]
            + 2.0 * C44 * (e[0, 2] ** 2 + e[1, 2] ** 2)
        )
        phason = (
            0.5 * K1 * (w[0, 0] ** 2 + w[0, 1] ** 2 + w[1, 0] ** 2 + w[1, 1] ** 2)
            + K2 * (w[0, 0] * w[1, 1] - w[0, 1] * w[1, 0])
            + 0.5 * K3 * (w[0, 2] ** 2 + w[1, 2] ** 2)
        )
        coupling = (e[0, 0] - e[1, 1]) * (w[0, 0] + w[1, 1]) + 2.0 * e[0, 1] * (w[1, 0] - w[0, 1])
        return phonon + phason + R * coupling

    return energy


def decagonal_quasicrystal(
    C11: float = 234.33e9,
    C12: float = 57.41e9,
    C13: float = 66.63e9,
    C33: float = 232.22e9,
    C44: float = 70.19e9,
    K1: float = 122e9,
    K2: float = 24e9,
    K3: float = 12e9,
    R: float = -1.1e9,
    density: float = 4186.0,
    inertia: float = 0.0,
    viscosity: float = 1.0 / PHASON_MOBILITY,
    name: str = "decagonal quasicrystal",
) -> Body:
    """Decagonal quasicrystal; the defaults are Al-Ni-Co.

    The phason has no measured inertia and relaxes diffusively: ρ̄ = 0 and η = 1/Γ_w by default, with
    the Γ_w of Al-Pd-Mn for want of another (as Fan does). K1/η is then 6e-8 m²/s, and only
    ``inertia`` > 0 with a small ``viscosity`` makes waves of it: a scaled body then, not Al-Ni-Co.

    Args:
        C11: [Pa]; 234.33e9 (r; resonant ultrasound, Chernikov et al. 1998), like the next four.
        C12: L of the plane problem [Pa]; 57.41e9 (r), so that M = (C11 − C12)/2 = 88.46e9.
        C13: [Pa]; 66.63e9 (r).
        C33: Along the ten-fold axis [Pa]; 232.22e9 (r).
        C44: Shear across it [Pa]; 70.19e9 (r).
        K1: Phason modulus [Pa]; 122e9 (r; a simulation, Jeong and Steinhardt 1993, as in Fan 2011:
            a thousand times what is measured in icosahedral alloys).
        K2: Phason modulus of det w, a null Lagrangian [Pa]; 24e9 (r; the same).
        K3: Phason modulus along the ten-fold axis [Pa]; no measurement known to us. 12e9 (r) is
            what calculations of layered plates take (some call it K4).
        R: Phonon-phason coupling [Pa]; −1.1e9 (r; Edagawa 2007).
        density: ρ [kg/m³]; 4186 (r).
        inertia: ρ̄ [kg/m³] in χ = ½ρ̄|ν̇|².
        viscosity: η = 1/Γ_w [kg/(m³s)].
        name: What to call it.

    Raises:
        CoercivityError: unless the inequalities above hold.
        BodyError: for constants that are not finite numbers, or masses no body can have.
    """
    family = "decagonal_quasicrystal"
    phonon = {"C11": C11, "C12": C12, "C13": C13, "C33": C33, "C44": C44}
    constants = finite(family, {**phonon, "K1": K1, "K2": K2, "K3": K3, "R": R})
    require_positive(family, constants, ("C33", "C44", "K3"))
    require(family, "C11 > C12", C11, C12, "Choose a smaller C12 or a larger C11.")
    bulk, remedy = (C11 + C12) * C33, "Choose a smaller |C13|, or a larger C11 + C12."
    require(family, "(C11 + C12)*C33 > 2*C13**2", bulk, 2 * C13**2, remedy)
    require(family, "K1 > |K2|", K1, abs(K2), "Choose a larger K1 or a smaller |K2|.")
    M = (C11 - C12) / 2
    remedy = f"Choose |R| < {math.sqrt(M * (K1 + K2) / 2):.9g}, or a larger K1 + K2."
    require(family, "(C11 - C12)/2*(K1 + K2) > 2*R**2", M * (K1 + K2), 2 * R**2, remedy)
    energy = _energy(**constants)
    return Body(
        2, energy, density, inertia, viscosity, name=name, constants=constants, parity="polar"
    )
