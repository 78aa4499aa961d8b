# SPDX-License-Identifier: LGPL-3.0-or-later
"""What checkpoints cost: a run with them over one without, and one checkpoint over the interval.

    [mpirun -n 2] python benchmarks/checkpoint.py [--cells 100000] [--steps 400]

A cube of icosahedral quasicrystal that rings. The first number is the wall time of making one
checkpoint over the default interval of 600 s; the second is what all but the checkpoints cost
(looks at the clock and for signals, copies of states whose books were in order): the time of steps
and books with checkpoints switched on but none due, over that without, the smallest of three each,
in turn.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

from mpi4py import MPI

import complexbody as cb
from complexbody import meshes, statefile
from complexbody.forms import scaled_icosahedral_quasicrystal
from complexbody.problem import Problem
from complexbody.timesets import critical_step


def cube(comm: Any, cells: int) -> cb.Scene:
    """A cube of about so many cells, in motion."""
    side = max(2, round((cells / 6) ** (1 / 3)))
    initial = cb.Initial(u=lambda x: 0.01 * x[:3] ** 2, nu=lambda x: 0.01 * x[:3])
    mesh = meshes.box(comm, (0, 0, 0), (1, 1, 1), (side,) * 3)
    return cb.Scene(mesh, scaled_icosahedral_quasicrystal(), initial=initial)


def main() -> None:
    """Measure and print."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--cells", type=int, default=100_000)
    options.add_argument("--steps", type=int, default=400)
    a, comm = options.parse_args(), MPI.COMM_WORLD
    with tempfile.TemporaryDirectory() as made:
        folder = Path(comm.bcast(made))
        scene = cube(comm, a.cells)
        until = a.steps * 0.9 * critical_step(Problem(scene))
        for method in (cb.Synchronous(), cb.AVI()):
            times: dict[bool, list[float]] = {True: [], False: []}
            saving, size = 0.0, 0
            for _ in range(3):
                for on in times:
                    keep = cb.Checkpoint(1e9, folder=folder) if on else None
                    s = cb.simulate(scene, method, until=until, checkpoint=keep).stats
                    times[on].append(s.stepping + s.booking)
                    if on:
                        saving, size = s.saving, statefile.listed(folder)[0].stat().st_size
            if comm.rank == 0:
                ratio = min(times[True]) / min(times[False])
                print(
                    f"{type(method).__name__}: {s.cells} cells, {size / 1e6:.1f} MB in "
                    f"{saving:.3f} s, {saving / 600:.2%} of 600 s; the rest: {ratio:.3f}"
                )


if __name__ == "__main__":
    main()
