# SPDX-License-Identifier: LGPL-3.0-or-later
"""Force evaluations side by side: our kernel, dolfinx's assembly, products with the stiffness.

    python benchmarks/force.py [--cells 50000 …] [--dim 2 3] [--repeats 7]

One process, one core; every contender works on the same body and mesh, taken in turn, and the
smallest time of the repeats counts. Read the ratios: a time on its own says nothing.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dolfinx.fem.petsc  # noqa: F401  (not imported by dolfinx.fem itself)
import numpy as np
from dolfinx import fem
from dolfinx import mesh as dmesh
from mpi4py import MPI
from petsc4py import PETSc

import complexbody as cb
from complexbody import _compat
from complexbody.forms import isotropic_two_field, scaled_icosahedral_quasicrystal
from complexbody.problem import Problem


def body_and_mesh(dim: int, cells: int) -> tuple[cb.Body, Any]:
    """A coupled body of 2·dim components and a uniform mesh of about ``cells`` simplices."""
    comm, none = MPI.COMM_SELF, dmesh.GhostMode.none
    if dim == 3:
        m = max(1, round((cells / 6) ** (1 / 3)))
        box = [np.zeros(3), np.ones(3)]
        return scaled_icosahedral_quasicrystal(), dmesh.create_box(
            comm, box, [m] * 3, ghost_mode=none
        )
    m = max(1, round((cells / 2) ** 0.5))
    mesh = dmesh.create_rectangle(comm, [np.zeros(2), np.ones(2)], [m, m], ghost_mode=none)
    return isotropic_two_field(d=2), mesh


def fastest(
    contenders: dict[str, Callable[[], None]], repeats: int, seconds: float
) -> dict[str, float]:
    """Smallest time of one call of each contender, taken in turn so that all see the same noise."""
    best = dict.fromkeys(contenders, np.inf)
    calls = {}
    for name, call in contenders.items():
        call()  # warm-up, discarded
        begun = time.perf_counter()
        call()
        calls[name] = max(1, int(seconds / max(time.perf_counter() - begun, 1e-9)))
    for _ in range(repeats):
        for name, call in contenders.items():
            begun = time.perf_counter()
            for _ in range(calls[name]):
                call()
            best[name] = min(best[name], (time.perf_counter() - begun) / calls[name])
    return best


def stiffness(problem: Problem, kind: str) -> Any:
    """The assembled stiffness as a PETSc matrix of type "aij" or "baij"."""
    matrix = fem.petsc.assemble_matrix(_compat.form(problem.action.jacobian()))
    matrix.assemble()
    return matrix if kind == "aij" else matrix.convert("baij")


def measure(dim: int, cells: int, repeats: int, matrices: bool) -> dict[str, Any]:
    """Seconds of each contender on one mesh, with memory per cell."""
    body, mesh = body_and_mesh(dim, cells)
    problem = Problem(cb.Scene(mesh, body))
    kernels, action = problem.kernels, problem.action
    rng = np.random.default_rng(1)
    kernels.x[:-1, : problem.disc.n] = rng.standard_normal((problem.disc.nodes, problem.disc.n))
    count = _compat.cell_count(mesh)[0]
    default = fem.form(action.residual())
    tuned = _compat.form(action.residual())
    vector = np.zeros(len(action.q.x.array))
    contenders: dict[str, Callable[[], None]] = {
        "complexbody": kernels.forces,
        "dolfinx (default flags)": lambda: fem.assemble_vector(vector, default),
        "dolfinx (-O3 -march=native)": lambda: fem.assemble_vector(vector, tuned),
    }
    keep, size = [], {}
    if matrices:
        for kind in ("aij", "baij"):
            matrix = stiffness(problem, kind)
            x, y = matrix.createVecRight(), matrix.createVecLeft()
            x.setArray(rng.standard_normal(x.getLocalSize()))
            contenders[f"PETSc {kind} product"] = lambda a=matrix, b=x, c=y: a.mult(b, c)
            keep.append((matrix, x, y))
            info = matrix.getInfo()
            size[f"PETSc {kind} product"] = info["nz_used"] * (12 if kind == "aij" else 8.1) / count
    best = fastest(contenders, repeats, 0.1)
    size["complexbody"] = kernels.bytes_per_cell()
    for matrix, x, y in keep:
        for thing in (matrix, x, y):
            thing.destroy()
    problem.close()
    return {
        "dim": dim,
        "cells": count,
        "components": problem.disc.n,
        "seconds": best,
        "bytes": size,
    }


def main() -> None:
    """Measure and print; --json writes the figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, nargs="+", default=[48000, 100000, 400000])
    parser.add_argument("--dim", type=int, nargs="+", default=[2, 3], choices=[2, 3])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--no-matrices", action="store_true", help="leave out PETSc products")
    parser.add_argument("--json", type=Path, help="write the figures here")
    options = parser.parse_args()
    results = []
    for dim in options.dim:
        for cells in options.cells:
            r = measure(dim, cells, options.repeats, not options.no_matrices)
            results.append(r)
            ours = r["seconds"]["complexbody"]
            print(f"\n{dim}D, {r['cells']} cells, {r['components']} components")
            print(f"  {'':28} {'ns/cell':>8} {'× ours':>8} {'bytes/cell':>11}")
            for name, seconds in r["seconds"].items():
                memory = f"{r['bytes'][name]:11.0f}" if name in r["bytes"] else ""
                print(
                    f"  {name:28} {seconds / r['cells'] * 1e9:8.1f} {seconds / ours:8.2f} {memory}"
                )
            sys.stdout.flush()
    if options.json:
        versions = {"numpy": np.__version__, "petsc": ".".join(map(str, PETSc.Sys.getVersion()))}
        options.json.write_text(json.dumps({"versions": versions, "results": results}, indent=1))


if __name__ == "__main__":
    main()
