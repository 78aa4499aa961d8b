# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A body of your own in 25 lines: a kink runs through a crystal and carries a strain along.

ν is how far a row of atoms has slipped over its substrate, in the crystal's stiff bar: every 2π the
row fits again (Frenkel and Kontorova's dislocation), and where it does not the bar swells. Units
are scaled: masses, the row's stiffness and the depth of its wells are 1.

.. math:: \rho e = \tfrac12 E u'^2 + \tfrac12\nu'^2 + g\,u'(1 - \cos\nu), \qquad
          \rho w = 1 - \cos\nu, \qquad \chi = \tfrac12\dot\nu^2,

.. math:: \ddot u = (Eu' + g(1 - \cos\nu))', \qquad \ddot\nu = \nu'' - (1 + g\,u')\sin\nu.

That is all: no force, no mass, no stable step is written below. None of it is quadratic.

**Exact.** In a wave that runs with speed v, ξ = x − vt, the first equation gives
(E − v²) u' = −g(1 − cos ν), and the second then has the first integral (s = sin ½ν)

.. math:: (1 - v^2)\,\nu'^2 = 4s^2(1 - Gs^2), \qquad G = g^2/(E - v^2),

that of a pendulum in changed wells: for G < 1 it goes from 0 to 2π, with m = √(1 − v²), as

.. math:: \cot\tfrac12\nu = \mp\sqrt{1 - G}\,\sinh\frac{\xi}{m}, \qquad
          u = -\frac{2gm}{E - v^2}\,\frac{1}{\sqrt G}
          \operatorname{artanh}\Big(\sqrt G\tanh\frac{\xi}{m}\Big):

a kink (antikink), and a step of the displacement that travels with it. Two of them, far from each
other, are started towards each other; ``check`` takes the first before they meet and asserts that
the errors of ν and u are below (h/m)², h the size of cells. What happens when they meet no formula
says: the picture shows them annihilate, into a breather that dies away and sound that carries off
what they had.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

import complexbody as cb
from complexbody.meshes import interval
from complexbody.reading import Results

E, g, v, HALF, START = 4.0, 1.5, 0.6, 60.0, 20.0
DEFAULTS = {"until": 60.0, "every": 0.5, "fields": ("u", "nu")}


def kink(x: Any, t: float, way: int) -> tuple[Any, Any]:
    """ν and u of the exact wave that starts at −20·way and runs towards +way."""
    G, m, xi = g**2 / (E - v**2), np.sqrt(1 - v**2), way * (x + way * START) - v * t
    nu = 2 * np.arctan2(1, -np.sqrt(1 - G) * np.sinh(xi / m))
    step = np.arctanh(np.sqrt(G) * np.tanh(xi / m)) / np.sqrt(G)
    return nu, -2 * g * m / (E - v**2) * way * step


def energy(U: Any, nu: Any, N: Any) -> Any:
    """ρe."""
    return E * U[0, 0] ** 2 / 2 + ufl.inner(N, N) / 2 + g * U[0, 0] * (1 - ufl.cos(nu[0]))


def potential(u: Any, nu: Any) -> Any:
    """ρw: the wells."""
    return 1 - ufl.cos(nu[0])


def both(x: Any, which: int, t: float = 0.0) -> Any:
    """ν (0) or u (1) of two kinks at t, far from each other."""
    return kink(x[0], t, 1)[which] + kink(x[0], t, -1)[which]


def rate(x: Any, which: int, dt: float = 1e-4) -> Any:
    """Their rate at t = 0."""
    return (both(x, which, dt) - both(x, which, -dt)) / (2 * dt)


def scene(comm: Any, cells: int = 2400) -> cb.Scene:
    """A bar with free ends, and two kinks in it."""
    body = cb.Body(descriptor=1, displacement=1, energy=energy, potential=potential,
                   density=1.0, inertia=1.0, name="slipping row")  # fmt: skip
    start = cb.Initial(lambda x: both(x, 1), lambda x: both(x, 0),
                       lambda x: rate(x, 1), lambda x: rate(x, 0))  # fmt: skip
    return cb.Scene(interval(comm, -HALF, HALF, cells), body, initial=start, name="two kinks")


def check(result: cb.Result) -> str:
    """Both kinks before they meet, against the exact ones: ν and u everywhere, to (h/m)²."""
    mesh, t = result.scene.mesh, 1.0 * START
    early, x = cb.simulate(result.scene, until=t, progress=False), mesh.geometry.x.T
    most = (2 * HALF / mesh.topology.index_map(1).size_global) ** 2 / (1 - v**2)
    errors = []
    for which, function in enumerate((early.nu, early.u)):
        error = np.abs(function.x.array - both(x, which, t)).max(initial=0.0)
        errors.append(mesh.comm.allreduce(float(error), op=MPI.MAX))
    assert max(errors) < most, f"errors of ν and u are {errors}, more than {most:.1e}"
    swell = -2 * g / (E - v**2)
    return (
        f"kinks have run {v * t:g} with largest errors of ν {errors[0]:.1e} (of 2π) and of u "
        f"{errors[1]:.1e} (below (h/m)² = {most:.1e}), each with a strain of {swell:.2f}"
    )


def picture(result: cb.Result, path: Path) -> None:
    """ν and the strain u' over place and time, from the files of the run; rank 0 draws."""
    import matplotlib

    if result.scene.mesh.comm.rank > 0 or result.folder is None:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    files = Results(result.folder)
    fields = [files.series(name) for name in ("nu", "u")]
    nu, u = (np.array([f.values(step)[:, 0] for step in range(len(f.times))]) for f in fields)
    x = np.linspace(-HALF, HALF, nu.shape[1])
    shown = (((nu - 2 * np.pi) / np.pi, "slip (ν − 2π)/π", 2.0),
             (np.gradient(u, x, axis=1), "strain u′", 1.0))  # fmt: skip
    figure, axes = plt.subplots(1, 2, figsize=(11, 5), sharey=True, layout="constrained")
    for ax, (values, label, most) in zip(axes, shown, strict=True):
        drawn = ax.pcolormesh(x, fields[0].times, values, cmap="RdBu_r", vmin=-most,
                              vmax=most, shading="gouraud", rasterized=True)  # fmt: skip
        figure.colorbar(drawn, ax=ax, label=label, extend="both")
        ax.set_xlabel("x")
    axes[0].set_ylabel("t")
    figure.suptitle("Two kinks meet, each with the strain it carries (scaled units)")
    figure.savefig(path, dpi=100)
    plt.close(figure)
