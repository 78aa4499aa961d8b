# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A pulse meets a crack: cells graded by 80 towards its tip, and five ways to step them.

A plate 2.4 × 1 with a sharp notch of length 0.9 from the left is struck on its upper edge. Edges
at the tip are 80 times shorter than those far away, and of 10 000 triangles nine tenths are large.
With one step for all the smallest dictates it; with local steps only the few pay.

**Equations.** An icosahedral quasicrystal, phonon u and phason ν with three components each, in
*scaled* units (ρ = μ = 1): *not* a real material (see
:func:`complexbody.forms.scaled_icosahedral_quasicrystal`). With U = ∇u, w = ∇ν the principle

.. math:: \delta\int\!\!\int \tfrac12\rho|\dot u|^2 + \tfrac12\bar\rho|\dot\nu|^2
          - \rho e(\mathrm{sym}\,U, w)\,dx\,dt
          - \delta\int\!\!\int_{\mathrm{top}} p(t)\,n\cdot u\,ds\,dt
          - \int\!\!\int \eta\dot\nu\cdot\delta\nu\,dx\,dt = 0

gives :math:`\rho\ddot u = \mathrm{Div}\,P` and
:math:`\bar\rho\ddot\nu + \eta\dot\nu = \mathrm{Div}\,S`, with P n = −p n on the upper edge, p a
Ricker pulse. The lower edge is held; all others are free, those of the notch included, and nothing
keeps its faces from overlapping. At the tip the stresses are singular, hence the fine mesh.

**Methods.** One step for all (leapfrog at 0.9 of the critical step); asynchronous integrators at
0.45, as the paper has them, with the cells' potentials corrected, on plain windows (every cell its
own rational time set) and on balanced ones; and local leapfrog at 0.9 and at 0.45. ``check`` runs
them all on the same mesh, and compares them with one step for all at a quarter of its step: what
differs is the error of *time stepping alone*. It should be that of the phase of a leapfrog with
the method's largest step h,

.. math:: \omega T\,(\omega h)^2/24, \qquad \omega = 2\pi f,

f the frequency of the pulse, and ``check`` asserts that it is no more than twice that. Where every
cell acts alone, at the multiples of any real step, it is not: the ripple that each leaves on its
nodes makes ten times as much. The mesh itself costs 0.025, at forty points at the end against a
mesh 2.5 times as fine. Cell updates can be counted on any machine; times (processor time, the best
of some) are of this one.

Run it with ``complexbody run demos/graded_crack.py`` (half a minute, most of it for the
comparison), or as a script, ``python demos/graded_crack.py``, which prints the table.
``--set dim=3`` is a thin plate of tetrahedra and takes minutes; its check leaves out the windows,
which the script has (``graded_crack.py 3D``). ``--set refine=0.4`` is coarse.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat
from complexbody.errors import SceneError
from complexbody.forms import scaled_icosahedral_quasicrystal
from complexbody.meshes import Side, altitudes, balanced, notched_plate
from complexbody.picture import Panel, still
from complexbody.simulation import Simulation

LENGTH, WIDTH, NOTCH, OPENING, THICKNESS = 2.4, 1.0, 0.9, 0.02, 0.05

#: What is compared; the first is what updates and times are told against.
METHODS: dict[str, Any] = {
    "one step for all": cb.Synchronous(),
    "the published AVI": cb.AVI.as_published(),
    "real steps, corrected": cb.AVI(schedule="exact"),
    "plain windows": cb.AVI(balanced=False),
    "balanced windows": cb.AVI(),
    "local leapfrog": cb.LocalLeapfrog(),
    "the same at 0.45": cb.LocalLeapfrog(safety=0.45),
}
#: Cells that act alone leave a ripple on their nodes: a floor and a noise, not a phase.
ALONE = ("the published AVI", "real steps, corrected")
#: The reference makes so many steps where one step for all makes one.
FINER = 4
#: The shortest time of so many runs counts.
REPEATS = 2

