# SPDX-License-Identifier: LGPL-3.0-or-later
"""What asynchrony costs in accuracy, and what balanced windows give back: DESIGN §5 measured.

    python benchmarks/asynchrony.py [--quick] [--out docs/charts]

The standing wave of precision.py at fixed α (step over critical step). Three parts:
1. errors under refinement, bias of a mode's amplitude beside one step on the same mesh, and cell
   updates, for one step, plain windows, real steps (published and corrected), balanced windows;
2. the error of time stepping alone, over α: distance to a run with a tenth of the step on the
   same mesh;
3. energy over 45 periods of the faster mode and over 100 000 windows, from smooth and from random
   initial data.
Writes asynchrony.json and .png; no times are taken.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import precision
from mpi4py import MPI
from precision import UNTIL, Array, Wave, box

import complexbody as cb
from complexbody import machine, meshes
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.synchronous import Synchronous
from complexbody.problem import Problem

METHODS: dict[str, Any] = {
    "one step, 0.9": Synchronous(),
    "plain, 0.45": AVI(balanced=False),
    "plain, 0.6": AVI(safety=0.6, balanced=False),
    "published, 0.45": AVI.as_published(),
    "corrected, 0.45": AVI(schedule="exact"),
    "balanced, 0.45": AVI(),
    "balanced, 0.6": AVI(safety=0.6),
}
COLOURS = {"plain": "#d98200", "balanced": "#c2185b", "one step": "#26a", "published": "#7a7a7a",
           "corrected": "#2e8b57"}  # fmt: skip
Maker = Callable[[int], Any]


def random_interval(n: int) -> Any:
    """Unit interval of n cells, sizes random in [1, 3] before scaling."""
    sizes = np.random.default_rng(7).uniform(1.0, 3.0, n)
    return meshes.graded_interval(MPI.COMM_SELF, sizes / sizes.sum())


CASES: dict[str, tuple[Wave, tuple[int, ...], Maker]] = {
    "2D, vertices moved by 25 %": (Wave(2), (20, 40, 80, 160), lambda n: box(2, n, 0.25, 1)),
    "2D, graded by 27": (Wave(2), (20, 40, 80), lambda n: box(2, n, 0.2, 27)),
    "2D, graded by 127": (Wave(2), (20, 40, 80), lambda n: box(2, n, 0.2, 127)),
    "3D, moved by 20 %, k0 = 3, η = 0": (Wave(3, 3), (8, 16, 24), lambda n: box(3, n, 0.2, 1)),
    "3D, moved by 20 %, k0 = 3, η = 2": (Wave(3, 3, 2), (8, 16, 24), lambda n: box(3, n, 0.2, 1)),
    "1D, sizes random in [1, 3]": (Wave(1), (100, 200, 400, 800), random_interval),
}


def end(problem: Problem, method: Any, until: float = UNTIL) -> tuple[Any, Array]:
    """The finished run and its positions, node records."""
    run = method.prepare(problem, until)
    run.advance(round(until / run.step))
    updates = run.updates
    x = run.sample()[0].copy()
    run.updates = updates  # without the sample's own
    return run, x


def refinement(name: str, limit: int) -> list[dict[str, Any]]:
    """Errors and updates of all methods on the meshes of a case, with orders between meshes."""
    wave, sizes, make = CASES[name]
    rows: list[dict[str, Any]] = []
    print(f"\n{name}\n  {'method':28}N        L2     energy      bias   updates  ratio")
    for label, method in METHODS.items():
        for n in sizes[:limit]:
            problem = Problem(wave.scene(make(n)))
            run, x = end(problem, method)
            l2, energy = wave.errors(problem, x, UNTIL)
            base = next((r for r in rows if r["per_side"] == n), None)
            ratio = run.updates / base["updates"] if base else 1.0
            mode = amplitudes(wave, problem, x)
            bias = float(np.abs(mode - base["mode"]).max()) if base else 0.0
            rows.append({"case": name, "method": label, "per_side": n, "l2": l2, "energy": energy,
                         "mode": mode.tolist(), "bias": bias, "updates": run.updates,
                         "ratio": ratio})  # fmt: skip
            print(f"  {label:20}{n:9}{l2:11.2e}{energy:11.2e}{bias:10.1e}{run.updates:10.2e}"
                  f"{ratio:7.2f}", flush=True)  # fmt: skip
            problem.close()
    return rows


def amplitudes(wave: Wave, problem: Problem, x: Array) -> Array:
    """Amplitudes of (u, ν) in the wave's own shape: the ripple of single nodes averages out."""
    shape = wave.shape(problem.disc.position[:-1].T)
    weight = problem.disc.volume * shape
    return weight @ x[:-1, :2] / (weight @ shape)


