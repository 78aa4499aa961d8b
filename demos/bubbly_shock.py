# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A pressure pulse in a water pipe meets a layer of bubbles: dispersion, and bubbles that ring.

One dimension, u along x and ν = R − R0 of air bubbles of 1 mm in water (void fraction 1e-3 beyond
x = 0.5 m, as good as none before). The bubbles' kinetic co-energy 2πnρR³Ṙ² depends on ν: the run is
``cb.Implicit``, a Newton per node and step (see :mod:`complexbody.forms.bubbly` for the action).

**What must come out.** Small waves in the layer obey q²/ω² = 1/c² + 4πnR0/(ω0² − ω²) (Commander
and Prosperetti 1989, undamped): about 370 m/s at low frequencies instead of 1482 m/s. From the
Fourier phases of ν at two probes Δx apart ``check`` takes the speed ωΔx/Δφ at frequencies in the
pulse, and asserts that each is within 1 %. ``amplitude=3e4`` is a strong pulse, whose compression
steepens into a front followed by ringing bubbles; it is compared with no linear theory.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import mesh as dmesh

import complexbody as cb
from complexbody.forms import bubbly_dispersion, bubbly_liquid
from complexbody.meshes import interval

DEFAULTS = {
    "until": 1.7e-2, "every": 1e-3, "fields": ("u", "nu"), "integrator": "implicit",
    "probes": {"first": (1.0,), "second": (2.0,)}, "probe_steps": 4,
}  # fmt: skip
WATER, LENGTH, FREQUENCY, WEAK = 0.5, 5.5, 300.0, 500.0


def scene(comm: Any, cells: int = 1100, amplitude: float = WEAK) -> cb.Scene:
    """The pipe, at rest, a Ricker pulse of pressure on its left end.

    Args:
        comm: Communicator.
        cells: Along the pipe.
        amplitude: Of the pressure [Pa].
    """
    mesh = interval(comm, 0.0, LENGTH, cells)
    owned = np.arange(mesh.topology.index_map(1).size_local, dtype=np.int32)
    layer = dmesh.compute_midpoints(mesh, 1, owned)[:, 0] > WATER
    tags = dmesh.meshtags(mesh, 1, owned, np.where(layer, 2, 1).astype(np.int32))
    water = bubbly_liquid(void_fraction=1e-8, d=1, name="water")
    return cb.Scene(
        mesh, {1: water, 2: bubbly_liquid(d=1)}, cell_tags=tags,
        supports=[cb.Fix("u", lambda x: x[0] > LENGTH - 1e-9)],
        loads=[cb.Traction(lambda x: x[0] < 1e-9, amplitude, cb.ricker(FREQUENCY))],
        name="pressure pulse into a bubbly layer",
    )  # fmt: skip


def speeds(result: cb.Result) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequencies [Hz], measured and exact phase speeds [m/s] between the probes; on rank 0."""
    first, second = (result.probes[name] for name in ("first", "second"))
    frequencies = FREQUENCY * np.array([0.5, 0.75, 1.0, 1.25, 1.5])
    omega = 2 * np.pi * frequencies
    waves = np.exp(1j * omega[:, None] * first["time"])
    one, two = ((waves * p["nu"][:, 0]).sum(axis=1) for p in (first, second))
    exact = omega / np.sqrt(bubbly_dispersion(omega).real)
    distance = DEFAULTS["probes"]["second"][0] - DEFAULTS["probes"]["first"][0]
    phase = np.angle(two / one)
    # Whole turns that the phase does not show: those nearest to the exact ones.
    phase += 2 * np.pi * np.round((omega * distance / exact - phase) / (2 * np.pi))
    return frequencies, omega * distance / phase, exact


def check(result: cb.Result) -> str:
    """Phase speeds within 1 % of the linear ones, for the weak pulse it starts with."""
    smallest = 1e-3 + float(result.scene.mesh.comm.allreduce(result.nu.x.array.min(), min))
    assert smallest > 0, "a bubble has collapsed"
    told = f"smallest bubble {1e3 * smallest:.3f} mm; {result.solving}"
    load = result.scene.loads[0].vector
    if result.scene.mesh.comm.rank == 0 and load == WEAK and result.time >= DEFAULTS["until"]:
        frequencies, found, exact = speeds(result)
        error = np.abs(found / exact - 1).max()
        assert error < 0.01, f"phase speeds {found} m/s, but {exact} m/s are exact"
        told = (
            f"phase speeds from {found[0]:.1f} m/s at {frequencies[0]:.0f} Hz to {found[-1]:.1f} "
            f"at {frequencies[-1]:.0f} Hz, within {100 * error:.2f} % of the linear theory; {told}"
        )
    return told


def picture(result: cb.Result, path: Path) -> None:
    """Radii along the pipe at the end, and in time at both probes; rank 0 draws."""
    import matplotlib

    comm = result.scene.mesh.comm
    parts = comm.gather((result.scene.mesh.geometry.x[:, 0], result.nu.x.array))
    if comm.rank > 0:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x, nu = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(x)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    left.plot(x[order], 1e6 * nu[order])
    left.axvspan(0, WATER, color="0.9")
    left.set(xlabel="x [m] (grey: water)", ylabel="R − R0 [µm]",
             title=f"at t = {1e3 * result.time:.1f} ms")  # fmt: skip
    for name, probe in result.probes.items():
        place = DEFAULTS["probes"][name][0]
        right.plot(1e3 * probe["time"], 1e6 * probe["nu"][:, 0], label=f"x = {place} m")
    right.set(xlabel="t [ms]", ylabel="R − R0 [µm]", title="Bubbles at two places")
    right.legend()
    figure.savefig(path, dpi=150)
    plt.close(figure)
