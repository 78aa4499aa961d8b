# SPDX-License-Identifier: LGPL-3.0-or-later
"""Speed against accuracy: a coupled standing wave stepped in seven ways, all in one process.

    python benchmarks/precision.py [--quick] [--scenes uniform graded layer] [--out docs/charts]

The scalar pair ρe = ½A|∇u|² + ½K|∇ν|² + R∇u·∇ν + ½k₀ν² with viscosity η keeps u, ν ∝ Π sin πx_i,
so that the exact solution is a 4×4 matrix exponential. Errors are those of nodal values at the end,
in the lumped L2 norm and in the energy norm, over the initial state's norms. Contenders run the
whole history in turn; a short first run of each is discarded, the smallest processor time of the
repeats counts (setting up is not in it; all use one thread). The hand-written leapfrogs make the
same steps as Synchronous. Writes precision.json, .csv and .png; other scenes keep their rows.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy.linalg
import ufl
from dolfinx import fem
from dolfinx.fem import petsc  # must be imported by name
from mpi4py import MPI
from petsc4py import PETSc

import complexbody as cb
from complexbody import _compat, machine, meshes
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.synchronous import Synchronous
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]
A, K, R = 1.0, 0.6, 0.3
START = np.array([1.0, 0.5, 0.0, 0.0])  # amplitudes of u, ν and of their rates
UNTIL = 1.3
ROUNDS, ENOUGH = 20, 2.0  # at least two runs of each, at most ROUNDS, else until ENOUGH seconds
CAPTION = (
    "Smallest processor time of 2 to 20 runs; other processes used the machine and may have "
    "disturbed it.\nu and ν scalar and coupled, k₀ = 3, η = 2, until t = 1.3. Numbers at "
    "Synchronous: squares or cubes, each cut into 2 or 6 simplices."
)


@dataclass(frozen=True)
class Wave:
    """The exact solution on the unit interval, square or cube; k₀ and η are constants of ν."""

    dim: int
    k0: float = 0.0
    eta: float = 0.0

    def body(self) -> cb.Body:
        """The scalar pair."""

        def energy(U: Any, nu: Any, N: Any) -> Any:
            pairs = [(U[0, i], N[0, i]) for i in range(self.dim)]
            waves = sum(0.5 * A * a**2 + 0.5 * K * b**2 + R * a * b for a, b in pairs)
            return waves + 0.5 * self.k0 * nu[0] ** 2

        return cb.Body(1, energy, 1.0, 1.0, viscosity=self.eta, displacement=1)

    def shape(self, x: Array) -> Array:
        """Π sin πx_i at points (3, npts)."""
        return np.prod(np.sin(np.pi * x[: self.dim]), axis=0)

    def scene(self, mesh: Any) -> cb.Scene:
        """The wave at rest at t = 0, held on the whole boundary."""
        initial = cb.Initial(*(lambda x, a=a: a * self.shape(x)[None] for a in START[:2]))
        held = [cb.Fix(field, "boundary") for field in ("u", "nu")]
        return cb.Scene(mesh, self.body(), supports=held, initial=initial)

    def amplitudes(self, t: float) -> Array:
        """Exact amplitudes of (u, ν) at t."""
        q2 = self.dim * np.pi**2
        stiffness = np.array([[A * q2, R * q2], [R * q2, K * q2 + self.k0]])
        system = np.vstack([np.eye(4)[2:], np.hstack([-stiffness, -np.diag([0.0, self.eta])])])
        return (scipy.linalg.expm(system * t) @ START)[:2]

    def norms(self, problem: Problem, difference: Array) -> Array:
        """L2 (lumped) and energy norm of nodal records (nodes, 2)."""
        problem.kernels.x[:] = 0.0
        problem.kernels.x[:-1, :2] = difference
        square = np.sum(difference**2 * problem.disc.volume[:, None])
        return np.sqrt([square, max(0.0, 2.0 * float(problem.kernels.energies().sum()))])

    def errors(self, problem: Problem, x: Array, t: float) -> Array:
        """Relative errors of nodal records x at t: (L2, energy norm)."""
        f = self.shape(problem.disc.position[:-1].T)[:, None]
        wrong = self.norms(problem, x[:-1, :2] - f * self.amplitudes(t))
        return wrong / self.norms(problem, f * START[:2])


def box(dim: int, cells: int, jiggle: float, ratio: float = 1.0) -> Any:
    """Unit square or cube, vertices moved by ``jiggle``, then by s ↦ (gˢ − 1)/(g − 1), g ratio."""
    make = meshes.rectangle if dim == 2 else meshes.box
    mesh = make(MPI.COMM_SELF, np.zeros(dim), np.ones(dim), cells)
    x = (meshes.jiggled(mesh, jiggle, 3) if jiggle else mesh).geometry.x
    if ratio > 1:
        x[:, :dim] = (ratio ** x[:, :dim] - 1) / (ratio - 1)
    return mesh


def layered(cells: int, ratio: float = 50.0) -> Any:
    """Unit cube whose middle layer of cells along x is thinner than the others by ``ratio``."""
    mesh = box(3, cells, 0.0)
    sizes = np.where(np.arange(cells) == cells // 2, 1.0, ratio)
    planes = np.concatenate([[0.0], np.cumsum(sizes) / sizes.sum()])
    mesh.geometry.x[:, 0] = planes[np.rint(mesh.geometry.x[:, 0] * cells).astype(int)]
    return mesh


class Leapfrog:
    """What one writes by hand, the recursion of Synchronous with exact dissipation (γ = η/ρ̄):
    v ← e^{−γh}v + hf/m, then x ← x + w with w = (1 − e^{−γh})v/γ.
    """  # noqa: D205

    def __init__(self, problem: Problem, until: float, assembled: bool) -> None:
        action, mesh = problem.action, problem.scene.mesh
        self.updates, self.assembled = 0, assembled
        self.step = step = Synchronous().prepare(problem, until).step
        self.problem, self.q = problem, fem.Function(action.space)
        self.x = self.q.x.array  # a view
        self.x.reshape(-1, 2)[problem.disc.dof] = problem.initial_fields
        self.f, self.w, mass = (np.zeros_like(self.x) for _ in range(3))
        ones = fem.Constant(mesh, np.ones(2))
        fem.assemble_vector(mass, _compat.form(ufl.inner(ones, action.v) * ufl.dx))
        eta = problem.scene.bodies[0].viscosity_matrix[0, 0]
        rate = np.tile([0.0, eta], len(mass) // 2) + 1e-300
        self.decay = np.exp(-rate * step) if eta > 0 else None
        self.scale = step * -np.expm1(-rate * step) / rate / mass
        facets, dim = _compat.exterior_facets(mesh), mesh.topology.dim - 1
        self.scale.reshape(-1, 2)[fem.locate_dofs_topological(action.space, dim, facets)] = 0.0
        if assembled:
            self.matrix = petsc.assemble_matrix(_compat.form(action.jacobian()))
            self.matrix.assemble()
            wrap = partial(PETSc.Vec.createWithArray, comm=MPI.COMM_SELF)
            self.vectors = wrap(PETSc.Vec(), self.x), wrap(PETSc.Vec(), self.f)
        else:
            self.form = _compat.form(ufl.replace(action.residual(), {action.q: self.q}))

    def advance(self, steps: int) -> None:
        """Do ``steps`` steps; the first kick of a history is half of one."""
        for _ in range(steps):
            if self.assembled:
                self.matrix.mult(*self.vectors)
            else:
                self.f[:] = 0.0
                fem.assemble_vector(self.f, self.form)
            self.f *= self.scale if self.updates else 0.5 * self.scale
            if self.decay is not None:
                self.w *= self.decay
            self.w -= self.f
            self.x += self.w
            self.updates += self.problem.disc.count

    def sample(self) -> tuple[Array]:
        """Positions as node records."""
        return (np.vstack([self.x.reshape(-1, 2)[self.problem.disc.dof], [[0, 0]]]),)


#: How each contender starts, its colour and its line, in the order of the table.
STYLES: dict[str, tuple[Callable[[Problem, float], Any], str, str]] = {
    "Synchronous": (Synchronous().prepare, "#1f5fa8", "-"),
    "AVI, plain windows": (AVI(balanced=False).prepare, "#d98200", "-"),
    "AVI, balanced windows": (AVI().prepare, "#c2185b", "-"),
    "AVI, real steps, corrected": (AVI(schedule="exact").prepare, "#8e6bbf", "-"),
    "LocalLeapfrog": (LocalLeapfrog().prepare, "#111111", "-"),
    "leapfrog, dolfinx assembly": (partial(Leapfrog, assembled=False), "#666666", "--"),
    "leapfrog, PETSc AIJ": (partial(Leapfrog, assembled=True), "#2e8b57", "--"),
}


def timed(run: Any, steps: int) -> tuple[float, int, Array]:
    """Processor seconds, updates, positions."""
    begun = time.process_time()
    run.advance(steps)
    return time.process_time() - begun, run.updates, run.sample()[0].copy()


def measure(scene: str, cells: int, enough: float) -> list[Any]:
    """Rows of one mesh: errors, smallest seconds, updates of every contender."""
    _, wave, _, _, mesh = SCENES[scene]
    problems = {name: Problem(wave.scene(mesh(cells))) for name in STYLES}
    found: dict[str, list[tuple[float, int, Array]]] = {name: [] for name in STYLES}
    for name, (prepare, *_) in STYLES.items():
        timed(prepare(problems[name], UNTIL), 3)  # warm-up, discarded
    for _ in range(ROUNDS):
        for name, (prepare, *_) in STYLES.items():
            if len(found[name]) < 2 or sum(f[0] for f in found[name]) < enough:
                run = prepare(problems[name], UNTIL)
                found[name].append(timed(run, round(UNTIL / run.step)))
    best = {name: min(runs, key=lambda run: run[0]) for name, runs in found.items()}
    rows, base = [], best["Synchronous"]
    count = problems["Synchronous"].disc.count
    print(f"\n{scene}, {cells} per side, {count} cells, {base[1]} updates by Synchronous")
    print(f"  {'':27}{'L2':>10}{'energy':>10}{'seconds':>10}{'× time':>10}{'× updates':>10}")
    for name, (seconds, updates, x) in best.items():
        l2, energy = wave.errors(problems[name], x, UNTIL)
        ratios = seconds / base[0], updates / base[1]
        rows.append({"scene": scene, "per_side": cells, "cells": count, "method": name, "l2": l2,
                     "energy": energy, "seconds": seconds, "updates": updates,
                     "runs": len(found[name]), "time_ratio": ratios[0], "update_ratio": ratios[1],
                     "commit": machine.commit()})  # fmt: skip
        numbers = f"{l2:10.2e}{energy:10.2e}{seconds:10.3g}{ratios[0]:10.2f}{ratios[1]:10.2f}"
        print(f"  {name:27}{numbers}", flush=True)
        problems[name].close()
    return rows


def draw(rows: list[Any], path: Path, caption: str) -> None:
    """Error against seconds: a column per scene, a row per norm, a line per method."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False})
    scenes = [s for s in SCENES if any(r["scene"] == s for r in rows)]
    figure, axes = plt.subplots(2, len(scenes), figsize=(13.5, 8.4), sharex="col", squeeze=False)
    for column, scene in enumerate(scenes):
        mine = [r for r in rows if r["scene"] == scene]
        for row, norm in enumerate(("l2", "energy")):
            panel(axes[row, column], mine, norm, SCENES[scene][1].dim)
        axes[0, column].set_title(SCENES[scene][0])
        axes[1, column].set_xlabel("processor seconds of stepping")
    axes[0, 0].set_ylabel("relative L2 error of (u, ν)")
    axes[1, 0].set_ylabel("relative error in the energy norm")
    lines = axes[0, 0].lines[: len(STYLES)]
    figure.legend(
        lines, list(STYLES), ncols=len(STYLES), fontsize=9, loc="upper center", frameon=False
    )
    figure.text(0.01, 0.008, caption, color="0.35")
    figure.tight_layout(rect=(0, 0.05, 1, 0.96))
    figure.savefig(path, dpi=150)
    plt.close(figure)


