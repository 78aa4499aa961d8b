# SPDX-License-Identifier: LGPL-3.0-or-later
"""Energy over long times, and what is true on average: every integrator without dissipation.

    python benchmarks/energy.py [--quick] [--draw] [--out docs/charts]

The scalar pair of precision.py (η = k₀ = 0) on two small meshes: an interval of sizes scattered in
[1, 3], and a square with moved vertices, graded by 9. From rest, either a standing wave ("smooth")
or random positions at all nodes ("random": all modes, the highest above all). Reference: the exact
motion of the same semi-discrete equations, by their modes, at the very times a run is looked at. So
no error in space is in what follows, and none of looking seldom. Per method, and fraction of its
usual step:
- E/E₀ − 1: the largest, its mean over the run, its slope per 1000 periods of the slowest mode;
- mean-square displacement: the time average of u² and ν² at each node, relative L2 error of it;
  *chance*: what separates the exact one over the same stretch of time from that over all times.
No times are taken. Writes energy.json, .csv and .png.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from asynchrony import random_interval, rough
from precision import Array, Wave, box

import complexbody as cb
from complexbody import machine
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.synchronous import Synchronous
from complexbody.problem import Problem
from complexbody.timesets import critical_step

#: Name -> usual fraction of the critical step, method at a fraction and critical step, colour.
METHODS: dict[str, tuple[float, Callable[[float, float], Any], str]] = {
    "Synchronous": (0.9, lambda a, _: Synchronous(safety=a), "#1f5fa8"),
    "AVI, as published": (0.45, lambda a, _: AVI.as_published(a), "#7a7a7a"),
    "AVI, real steps, corrected": (0.45, lambda a, _: AVI(a, "exact"), "#2e8b57"),
    "AVI, plain windows": (0.45, lambda a, _: AVI(a, balanced=False), "#d98200"),
    "AVI, balanced windows": (0.45, lambda a, _: AVI(a), "#c2185b"),
    "LocalLeapfrog": (0.9, lambda a, _: LocalLeapfrog(a), "#111111"),
}
OURS = tuple(METHODS)
if hasattr(cb, "PetscTS"):
    METHODS |= {
        "PetscTS alpha2": (0.9, lambda a, h: cb.PetscTS("alpha2", a * h), "#8e6bbf"),
        "PetscTS rk4": (0.9, lambda a, h: cb.PetscTS("rk4", a * h), "#00a3a3"),
    }
if hasattr(cb, "Newmark"):
    METHODS["Newmark"] = (0.9, lambda a, h: cb.Newmark(a * h), "#a0522d")

SCENES: dict[str, tuple[str, Wave, Callable[[int], Any], int]] = {
    "bar": ("interval, 24 cells of sizes in [1, 3]", Wave(1), random_interval, 24),
    "square": ("square, moved and graded by 9", Wave(2), lambda n: box(2, n, 0.2, 9), 7),
}
DATA = ("smooth", "random")
FRACTIONS = (1.0, 0.5, 0.25)
PARTS = 200  # of a run: means of the energy over each are kept
LOST = 100.0  # a run whose energy grows so many times is over


class Modes:
    """The exact motion from rest of M q̈ = −Kq, by its modes."""

    def __init__(self, problem: Problem) -> None:
        disc, kernels = problem.disc, problem.kernels
        self.weight = np.repeat(disc.volume[:, None], disc.n, axis=1)  # ρ = ρ̄ = 1
        free = ~problem.masses.fixed[problem.masses.classes[:-1]]
        K = []
        for unit in np.eye(free.sum()):
            kernels.x[:] = 0.0
            kernels.x[:-1, : disc.n][free] = unit
            kernels.forces()
            K.append(-kernels.f[:-1, : disc.n][free])
        root = np.sqrt(self.weight[free])
        squares, vectors = np.linalg.eigh(np.array(K) / np.outer(root, root))
        self.frequencies, self.free = np.sqrt(squares), free
        self.shapes = vectors / root[:, None]
        start = problem.initial_fields[: disc.nodes, : disc.n][free]
        self.amounts = (vectors * root[:, None]).T @ start
        self.energy = 0.5 * float(squares @ self.amounts**2)
        self.period = 2 * np.pi / float(self.frequencies[0])

    def mean_squares(self, times: Array) -> Array:
        """Averages of q² over the times, of the free components (free,)."""
        total = np.zeros(len(self.shapes))
        for part in np.array_split(times, 1 + len(times) // 2000):
            q = self.shapes @ (self.amounts[:, None] * np.cos(np.outer(self.frequencies, part)))
            total += (q**2).sum(axis=1)
        return total / len(times)

    def for_ever(self) -> Array:
        """The average of q² over all times (free,); no two frequencies are equal."""
        return 0.5 * self.shapes**2 @ self.amounts**2


def distance(weight: Array, one: Array, other: Array) -> float:
    """Relative L2 distance of two fields, to the second."""
    return float(np.sqrt(weight @ (one - other) ** 2 / (weight @ other**2)))


def follow(scene: cb.Scene, method: Any, modes: Modes, until: float, looks: int) -> dict[str, Any]:
    """Energies over a run, and averages beside the exact motion's."""
    problem = Problem(scene)
    run = method.prepare(problem, until)
    last, n = round(until / run.step), problem.disc.n
    times, energies, squares = [], [], 0.0
    for i in range(1, looks + 1):
        run.advance(i * last // looks - run.steps)
        e = run.entries()
        energies.append((e.kinetic_u + e.kinetic_nu + e.stored) / modes.energy - 1)
        if not energies[-1] < LOST:
            break
        # Cells of windows are laid out anew: numbers of nodes are the mesh's.
        at = np.zeros((problem.disc.nodes, n))
        at[problem.disc.dof] = run.sample()[0][:-1, :n] ** 2
        squares = squares + at
        times.append(run.time)
    steps, updates = run.step, run.updates
    out: dict[str, Any] = {"step": steps, "updates": updates, "energy": energies}
    if len(times) == looks:
        fixed = Problem(scene)
        mean = (squares / looks)[fixed.disc.dof][modes.free]
        exact, weight = modes.mean_squares(np.array(times)), modes.weight[modes.free]
        fixed.close()
        slope = np.polyfit(np.array(times) / (1000 * modes.period), energies, 1)[0]
        out |= {
            "largest": float(np.abs(energies).max()), "mean": float(np.mean(energies)),
            "slope": float(slope),
            "mean_square": distance(weight, mean, exact),
            "chance": distance(weight, modes.for_ever(), exact),
        }  # fmt: skip
    problem.close()
    return out


def measure(name: str, periods: float, looks: int, fractions: tuple[float, ...]) -> list[Any]:
    """All methods, initial data and steps on one mesh."""
    _, wave, make, cells = SCENES[name]
    makers = {"smooth": wave.scene, "random": lambda mesh: rough(wave, mesh)}
    rows = []
    print(f"\n{name}: E/E0 − 1 largest, mean, slope per 1000 periods; mean squares: error, chance")
    for data in DATA:
        scene = makers[data](make(cells))
        problem = Problem(scene)
        modes, critical = Modes(problem), critical_step(problem)
        problem.close()
        for method, (usual, maker, _) in METHODS.items():
            # PETSc's run Python at every step: without the smallest ones.
            for fraction in fractions if method in OURS else fractions[:-1]:
                alpha = usual * fraction
                given = makers[data](make(cells))
                found = follow(given, maker(alpha, critical), modes, periods * modes.period, looks)
                row = {"scene": name, "data": data, "method": method, "alpha": alpha, **found}
                rows.append(row)
                numbers = [row.get(key, np.nan) for key in NUMBERS]
                text = "".join(f"{number:11.2e}" for number in numbers)
                print(f"  {data:8}{method:28}{alpha:7.4g}{text}", flush=True)
    return rows


NUMBERS = ("largest", "mean", "slope", "mean_square", "chance")


def draw(found: dict[str, Any], path: Path) -> None:
    """A row per mesh: energy over time, mean energy and mean squares over the step."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(len(SCENES), 3, figsize=(14.5, 8.4), squeeze=False)
    for row, scene in enumerate(SCENES):
        mine = [r for r in found["results"] if (r["scene"], r["data"]) == (scene, "random")]
        mine = [r for r in mine if r["method"] in METHODS]
        for name, (usual, _, colour) in METHODS.items():
            rows = [r for r in mine if r["method"] == name]
            if not rows:
                continue
            line = {"color": colour, "lw": 1.8, "label": name}
            energy = np.array(rows[0]["energy"])
            width = max(1, PARTS // 40)
            smooth = np.convolve(energy, np.ones(width) / width, "valid")
            at = found["periods"] * (np.arange(len(smooth)) + width / 2) / PARTS
            axes[row, 0].plot(at, 100 * smooth, **line)
            if len(energy) < PARTS:
                axes[row, 0].plot(at[-1:], 100 * smooth[-1:], "x", color=colour, ms=8, mew=2)
            alive = [r for r in rows if "mean" in r]
            x = [r["alpha"] / usual for r in alive]
            for column, key in ((1, "mean"), (2, "mean_square")):
                y = np.abs([r[key] for r in alive])
                axes[row, column].loglog(x, y, marker="o", ms=4.5, **line)
        axes[row, 0].set_yscale("symlog", linthresh=1.0)
        axes[row, 0].axhline(0, color="0.6", lw=0.8)
        axes[row, 0].set(title=f"Energy, {SCENES[scene][0]}", ylabel="E/E₀ − 1 [%], running mean",
                         xlabel="periods of the slowest mode")  # fmt: skip
        chance = np.median([r["chance"] for r in mine if "chance" in r])
        axes[row, 2].axhline(chance, color="0.5", ls=":", lw=1.2)
        axes[row, 2].annotate("chance", (1.0, chance), color="0.4", va="top", ha="right")
        for column, title in ((1, "Mean of E/E₀ − 1"), (2, "Mean-square displacement")):
            ax = axes[row, column]
            ax.set(title=f"{title}, error", xlabel="step over the method's usual one")
            fractions = sorted({r["alpha"] / METHODS[r["method"]][0] for r in mine})
            ax.set_xticks(fractions, [f"{f:.3g}" for f in fractions])
            ax.minorticks_off()
            ax.margins(x=0.08)
        axes[row, 1].set_ylim(bottom=1e-3)
    for ax in axes.flat:
        ax.grid(True, lw=0.4, color="0.9")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=min(5, len(labels)), loc="upper center", frameon=False)
    figure.text(0.01, 0.008, CAPTION, color="0.35")
    figure.tight_layout(rect=(0, 0.045, 1, 0.95 if len(labels) < 7 else 0.92))
    figure.savefig(path, dpi=150)
    plt.close(figure)


CAPTION = (
    "Random positions at all nodes, from rest; no dissipation. ×: energy grew a hundredfold, the "
    "run was ended. Reference: exact motion of the same semi-discrete equations.\nNewmark and "
    "alpha2 keep the energy of linear scenes to their solvers' tolerance: below the middle panels."
)


def main() -> None:
    """Measure, print, write and draw."""
    style = argparse.RawTextHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("--quick", action="store_true", help="few periods, for a check")
    parser.add_argument("--out", type=Path, help="folder; docs/charts, or results with --quick")
    parser.add_argument("--draw", action="store_true", help="only draw again what was measured")
    options = parser.parse_args()
    out = options.out or Path("results" if options.quick else "docs/charts")
    out.mkdir(parents=True, exist_ok=True)
    data = out / "energy.json"
    if not options.draw:
        periods, looks = (10.0, 100) if options.quick else (300.0, 3000)
        rows = [r for name in SCENES for r in measure(name, periods, looks, FRACTIONS)]
        with (out / "energy.csv").open("w", newline="") as file:
            keys = ("scene", "data", "method", "alpha", "step", "updates", *NUMBERS)
            writer = csv.DictWriter(file, keys, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)
        for row in rows:
            parts = np.array_split(row["energy"], round(PARTS * len(row["energy"]) / looks))
            row["energy"] = [float(f"{np.mean(part):.4g}") for part in parts]
        found = {"machine": machine.machine(), "versions": machine.versions(),
                 "commit": machine.commit(), "periods": periods, "looks": looks,
                 "results": rows}  # fmt: skip
        data.write_text(json.dumps(found) + "\n")
    draw(json.loads(data.read_text()), out / "energy.png")


if __name__ == "__main__":
    main()
