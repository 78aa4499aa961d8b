# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bubbly liquid: body, linear waves, refusals; Rayleigh's bubble against itself and the body."""

from __future__ import annotations

import math

import numpy as np
import pytest
import ufl
from dense import prepared, state, whole
from scipy.optimize import approx_fprime
from verification.bubbles import COLLAPSE, Bubble, collapse_time

import complexbody as cb
from complexbody import meshes
from complexbody.errors import BodyError
from complexbody.forms import bubbly_branches, bubbly_dispersion, bubbly_liquid, minnaert

SCALED = {
    "radius": 0.1,
    "void_fraction": 0.05,
    "density": 1.0,
    "sound_speed": 1.0,
    "pressure": 0.02,
    "gamma": 1.4,
}
N = 3 * 0.05 / (4 * math.pi * 0.1**3)
FREE = Bubble(R0=0.1, rho=1.0, p0=0.02, gamma=1.4)


def vector(*values):
    return ufl.as_vector([ufl.as_ufl(float(v)) for v in values])


@pytest.mark.serial
def test_body_is_n_bubbles():
    """χ and w are n times the kinetic energy and the potential of Rayleigh's bubble."""
    body = bubbly_liquid(**SCALED, d=1)
    for R, rate in ((0.06, 0.3), (0.1, -1.0), (0.17, 0.2)):
        chi = float(body.inertia(vector(R - 0.1), vector(rate)))
        w = float(body.potential(vector(0.0), vector(R - 0.1)))
        assert chi + w == pytest.approx(4 * math.pi * N * FREE.energy(R, rate), rel=1e-13)


@pytest.mark.serial
def test_linearised_is_the_second_order():
    """w = w(0) + ½w''ν² + O(ν³), χ = ½mν̇² at ν = 0: the remainder falls eightfold."""
    full, linear = bubbly_liquid(**SCALED), bubbly_liquid(**SCALED, linearised=True)
    w = lambda body, x: float(body.potential(vector(0, 0, 0), vector(x)))  # noqa: E731
    rest = [w(full, x) - w(full, 0.0) - w(linear, x) for x in (2e-3, 1e-3)]
    assert rest[0] / rest[1] == pytest.approx(8, rel=0.05)
    chi = float(full.inertia(vector(0.0), vector(0.7)))
    assert chi == pytest.approx(0.5 * linear.inertia * 0.49, rel=1e-14)


@pytest.mark.serial
@pytest.mark.parametrize("viscosity", [0.0, 0.003])
def test_dispersion_is_the_bodys(viscosity, value, hessian):
    """det(K(q) − iωD − ω²M) = 0 of the linearised body in 3D; Commander-Prosperetti's form."""
    body = bubbly_liquid(**SCALED, viscosity=viscosity, linearised=True)
    e = lambda g, v: value(body.energy, np.diag([g, 0, 0]), [v], np.zeros((1, 3)))  # noqa: E731
    uu, nn = 2 * e(1, 0), 2 * e(0, 1) + 2 * float(body.potential(vector(0, 0, 0), vector(1)))
    un = e(1, 1) - e(1, 0) - e(0, 1)
    for omega in (0.5, 2.0, 3.1, 7.0):
        q2 = complex(bubbly_dispersion(omega, **SCALED, viscosity=viscosity))
        a = uu * q2 - body.density * omega**2
        b = nn - 1j * omega * body.viscosity - omega**2 * body.inertia
        assert abs(a * b - un**2 * q2) < 1e-12 * (abs(a * b) + abs(un**2 * q2))
        damping = 1j * omega * 4 * viscosity / 0.1**2
        form = 1 + 4 * math.pi * N * 0.1 / (3 * 1.4 * 0.02 / 0.1**2 - omega**2 - damping)
        assert q2 == pytest.approx(omega**2 * form, rel=1e-12)
        assert q2.imag > 0 or viscosity == 0


@pytest.mark.serial
def test_branches():
    """They invert the dispersion; low is Wood's speed, the gap's edges ω0² and ω0² + 4πnR0c²."""
    for q in (0.01, 1.0, 3.0, 40.0):
        for omega in bubbly_branches(q, **SCALED):
            assert bubbly_dispersion(omega, **SCALED) == pytest.approx(q**2, rel=1e-9)
    low, high = bubbly_branches(1e-6, **SCALED)
    assert low / 1e-6 == pytest.approx((1 + 0.05 / (1.4 * 0.02)) ** -0.5, rel=1e-9)
    own = minnaert(0.1, 1.0, 0.02, 1.4)
    assert high**2 == pytest.approx(own**2 + 4 * math.pi * N * 0.1, rel=1e-9)
    assert bubbly_branches(1e5, **SCALED)[0] == pytest.approx(own, rel=1e-6)
    # Minnaert's air bubble in water: 3.28 kHz at 1 mm
    assert minnaert() / (2 * math.pi) == pytest.approx(3283, rel=1e-3)


