# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A plate full of parallel microcracks is struck: waves are slow across the cracks.

u, and the mean jump ν across cracks with normal m (:func:`complexbody.forms.microcracked`); units
are *scaled* and belong to no material. Cracks open and slide under a strain, which softens the
plate for waves along m, and rub (η), which damps them.

.. math:: \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2 + \mu|\varepsilon|^2 + \dots
          + \tfrac12k_0|\nu|^2 + c_1(m\cdot\nu)\,\mathrm{tr}\,\varepsilon
          + c_2\,\nu\cdot\varepsilon m, \qquad
          \rho\ddot u = \mathrm{Div}\,P, \quad
          \bar\rho\ddot\nu + \eta\dot\nu = \mathrm{Div}\,S - z.

**Measured.** A blow on a point is a sum of plane waves in all directions, and as long as none has
met an edge each of them goes its own way: with â(q) = ∫(u, ν) e^{−iq·x} dx and its rate, written in
the polarisations a_b of ``body.dispersion(q)``, the coefficient of each is multiplied by
exp(−iω_b(q)t). From the blow and the final state, two snapshots, come frequency and decay of the
two sound waves of all wave vectors: ``check`` compares those on a circle, 24 directions, with
dispersion. The phase of P1 waves of length 2π/q is off by at most (qh)²/8, h the size of cells (its
diagonal is h√2): relative errors of ω are asserted to be below that. The other asserted number is
that of the rest: what all waves together do to â at every other q, |q| ≤ 2 q of the circle.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import complexbody as cb
from complexbody.forms import microcracked
from complexbody.meshes import rectangle

HALF, WIDTH, CIRCLE = 6.0, 0.35, 3.0
ANGLES = np.radians(np.arange(0.0, 360.0, 15.0))
DEFAULTS = {"until": 2.5, "every": 0.25, "fields": ("u", "nu"), "integrator": "synchronous"}


def scene(comm: Any, cells: int = 200, angle: float = 30.0) -> cb.Scene:
    """The plate, at rest but for the blow.

    Args:
        comm: Communicator.
        cells: Per side.
        angle: Of the cracks' normal with x [degrees].
    """
    normal = (np.cos(np.radians(angle)), np.sin(np.radians(angle)))
    body = microcracked(d=2, normal=normal, c1=-0.35, c2=-0.9, k0=1.0, inertia=0.1, viscosity=0.1)

    def blow(x: Any) -> Any:
        pulse = np.exp(-(x[0] ** 2 + x[1] ** 2) / WIDTH**2)
        return np.stack([0.6 * pulse, pulse])

    mesh = rectangle(comm, (-HALF, -HALF), (HALF, HALF), cells)
    initial = cb.Initial(u_dot=blow)
    return cb.Scene(mesh, body, initial=initial, name="blow on a microcracked plate (scaled units)")


def transform(mesh: Any, function: Any, q: Any) -> Any:
    """Σ over nodes of a field times e^{−iq·x}, shape (q, components); collective."""
    space = function.function_space
    owned, size = space.dofmap.index_map.size_local, space.dofmap.index_map_bs
    values = function.x.array[: owned * size].reshape(owned, size)
    return mesh.comm.allreduce(np.exp(-1j * q @ mesh.geometry.x[:owned, :2].T) @ values)


def waves(result: cb.Result, q: Any) -> tuple[Any, Any, Any]:
    """ω of all branches, shape (q, 8): exact, and measured; and how much of â they make."""
    mesh, body, t = result.scene.mesh, result.scene.bodies[0], result.time
    start = cb.simulate(result.scene, until=1e-9 * t, progress=False)  # the blow, on the mesh
    exact, a = body.dispersion(q, polarisations=True)
    modes = np.concatenate([a, -1j * exact[:, None] * a], axis=1)  # of fields and rates
    first, last = (
        np.linalg.solve(modes, np.concatenate(
            [transform(mesh, getattr(r, name), q) for name in ("u", "nu", "u_dot", "nu_dot")],
            axis=1)[..., None])[..., 0]
        for r in (start, result)
    )  # fmt: skip
    ratio = last / (first * np.exp(-1j * exact * t))
    return exact, exact + 1j * np.log(ratio) / t, first


def sound(exact: Any, body: cb.Body) -> Any:
    """Branches of the two sound waves (of waves with Re ω > 0 those that decay least)."""
    order = np.argsort(np.where(exact.real > 1e-9, -exact.imag, np.inf), axis=-1)[:, :2]
    speed = np.take_along_axis(exact.real, order, axis=1)
    return np.take_along_axis(order, np.argsort(speed, axis=1), axis=1)
