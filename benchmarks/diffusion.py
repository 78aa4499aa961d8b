# SPDX-License-Identifier: LGPL-3.0-or-later
"""A stiff diffusive descriptor: implicit in ν at the step of u, against explicit at ν's own limit.

    python benchmarks/diffusion.py [--cells 40 80] [--diffusivity 0.2 2]

A scalar pair on a square, ½|∇u|² + R∇u·∇ν + ½K|∇ν|² + ½k0ν², ρ = 1, no inertia of ν and η = 1, so
that K is ν's diffusivity; u, ν ∝ cos πx cos πy, whose motion is a 3×3 matrix exponential. Errors
are those of (u, ν) in the mean over nodes, relative to the mean of u at the start; times are of
stepping alone, both runs side by side, the least of three.
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
import scipy.linalg
import ufl
from dolfinx import mesh as dmesh
from mpi4py import MPI

import complexbody as cb

COUPLING, SELF = 0.3, 0.5


def scene(cells: int, K: float) -> cb.Scene:
    """The pair on cells × cells squares, two triangles each."""

    def energy(U: Any, nu: Any, N: Any) -> Any:
        own = 0.5 * ufl.inner(U, U) + 0.5 * K * ufl.inner(N, N) + 0.5 * SELF * nu[0] ** 2
        return own + COUPLING * ufl.inner(U, N)

    mesh = dmesh.create_unit_square(MPI.COMM_SELF, cells, cells, ghost_mode=dmesh.GhostMode.none)
    body = cb.Body(1, energy, 1.0, 0.0, 1.0, displacement=1)
    return cb.Scene(mesh, body, initial=cb.Initial(u=wave, nu=lambda x: 0.5 * wave(x)))


def wave(x: np.ndarray) -> np.ndarray:
    """cos πx cos πy."""
    return np.cos(np.pi * x[0]) * np.cos(np.pi * x[1])


def error(result: cb.Result, K: float) -> float:
    """Error of (u, ν) at the end, relative to u at the start."""
    q2 = 2 * np.pi**2
    matrix = np.array([[0, 0, 1], [-COUPLING * q2, -K * q2 - SELF, 0], [-q2, -COUPLING * q2, 0]])
    u, nu, _ = scipy.linalg.expm(matrix * result.time) @ [1.0, 0.5, 0.0]
    shape = wave(result.scene.mesh.geometry.x.T)
    off = np.stack([result.u.x.array - u * shape, result.nu.x.array - nu * shape])
    return float(np.linalg.norm(off) / np.linalg.norm(shape))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[40, 80])
    parser.add_argument("--diffusivity", type=float, nargs="+", default=[0.2, 2.0])
    parser.add_argument("--until", type=float, default=1.0)
    a = parser.parse_args()
    print("cells   K     method             steps   error    time/explicit   linear its per step")
    for cells in a.cells:
        for K in a.diffusivity:
            methods = {
                "explicit": cb.Synchronous(),
                "implicit": cb.Implicit(forces="implicit"),
                "implicit, half": cb.Implicit(forces="implicit", safety=0.45),
                "same, 1e-8": cb.Implicit(forces="implicit", safety=0.45, tolerance=1e-8),
                "backward Euler": cb.Implicit(forces="implicit", order=1),
            }  # fmt: skip
            seconds, found = dict.fromkeys(methods, np.inf), {}
            for _ in range(3):
                for name, method in methods.items():
                    found[name] = r = cb.simulate(scene(cells, K), method, until=a.until)
                    seconds[name] = min(seconds[name], r.stats.stepping)
            for name, r in found.items():
                ratio = seconds[name] / seconds["explicit"]
                linear = r.solving.split("; ")[-1].split()[0] if r.solving else "-"
                print(f"{cells:5d} {K:5.3g}   {name:15s} {r.stats.steps:8d}   {error(r, K):.2e}"
                      f"   {ratio:10.3f}   {linear:>10s}", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
