# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A liquid-crystal cell in a field: the Freedericksz transition, and relaxation when it is off.

5CB between plates d = 50 µm apart (real constants, recalled: see
:func:`complexbody.forms.nematic_director`). ν = θ is the angle of the director with the plates,
which hold it at zero; it has no inertia. A field across the cell turns it, and tilts to either side
cost the same:

.. math:: \rho e = \tfrac12K|\nabla\theta|^2, \qquad \rho w = \tfrac12 f\cos^2\theta, \qquad
          \gamma_1\dot\theta = K\Delta\theta + \tfrac12 f\sin2\theta, \qquad
          f = \Big(\frac H{H_c}\Big)^2 K\frac{\pi^2}{d^2}.

**Exact.** A small tilt ∝ sin(πy/d) cos(kx) grows at the rate (f − Kq²)/γ1, q² = π²/d² + k²: above
the threshold H_c long waves do. Without the field every tilt decays at Kq²/γ1 (τ = 3.4 s for the
longest). Far from walls the grown tilt saturates: with 𝒦 the complete elliptic integral, that of
the middle, θ_m, obeys

.. math:: \mathcal K(\sin\theta_m) = \frac{\pi}{2}\,\frac{H}{H_c}.

Seeded with a tilt of 2 mrad that changes sign along the cell, domains grow with walls between them.
``check`` asserts the rate of growth, the rate of decay without the field (each within 1 %), and θ_m
(within 0.02 rad). Time is stepped explicitly: ν diffuses, and nothing else moves.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from _snapshots import on_grid
from mpi4py import MPI
from scipy.optimize import brentq
from scipy.special import ellipk, ellipkinc

import complexbody as cb
from complexbody.forms import nematic_director
from complexbody.meshes import rectangle

D, LENGTH, SEED = 50e-6, 200e-6, 2e-3
# u is at rest whatever B is; sound is not to dictate the step.
BODY = nematic_director(bulk=1e-6)
K, GAMMA = BODY.constants["K"], BODY.viscosity
Q2 = (np.pi / D) ** 2 + (2 * np.pi / LENGTH) ** 2  # of the seeded tilt
DEFAULTS = {
    "until": 15.0, "every": 1.5, "fields": ("nu",), "integrator": "synchronous",
    "probes": {"middle": (LENGTH / 2, D / 2)},
}  # fmt: skip


def scene(comm: Any, cells: int = 32, field: float = 2.0) -> cb.Scene:
    """The cell, slightly tilted to alternating sides.

    Args:
        comm: Communicator.
        cells: Across the cell; four times as many along it.
        field: H/H_c; 0 is off.
    """
    f = field**2 * K * (np.pi / D) ** 2
    body = dataclasses.replace(BODY, potential=lambda u, nu: 0.5 * f * ufl.cos(nu[0]) ** 2)
    mesh = rectangle(comm, (0.0, 0.0), (LENGTH, D), (4 * cells, cells))
    return cb.Scene(
        mesh, body if field else BODY,
        supports=[cb.Fix("nu", lambda x: (x[1] < 1e-9) | (x[1] > D - 1e-9))],
        initial=cb.Initial(
            nu=lambda x: -SEED * np.sin(np.pi * x[1] / D) * np.cos(2 * np.pi * x[0] / LENGTH)
        ),
        name=f"nematic cell at {field:g} times the threshold" if field else "nematic cell",
    )  # fmt: skip


def saturated(field: float) -> float:
    """θ_m [rad] of the formula above, for fields beyond the threshold."""
    return float(brentq(lambda t: ellipk(np.sin(t) ** 2) - field * np.pi / 2, 1e-6, 1.5707963))


def told_field(result: cb.Result) -> float:
    """H/H_c of a scene, from its body's potential at θ = 0, which is ½f."""
    potential = result.scene.bodies[0].potential
    if potential is None:
        return 0.0
    return float(np.sqrt(2 * float(potential(None, ufl.as_vector([0.0]))) / K) * D / np.pi)


def growth(result: cb.Result) -> float:
    """Rate [1/s] at which a tilt of 2 to 20 mrad grew in the middle; on rank 0."""
    record = result.probes["middle"]
    time, tilt = record["time"], np.abs(record["nu"][:, 0])
    small = (tilt > 1.5 * SEED) & (tilt < 10 * SEED)
    return float(np.polyfit(time[small], np.log(tilt[small]), 1)[0])


