# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Waves in a decagonal quasicrystal: phonons ring, phasons turn from waves into diffusion.

Al-Ni-Co in the quasi-periodic plane, phonon u and phason ν, with the moduli of
:func:`complexbody.forms.decagonal_quasicrystal`. Only two constants are *scaled*: the phason has
the inertia ρ̄ = ρ and a viscosity η that stops it in τ = ρ̄/η = 0.3 µs (the real one, as far as it
is known, is 10⁸ times larger: no waves at all).

.. math:: \rho\ddot u = \mathrm{Div}\,P, \qquad
          \bar\rho\ddot\nu + \eta\dot\nu = \mathrm{Div}\,S = K_1\Delta\nu + R\,\partial^2u.

**Exact.** With |R| as small as it is, a phason of wave number q obeys ω² + iω/τ = c²q²,
c² = K1/ρ̄. Below q = 1/(2cτ) it only decays, where it is long as Dq² with D = K1/η: diffusion.
Above, it is a wave, with half the damping 1/(2τ) whatever its length: the telegraph equation.
A blob of phason spreads accordingly. The mean square of its distance from where it was is, *with*
R (whose second derivatives ∂₁₁ − ∂₂₂ and ∂₁₂ do not see r²), and K2 (which has no effect inside),

.. math:: \langle r^2\rangle = \langle r^2\rangle_0 + 4D\,[t - \tau(1 - e^{-t/\tau})],

2c²t² at first, as waves, and 4Dt in the end, as heat. Uniform P1 meshes have second differences
that are exact for r², so that only the steps in time change that.

**Measured.** Phonon and phason are struck at a point of a plate. ``check`` asserts ⟨r²⟩ within
10⁻³, and frequency and decay of phonons and phasons in the final state (see ``_snapshots.py``) at
14 wave numbers against ``body.dispersion``, within (qh)²/5 + 10⁻³.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from _snapshots import on_grid, waves

import complexbody as cb
from complexbody.forms import decagonal_quasicrystal
from complexbody.meshes import rectangle

MM = 1e-3
HALF, WIDTH, TAU = 10 * MM, 0.8 * MM, 0.3e-6
ALLOY = decagonal_quasicrystal(
    inertia=4186.0, viscosity=4186.0 / TAU, name="Al-Ni-Co with scaled phason dynamics"
)
D = ALLOY.constants["K1"] / ALLOY.viscosity
TURNS = 1 / (2 * np.sqrt(D * TAU))  # c² = D/τ: the wave number from which phasons are waves
NUMBERS = np.geomspace(80.0, 2000.0, 14)
TOWARDS = np.array([np.cos(0.35), np.sin(0.35)])
DEFAULTS = {"until": 1.05e-6, "every": 1.05e-7, "fields": ("u", "nu"), "integrator": "synchronous"}


def scene(comm: Any, cells: int = 200) -> cb.Scene:
    """The plate, struck in the middle: u gets a velocity, ν a blob.

    Args:
        comm: Communicator.
        cells: Per side.
    """

    def blob(x: Any, along: tuple[float, float], size: float) -> Any:
        pulse = np.exp(-(x[0] ** 2 + x[1] ** 2) / WIDTH**2)
        return size * np.stack([part * pulse for part in along])

    mesh = rectangle(comm, (-HALF, -HALF), (HALF, HALF), cells)
    start = cb.Initial(u_dot=lambda x: blob(x, (1.0, -0.7, 0.0), 1.0),
                       nu=lambda x: blob(x, (1.0, 0.3), 1e-7))  # fmt: skip
    return cb.Scene(mesh, ALLOY, initial=start, name="blow on a decagonal quasicrystal")


def spread(result: cb.Result) -> tuple[float, float]:
    """⟨r²⟩ of ν1 [m²]: of the final state, and exact; collective."""
    mesh, space, t = result.scene.mesh, result.nu.function_space, result.time
    owned = space.dofmap.index_map.size_local
    nu, square = result.nu.x.array[: 2 * owned : 2], (mesh.geometry.x[:owned] ** 2).sum(axis=1)
    found = mesh.comm.allreduce(float(square @ nu)) / mesh.comm.allreduce(float(nu.sum()))
    return found, WIDTH**2 + 4 * D * (t - TAU * (1 - np.exp(-t / TAU)))


