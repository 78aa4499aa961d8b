# SPDX-License-Identifier: LGPL-3.0-or-later
"""What several ranks gain on one graded mesh, by method, beside what the machine itself allows.

    mpirun -n 2 python benchmarks/avi_ranks.py [--cells 216000] [--even] [--quick]

*Speed-up* is the time of one rank alone over that of all ranks on the same mesh; *limit* the
throughput of as many whole copies at once as there are ranks, one a rank: what processor and
memory give. ``--even`` shares cells out by their work (``meshes.balanced``), else dolfinx does by
their number. Wall times, taken in turn, the least of the repeats.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
from avi import METHODS, scene
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes
from complexbody.problem import Problem

UNTIL = 50.0


def prepared(comm: Any, cells: int, even: bool, method: Any) -> tuple[Any, int]:
    """A run of the 3D scene that is under way, and how many beats make some 3·10⁶ updates."""
    given = scene(3, cells, 64.0, 0.0, comm)
    if even and comm.size > 1:
        mesh = meshes.balanced(given.mesh)[0]
        given = cb.Scene(mesh, given.bodies[0], initial=given.initial)
    run = method.prepare(Problem(given), UNTIL)
    run.advance(2)
    before = comm.allreduce(run.updates)
    run.advance(1)
    done = comm.allreduce(run.updates) - before or cells
    return run, max(1, round(3e6 / done))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=216000)
    parser.add_argument("--even", action="store_true", help="share cells out by work")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--quick", action="store_true", help="a small mesh, few repeats")
    options = parser.parse_args()
    cells, repeats = options.cells, options.repeats
    if options.quick:
        cells, repeats = cells // 10, 3
    comm = MPI.COMM_WORLD
    if comm.rank == 0:
        heads = ("speed-up", "limit", "reached", "imbalance")
        print(f"{comm.size} ranks{'':12}" + "{:>10}{:>8}{:>9}{:>11}".format(*heads))
    for name, method in {"synchronous": cb.Synchronous(), **METHODS}.items():
        together, beats = prepared(comm, cells, options.even, method)
        alone, _ = prepared(MPI.COMM_SELF, cells, False, method)  # every rank its whole copy
        best = dict.fromkeys(("one", "copies", "together"), np.inf)
        for _ in range(repeats):
            for what, run in (
                ("one", alone if comm.rank == 0 else None), ("copies", alone),
                ("together", together),
            ):  # fmt: skip
                comm.Barrier()
                begun = time.perf_counter()
                if run is not None:
                    run.advance(beats)
                elapsed = comm.allreduce(time.perf_counter() - begun, op=MPI.MAX)
                best[what] = min(best[what], elapsed)
        limit, speed = comm.size * best["one"] / best["copies"], best["one"] / best["together"]
        work = comm.allgather(together.updates)
        if comm.rank == 0:
            uneven = max(work) * comm.size / max(sum(work), 1) - 1
            print(
                f"{name:19}{speed:10.2f}{limit:8.2f}{100 * speed / limit:7.0f} %"
                f"{100 * uneven:9.0f} %",
                flush=True,
            )
        together.close()
        alone.close()


if __name__ == "__main__":
    main()
