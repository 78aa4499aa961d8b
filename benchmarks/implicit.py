# SPDX-License-Identifier: LGPL-3.0-or-later
"""The implicit integrator: a Newton per node against SNES, iterations per step, memory over time.

    python benchmarks/implicit.py [--cells 120] [--steps 2000]

A field of bodies with χ = ½(1 + ν)³ν̇² on a square, coupled to u. Errors are those of ν against a
run on a mesh twice as fine with half the step, in the mean over nodes both meshes have.
"""

from __future__ import annotations

import argparse
import resource
import time
from typing import Any

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

import complexbody as cb
from complexbody.integrators.implicit_run import ImplicitRun
from complexbody.problem import Problem


def scene(comm: Any, cells: int) -> cb.Scene:
    """Stretching in u and ν, ν coupled to div u, an inertia that grows with ν."""

    def energy(U: Any, nu: Any, N: Any) -> Any:
        squares = sum(U[i, j] ** 2 for i in range(2) for j in range(3))
        gradient = sum(N[0, j] ** 2 for j in range(3))
        return 0.5 * (squares + gradient) + 0.4 * (U[0, 0] + U[1, 1]) * nu[0] + nu[0] ** 2

    body = cb.Body(1, energy, 1.0, lambda nu, v: 0.5 * (1 + nu[0]) ** 3 * v[0] ** 2, displacement=2)
    mesh = dmesh.create_unit_square(comm, cells, cells, ghost_mode=dmesh.GhostMode.none)
    start = lambda x: 0.3 * np.cos(np.pi * x[0]) * np.cos(np.pi * x[1])  # noqa: E731
    return cb.Scene(mesh, body, supports=[cb.Fix("u", "boundary")], initial=cb.Initial(nu=start))


def at_nodes(result: cb.Result, points: int) -> np.ndarray:
    """ν at the corners of a grid of ``points`` squares per side."""
    x = result.scene.mesh.geometry.x
    grid = np.round(points * x[:, :2], 9)
    on = np.all(np.abs(grid - np.round(grid)) < 1e-6, axis=1)
    values = np.zeros((points + 1, points + 1))
    i, j = np.round(grid[on]).astype(int).T
    values[i, j] = result.nu.x.array[on]
    return values


def errors(cells: int, until: float) -> None:
    """Error, time and iterations of both quadratures, and of half their step."""
    fine = cb.simulate(scene(MPI.COMM_SELF, 2 * cells), cb.Implicit(safety=0.3), until=until)
    exact = at_nodes(fine, cells)
    print(f"{2 * cells**2} triangles, 3 components, until t = {until}")
    print(f"{'quadrature':12s} {'error of ν':>11s} {'time':>6s}   solving")
    first = 0.0
    for quadrature in ("vertex", "consistent"):
        for safety in (0.8, 0.4):
            method = cb.Implicit(quadrature=quadrature, safety=safety)
            seconds = np.inf
            for _ in range(2):
                result = cb.simulate(scene(MPI.COMM_SELF, cells), method, until=until)
                seconds = min(seconds, result.stats.stepping)
            first = first or seconds
            error = np.sqrt(np.mean((at_nodes(result, cells) - exact) ** 2))
            print(f"{quadrature:12s} {error:11.2e} {seconds / first:6.2f}   {result.solving}")


def memory(steps: int) -> None:
    """Growth of this process's memory over ``steps`` steps."""
    for quadrature in ("vertex", "consistent"):
        run = cb.Implicit(quadrature=quadrature).prepare(Problem(scene(MPI.COMM_SELF, 40)), 1e3)
        assert isinstance(run, ImplicitRun)
        run.advance(steps // 10)
        before, begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
        run.advance(steps)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        print(f"{quadrature:12s} {steps} steps: memory grew by {grown} of {before} KB "
              f"({time.perf_counter() - begun:.0f} s)")  # fmt: skip
        run.close()


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, default=120)
    parser.add_argument("--steps", type=int, default=2000)
    options = parser.parse_args()
    errors(options.cells, 0.2)
    memory(options.steps)


if __name__ == "__main__":
    main()
