# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a plan saves: the same scene with all components and with those that move, side by side.

    python benchmarks/plan.py [--cells 200] [--repeats 5]

*Antiplane*: a Cosserat body of six components on a plane mesh, of which u3, φ1 and φ2 move.
*Uncoupled*: an icosahedral quasicrystal in space without phonon–phason coupling: only u moves.
Both runs make the same steps and end in the same fields. Processor time of stepping, the smallest
of some runs made in turn; the time to plan is what it adds to setting up a run.
"""

from __future__ import annotations

import argparse
import time
import warnings
from typing import Any

import numpy as np
import ufl
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes
from complexbody.forms import scaled_icosahedral_quasicrystal
from complexbody.problem import Problem


def cosserat(U: Any, nu: Any, N: Any) -> Any:
    """Microrotations φ, held a little."""
    curl = ufl.as_vector([U[2, 1] - U[1, 2], U[0, 2] - U[2, 0], U[1, 0] - U[0, 1]])
    turn, strain = 0.5 * curl - nu, ufl.sym(U)
    return (0.5 * ufl.tr(strain) ** 2 + 1.3 * ufl.inner(strain, strain)
            + 0.6 * ufl.inner(turn, turn) + 0.4 * ufl.inner(N, N)
            + 0.1 * ufl.inner(nu, nu))  # fmt: skip


def bump(component: int, dim: int) -> Any:
    """A smooth bump of one of three components in the middle of the unit square or cube."""

    def values(x: Any) -> Any:
        out = np.zeros((3, x.shape[1]))
        out[component] = np.exp(-40 * np.sum((x[:dim] - 0.5) ** 2, axis=0))
        return out

    return values


def antiplane(cells: int) -> cb.Scene:
    """Three of six components move."""
    mesh = meshes.rectangle(MPI.COMM_SELF, (0, 0), (1, 1), cells)
    body = cb.Body(3, cosserat, 1.0, 0.5, 0.1)
    return cb.Scene(mesh, body, initial=cb.Initial(u=bump(2, 2)), name="antiplane Cosserat")


def uncoupled(cells: int) -> cb.Scene:
    """Phonons move, phasons do not."""
    side = max(4, round((cells**2 / 3) ** (1 / 3)))
    mesh = meshes.box(MPI.COMM_SELF, (0, 0, 0), (1, 1, 1), side)
    body = scaled_icosahedral_quasicrystal(0.0)
    return cb.Scene(mesh, body, initial=cb.Initial(u=bump(0, 3)), name="phonons alone")


def set_up(scene: cb.Scene, plan: bool) -> float:
    """Processor time to make a scene ready [s]."""
    begun = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        problem = Problem(scene, reduce=plan)
    problem.close()
    return time.process_time() - begun


def measure(scene: cb.Scene, repeats: int, steps: int = 60) -> None:
    """Print what leaving components out saves."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        problems = {plan: Problem(scene, reduce=plan) for plan in (True, False)}
    best, ends = {}, {}
    step = cb.Synchronous().prepare(problems[False], 1.0).step
    for turn in range(repeats + 1):
        for plan, problem in problems.items():
            run = cb.Synchronous(step).prepare(problem, steps * step)
            run.advance(2)
            begun = time.process_time()
            run.advance(steps)
            spent = time.process_time() - begun
            if turn:  # the first is a warm-up
                best[plan] = min(spent, best.get(plan, np.inf))
            n = problem.disc.n
            ends[plan] = problem.spread(run.sample()[0][: problem.disc.nodes, :n]).copy()
    live, total = problems[True].disc.n, problems[False].disc.n
    count = problems[True].disc.count
    apart = np.abs(ends[True] - ends[False]).max() / np.abs(ends[False]).max()
    memory = [problems[p].kernels.bytes_per_cell() for p in (False, True)]
    planning = min(set_up(scene, True) - set_up(scene, False) for _ in range(repeats))
    print(f"{scene.name}: {count} cells, {live} of {total} components")
    print(f"  time of all over that of those that move    {best[False] / best[True]:6.2f}")
    print(f"  memory likewise                             {memory[0] / memory[1]:6.2f}")
    print(f"  fields apart, relative                      {apart:6.1e}")
    share = planning / (best[True] / steps * 5000)
    print(f"  planning over a run of 5000 steps           {100 * share:6.2f} %")


def main() -> None:
    """Both scenes."""
    style = argparse.RawTextHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=style)
    parser.add_argument("--cells", type=int, default=200, help="squares per side")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    for make in (antiplane, uncoupled):
        measure(make(options.cells), options.repeats)


if __name__ == "__main__":
    main()