DEFAULTS = {
    "until": 1.0,  # the pulse has met the notch, and the waves from its tip have spread
    "every": 0.1,
    "fields": ("u", "nu", "steps", "levels"),
    "integrator": "local-leapfrog",
}


def scene(
    comm: Any,
    refine: float = 1.0,
    grading: float = 80.0,
    dim: int = 2,
    frequency: float = 3.0,
    even: bool = False,
) -> cb.Scene:
    """The plate.

    Args:
        comm: Communicator.
        refine: Edges far from the tip have a length of 0.025 / refine.
        grading: Edges at the tip are so many times shorter.
        dim: 2 (plane waves along z: plane strain) or 3 (a plate 0.05 thick).
        frequency: Of the Ricker pulse.
        even: Share out cells by their work instead of their number: good for local leapfrog. The
            cut then goes through the tip, and windows exchange kicks at each of its many times.
    """
    if dim not in (2, 3):
        raise SceneError(f"graded crack: dim is {dim}. Give 2 for triangles or 3 for a thin plate.")
    size = 0.025 / refine
    mesh, cell_tags, facet_tags = notched_plate(
        comm, LENGTH, WIDTH, NOTCH, OPENING, size, size / grading,
        THICKNESS if dim == 3 else None, growth=0.2,
    )  # fmt: skip
    if even:
        mesh, cell_tags, facet_tags = balanced(mesh, None, cell_tags, facet_tags)
    return cb.Scene(
        mesh,
        scaled_icosahedral_quasicrystal(),
        supports=[cb.Fix("u", Side.BOTTOM), cb.Fix("nu", Side.BOTTOM)],
        loads=[cb.Pressure(Side.TOP, 1e-2, cb.ricker(frequency))],
        cell_tags=cell_tags,
        facet_tags=facet_tags,
        name=f"pulse on a crack in {dim}D (scaled units)",
    )


@dataclass(frozen=True)
class Row:
    """A method: errors of (u, ν) and of rates (relative, L2), largest step, updates, seconds."""

    name: str
    error: float
    rate_error: float
    step: float
    updates: int
    seconds: float


def comparison(given: cb.Scene, until: float, names: Sequence[str] = tuple(METHODS)) -> list[Row]:
    """Run methods on a scene, and measure them against a fine synchronous run; collective."""
    exact = cb.simulate(given, cb.Synchronous(safety=0.9 / FINER), until=until, progress=False)
    norm = Norm(exact)
    rows = []
    for name in names:
        method, seconds = METHODS[name], np.inf
        for _ in range(REPEATS):
            ready = Simulation(given, method, until=until, ledger_steps=10**9, progress=False)
            begun = time.process_time()
            result = ready.run()
            spent = given.mesh.comm.allreduce(time.process_time() - begun, op=MPI.MAX)
            seconds = min(seconds, spent)
        errors = (norm(result, names) for names in (("u", "nu"), ("u_dot", "nu_dot")))
        sets, s = result.time_sets, result.stats
        step = s.step if sets is None else sets.largest_step
        rows.append(Row(name, *errors, step, s.updates, seconds))
    return rows


class Norm:
    """Relative L2 distance of results from an exact one."""

    def __init__(self, exact: cb.Result) -> None:
        self.exact, space = exact, exact.u.function_space
        self.difference = [fem.Function(space) for _ in range(2)]
        a, b = self.difference
        self.form = fem.form((ufl.inner(a, a) + ufl.inner(b, b)) * ufl.dx)

    def __call__(self, result: cb.Result, names: tuple[str, str]) -> float:
        """Distance of two fields together; collective."""
        squares = []
        for scale in (1.0, 0.0):
            for name, function in zip(names, self.difference, strict=True):
                values = scale * getattr(result, name).x.array
                function.x.array[:] = values - getattr(self.exact, name).x.array
            local = float(fem.assemble_scalar(self.form))
            squares.append(self.form.mesh.comm.allreduce(local))
        return float(np.sqrt(squares[0] / squares[1]))


