# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Standing wave of a one-dimensional quasicrystal in antiplane motion, against the exact solution.

Phonon u and phason ν are scalars, both held at zero on the whole boundary of the unit interval or
square. Units are *scaled*: ρ = C44 = side = 1, and K2 = 0.5, R3 = 0.3 belong to no material.

**Equations.** The action is

.. math:: \mathcal A = \int\!\!\int \tfrac12\rho\dot u^2 + \tfrac12\bar\rho\dot\nu^2
          - \tfrac12 C_{44}|\nabla u|^2 - \tfrac12 K_2|\nabla\nu|^2
          - R_3\nabla u\cdot\nabla\nu\,dx\,dt

and δ𝒜 − ∫∫ ην̇ δν dx dt = 0 gives

.. math:: \rho\ddot u = C_{44}\Delta u + R_3\Delta\nu, \qquad
          \bar\rho\ddot\nu + \eta\dot\nu = R_3\Delta u + K_2\Delta\nu.

**Exact solution.** With S = Π sin πx_i, ΔS = −q²S, q² = dim·π², the fields u = a(t)S and ν = b(t)S
solve them if

.. math:: \rho\ddot a = -q^2(C_{44}a + R_3b), \qquad
          \bar\rho\ddot b + \eta\dot b = -q^2(R_3a + K_2b),

which a matrix exponential does. At first a = 1 and b = 0, at rest: coupling alone moves ν.

**Error.** On a uniform mesh of size h, S is a mode of the lumped P1 operator as well, with
q² (1 − (πh)²/12) at least in the place of q²; a step below the critical one undoes some of that. So
phases are wrong by up to ωT(πh)²/24 at the time T, ω being the higher of the frequencies, and P1
interpolates S with an error of up to dim (πh)²/8. The error in L2 relative to the initial u is then

.. math:: (\pi h)^2\left(\frac{\mathrm{dim}}{8} + \frac{\omega T}{24}\right)

at most (for ρ̄ = ρ and any scheme of second order): ``check`` asserts it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from scipy.linalg import expm

import complexbody as cb
from complexbody.errors import SceneError
from complexbody.forms import hexagonal_quasicrystal
from complexbody.meshes import interval, rectangle
from complexbody.picture import Panel, still

DEFAULTS = {"until": 2.0, "every": 0.1, "fields": ("u", "nu"), "integrator": "synchronous"}


def scene(
    comm: Any, cells: int = 64, dim: int = 2, viscosity: float = 0.5, inertia: float = 1.0
) -> cb.Scene:
    """The interval or square with the wave at its widest.

    Args:
        comm: Communicator.
        cells: Per side.
        dim: 1 or 2.
        viscosity: η.
        inertia: ρ̄; 0 makes ν diffuse, if η > 0.
    """
    if dim == 1:
        mesh = interval(comm, 0.0, 1.0, cells)
    elif dim == 2:
        mesh = rectangle(comm, (0.0, 0.0), (1.0, 1.0), cells)
    else:
        raise SceneError(f"standing wave: dim is {dim}, but antiplane motion has 1 or 2 of them.")
    body = hexagonal_quasicrystal(
        C44=1.0, K2=0.5, R3=0.3, density=1.0, inertia=inertia, viscosity=viscosity,
        name="1D hexagonal quasicrystal (scaled)",
    )  # fmt: skip
    return cb.Scene(
        mesh,
        body,
        supports=[cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")],
        initial=cb.Initial(u=lambda x: np.prod(np.sin(np.pi * x[:dim]), axis=0)),
        name=f"standing wave in {dim}D",
    )


def amplitudes(body: cb.Body, dim: int, t: float) -> tuple[float, float]:
    """(a, b) at the time t: the exact solution is u = aS, ν = bS."""
    q2, rho, rho_nu, eta = dim * np.pi**2, body.density, body.inertia, body.viscosity
    C44, K2, R3 = (body.constants[name] for name in ("C44", "K2", "R3"))
    pull = -q2 * np.array([[C44, R3], [R3, K2]])  # on (a, b)
    if rho_nu == 0:  # (a, b, ȧ)
        rate = np.array([[0, 0, 1], [*pull[1] / eta, 0], [*pull[0] / rho, 0]])
    else:  # (a, b, ȧ, ḃ)
        rate = np.zeros((4, 4))
        rate[:2, 2:] = np.eye(2)
        rate[2:, :2] = pull / np.array([[rho], [rho_nu]])
        rate[3, 3] = -eta / rho_nu
    a, b = expm(rate * t)[:2, 0]
    return float(a), float(b)


def relative_error(result: cb.Result) -> float:
    """L2 error of (u, ν) at the end over the L2 norm of the initial u; collective."""
    mesh, body = result.scene.mesh, result.scene.bodies[0]
    dim = mesh.geometry.dim
    x, S = ufl.SpatialCoordinate(mesh), 1.0
    for i in range(dim):
        S *= ufl.sin(np.pi * x[i])
    a, b = amplitudes(body, dim, result.time)
    square = (result.u[0] - a * S) ** 2 + (result.nu[0] - b * S) ** 2
    form = fem.form(square * ufl.dx(domain=mesh, metadata={"quadrature_degree": 6}))
    total = mesh.comm.allreduce(float(fem.assemble_scalar(form)))
    return float(np.sqrt(total * 2**dim))  # ‖S‖² = 2^(−dim)


def bound(result: cb.Result) -> float:
    """The bound of the error from the file's head, (πh)² (dim/8 + ωT/24); collective."""
    mesh, body = result.scene.mesh, result.scene.bodies[0]
    dim, cells = mesh.geometry.dim, mesh.topology.index_map(mesh.topology.dim).size_global
    h = (cells / dim) ** (-1.0 / dim)  # 1 interval or 2 triangles in each cell of the grid
    C44, K2, R3 = (body.constants[name] for name in ("C44", "K2", "R3"))
    omega = np.sqrt(dim * np.linalg.eigvalsh([[C44, R3], [R3, K2]])[1] / body.density) * np.pi
    return float((np.pi * h) ** 2 * (dim / 8 + omega * result.time / 24))


def check(result: cb.Result) -> str:
    """The relative L2 error at the end, below the bound that follows from h²."""
    error, most = relative_error(result), bound(result)
    assert error <= most, f"relative L2 error {error:.2e}, but at most {most:.2e} was expected"
    return f"relative L2 error {error:.2e} at t = {result.time:g} (at most {most:.2e} by theory)"


def picture(result: cb.Result, path: Path) -> None:
    """Both fields at the end."""
    panels = [
        Panel("u", 0, warp=None, label="phonon u", unit=""),
        Panel("nu", 0, warp=None, label="phason ν", unit=""),
    ]
    title = "Standing wave of phonon and phason (scaled units)"
    still(path, {"u": result.u, "nu": result.nu}, panels, title)
