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
two sound waves in 24 directions, |q| = 2.5. P1 on cells of size h has relative errors of ω of some
(qh)²/24, and more where the diagonals of cells mix the two: ``check`` asserts (qh)²/5.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from _snapshots import on_grid, waves

import complexbody as cb
from complexbody.forms import microcracked
from complexbody.meshes import rectangle

HALF, WIDTH, CIRCLE = 6.0, 0.35, 2.5
ANGLES = np.radians(np.arange(0.0, 360.0, 15.0))
DEFAULTS = {"until": 2.8, "every": 0.28, "fields": ("u", "nu"), "integrator": "synchronous"}


def scene(comm: Any, cells: int = 200, angle: float = 30.0) -> cb.Scene:
    """The plate, at rest but for the blow.

    Args:
        comm: Communicator.
        cells: Per side.
        angle: Of the cracks' normal with x [degrees].
    """
    normal = (np.cos(np.radians(angle)), np.sin(np.radians(angle)))
    body = microcracked(
        k0=1.0, k1=0.02, k2=0.02, k2_skew=0.01, k3=0.0, k3_sym=0.0, c1=-0.5, c2=-1.0,
        normal=normal, inertia=0.02, viscosity=0.05, d=2,
    )  # fmt: skip

    def blow(x: Any) -> Any:
        pulse = np.exp(-(x[0] ** 2 + x[1] ** 2) / WIDTH**2)
        return np.stack([0.6 * pulse, pulse])

    mesh = rectangle(comm, (-HALF, -HALF), (HALF, HALF), cells)
    name = f"blow on cracks at {angle:g} degrees (scaled)"
    return cb.Scene(mesh, body, initial=cb.Initial(u_dot=blow), name=name)


def tilt(name: str) -> float:
    """The cracks' angle [degrees], from the name of their scene."""
    return float(name.split(" at ")[1].split()[0])


def sound(exact: Any) -> Any:
    """Branches of the two sound waves (of waves with Re ω > 0 those that decay least)."""
    order = np.argsort(np.where(exact.real > 1e-9, -exact.imag, np.inf), axis=-1)[:, :2]
    speed = np.take_along_axis(exact.real, order, axis=1)
    return np.take_along_axis(order, np.argsort(speed, axis=1), axis=1)


def on_circle(result: cb.Result) -> tuple[Any, Any, Any]:
    """ω of the slow and the fast sound wave, exact and measured, and their shares: (angles, 2)."""
    q = CIRCLE * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
    exact, found, share, _ = waves(result, q)
    chosen = sound(exact)
    one, two, three = (np.take_along_axis(a, chosen, axis=1) for a in (exact, found, share))
    return one, two, three / three.max()


def check(result: cb.Result) -> str:
    """Frequency and decay of sound in all directions against dispersion, to (qh)²/8."""
    exact, found, share = on_circle(result)
    cells = (result.scene.mesh.topology.index_map(2).size_global / 2) ** 0.5
    most, struck = (CIRCLE * 2 * HALF / cells) ** 2 / 5, share > 0.1
    error = (np.abs(found / exact - 1)[struck]).max()
    assert error < most, f"frequencies are off by {error:.2e} of themselves, {most:.2e} expected"
    fast = found.real[:, 1][struck[:, 1]] / CIRCLE
    return (
        f"speeds of {struck.sum()} sound waves within {100 * error:.2f} % of dispersion (at most "
        f"{100 * most:.2f} % expected); the fast one from {fast.min():.3f} to {fast.max():.3f}"
    )


def picture(result: cb.Result, path: Path) -> None:
    """Motion and the opening of cracks, and the speeds of sound by direction; rank 0 draws."""
    import matplotlib

    _, found, share = on_circle(result)
    grid = on_grid(result.u, result.nu)
    if grid is None:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x, y, u, nu = grid
    turn = np.radians(tilt(result.scene.name))
    fine = np.linspace(0, 2 * np.pi, 181)
    q = CIRCLE * np.stack([np.cos(fine), np.sin(fine)], axis=1)
    omega = result.scene.bodies[0].dispersion(q)
    speed = np.take_along_axis(omega, sound(omega), axis=1).real / CIRCLE
    figure = plt.figure(figsize=(13, 4.4), layout="constrained")
    axes = [figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2),
            figure.add_subplot(1, 3, 3, projection="polar")]  # fmt: skip
    opening = nu[..., 0] * np.cos(turn) + nu[..., 1] * np.sin(turn)
    shown = ((np.linalg.norm(u, axis=2), "|u|", "magma"), (opening, "opening m·ν", "RdBu_r"))
    for ax, (values, label, colours) in zip(axes, shown, strict=False):
        top = np.quantile(np.abs(values), 0.999)
        drawn = ax.imshow(values, origin="lower", extent=(x[0], x[-1], y[0], y[-1]), cmap=colours,
                          vmin=0 if colours == "magma" else -top, vmax=top)  # fmt: skip
        figure.colorbar(drawn, ax=ax, label=label, shrink=0.85)
        for place in np.linspace(-4.5, 4.5, 4):  # how the cracks lie, in a corner
            at = np.array([-4.6, 4.6]) + 0.16 * place * np.array([np.cos(turn), np.sin(turn)])
            along = 0.55 * np.array([-np.sin(turn), np.cos(turn)])
            ax.plot(*np.stack([at - along, at + along], axis=1), color="w" if not values.min() < 0
                    else "k", lw=2)  # fmt: skip
        ax.set(xlabel="x", ylabel="y")
    for branch, colour in enumerate(("C0", "C3")):
        axes[2].plot(fine, speed[:, branch], color=colour, lw=1.2)
        struck = share[:, branch] > 0.1
        axes[2].plot(ANGLES[struck], found[struck, branch].real / CIRCLE, "o", ms=4, color=colour)
    axes[2].set_title("speeds of sound by direction:\nlines exact, points measured", fontsize=10)
    axes[2].set(rlim=(0, 1.1 * speed.max()), rticks=(0.5, 1.0, 1.5))
    axes[2].set_rlabel_position(15)
    figure.suptitle(f"Blow on a microcracked plate, t = {result.time:g} (scaled units; cracks "
                    "lie as in the corners)")  # fmt: skip
    figure.savefig(path, dpi=100)
    plt.close(figure)