def branches(result: cb.Result) -> dict[str, tuple[Any, Any, Any]]:
    """q, ω exact and ω measured, of "phonon" and "phason" branches with Re ω ≥ 0; collective."""
    numbers = NUMBERS[np.abs(NUMBERS / TURNS - 1) > 0.1]  # there two branches are nearly one
    exact, found, share, a = waves(result, numbers[:, None] * TOWARDS)
    size = np.abs(a)
    phason = size[:, 3:].max(axis=1) > size[:, :2].max(axis=1)
    ahead = (exact.real > -1e-6 * np.abs(exact)) & (size[:, 2] < 0.5)  # u3 is at rest
    out = {}
    for name, kind in (("phonon", ~phason), ("phason", phason)):
        row, branch = np.nonzero(kind & ahead)
        struck = share[row, branch] > 0.02 * share[row].max(axis=1)
        row, branch = row[struck], branch[struck]
        out[name] = numbers[row], exact[row, branch], found[row, branch]
    return out


def check(result: cb.Result) -> str:
    """Spreading of the phason, and frequencies and decay of all waves."""
    found, exact = spread(result)
    assert abs(found / exact - 1) < 1e-3, f"⟨r²⟩ is {found:.6g} m², exactly {exact:.6g} m²"
    told = f"phason spreads to ⟨r²⟩ = {1e6 * found:.4f} mm² (exactly {1e6 * exact:.4f})"
    size = 2 * HALF / (result.scene.mesh.topology.index_map(2).size_global / 2) ** 0.5
    for name, (q, omega, measured) in branches(result).items():
        error = np.abs(measured / omega - 1)
        off = error - (q * size) ** 2 / 5
        assert off.max() < 1e-3, f"{name}: ω off by {error} of itself at q = {q}"
        told += f"; ω of {len(q)} {name}s within {100 * error.max():.2f} % of dispersion"
    return told


def picture(result: cb.Result, path: Path) -> None:
    """Rings of phonons, the phason's blob and its front, and dispersion; rank 0 draws."""
    import matplotlib

    measured, grid = branches(result), on_grid(result.u, result.nu)
    if grid is None:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(10.5, 8.6), layout="constrained")
    x, y, u, nu = grid
    extent = 1e3 * np.array([x[0], x[-1], y[0], y[-1]])
    shown = ((1e9 * u[..., 0], "phonon u₁ [nm]"), (1e9 * nu[..., 0], "phason ν₁ [nm]"))
    for ax, (values, label) in zip(axes[0], shown, strict=True):
        top = np.abs(values).max()
        drawn = ax.imshow(values, origin="lower", extent=extent, cmap="RdBu_r", vmin=-top, vmax=top)
        figure.colorbar(drawn, ax=ax, label=label)
        ax.set(xlabel="x [mm]", ylabel="y [mm]")
    fine = np.geomspace(NUMBERS[0] / 1.3, NUMBERS[-1] * 1.2, 400)
    omega, a = ALLOY.dispersion(fine[:, None] * TOWARDS, polarisations=True)
    phason = np.abs(a[:, 3:]).max(axis=1) > np.abs(a[:, :2]).max(axis=1)
    seen = (omega.real > -1e-6 * np.abs(omega)) & (np.abs(a[:, 2]) < 0.5)
    frequency, decay = axes[1]
    for name, kind, colour in (("phonon", ~phason, "C0"), ("phason", phason, "C3")):
        row, branch = np.nonzero(kind & seen)
        curve, (q, _, found) = omega[row, branch], measured[name]
        moving = curve.real > 1e-6 * np.abs(curve)
        frequency.loglog(fine[row][moving], curve.real[moving], ",", color=colour)
        moves = found.real > 1e-2 * np.abs(found)
        frequency.loglog(q[moves], found.real[moves], "o", ms=5, color=colour, label=name)
        if name == "phason":
            decay.loglog(fine[row], -curve.imag, ",", color=colour)
            decay.loglog(q, -found.imag, "o", ms=5, color=colour, label=name)
    decay.loglog(fine, D * fine**2, "k:", lw=1, label="diffusion, Dq²")
    decay.set(ylim=(0.5 * D * NUMBERS[0] ** 2, 3 / TAU))
    for ax, label in ((frequency, "frequency Re ω [rad/s]"), (decay, "decay −Im ω [1/s]")):
        ax.axvline(TURNS, color="0.7", lw=1)
        ax.set(xlabel="wave number q [1/m]", ylabel=label)
        ax.legend(frameon=False)
    figure.suptitle(f"{ALLOY.name}, t = {1e6 * result.time:.2f} µs; fine points exact, dots "
                    "measured")  # fmt: skip
    figure.savefig(path, dpi=90)
    plt.close(figure)