def of_time(sides: tuple[int, ...], alphas: tuple[float, ...]) -> list[dict[str, Any]]:
    """Distance (L2, energy norm, relative) to Synchronous with a tenth of its step."""
    wave, rows = Wave(2), []
    print(f"\nerror of time stepping alone\n  {'':10}     α        N         L2     energy")
    for n in sides:
        fixed = Problem(wave.scene(box(2, n, 0.25, 1)))
        _, exact = end(fixed, Synchronous(safety=0.09))
        nodes = np.zeros((fixed.disc.nodes, 2))
        nodes[fixed.disc.dof] = exact[:-1, :2]
        shape = wave.shape(fixed.disc.position[:-1].T)[:, None]
        size = wave.norms(fixed, shape * precision.START[:2])
        methods = [("one step", 0.9, Synchronous())]
        for alpha in alphas:
            methods += [("plain", alpha, AVI(safety=alpha, balanced=False)),
                        ("balanced", alpha, AVI(safety=alpha))]  # fmt: skip
        for label, alpha, method in methods:
            problem = Problem(wave.scene(box(2, n, 0.25, 1)))
            _, x = end(problem, method)
            l2, energy = wave.norms(problem, x[:-1, :2] - nodes[problem.disc.dof]) / size
            row = {"method": label, "alpha": alpha, "per_side": n, "l2": l2, "energy": energy}
            rows.append(row)
            print(f"  {label:10}{alpha:6.3g}{n:9}{l2:11.2e}{energy:11.2e}")
            problem.close()
        fixed.close()
    return rows


