# SPDX-License-Identifier: LGPL-3.0-or-later
"""What quiet cells save: a pulse that enters a body at rest, with and without skipping them.

    python benchmarks/quiet.py [--cells 160000] [--repeats 5] [--part 0.1]

The body is a cube of icosahedral quasicrystal (scaled units, six components), hit on a small patch
of one face, its cells equal, or the finer the nearer to the patch (by 6 along each axis); for the
implicit integrator its χ is ½(1 + |ν|²)|ν̇|². The run lasts ``part`` of the time in which its
fastest wave crosses the cube. Times are processor times of all steps, the first one included, the
smallest of the repeats, with and without in turn; the two runs end in the same state to the bit,
which is checked.

Where all cells are awake there is nothing to skip. The second table is what the watch would cost
there if it were kept on; it is given up before, and what is left is a test per chunk of cells. The
last table is by the share of cells that are awake.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes
from complexbody.forms import scaled_icosahedral_quasicrystal
from complexbody.problem import Problem

METHODS = {
    "Synchronous": cb.Synchronous(),
    "AVI, balanced": cb.AVI(),
    "AVI, plain": cb.AVI(balanced=False),
    "AVI, exact": cb.AVI(schedule="exact"),
    "LocalLeapfrog": cb.LocalLeapfrog(),
}
#: Those that pay off on graded meshes; and how far a cell's size may vary there.
LOCAL, GROWTH = ("AVI, balanced", "AVI, plain", "AVI, exact", "LocalLeapfrog"), 6.0


def cube(comm: Any, cells: int, growth: float = 1.0, general: bool = False) -> cb.Scene:
    """A cube of about so many cells, hit on a patch; cells across its face grow so many times."""
    side = max(2, round((cells / 6) ** (1 / 3)))
    mesh = meshes.box(comm, (0, 0, 0), (1, 1, 1), (side,) * 3)
    if growth > 1:
        x, a = mesh.geometry.x, np.log(growth)
        s = 2 * x[:, 1:] - 1  # finest in the middle, on both axes, and at the face
        x[:, 1:] = 0.5 + 0.5 * np.sign(s) * np.expm1(a * np.abs(s)) / np.expm1(a)
        x[:, 0] = np.expm1(a * x[:, 0]) / np.expm1(a)
    width = 1.6 / side * (np.log(growth) / (growth - 1) if growth > 1 else 1.0)

    def patch(x: Any) -> Any:
        return (x[0] < 1e-9) & (np.abs(x[1:] - 0.5).max(axis=0) < width)

    body = scaled_icosahedral_quasicrystal()
    if general:
        body = replace(body, inertia=chi)
    return cb.Scene(mesh, body, loads=[cb.Traction(patch, (1.0, 0.3, 0.0), cb.ricker(20.0))])


def chi(nu: Any, rate: Any) -> Any:
    """½(1 + |ν|²)|ν̇|², so that momenta have to be solved for."""
    return 0.5 * (1 + ufl.inner(nu, nu)) * ufl.inner(rate, rate)


def crossing(scene: cb.Scene) -> float:
    """Time in which the fastest plane wave along an axis crosses the cube [s]."""
    problem = Problem(scene)
    n, H = scene.components, problem.hessian_samples(0)[0]
    mass = np.r_[np.full(3, scene.bodies[0].density), np.diag(scene.bodies[0].inertia_matrix)]
    along = H[0 : 3 * n : 3, 0 : 3 * n : 3] / np.sqrt(np.outer(mass, mass))
    problem.close()
    return float(1 / np.sqrt(np.linalg.eigvalsh(along).max()))


def compare(
    scene: cb.Scene, method: Any, until: float, repeats: int
) -> tuple[Any, int, list[float]]:
    """A run with quiet cells skipped, its steps, and processor times of with and without [s]."""
    problems, runs = {}, {}
    for quiet in (True, False):
        problems[quiet] = Problem(scene)
        problems[quiet].quiet = quiet
    best = dict.fromkeys(problems, np.inf)
    for _ in range(repeats):
        for quiet, problem in problems.items():
            run = runs[quiet] = method.prepare(problem, until)
            steps = max(round(until / run.step), 1)
            begun = time.process_time()
            run.advance(steps)
            best[quiet] = min(best[quiet], time.process_time() - begun)
            run.close()
    ends = [[values.copy() for values in runs[quiet].sample()] for quiet in problems]
    assert all(map(np.array_equal, *ends)), "skipping quiet cells has changed a bit"
    for problem in problems.values():
        problem.close()
    return runs[True], steps, list(best.values())


def savings(scene: cb.Scene, methods: dict[str, Any], until: float, repeats: int) -> None:
    """Print what each method saves."""
    head = ("steps", "skipped", "of updates", "of time", "saving")
    print(f"{'':16}" + "".join(f"{word:>12}" for word in head))
    for name, method in methods.items():
        run, steps, (some, full) = compare(scene, method, until, repeats)
        quiet = run.skipped / (run.skipped + run.updates)
        print(
            f"{name:16}{steps:12d}{quiet:12.3f}{1 - quiet:12.3f}{some / full:12.3f}"
            f"{full / some:12.2f}",
            flush=True,
        )
    print(f"{run.problem.disc.count} cells")


def overhead(scene: cb.Scene, method: Any) -> float:
    """Time of steps with the watch kept on, where all cells are awake, over that without it.

    More than is ever paid: a watch is given up before that. One run with it on and off in turn,
    since two runs differ by more, by where their arrays happen to lie.
    """
    problem = Problem(scene)
    run = method.prepare(problem, 10.0)
    assert run.activity is not None
    state = run.activity.state
    while state.awake_cells < state.cells:
        state.on = 1
        run.advance(1)
    best = {0: np.inf, 1: np.inf}
    for _ in range(60):
        for on in best:
            state.on = on
            begun = time.process_time()
            run.advance(4)
            best[on] = min(best[on], time.process_time() - begun)
    run.close()
    problem.close()
    return best[1] / best[0]


def by_share(scene: cb.Scene, repeats: int) -> None:
    """Time of a step over that of a full one, as the pulse spreads."""
    times: dict[bool, Any] = {}
    shares: list[float] = []
    for attempt in range(repeats):
        for quiet in (True, False):
            problem = Problem(scene)
            problem.quiet = quiet
            run = cb.Synchronous().prepare(problem, 10.0)
            run.advance(1)
            found = []
            for _ in range(60):
                begun = time.process_time()
                run.advance(1)
                found.append(time.process_time() - begun)
                if quiet and attempt == 0:
                    shares.append(1.0)
                    if run.activity is not None and run.activity.state.on:
                        state = run.activity.state
                        shares[-1] = state.awake_cells / state.cells
            run.close()
            problem.close()
            times[quiet] = np.minimum(times.get(quiet, np.inf), found)
    full = float(np.median(times[False]))
    print("\nawake at a step's end, and its time over a full one's")
    for i in range(0, 60, 3):
        print(f"{shares[i]:8.3f} {times[True][i] / full:8.3f}")
        if shares[i] == 1.0:
            break


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=160_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--part", type=float, default=0.1, help="of the crossing time")
    options = parser.parse_args()
    comm = MPI.COMM_SELF
    pulse = cube(comm, options.cells)
    until = options.part * crossing(pulse)
    print(f"a pulse, {options.part:g} of the crossing time, equal cells")
    savings(pulse, METHODS, until, options.repeats)
    general = cube(comm, options.cells, general=True)
    savings(general, {"Implicit": cb.Implicit()}, until, options.repeats)
    graded = cube(comm, options.cells, GROWTH)
    print(f"\nthe same, cells growing by {GROWTH:g} from the patch on")
    savings(graded, {name: METHODS[name] for name in LOCAL}, until, options.repeats)
    print("\nall cells awake: time of a step with the watch kept on over one without")
    for name, method in METHODS.items():
        if name != "AVI, exact":  # all it does for quiet cells is before a span
            scene = graded if name == "LocalLeapfrog" else pulse
            print(f"{name:16}{overhead(scene, method):12.3f}", flush=True)
    by_share(pulse, options.repeats)


if __name__ == "__main__":
    main()
