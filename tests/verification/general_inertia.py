# SPDX-License-Identifier: LGPL-3.0-or-later
"""Small scenes whose inertia depends on the state, χ(ν, ν̇)."""

import dolfinx
import numpy as np
import ufl
from verification.bubbles import Bubble

import complexbody as cb
from complexbody.forms import bubbly_liquid
from complexbody.forms.bubbly import number_density


def line(comm, cells=4):
    """A unit interval."""
    return dolfinx.mesh.create_interval(comm, cells, [0.0, 1.0])


def stretching(U, nu, N):
    """½(u'² + |∇ν|²)."""
    return 0.5 * (ufl.inner(U, U) + ufl.inner(N, N))


def powers(comm):
    """½ν³ν̇² and a potential in which y = ν^{5/2} oscillates linearly (first integral)."""
    body = cb.Body(
        1, stretching, 1.0, lambda nu, v: 0.5 * nu[0] ** 3 * v[0] ** 2, displacement=1,
        potential=lambda u, nu: 0.32 * (nu[0] ** 2.5 - 1) ** 2,
    )  # fmt: skip
    return cb.Scene(line(comm), body, initial=cb.Initial(nu=1.5**0.4))


def collapsing(comm, potential=lambda u, nu: 2.0 * nu[0]):
    """A bubble that nothing holds: ν falls to zero, where its inertia ½ν³ν̇² ends."""
    body = cb.Body(
        1, lambda U, nu, N: 0.5 * ufl.inner(U, U) + 0.01 * ufl.inner(N, N), 1.0,
        lambda nu, v: 0.5 * nu[0] ** 3 * v[0] ** 2, displacement=1, potential=potential,
    )  # fmt: skip
    return cb.Scene(line(comm), body, initial=cb.Initial(nu=1.0))


def bubble(comm, stretch):
    """Bubbles in liquid that is held, released from rest at R = stretch R0, and one alone."""
    body = bubbly_liquid(void_fraction=1e-6, sound_speed=150.0, d=1)
    scene = cb.Scene(
        line(comm, 2), body, supports=[cb.Fix("u", "boundary"), cb.Fix("u", lambda x: x[0] < 2)],
        initial=cb.Initial(nu=1e-3 * (stretch - 1)),
    )  # fmt: skip
    c, n = body.constants, number_density(1e-3, 1e-6)
    S = 4 * np.pi * n * 1e-6 * c["density"] * c["sound_speed"] ** 2
    return scene, Bubble(1e-3, c["density"], c["pressure"], c["gamma"], S=S)