def check(result: cb.Result) -> str:
    """Growth, saturation, and decay without the field, against the exact ones."""
    comm, field = result.scene.mesh.comm, told_field(result)
    cells = round((result.scene.mesh.topology.index_map(2).size_global / 8) ** 0.5)
    off, until = scene(comm, cells, 0.0), 1.0 / (K * Q2 / GAMMA)
    relaxed = cb.simulate(off, until=until, progress=False)
    left = comm.allreduce(float(np.abs(relaxed.nu.x.array).max(initial=0.0)), op=MPI.MAX)
    decay, exact = -np.log(left / SEED) / until, K * Q2 / GAMMA
    assert abs(decay / exact - 1) < 0.01, f"decays at {decay:.4f}/s, exactly {exact:.4f}/s"
    told = f"without field decay at {decay:.4f}/s (Kq²/γ1 = {exact:.4f}/s)"
    grows = (field**2 * K * (np.pi / D) ** 2 - K * Q2) / GAMMA
    if grows * result.time < 10:
        return f"{told}; no time for tilts to grow"
    rate, tilt = comm.bcast(
        (growth(result), abs(result.probes["middle"]["nu"][-1, 0])) if comm.rank == 0 else None
    )
    assert abs(rate / grows - 1) < 0.01, f"grows at {rate:.4f}/s, exactly {grows:.4f}/s"
    most = saturated(field)
    assert abs(tilt - most) < 0.02, f"saturates at {tilt:.3f} rad, exactly at {most:.3f}"
    return (
        f"tilt grows at {rate:.4f}/s (exactly {grows:.4f}), to {tilt:.3f} rad in the middle "
        f"({most:.3f}); {told}"
    )


def picture(result: cb.Result, path: Path) -> None:
    """The cell between crossed polarisers, its director, growth and profile; rank 0 draws."""
    import matplotlib

    grid = on_grid(result.nu)
    if grid is None:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x, y, values = 1e6 * grid[0], 1e6 * grid[1], grid[2][..., 0]
    n = len(y)
    figure = plt.figure(figsize=(11, 6.2), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=(1.15, 1))
    ax, (left, right) = top.subplots(), bottom.subplots(1, 2)
    ax.imshow(np.sin(2 * values) ** 2, origin="lower", cmap="magma", interpolation="bicubic",
              extent=(0, 1e6 * LENGTH, 0, 1e6 * D), vmin=0, vmax=1)  # fmt: skip
    every = slice(n // 16, None, n // 8)
    rods = np.cos(values[every, every]), np.sin(values[every, every])
    ax.quiver(x[every], y[every], *rods, color="white", pivot="mid", headwidth=0, headlength=0,
              headaxislength=0, scale=4.0e-1, scale_units="x", width=0.0022)  # fmt: skip
    field, record = told_field(result), result.probes["middle"]
    ax.set(xlabel="x [µm]", ylabel="y [µm]", title=f"5CB at {field:g} H_c, t = {result.time:g} s, "
           "between crossed polarisers (plates at bottom and top)")  # fmt: skip
    time, tilt = record["time"], np.abs(record["nu"][:, 0])
    rate = (field**2 * K * (np.pi / D) ** 2 - K * Q2) / GAMMA
    left.semilogy(time, tilt, lw=2.5, label="tilt in the middle")
    left.semilogy(time, SEED * np.exp(rate * time), "k--", lw=1, label="exact rate of small tilts")
    left.set(xlabel="t [s]", ylabel="θ [rad]", ylim=(SEED / 2, 3))
    right.plot(y, np.abs(values[:, values.shape[1] // 2]), ".", label="across the middle")
    if field > 1:
        most = saturated(field)
        left.axhline(most, color="k", ls=":", lw=1, label="exact saturation")
        angle = np.linspace(0, most, 200)
        phase = np.arcsin(np.clip(np.sin(angle) / np.sin(most), 0, 1))
        depth = 1e6 * D / (np.pi * field) * ellipkinc(phase, np.sin(most) ** 2)
        right.plot(np.r_[depth, 1e6 * D - depth[::-1]], np.r_[angle, angle[::-1]], "k", lw=1,
                   zorder=0, label="exact, far from walls")  # fmt: skip
    right.set(xlabel="y [µm]", ylabel="θ [rad]")
    left.legend(frameon=False)
    right.legend(frameon=False)
    figure.savefig(path, dpi=100)
    plt.close(figure)
