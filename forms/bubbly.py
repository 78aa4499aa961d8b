# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Bubbly liquid: displacement u of the mixture, descriptor ν = R − R0 [m] of n bubbles per volume.

With a = 4πnR0², R = R0 + ν and K = ρ_l c²,

.. math::

    \chi = 2\pi n\rho_l R^3\dot\nu^2, \qquad
    w = \tfrac43\pi nR^3\Big[p_0 + \frac{p_0}{\gamma-1}\Big(\frac{R_0}{R}\Big)^{3\gamma}\Big],
    \qquad \rho e = \tfrac12 K(\mathrm{div}\,u - a\nu)^2, \qquad \eta = 16\pi n\mu R_0.

χ is the kinetic energy of the liquid around n spheres, w the work against the pressure p∞ and the
energy of the gas; both pressures are p0, since ν = 0 is at rest only then (no surface tension). For
u = 0 and K = 0 this is Rayleigh's equation ρ_l(RR̈ + 3Ṙ²/2) = p_gas − p0; in it viscosity is
−4μṘ/R, a force 16πμRṘ per bubble, of which η is the value at R0. The void in the liquid's volume
is linear in ν, as in the linear theory: at large ν the exact (4/3)πn(R³ − R0³) differs from aν.

Linear waves: with m = 4πnρ_lR0³ and w'' = 12πnγp0R0, u along q and both ∝ e^{i(qx − ωt)},

.. math::

    -\rho\omega^2\,\mathrm{div}\,u = -Kq^2(\mathrm{div}\,u - a\nu), \qquad
    (w'' - m\omega^2 - i\omega\eta)\,\nu = Ka(\mathrm{div}\,u - a\nu),

so that, exactly, q²/ω² = ρ/K + ρa²/(w'' − mω² − iωη). The body's ρ is ρ_l, and this is

.. math::

    \frac{q^2}{\omega^2} = \frac1{c^2}
        + \frac{4\pi nR_0}{\omega_0^2 - \omega^2 - i\omega\,4\mu/(\rho_lR_0^2)},
    \qquad \omega_0^2 = \frac{3\gamma p_0}{\rho_lR_0^2}.

Ka² shifts neither ω0 nor any other term of it: it is the gap's upper edge ω0² + 4πnR0c², where
q = 0 and where bubbles in a liquid at rest as a whole oscillate. e alone does not see div u = aν,
but w holds that mode. Nothing holds shear: transverse motions have no frequency, and a scene in
two or three dimensions warns of them. Left out: heat, radiation by a single bubble, surface
tension.

Sources (recalled, not re-read): Minnaert 1933; Caflisch, Miksis, Papanicolaou and Ting 1985;
Commander and Prosperetti 1989.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.body import Body
from complexbody.errors import BodyError
from complexbody.forms._admissible import finite

Array = npt.NDArray[Any]


def _require(family: str, condition: str, holds: bool, value: float, remedy: str) -> None:
    """BodyError unless the condition holds."""
    if not holds:
        raise BodyError(f"{family}: {condition} does not hold (it is {value!r}). {remedy}")


def _checked(family: str, **constants: Any) -> dict[str, float]:
    """The constants as floats, in the ranges a bubbly liquid can have."""
    values = finite(family, constants)
    for name, value in values.items():
        if name == "gamma":
            remedy = "Give a ratio of heats above 1; 1.001 is near enough to isothermal."
            _require(family, "gamma > 1", value > 1, value, remedy)
        elif name == "void_fraction":
            remedy = "Give the share of gas in the volume, such as 1e-3."
            _require(family, "0 < void_fraction < 1", 0 < value < 1, value, remedy)
        elif name == "viscosity":
            _require(family, "viscosity >= 0", value >= 0, value, "Give zero or more.")
        else:
            _require(family, f"{name} > 0", value > 0, value, f"Give {name} a positive value.")
    return values


def number_density(radius: float, void_fraction: float) -> float:
    """n = 3β/(4πR0³) [1/m³], bubbles of the given radius [m] per volume."""
    return 3 * void_fraction / (4 * math.pi * radius**3)


def minnaert(
    radius: float = 1e-3, density: float = 1000.0, pressure: float = 101325.0, gamma: float = 1.4
) -> float:
    """ω0 = √(3γp0/ρ_l)/R0 [rad/s], the frequency of a free bubble (Minnaert 1933).

    Args:
        radius: R0 [m].
        density: ρ_l [kg/m³].
        pressure: p0 [Pa].
        gamma: γ of the gas.

    Raises:
        BodyError: unless the first three are positive and γ > 1.
    """
    _checked("minnaert", radius=radius, density=density, pressure=pressure, gamma=gamma)
    return math.sqrt(3 * gamma * pressure / density) / radius