def table(rows: list[Row]) -> str:
    """Rows as text, updates and times relative to the first."""
    names = ("error u, ν", "of rates", "largest step", "updates", "ratio", "time")
    lines = ["{:22} {:>11} {:>9} {:>13} {:>9} {:>6} {:>6}".format("", *names)]
    for row in rows:
        lines.append(
            f"{row.name:22} {row.error:11.1e} {row.rate_error:9.1e} {row.step:13.2e} "
            f"{row.updates:9.2e} {row.updates / rows[0].updates:6.2f} "
            f"{row.seconds / rows[0].seconds:6.2f}"
        )
    return "\n".join(lines)


def check(result: cb.Result) -> str:
    """Errors of all methods as of their phase, updates saved by local steps, energy balanced."""
    mesh, comm = result.scene.mesh, result.scene.mesh.comm
    sizes = altitudes(mesh)
    smallest = comm.allreduce(float(sizes.min(initial=np.inf)), op=MPI.MIN)
    ratio = comm.allreduce(float(sizes.max(initial=0.0)), op=MPI.MAX) / smallest
    assert ratio >= 64, f"cells are graded by {ratio:.0f} only"
    balance = np.abs(result.ledger["balance"]).max() / result.ledger["work"].max()
    assert balance < 0.05, f"energy is out of balance by {balance:.1e} of the work"
    # In 3D windows take minutes, on several ranks more: the script has them.
    names = tuple(METHODS) if mesh.geometry.dim == 2 else ("one step for all", "local leapfrog")
    rows = comparison(result.scene, result.time, names)
    if result.folder is not None and comm.rank == 0:
        (result.folder / "methods.txt").write_text(table(rows) + "\n", encoding="utf-8")
    omega = 2 * np.pi * result.scene.loads[0].history.frequency
    for row in rows:
        if row.name in ALONE:
            assert row.error < 0.1, f"{row.name}: error {row.error:.1e}"
            continue
        phase = omega * result.time * (omega * row.step) ** 2 / 24
        assert row.error < 2 * phase, f"{row.name}: error {row.error:.1e}, of phase {phase:.1e}"
    for row in rows[1:]:
        share = row.updates / rows[0].updates
        assert share < 0.7, f"{row.name} has {share:.2f} of the updates of one step for all"
    told = (
        f"{row.name} {row.error:.1e} with {row.updates / rows[0].updates:.2f} of the updates and "
        f"{row.seconds / rows[0].seconds:.2f} of the time"
        for row in rows
    )
    return f"cells graded by {ratio:.0f}; error of time stepping: {'; '.join(told)}"


def picture(result: cb.Result, path: Path) -> None:
    """u̇₂: shadow of the notch and waves from its tip; ν̇₂; and who steps how finely."""
    panels = [
        Panel("u_dot", 1, warp=None, label="phonon rate u̇₂", unit=""),
        Panel("nu_dot", 1, warp=None, label="phason rate ν̇₂", unit=""),
    ]
    functions = {"u_dot": result.u_dot, "nu_dot": result.nu_dot}
    if result.time_sets is not None:
        level = fem.Function(_compat.cell_space(result.scene.mesh))
        level.x.array[: len(result.time_sets.levels)] = result.time_sets.levels
        functions["level"] = level
        panels.append(Panel("level", warp=None, label="octave of the step", unit=""))
    still(path, functions, panels, "Pulse on a crack (scaled units)", None)


def main() -> None:
    """Print the table for the default scene, with the word 3D for the thin plate."""
    comm = MPI.COMM_WORLD
    rows = comparison(scene(comm, dim=3 if "3D" in sys.argv[1:] else 2), DEFAULTS["until"])
    if comm.rank == 0:
        print(table(rows))


if __name__ == "__main__":
    main()