@pytest.mark.parametrize("branch", [0, 1])
def test_standing_wave(comm, branch):
    """Fixed ends, u ∝ sin qx, ν ∝ cos qx: each branch keeps its frequency, error of order 2."""
    body = bubbly_liquid(**SCALED, d=1, linearised=True)
    q, a = math.pi, 4 * math.pi * N * 0.1**2
    omega = float(bubbly_branches(q, **SCALED)[branch])
    stiff = 12 * math.pi * N * 1.4 * 0.02 * 0.1 - body.inertia * omega**2
    ratio = a * q / (stiff + a**2)
    errors = []
    for cells in (16, 32):
        scene = cb.Scene(
            meshes.interval(comm, 0, 1, cells),
            body,
            [cb.Fix("u", "boundary")],
            initial=cb.Initial(lambda x: np.sin(q * x[:1]), lambda x: ratio * np.cos(q * x[:1])),
        )
        run = prepared(scene, cb.Synchronous(0.32 / cells))
        run.advance(5 * cells)
        x = whole(scene.mesh)[0][:, 0]
        exact = np.cos(omega * run.time) * np.array([np.sin(q * x), ratio * np.cos(q * x)]).T
        errors.append(abs((state(run)[0] - exact) / [1, ratio]).max())
    assert errors[1] < 0.02
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("name", "inside", "outside"),
    [
        ("void_fraction", 1e-9, 0.0),
        ("void_fraction", 1 - 1e-9, 1.0),
        ("gamma", 1 + 1e-9, 1.0),
        ("viscosity", 0.0, -1e-9),
        ("radius", 1e-9, 0.0),
        ("density", 1e-9, 0.0),
        ("sound_speed", 1e-9, 0.0),
        ("pressure", 1e-9, 0.0),
        ("d", 3, 4),
        ("d", 1, 0),
    ],
)
def test_refused_at_the_boundary(name, inside, outside):
    """The last value inside is accepted, the first outside refused by name; NaN too."""
    bubbly_liquid(**{name: inside})
    for bad in (outside, math.nan):
        with pytest.raises(BodyError, match=rf"\b{name}\b"):
            bubbly_liquid(**{name: bad})


@pytest.mark.serial
@pytest.mark.parametrize("S", [0.0, 0.3])
@pytest.mark.parametrize("start", [0.06, 0.0999, 0.14, 0.2])
def test_reference_period(start, S):
    """Quadrature against the trajectory after one period; the first integral on the way."""
    bubble = Bubble(0.1, 1.0, 0.02, 1.4, S=S)
    period = bubble.period(start)
    R, rate = bubble.trajectory(start, np.linspace(0, period, 9))
    assert R[-1] == pytest.approx(start, rel=1e-9)
    assert abs(rate[-1]) < 1e-7 * 0.1 * bubble.frequency
    assert R[4] == pytest.approx(bubble.turning(start), rel=1e-9)
    depth = bubble.V(start) - bubble.V(0.1)
    assert abs(bubble.energy(R, rate) - bubble.V(start)).max() < 1e-9 * depth
    slope = approx_fprime(np.array([start]), lambda r: bubble.V(r[0]), 1e-8)[0]
    assert slope == pytest.approx(bubble.force(start), rel=1e-3, abs=1e-9)


@pytest.mark.serial
def test_reference_limits():
    """Minnaert's period as the amplitude vanishes, to order 2; Rayleigh's collapse time."""
    assert FREE.frequency == pytest.approx(minnaert(0.1, 1.0, 0.02, 1.4), rel=1e-14)
    excess = [FREE.period(0.1 + x) * FREE.frequency / (2 * np.pi) - 1 for x in (2e-3, 1e-3)]
    assert excess[0] / excess[1] == pytest.approx(4, rel=0.1)
    exact = math.sqrt(math.pi / 6) * math.gamma(5 / 6) / math.gamma(4 / 3)
    assert exact == pytest.approx(COLLAPSE, abs=1e-6)
    assert collapse_time(0.2, 3.0, 7.0) == pytest.approx(exact * 0.2 * math.sqrt(3 / 7), rel=1e-11)


@pytest.mark.serial
def test_reference_damping():
    """A small oscillation decays with rate η/(2m) = 2μ/(ρR0²)."""
    bubble = Bubble(0.1, 1.0, 0.02, 1.4, mu=2e-4)
    body = bubbly_liquid(**SCALED, viscosity=2e-4, linearised=True)
    rate = 0.5 * body.viscosity / body.inertia
    omega = math.sqrt(bubble.frequency**2 - rate**2)
    t = 6 * math.pi / omega
    R, _ = bubble.trajectory(0.1 + 1e-7, [0.0, t])
    assert (R[-1] - 0.1) / 1e-7 == pytest.approx(math.exp(-rate * t), rel=1e-4)
