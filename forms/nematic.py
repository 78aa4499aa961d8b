# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Nematic order: the director of a liquid crystal, alone or in an elastomer.

*A nematic in the plane* (:func:`nematic_director`): ν = θ [rad], the angle of the director, and

.. math:: \rho e = \tfrac12K|\nabla\theta|^2 + \tfrac12B|\nabla u|^2, \quad
          z^v = \gamma_1\dot\theta,

Frank's energy with one constant. θ relaxes, with −Im ω = Kq²/γ1. Flow is left out, also the
backflow that lowers γ1 in splay and bend. u, one scalar, is coupled with nothing (a body here has
a displacement): B is the liquid's bulk modulus, and in one dimension √(B/ρ) its sound.

*A nematic elastomer* (:func:`nematic_elastomer`): the director is n + ν with n the unit vector of
an axis, ν ⟂ n small, k = 2. With ε = sym ∇u, W = skw ∇u and a = Wn − ν, the rotation of the body
relative to the director,

.. math:: \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2 + \mu|\varepsilon|^2
          + \tfrac12D_1|a|^2 + D_2\,a\cdot\varepsilon n + \tfrac12K|\nabla\nu|^2,

de Gennes' terms D1 and D2, on an isotropic network. εn across n, of length s, costs 2μs² of its
own, so the energy is coercive on (sym U, a, ∇ν) iff μ > 0, 3λ + 2μ > 0, D1 > 0, K > 0 and
4μD1 > D2². At 4μD1 = D2² shear with n in its plane is free: *soft* (Golubović and Lubensky 1989),
refused here. Under a slow strain ν = (D2/D1) εn + Wn, and the shear modulus is μ − D2²/(4D1).
Waves along n: u and ν across n, twice,

.. math:: (\rho\omega^2 - Sq^2)(\bar\rho\omega^2 + i\omega\gamma_1 - Kq^2 - D_1) = T^2q^2, \quad
          S = \mu + \tfrac14D_1 + \tfrac12D_2, \; T = \tfrac12(D_1 + D_2).

Its z^v = γ1ν̇ resists turning of the director in space, not against the body, as it should: so a
rigid rotation is damped, and waves are right where the body turns slowly beside its director.

Sources: de Gennes and Prost, The Physics of Liquid Crystals (1993); de Gennes, in Liquid Crystals
of One- and Two-Dimensional Order (1980); constants (r) recalled, not re-read.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl

from complexbody.body import Body
from complexbody.errors import BodyError
from complexbody.forms._admissible import Energy, finite, require, require_positive

Array = npt.NDArray[Any]


def _director(K: float, B: float) -> Energy:
    """Frank's energy of θ and that of a scalar u, whatever the constants."""

    def energy(U: Any, nu: Any, N: Any) -> Any:
        return 0.5 * K * ufl.inner(N, N) + 0.5 * B * ufl.inner(U, U)

    return energy


def nematic_director(
    K: float = 6e-12, viscosity: float = 0.08, density: float = 1020.0, bulk: float = 2e9,
    inertia: float = 0.0, name: str = "nematic",
) -> Body:  # fmt: skip
    """Director of a nematic in the plane (``displacement=1``, ``descriptor=1``), by default 5CB's.

    Args:
        K: K [N]; 6e-12 (r; 5CB near 25 °C, the mean of splay and bend is nearer 7e-12).
        viscosity: γ1 [Pa·s]; 0.08 (r; the same).
        density: ρ [kg/m³].
        bulk: B [Pa], of u; that of common liquids.
        inertia: ρ̄ [kg/m], of the director: some ρ(1 nm)², never felt.
        name: What to call it.

    Raises:
        CoercivityError: unless K and B are positive.
        BodyError: for constants that are not finite numbers, or masses no body can have.
    """
    constants = finite("nematic_director", {"K": K, "bulk": bulk})
    require_positive("nematic_director", constants, ("K", "bulk"))
    return Body(1, _director(K, bulk), density, inertia, viscosity, displacement=1, name=name,
                constants=constants, parity="axial")  # fmt: skip


def _elastomer(axis: int, lam: float, mu: float, D1: float, D2: float, K: float) -> Energy:
    """The energy of the elastomer as ``f(U, nu, N)``, whatever the constants."""
    across = [i for i in range(3) if i != axis]

    def energy(U: Any, nu: Any, N: Any) -> Any:
        e, turn = ufl.sym(U), ufl.skew(U)
        lag = [turn[i, axis] - nu[p] for p, i in enumerate(across)]
        own = 0.5 * lam * ufl.tr(e) ** 2 + mu * ufl.inner(e, e) + 0.5 * K * ufl.inner(N, N)
        shear = sum(a * e[i, axis] for a, i in zip(lag, across, strict=True))
        return own + 0.5 * D1 * sum(a**2 for a in lag) + D2 * shear

    return energy


def _mirrored(axis: int, mirror: Array) -> Array:
    """What a mirror does to ν: n + ν and −n − ν are one state, so ν⊗n goes as a tensor."""
    across = [i for i in range(3) if i != axis]
    return mirror[axis, axis] * mirror[np.ix_(across, across)]


def nematic_elastomer(
    lam: float = 2.0, mu: float = 1.0, D1: float = 0.5, D2: float = 1.0, K: float = 0.05,
    density: float = 1.0, inertia: float = 0.0, viscosity: float = 0.3, axis: int = 0,
    name: str = "nematic elastomer",
) -> Body:  # fmt: skip
    """Nematic elastomer (``displacement=3``, ``descriptor=2``), by default dimensionless.

    Args:
        lam: λ [Pa].
        mu: μ [Pa].
        D1: D1 [Pa], of a; about μ.
        D2: D2 [Pa], coupling of a and εn; positive where the director turns towards a stretch.
        K: K [N]; √(K/D1) is some 10 nm in real elastomers.
        density: ρ [kg/m³].
        inertia: ρ̄ [kg/m].
        viscosity: γ1 [Pa·s].
        axis: 0, 1 or 2: n; ν has the director's other two components, in order.
        name: What to call it.

    Raises:
        CoercivityError: unless the inequalities above hold.
        BodyError: for constants that are not finite numbers, another axis, or masses no body can
            have.
    """
    family = "nematic_elastomer"
    if isinstance(axis, bool) or axis not in (0, 1, 2):
        raise BodyError(f"{family}: axis is {axis!r}. Give 0, 1 or 2.")
    constants = finite(family, {"lam": lam, "mu": mu, "D1": D1, "D2": D2, "K": K})
    require_positive(family, constants, ("mu", "D1", "K"))
    require(family, "3*lam + 2*mu > 0", 3 * lam + 2 * mu, 0.0, "Choose a larger lam.")
    remedy = f"Choose |D2| < {2 * (mu * D1) ** 0.5:.9g}, or a larger mu or D1."
    require(family, "4*mu*D1 > D2**2", 4 * mu * D1, D2**2, remedy)
    return Body(2, _elastomer(axis, **constants), density, inertia, viscosity, name=name,
                constants=constants, parity=partial(_mirrored, axis))  # fmt: skip
