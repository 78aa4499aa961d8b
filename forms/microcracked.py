# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Microcracked bodies: displacement u, descriptor ν the mean jump of u across a family of cracks.

Cracks of one orientation with unit normal m. Turning m round turns the jump round: (m, ν) and
(−m, −ν) are the same state, so that ν⊗m is what the body can feel. Of the isotropic energy of two
fields (:mod:`complexbody.forms.two_field`) that leaves out k3 and k3', zero by default: give them
to cracks whose two faces differ. With ε = sym ∇u, w = ∇ν,

.. math:: \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2 + \mu|\varepsilon|^2
          + \tfrac12k_1(\mathrm{tr}\,w)^2 + k_2|\mathrm{sym}\,w|^2 + k_2'|\mathrm{skw}\,w|^2
          + k_3\,\mathrm{tr}\,\varepsilon\,\mathrm{tr}\,w + k_3'\,\varepsilon:\mathrm{sym}\,w
          + \tfrac12k_0|\nu|^2
          + c_1(m\cdot\nu)\,\mathrm{tr}\,\varepsilon + c_2\,\nu\cdot\varepsilon m,

all that is linear in ν⊗m and in ε and isotropic in both. Cracks of area s per volume whose faces
part by ν take the strain s·sym(ν⊗m) off an elastic body: c1 = −λs and c2 = −2μs. Without m (cracks
of all orientations) such terms are forbidden. In the mirrors of planes that contain m, ν goes as a
vector; the plane across m is no mirror where both the k3 and the c terms are there.

*Coercive* on (sym U, ν, N): first as without cracks. Then ∇ν is eliminated, which leaves the
moduli Λ = λ + 2μ/d − (k3 + k3'/d)²/(k1 + 2k2/d) of volume and G = μ − k3'²/(4k2) of shear; and
then ε, under the stress c1(m·ν)I + c2 sym(ν⊗m): with its trace (dc1 + c2)ν·m, and its deviator of
squared length c2²(1 − 1/d) for ν = m, c2²/2 for ν across m, what is left of ½k0|ν|² is positive iff

* opening: k0 > (c1 + c2/d)²/Λ + c2²(1 − 1/d)/(2G);
* sliding (d > 1): k0 > c2²/(4G).

Waves along m, with (a, k, r, c) = (λ+2μ, k1+2k2, k3+k3', c1+c2) for opening and
(μ, k2+k2', k3'/2, ½c2) for sliding:

.. math:: (\rho\omega^2 - aq^2)(\bar\rho\omega^2 + i\omega\eta - kq^2 - k_0) = (rq^2)^2 + (cq)^2.

Source of the descriptor: Mariano and Stazi, CMAME 190 (2001) 5657 (r: recalled, not re-read); the
coupling, its conditions and waves are derived here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from complexbody.body import Body
from complexbody.errors import BodyError
from complexbody.forms import two_field
from complexbody.forms._admissible import Energy, finite, require


def _energy(d: int, normal: Sequence[float], c1: float, c2: float, **rest: float) -> Energy:
    """The energy above as ``f(U, nu, N)``, whatever the constants."""
    solid = two_field._energy(d, **rest)

    def energy(U: Any, nu: Any, N: Any) -> Any:
        opening = sum(normal[i] * nu[i] for i in range(d))
        trace = sum(U[i, i] for i in range(d))
        pairs = ((i, j) for i in range(d) for j in range(d))
        pull = sum(0.5 * nu[i] * (U[i, j] + U[j, i]) * normal[j] for i, j in pairs)
        return solid(U, nu, N) + c1 * opening * trace + c2 * pull

    return energy


def microcracked(
    lam: float = 1.0, mu: float = 1.0, k0: float = 1.0, k1: float = 0.5, k2: float = 0.5,
    k2_skew: float = 0.25, k3: float = 0.0, k3_sym: float = 0.0, c1: float = -0.3,
    c2: float = -0.6, normal: Sequence[float] | None = None, density: float = 1.0,
    inertia: float = 0.5, viscosity: float = 0.2, d: int = 3, name: str = "microcracked body",
) -> Body:  # fmt: skip
    """Body with cracks of one orientation (``displacement=d``, ``descriptor=d``), dimensionless.

    Args:
        lam: λ [Pa].
        mu: μ [Pa].
        k0: Stiffness of cracks against opening and sliding [Pa/m²].
        k1: k1 [Pa], of ∇ν, as the next two.
        k2: k2 [Pa].
        k2_skew: k2' [Pa].
        k3: k3, coupling of tr ε and tr w [Pa].
        k3_sym: k3', coupling of ε and sym w [Pa].
        c1: c1 [Pa/m]; −λs for cracks of area s per volume.
        c2: c2 [Pa/m]; −2μs.
        normal: m, d components of any length but zero; by default along x1.
        density: ρ [kg/m³].
        inertia: ρ̄ [kg/m³] in χ = ½ρ̄|ν̇|².
        viscosity: η [kg/(m³s)], friction of the faces.
        d: Components of u and ν, 1 to 3; at least the dimension of the mesh.
        name: What to call it.

    Raises:
        CoercivityError: unless the inequalities above hold.
        BodyError: for constants that are not finite numbers, a normal that is none, or masses no
            body can have.
    """
    family = "microcracked"
    solid = {"lam": lam, "mu": mu, "k0": k0, "k1": k1, "k2": k2,
             "k2_skew": k2_skew, "k3": k3, "k3_sym": k3_sym}  # fmt: skip
    constants = two_field.admissible(family, d, solid) | finite(family, {"c1": c1, "c2": c2})
    m = np.eye(d)[0] if normal is None else np.asarray(normal, dtype=float)
    if m.shape != (d,) or not np.isfinite(m).all() or not m.any():
        raise BodyError(f"{family}: normal is {normal!r}. Give {d} numbers, not all zero.")
    m = m / np.linalg.norm(m)
    volume = lam + 2 * mu / d - (k3 + k3_sym / d) ** 2 / (k1 + 2 * k2 / d)
    need = (c1 + c2 / d) ** 2 / volume
    if d > 1:
        shear = mu - k3_sym**2 / (4 * k2)
        need += c2**2 * (1 - 1 / d) / (2 * shear)
        sliding = c2**2 / (4 * shear)
        remedy = f"Choose k0 > {max(sliding, need):.9g}, or a smaller |c2|."
        require(family, "k0 > c2**2/(4*G)", k0, sliding, remedy)
    remedy = f"Choose k0 > {need:.9g}, or smaller |c1| and |c2|."
    require(family, "k0 > (c1 + c2/d)**2/L + c2**2*(1 - 1/d)/(2*G)", k0, need, remedy)
    return Body(d, _energy(d, m.tolist(), **constants), density, inertia, viscosity,
                displacement=d, name=name, constants=constants, parity="polar")  # fmt: skip
