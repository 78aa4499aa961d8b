# SPDX-License-Identifier: LGPL-3.0-or-later
"""Whole steps of the synchronous integrator: against one force evaluation, by mesh size, by ranks.

    python benchmarks/step.py [--cells 100000 1000000 3000000] [--dim 2 3]
    mpirun -n 2 python benchmarks/step.py --scaling

The second form measures the speed-up of two ranks on one mesh beside that of two independent
copies of the whole problem running at once: what the machine itself allows.
"""

from __future__ import annotations

import argparse
import time
import tracemalloc
from typing import Any

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

import complexbody as cb
from complexbody.forms import isotropic_two_field, scaled_icosahedral_quasicrystal
from complexbody.integrators.synchronous_run import SynchronousRun
from complexbody.problem import Problem


def start(comm: Any, dim: int, cells: int) -> SynchronousRun:
    """A coupled body of 2·dim components on about ``cells`` simplices, ready to step."""
    none = dmesh.GhostMode.none
    if dim == 3:
        m = max(1, round((cells / 6) ** (1 / 3)))
        mesh = dmesh.create_box(comm, [np.zeros(3), np.ones(3)], [m] * 3, ghost_mode=none)
        body = scaled_icosahedral_quasicrystal(viscosity=0.0)
    else:
        m = max(1, round((cells / 2) ** 0.5))
        mesh = dmesh.create_rectangle(comm, [np.zeros(2), np.ones(2)], [m, m], ghost_mode=none)
        body = isotropic_two_field(d=2)
    wave = lambda x: 1e-3 * np.sin(7 * x[:1] + 3 * x[1:2]) * np.ones((dim, 1))  # noqa: E731
    scene = cb.Scene(mesh, body, initial=cb.Initial(u=wave, nu=wave))
    run = cb.Synchronous().prepare(Problem(scene), 1.0)
    run.advance(3)
    return run


def seconds_per_call(call: Any, repeats: int, least: float = 0.3) -> float:
    """Smallest mean time of one call over ``repeats`` stretches of about ``least`` seconds."""
    begun = time.perf_counter()
    call()
    count = max(1, int(least / (time.perf_counter() - begun)))
    best = np.inf
    for _ in range(repeats):
        begun = time.perf_counter()
        for _ in range(count):
            call()
        best = min(best, (time.perf_counter() - begun) / count)
    return float(best)


def sizes(dims: list[int], cells: list[int], repeats: int) -> None:
    """Cost per cell of a step and of a force evaluation over mesh sizes, one rank."""
    for dim in dims:
        print(f"\n{dim}D, one core; ns per cell")
        print(
            f"{'cells':>9} {'force':>7} {'step':>7} {'step/force':>10} {'bytes/cell':>10} "
            f"{'new bytes':>9}"
        )
        first = None
        for wanted in cells:
            run = start(MPI.COMM_SELF, dim, wanted)
            kernels, count = run.problem.kernels, int(np.sum(run.problem.disc.source_cell >= 0))
            force, step = np.inf, np.inf
            for _ in range(repeats):  # in turn: both see the same noise
                force = min(force, seconds_per_call(kernels.forces, 1))
                kernels.reset_forces()
                step = min(step, seconds_per_call(lambda r=run: r.advance(4), 1) / 4)
            tracemalloc.start()
            run.advance(50)
            new = tracemalloc.get_traced_memory()[1] / 50
            tracemalloc.stop()
            per = 1e9 / count
            first = first or step * per
            print(
                f"{count:9d} {force * per:7.1f} {step * per:7.1f} {step / force:10.2f} "
                f"{kernels.bytes_per_cell():10.0f} {new:9.0f}   "
                f"({step * per / first:.2f} of the first)",
                flush=True,
            )
            run.problem.close()


def scaling(cells: int, repeats: int) -> None:
    """Two ranks on one mesh against one rank, beside two whole copies at once."""
    comm = MPI.COMM_WORLD
    together = start(comm, 3, cells)
    alone = start(MPI.COMM_SELF, 3, cells)  # every rank has its own whole copy
    steps = 10
    best = {"one": np.inf, "copies": np.inf, "together": np.inf}

    def timed(run: SynchronousRun | None) -> float:
        comm.Barrier()
        begun = time.perf_counter()
        if run is not None:
            run.advance(steps)
        elapsed = time.perf_counter() - begun
        return float(comm.allreduce(elapsed, op=MPI.MAX))

    for _ in range(repeats):
        best["one"] = min(best["one"], timed(alone if comm.rank == 0 else None))
        best["copies"] = min(best["copies"], timed(alone))
        best["together"] = min(best["together"], timed(together))
    if comm.rank == 0:
        count = int(np.sum(alone.problem.disc.source_cell >= 0))
        limit = comm.size * best["one"] / best["copies"]
        speed = best["one"] / best["together"]
        print(f"{count} cells, {comm.size} ranks")
        print(f"  speed-up of {comm.size} ranks on one mesh      {speed:5.2f}")
        print(f"  throughput of {comm.size} copies at once       {limit:5.2f}")
        print(f"  reached of the machine's own limit     {100 * speed / limit:4.0f} %")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, nargs="+", default=[100000, 1000000, 3000000])
    parser.add_argument("--dim", type=int, nargs="+", default=[2, 3], choices=[2, 3])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--scaling", action="store_true", help="ranks instead of sizes")
    options = parser.parse_args()
    if options.scaling:
        scaling(options.cells[0] if len(options.cells) == 1 else 600000, options.repeats)
    elif MPI.COMM_WORLD.rank == 0:
        sizes(options.dim, options.cells, options.repeats)


if __name__ == "__main__":
    main()
