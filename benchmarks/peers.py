# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time of a step of the peers over that of Synchronous, side by side in one process.

    python benchmarks/peers.py [--cells 15]

A cube of 6·cells³ scattered tetrahedra of the scaled icosahedral quasicrystal (6 components, a
viscous phason). Explicit methods make the same step, 0.9 of the critical one; implicit ones 0.9, 5
and 20 of it. Contenders take turns; the smallest processor time of the rounds counts. Ratios are of
time per step and per simulated time; "updates" are passes over all cells per step.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from mpi4py import MPI

import complexbody as cb
from complexbody import machine, meshes
from complexbody.forms import scaled_icosahedral_quasicrystal
from complexbody.problem import Problem
from complexbody.timesets import critical_step

ROUNDS = 5


def scene(cells: int) -> cb.Scene:
    """A standing start in a cube that is held all around."""
    mesh = meshes.jiggled(meshes.box(MPI.COMM_SELF, (0, 0, 0), (1, 1, 1), cells), 0.15)

    def start(x: Any) -> Any:
        shape = np.prod(np.sin(np.pi * x), axis=0)
        return np.array([shape, 0 * shape, 0.5 * shape])

    held = [cb.Fix("u", "boundary"), cb.Fix("nu", "boundary")]
    body = scaled_icosahedral_quasicrystal()
    return cb.Scene(mesh, body, held, initial=cb.Initial(u=start, nu=start))


def contenders(critical: float) -> dict[str, tuple[Any, int]]:
    """Integrators by name, and how many steps are timed at once."""
    h = 0.9 * critical
    out: dict[str, tuple[Any, int]] = {
        "Synchronous": (cb.Synchronous(step=h), 100),
        "AssembledLeapfrog, assembly": (cb.AssembledLeapfrog("assembly", step=h), 15),
        "AssembledLeapfrog, matrix": (cb.AssembledLeapfrog("matrix", step=h), 30),
        "PetscTS rk4": (cb.PetscTS("rk4", h), 10),
    }
    for factor in (0.9, 5, 20):
        step, count = factor * critical, 10 if factor < 20 else 5
        out[f"Newmark, step × {factor:g}"] = cb.Newmark(step), count
        out[f"PetscTS alpha2, step × {factor:g}"] = cb.PetscTS("alpha2", step), count
        out[f"PetscTS cn, step × {factor:g}"] = cb.PetscTS("cn", step), count
    return out


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=15, help="cells per side; default 15")
    problem = Problem(scene(parser.parse_args().cells))
    critical, count = critical_step(problem, "exact"), problem.disc.count
    seconds: dict[str, float] = {}
    updates: dict[str, float] = {}
    methods = contenders(critical)
    for turn in range(ROUNDS + 1):
        for name, (method, steps) in methods.items():
            run = method.prepare(problem, 1e4 * method.step)
            run.advance(2)
            before, begun = run.updates, time.process_time()
            run.advance(steps)
            passed = (time.process_time() - begun) / steps
            if turn:  # the first round warms up
                seconds[name] = min(passed, seconds.get(name, np.inf))
            updates[name] = (run.updates - before) / steps / count
            run.close()
    base, step = seconds["Synchronous"], methods["Synchronous"][0].step
    here = machine.machine()
    print(f"{count} tetrahedra, 6 components, on {here['cpu']}")
    print(f"Synchronous: {base / count * 1e9:.1f} ns per cell and step")
    print(f"  {'':32}{'× step':>10}{'× time':>10}{'updates':>10}")
    for name, (method, _) in methods.items():
        ratio = seconds[name] / base
        print(f"  {name:32}{ratio:10.1f}{ratio * step / method.step:10.1f}{updates[name]:10.1f}")


if __name__ == "__main__":
    main()
