# SPDX-License-Identifier: LGPL-3.0-or-later
r"""One-dimensional hexagonal quasicrystals in antiplane motion: scalar phonon u, scalar phason ν.

The quasi-periodic direction x3 is normal to the plane of the mesh, u = u3 and ν = w3:

.. math:: \rho e = \tfrac12 C_{44}|\nabla u|^2 + \tfrac12 K_2|\nabla\nu|^2
          + R_3\nabla u\cdot\nabla\nu.

Two coupled membranes: coercive iff C44 > 0, K2 > 0 and C44K2 > R3². With ρ̄ = ρ and η = 0 the
waves are the eigenvectors of [[C44, R3], [R3, K2]], each with speed √(eigenvalue/ρ). Antiplane
fields do not vary along x3, so the mesh should be one- or two-dimensional. Constants marked (r) are
recalled from the source, not re-read.
"""

from __future__ import annotations

import math
from typing import Any

import ufl

from complexbody.body import Body
from complexbody.forms._admissible import Energy, finite, require, require_positive
from complexbody.forms.icosahedral import PHASON_MOBILITY


def _energy(C44: float, K2: float, R3: float) -> Energy:
    """The energy above as ``f(U, nu, N)``, whatever the constants; U and N have shape (1, 3)."""

    def energy(U: Any, nu: Any, N: Any) -> Any:
        own = 0.5 * C44 * ufl.inner(U, U) + 0.5 * K2 * ufl.inner(N, N)
        return own + R3 * ufl.inner(U, N)

    return energy


def hexagonal_quasicrystal(
    C44: float = 70.19e9,
    K2: float = 24e9,
    R3: float = 8.846e9,
    density: float = 4186.0,
    inertia: float = 0.0,
    viscosity: float = 1.0 / PHASON_MOBILITY,
    name: str = "1D hexagonal quasicrystal, antiplane",
) -> Body:
    """1D-hexagonal quasicrystal in antiplane motion (``displacement=1``, ``descriptor=1``).

    The defaults are those of published calculations, which borrow them from decagonal Al-Ni-Co: no
    one-dimensional quasicrystal has been measured. The phason's inertia is not known either; ρ̄ = 0
    and η = 1/Γ_w by default, as in :func:`~complexbody.forms.decagonal_quasicrystal`.

    Args:
        C44: Shear modulus of the phonon [Pa]; 70.19e9 (r; of Al-Ni-Co, Chernikov et al. 1998).
        K2: Modulus of the phason in the plane [Pa]; 24e9 (r; of Al-Ni-Co, as in Fan 2011).
        R3: Phonon-phason coupling [Pa]; 8.846e9 (r; customary in calculations, not measured).
        density: ρ [kg/m³]; 4186 (r; of Al-Ni-Co).
        inertia: ρ̄ [kg/m³] in χ = ½ρ̄ν̇².
        viscosity: η = 1/Γ_w [kg/(m³s)].
        name: What to call it.

    Raises:
        CoercivityError: unless C44 > 0, K2 > 0 and C44K2 > R3².
        BodyError: for constants that are not finite numbers, or masses no body can have.
    """
    family = "hexagonal_quasicrystal"
    constants = finite(family, {"C44": C44, "K2": K2, "R3": R3})
    require_positive(family, constants, ("C44", "K2"))
    remedy = f"Choose |R3| < {math.sqrt(C44 * K2):.9g}, or a larger C44 or K2."
    require(family, "C44*K2 > R3**2", C44 * K2, R3**2, remedy)
    energy = _energy(**constants)
    return Body(
        1, energy, density, inertia, viscosity, displacement=1, name=name, constants=constants,
        parity="even",
    )  # fmt: skip