def bubbly_liquid(
    radius: float = 1e-3,
    void_fraction: float = 1e-3,
    density: float = 1000.0,
    sound_speed: float = 1482.0,
    pressure: float = 101325.0,
    gamma: float = 1.4,
    viscosity: float = 0.0,
    d: int = 3,
    linearised: bool = False,
    name: str = "bubbly liquid",
) -> Body:
    """Bubbly liquid, by default air in water (``displacement=d``, ``descriptor=1``).

    Its χ depends on ν, which explicit integrators do not take; with ``linearised=True`` χ is
    ½mν̇² and w is ½w''ν², with m = 4πnρ_lR0³ and w'' = 12πnγp0R0: the body of the linear waves.

    Args:
        radius: R0 [m].
        void_fraction: β, which gives n = 3β/(4πR0³).
        density: ρ_l [kg/m³], also the mixture's ρ.
        sound_speed: c [m/s] of the pure liquid, K = ρ_l c².
        pressure: p0 [Pa], at rest, in the liquid as in the gas.
        gamma: γ of the gas.
        viscosity: μ [Pa·s] of the liquid; η = 16πnμR0 [kg/(m³s)]. Water has 1e-3.
        d: Number of components of u, 1 to 3; at least the dimension of the mesh.
        linearised: Whether χ and w are replaced by their quadratic parts.
        name: What to call it.

    Raises:
        BodyError: unless 0 < β < 1, γ > 1, μ ≥ 0, d is 1, 2 or 3 and all others are positive.
    """
    family = "bubbly_liquid"
    if isinstance(d, bool) or d not in (1, 2, 3):
        raise BodyError(f"{family}: d is {d!r}, not a dimension. Give d=1, 2 or 3.")
    constants = _checked(
        family,
        radius=radius,
        void_fraction=void_fraction,
        density=density,
        sound_speed=sound_speed,
        pressure=pressure,
        gamma=gamma,
        viscosity=viscosity,
    )
    n = number_density(radius, void_fraction)
    a, K = 4 * math.pi * n * radius**2, density * sound_speed**2

    def energy(U: Any, nu: Any, N: Any) -> Any:
        return 0.5 * K * (sum(U[i, i] for i in range(d)) - a * nu[0]) ** 2

    def chi(nu: Any, nu_dot: Any) -> Any:
        return 2 * math.pi * n * density * (radius + nu[0]) ** 3 * nu_dot[0] ** 2

    def potential(u: Any, nu: Any) -> Any:
        R = radius + nu[0]
        gas = (radius / R) ** (3 * gamma) / (gamma - 1)
        return 4 / 3 * math.pi * n * pressure * R**3 * (1 + gas)

    def quadratic(u: Any, nu: Any) -> Any:
        return 6 * math.pi * n * gamma * pressure * radius * nu[0] ** 2

    return Body(
        1,
        energy,
        density,
        4 * math.pi * n * density * radius**3 if linearised else chi,
        16 * math.pi * n * viscosity * radius,
        quadratic if linearised else potential,
        displacement=d,
        name=name,
        constants=constants,
        parity="even",
    )


def bubbly_dispersion(
    omega: Any,
    radius: float = 1e-3,
    void_fraction: float = 1e-3,
    density: float = 1000.0,
    sound_speed: float = 1482.0,
    pressure: float = 101325.0,
    gamma: float = 1.4,
    viscosity: float = 0.0,
) -> Array:
    """q² [1/m²] of the body's longitudinal waves e^{i(qx − ωt)}, the relation at the top.

    Args:
        omega: ω [rad/s], a number or an array.
        radius: R0 [m].
        void_fraction: β.
        density: ρ_l [kg/m³].
        sound_speed: c [m/s] of the pure liquid.
        pressure: p0 [Pa].
        gamma: γ of the gas.
        viscosity: μ [Pa·s] of the liquid.

    Returns:
        q² in the shape of ω: real if μ = 0 and ω is real (negative where nothing propagates),
        else complex, of positive imaginary part for ω > 0. Infinite at ω0 if μ = 0.

    Raises:
        BodyError: as in :func:`bubbly_liquid`.
    """
    _checked(
        "bubbly_dispersion",
        radius=radius,
        void_fraction=void_fraction,
        density=density,
        sound_speed=sound_speed,
        pressure=pressure,
        gamma=gamma,
        viscosity=viscosity,
    )
    w = np.asarray(omega)
    strength = 4 * math.pi * number_density(radius, void_fraction) * radius
    gap = minnaert(radius, density, pressure, gamma) ** 2 - w**2
    if viscosity > 0:
        gap = gap - 1j * w * 4 * viscosity / (density * radius**2)
    with np.errstate(divide="ignore"):
        return np.asarray(w**2 * (1 / sound_speed**2 + strength / gap))


def bubbly_branches(
    q: Any,
    radius: float = 1e-3,
    void_fraction: float = 1e-3,
    density: float = 1000.0,
    sound_speed: float = 1482.0,
    pressure: float = 101325.0,
    gamma: float = 1.4,
) -> tuple[Array, Array]:
    """The two undamped frequencies [rad/s] at wave number q [1/m], below and above the gap.

    The roots of ω⁴ − ω²(ω0² + 4πnR0c² + q²c²) + q²c²ω0² = 0, the relation at the top solved for ω.

    Args:
        q: Wave number, a number or an array.
        radius: R0 [m].
        void_fraction: β.
        density: ρ_l [kg/m³].
        sound_speed: c [m/s] of the pure liquid.
        pressure: p0 [Pa].
        gamma: γ of the gas.

    Returns:
        Both in the shape of q.

    Raises:
        BodyError: as in :func:`bubbly_liquid`.
    """
    _checked(
        "bubbly_branches",
        radius=radius,
        void_fraction=void_fraction,
        density=density,
        sound_speed=sound_speed,
        pressure=pressure,
        gamma=gamma,
    )
    strength = 4 * math.pi * number_density(radius, void_fraction) * radius
    own, wave = minnaert(radius, density, pressure, gamma) ** 2, (np.asarray(q) * sound_speed) ** 2
    total = own + strength * sound_speed**2 + wave
    upper = 0.5 * (total + np.sqrt(total**2 - 4 * own * wave))
    # from the product of the roots: their difference would cancel at small q
    return np.sqrt(own * wave / upper), np.sqrt(upper)