def energies(scene: cb.Scene, method: Any, until: float, samples: int) -> list[float]:
    """Energy over its start at ``samples`` times, up to hundredfold growth."""
    problem = Problem(scene)
    run = method.prepare(problem, until)
    last, out = round(until / run.step), []
    for i in range(samples + 1):
        run.advance(max(0, i * last // samples - run.steps))
        e = run.entries()
        out.append(e.kinetic_u + e.kinetic_nu + e.stored)
        if not out[-1] < 100 * out[0]:
            break
    problem.close()
    return [total / out[0] for total in out]


def rough(wave: Wave, mesh: Any) -> cb.Scene:
    """Random positions at every node, at rest: all modes at once, the highest above all."""
    noise = lambda x: np.random.default_rng(1).standard_normal((1, x.shape[1]))  # noqa: E731
    return replace(wave.scene(mesh), initial=cb.Initial(u=noise, nu=noise))


def drift(options: list[tuple[str, Maker, int]], periods: float, long: int) -> list[dict[str, Any]]:
    """Energy over many periods, and over ``long`` windows, of all methods."""
    wave, rows = Wave(2), []
    A, K, R = precision.A, precision.K, precision.R
    fast = np.pi * math.sqrt(2 * np.linalg.eigvalsh(np.array([[A, R], [R, K]]))[-1])
    print(f"\nenergy over {periods:g} periods, and over {long} windows: E/E0 − 1, largest and "
          "last\n  mesh             method            data     periods              windows"
          )  # fmt: skip
    for name, make, n in options:
        for label, method in METHODS.items():
            for data, scene in (("smooth", wave.scene), ("random", lambda mesh: rough(wave, mesh))):
                until = periods * 2 * math.pi / fast
                some = np.array(energies(scene(make(n)), method, until, 180)) - 1
                step = method.prepare(Problem(scene(make(n))), until).step
                many = np.array(energies(scene(make(n)), method, long * step, 400)) - 1
                middle = len(many) // 2
                row = {"mesh": f"{name} {n}", "method": label, "data": data,
                       "series": some.tolist(), "largest": float(np.abs(some).max()),
                       "end": float(some[-1]), "long": many.tolist(),
                       "long_largest": float(np.abs(many).max()),
                       "long_end": float(many[-20:].mean()),
                       "long_middle": float(many[middle - 10 : middle + 10].mean())}  # fmt: skip
                rows.append(row)
                print(f"  {row['mesh']:16} {label:16} {data:8}{row['largest']:9.1e}"
                      f"{row['end']:9.1e}"
                      f"{row['long_largest']:12.1e}{row['long_middle']:9.1e}{row['long_end']:9.1e}",
                      flush=True)  # fmt: skip
    return rows


def draw(found: dict[str, Any], path: Path) -> None:
    """Errors under refinement, error of time over α, and energies."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(2, 2, figsize=(11, 8.4))
    case = next(iter(CASES))
    for ax, norm, title in ((axes[0, 0], "l2", "L2 norm"), (axes[0, 1], "energy", "Energy norm")):
        for label in METHODS:
            mine = [r for r in found["refinement"] if (r["case"], r["method"]) == (case, label)]
            colour, line = COLOURS[label.split(",")[0]], "--" if "0.6" in label else "-"
            x, y = [r["per_side"] for r in mine], [r[norm] for r in mine]
            size = 9 if label.startswith("one") else 4  # visible under the others
            ax.loglog(x, y, line, color=colour, marker="o", ms=size, label=label)
        order = 2 if norm == "l2" else 1
        guide = np.array([x[0], x[-1]], dtype=float)
        low = 0.6 * min(r[norm] for r in found["refinement"] if r["case"] == case)
        ax.loglog(guide, low * (guide / guide[-1]) ** -order, ":", color="0.6", lw=1)
        ax.annotate(f"order {order}", (guide[1], low), color="0.45", ha="right", va="top")
        ax.set_xticks(x, [str(n) for n in x])
        ax.minorticks_off()
        ax.set(title=f"{title} of the error, {case}", xlabel="cells per side")
    axes[0, 0].legend(frameon=False, fontsize=9, title="scheme, α", loc="lower left")
    ax = axes[1, 0]
    for label in COLOURS:
        if label not in ("plain", "balanced"):
            continue
        for n, line in ((20, "--"), (80, "-")):
            mine = [r for r in found["time"] if (r["method"], r["per_side"]) == (label, n)]
            x, y = [r["alpha"] for r in mine], [r["energy"] for r in mine]
            ax.loglog(x, y, line, color=COLOURS[label], marker="o", ms=4, label=f"{label}, {n}")
    ax.set_xticks([r["alpha"] for r in mine], [f"{r['alpha']:g}" for r in mine])
    ax.minorticks_off()
    ax.legend(frameon=False, fontsize=9, title="scheme, cells per side")
    ax.set(title="Energy-norm error of time stepping alone", xlabel="α")
    ax = axes[1, 1]
    first = found["drift"][0]["mesh"]
    for row in found["drift"]:
        if row["mesh"] == first and row["method"] in ("one step, 0.9", "balanced, 0.45"):
            change = 100 * np.array(row["long"])
            times = np.linspace(0, found["long"], len(change))
            colour, dash = COLOURS[row["method"].split(",")[0]], "-:"[row["data"] == "random"]
            label = f"{row['method']}, {row['data']}"
            ax.plot(times, change, dash, lw=1.0, label=label, color=colour)
    ax.legend(frameon=False, fontsize=9, loc="center left", bbox_to_anchor=(0.0, 0.63))
    ax.set(title=f"Change of energy [%], {first} per side", xlabel="steps, or windows")
    for ax in axes.flat:
        ax.grid(True, lw=0.4, color="0.9")
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    """Measure, print, write and draw."""
    style = argparse.RawTextHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("--quick", action="store_true", help="small meshes, for a check")
    parser.add_argument("--out", type=Path, help="folder; docs/charts, or results with --quick")
    parser.add_argument("--draw", action="store_true", help="only draw again what was measured")
    options = parser.parse_args()
    out = options.out or Path("results" if options.quick else "docs/charts")
    out.mkdir(parents=True, exist_ok=True)
    data, quick = out / "asynchrony.json", options.quick
    if not options.draw:
        moved, graded = CASES["2D, vertices moved by 25 %"][2], CASES["2D, graded by 27"][2]
        two = [("moved", moved, 10 if quick else 20)]
        two += [] if quick else [("graded by 27", graded, 20)]
        periods, long = (5.0, 1000) if quick else (45.0, 100_000)
        found = {
            "machine": machine.machine(), "versions": machine.versions(),
            "commit": machine.commit(), "periods": periods, "long": long,
            "refinement": [r for name in CASES for r in refinement(name, 1 if quick else 4)],
            "time": of_time((10,) if quick else (20, 40, 80), (0.15, 0.3, 0.45, 0.6)),
            "drift": drift(two, periods, long),
        }  # fmt: skip
        data.write_text(json.dumps(found) + "\n")
    draw(json.loads(data.read_text()), out / "asynchrony.png")


if __name__ == "__main__":
    main()