def panel(axes: Any, rows: list[Any], norm: str, dim: int) -> None:
    """Lines, and guides: a mesh N times finer costs N^(d+1), its error falls by N^order."""
    for name, (_, colour, line) in STYLES.items():
        mine = [r for r in rows if r["method"] == name]
        x, y = [r["seconds"] for r in mine], [r[norm] for r in mine]
        axes.loglog(x, y, line, color=colour, marker="o", ms=4.5, lw=1.8, label=name)
        if name == "Synchronous":
            for r, *at in zip(mine, x, y, strict=True):
                axes.annotate(f"{r['per_side']}" + "²³"[dim - 2], at, xytext=(-8, -7),
                              textcoords="offset points", color=colour, ha="right")  # fmt: skip
    first = rows[0]["seconds"], 0.25 * rows[0][norm]  # free space: below Synchronous
    for order in (1, 2):
        end = 3.5 * first[0], first[1] * 3.5 ** (-order / (dim + 1))
        axes.loglog(*zip(first, end, strict=True), ":", color="0.5", lw=1)
        axes.annotate(f" order {order}", end, color="0.45", va="center")
    axes.grid(True, which="major", lw=0.4, color="0.88")
    axes.margins(0.12, 0.08)


#: Title, wave, meshes per side (whole, quick) and how to make one.
TWO, THREE = Wave(2, k0=3.0, eta=2.0), Wave(3, k0=3.0, eta=2.0)
SCENES: dict[str, tuple[str, Wave, tuple[int, ...], tuple[int, ...], Callable[[int], Any]]] = {
    "uniform": ("square, uniform", TWO, (40, 80, 160), (10, 20, 40), lambda n: box(2, n, 0, 1)),
    "graded": ("cube, graded by 27", THREE, (10, 16, 24), (4, 6, 8), lambda n: box(3, n, 0.2, 27)),
    "layer": ("cube, one layer 50 times thinner", THREE, (8, 16, 24), (4, 6, 8), layered),
}


def main() -> None:
    """Measure, print, write and draw."""
    style = argparse.RawTextHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("--quick", action="store_true", help="small meshes, for a check")
    parser.add_argument("--scenes", nargs="*", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--out", type=Path, help="folder; docs/charts, or results with --quick")
    options = parser.parse_args()
    out = options.out or Path("results" if options.quick else "docs/charts")
    out.mkdir(parents=True, exist_ok=True)
    data, here, versions = out / "precision.json", machine.machine(), machine.versions()
    rows = json.loads(data.read_text())["results"] if data.exists() else []
    rows = [r for r in rows if r["scene"] not in options.scenes]
    for scene in options.scenes:
        _, _, whole, quick, _ = SCENES[scene]
        for n in quick if options.quick else whole:
            rows += measure(scene, n, 0.1 if options.quick else ENOUGH)
            rows.sort(key=lambda r: list(SCENES).index(r["scene"]))
            found = {"machine": here, "versions": versions, "results": rows}
            data.write_text(json.dumps(found, indent=1) + "\n")
    with (out / "precision.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    draw(rows, out / "precision.png", f"One core of {here['cpu']}. {CAPTION}")


if __name__ == "__main__":
    main()
