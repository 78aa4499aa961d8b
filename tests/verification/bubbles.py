# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Radial motion of one bubble, from Rayleigh's equation alone: no mesh, no body.

ρ(RR̈ + 3Ṙ²/2) = p_g0(R0/R)^{3γ} − p∞ − 4μR0Ṙ/R² − S(R − R0)R0²/R². S [Pa/m] is the pressure of a
surrounding liquid of stiffness K kept from moving, S = 4πnR0²K, with its work taken on 4πR0²ν;
S = 0 is the free bubble. Viscosity is that of a constant coefficient 16πμR0 of Ṙ per bubble.
Energy per 4π: ½ρR³Ṙ² + V(R), dV/dR = −R²(p_g0(R0/R)^{3γ} − p∞) + S R0²(R − R0).
"""

import numpy as np
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

COLLAPSE = 0.914681  # Rayleigh 1917: √(π/6) Γ(5/6)/Γ(4/3)


class Bubble:
    """A bubble of rest radius R0 with its liquid, in any units."""

    def __init__(self, R0, rho, p0, gamma, mu=0.0, S=0.0):
        self.R0, self.rho, self.p0, self.gamma, self.mu, self.S = R0, rho, p0, gamma, mu, S

    def force(self, R):
        """dV/dR."""
        gas = self.p0 * (self.R0 / R) ** (3 * self.gamma) - self.p0
        return -(R**2) * gas + self.S * self.R0**2 * (R - self.R0)

    def V(self, R):
        """Potential energy per 4π of one bubble; not zero at rest."""
        gas = (self.R0 / R) ** (3 * self.gamma) / (self.gamma - 1)
        elastic = 0.5 * self.S * self.R0**2 * (R - self.R0) ** 2
        return self.p0 * R**3 / 3 * (1 + gas) + elastic

    def energy(self, R, rate):
        """The first integral per 4π, constant if mu = 0."""
        return 0.5 * self.rho * R**3 * rate**2 + self.V(R)

    @property
    def frequency(self):
        """Small-amplitude ω, Minnaert's if S = 0."""
        return np.sqrt(3 * self.gamma * self.p0 / self.R0**2 + self.S / self.R0) / np.sqrt(self.rho)

    def turning(self, start):
        """The other radius where Ṙ = 0, for a bubble released from rest at start."""
        f = lambda R: self.V(R) - self.V(start)  # noqa: E731
        step = 2.0 if start < self.R0 else 0.5
        end = self.R0
        while f(end) < 0:
            end *= step
        return brentq(f, *sorted((self.R0, end)), xtol=1e-15 * self.R0, rtol=1e-14)

    def period(self, start):
        """Period after release from rest at start, by quadrature: R = mid − half cos θ."""
        low, high = sorted((start, self.turning(start)))
        x, w = np.polynomial.legendre.leggauss(40)
        mid, half = 0.5 * (low + high), 0.5 * (high - low)

        def slowness(t):
            R = mid - half * np.cos(t)
            # V(low) − V(R) by quadrature of the force: the difference would cancel at the ends
            first = t < np.pi / 2
            width = half * np.sin(0.5 * t if first else 0.5 * (np.pi - t)) ** 2
            nodes = (low + width * (1 + x)) if first else (high - width * (1 + x))
            drop = width * (w @ self.force(nodes)) * (-1 if first else 1)
            return half * np.sin(t) * np.sqrt(0.5 * self.rho * R**3 / drop)

        parts = [
            quad(slowness, a, a + np.pi / 2, epsabs=0, epsrel=1e-11)[0] for a in (0, np.pi / 2)
        ]
        return 2 * sum(parts)

    def trajectory(self, start, times, rate=0.0):
        """R and Ṙ at the given times (increasing, from 0), shape (2, len(times))."""

        def right(t, y):
            R, v = y
            damping = 4 * self.mu * self.R0 * v
            pull = self.force(R) + damping + 1.5 * self.rho * R**2 * v**2
            return [v, -pull / (self.rho * R**3)]

        absolute = 1e-13 * np.array([self.R0, self.R0 * self.frequency])
        span = (0.0, times[-1])
        answer = solve_ivp(right, span, [start, rate], "DOP853", times, rtol=1e-12, atol=absolute)
        assert answer.success
        return answer.y


def collapse_time(R, rho, dp):
    """Rayleigh's time for an empty cavity at rest to close: 0.91468 R√(ρ/dp), by quadrature.

    ½ρR³Ṙ² = dp(Rm³ − R³)/3; with R = Rm(1 − s²), the end s = 0 is regular.
    """

    def slowness(s):
        x = 1 - s**2
        # (1 − x³)/s² = 1 + x + x²
        return 2 * np.sqrt(1.5 * x**3 / (1 + x + x**2))

    return R * np.sqrt(rho / dp) * quad(slowness, 0, 1, epsabs=0, epsrel=1e-12)[0]
