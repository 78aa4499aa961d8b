# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Impact on a perforated quasicrystal plate: phonon and phason waves at a hole.

A plate of an icosahedral quasicrystal, 20 × 14 × 0.4 mm³ with a hole of radius 2 mm, is struck on
its left end by an ultrasonic pulse. Its points carry the displacement u of the atoms (phonon) and
the displacement ν of the quasiperiodic order (phason), both with three components.

**Equations.** With U = ∇u, N = ∇ν, ε = sym U and w = N, the action is

.. math::

    \mathcal A = \int\!\!\int \tfrac12\rho|\dot u|^2 + \tfrac12\bar\rho|\dot\nu|^2
        - \rho e(\varepsilon, w)\,dx\,dt
        - \int\!\!\int_{\mathrm{left}} p(t)\, n\cdot u\,ds\,dt,

    \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2 + \mu|\varepsilon|^2
        + \tfrac12 k_4 Q_4(w) + \tfrac12 k_5(|w|^2 - Q_4(w)) + R\,e_c(\varepsilon, w),

with Q₄ and e_c as in :mod:`complexbody.forms.icosahedral`. The principle with dissipation reads
δ𝒜 − ∫∫ ην̇·δν dx dt = 0. The minus makes energy decrease (a plus would make it grow):

.. math:: \rho\ddot u = \mathrm{Div}\,P, \qquad \bar\rho\ddot\nu + \eta\dot\nu = \mathrm{Div}\,S,
          \qquad \dot E = \text{power of } p - \int \eta|\dot\nu|^2\,dx.

**Scene.** P n = −p n on the left end, p a Ricker pulse of 100 MPa and 1.64 MHz (in the bulk 4 mm
long, twice the radius of the hole); the right end is held, u = ν = 0; the faces are free; on the
edges u₂ = ν₂ = 0, mirror planes of plate and crystal: the plate is one of a row of holes. Until it
meets the hole the wave is therefore plane, and can be checked.

**Material.** λ, μ, ρ are those of Al-Pd-Mn.

* ``material="scaled"`` (default) is *not* a real material: k4 and k5 are 724 times, R 43 times as
  large, ν has the inertia ρ̄ = ρ and little viscosity: phasons are waves, half as fast as phonons.
* ``material="al-pd-mn"`` has the real constants: ρ̄ = 0 and η = 2·10¹⁸ kg/(m³s). In the microseconds
  of a sound wave ν does not move, and the plate is an ordinary elastic one.

**Checked.** In a wave much longer than the plate is thick, the stresses across it vanish: ε₃₃ and
w₃₃ follow ε₁₁ and w₁₁ so that P₃₃ = S₃₃ = 0. That leaves two waves (u₁, ν₁), eigenvectors of a 2×2
matrix. The faster runs at 6040 m/s in the scaled material, 2 % slower than without coupling, and
carries ν₁ = 0.150 u₁ along (6170 m/s and nothing in Al-Pd-Mn; 6563 m/s in the bulk). ``check``
finds both in the record of one point, and balances the energy.

Run it with ``mpirun -n 2 complexbody run demos/impact.py``: 337 000 tetrahedra, 3600 steps, less
than a minute on two cores, half of it for the mesh. ``--set refine=0.5`` takes seconds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import complexbody as cb
from complexbody.errors import SceneError
from complexbody.forms import icosahedral_quasicrystal, scaled_icosahedral_quasicrystal
from complexbody.meshes import Side, perforated_plate
from complexbody.picture import Panel, still

MM = 1e-3
LENGTH, WIDTH, THICKNESS, RADIUS = 20 * MM, 14 * MM, 0.4 * MM, 2 * MM
CENTRE = (9.5 * MM, WIDTH / 2)  # of the hole
PROBE = (4.5 * MM, WIDTH / 2, THICKNESS / 2)  # where the pulse is clear of its echo and of ν's wave

DEFAULTS = {
    "until": 4e-6,  # 1.3 times what a bulk P wave takes for the length
    "every": 2e-7,
    "fields": ("u", "nu"),
    "probes": {"front": PROBE},
    "integrator": "synchronous",
}


def material_body(material: str) -> cb.Body:
    """The quasicrystal of a name.

    Args:
        material: "scaled" or "al-pd-mn".

    Raises:
        SceneError: for other names.
    """
    real = icosahedral_quasicrystal(name="Al-Pd-Mn")
    if material == "al-pd-mn":
        return real
    if material != "scaled":
        raise SceneError(f"material {material!r} is not known. Give 'scaled' or 'al-pd-mn'.")
    # The dimensionless body in units of μ, ρ and 1 cm.
    mu, rho, scaled = real.constants["mu"], real.density, scaled_icosahedral_quasicrystal()
    k4, k5, R = (scaled.constants[name] * mu for name in ("k4", "k5", "R"))
    return icosahedral_quasicrystal(
        k4=k4, k5=k5, R=R, inertia=scaled.inertia * rho,
        viscosity=scaled.viscosity * np.sqrt(mu * rho) / 1e-2, name="Al-Pd-Mn with scaled phasons",
    )  # fmt: skip


def scene(
    comm: Any,
    refine: float = 1.0,
    material: str = "scaled",
    frequency: float = 1.64e6,
    pressure: float = 1e8,
) -> cb.Scene:
    """The plate.

    Args:
        comm: Communicator.
        refine: Edges have a length of 0.12 mm / refine, a third of it at the hole; cells grow in
            number by refine³.
        material: "scaled" or "al-pd-mn".
        frequency: Of the Ricker pulse [Hz].
        pressure: Its peak [Pa].
    """
    size = 0.12 * MM / refine
    mesh, cell_tags, facet_tags = perforated_plate(
        comm, LENGTH, WIDTH, THICKNESS, RADIUS, size, size / 3, CENTRE
    )
    edges = (Side.BOTTOM, Side.TOP)
    return cb.Scene(
        mesh,
        material_body(material),
        supports=[
            cb.Fix("u", Side.RIGHT),
            cb.Fix("nu", Side.RIGHT),
            cb.Fix("u", edges, components=1),
            cb.Fix("nu", edges, components=1),
        ],
        loads=[cb.Pressure(Side.LEFT, pressure, cb.ricker(frequency))],
        cell_tags=cell_tags,
        facet_tags=facet_tags,
        name=f"impact on a perforated plate, {material}",
    )


def plate_wave(body: cb.Body) -> tuple[float, float]:
    """Speed [m/s] of the fast long wave along x₁ in a thin plate with free faces, and its ν₁/u₁.

    The energy in (ε₁₁, w₁₁, ε₃₃, w₃₃) is ½ sᵀHs; ∂/∂ε₃₃ = ∂/∂w₃₃ = 0 leaves H' = A − BC⁻¹Bᵀ.
    """
    lam, mu, k4, k5, R = (body.constants[name] for name in ("lam", "mu", "k4", "k5", "R"))
    tau, own, mixed = (1 + np.sqrt(5)) / 2, (k4 + 2 * k5) / 3, (k4 - k5) / 3
    H = np.array([
        [lam + 2 * mu, R, lam, -tau * R],
        [R, own, R / tau, mixed],
        [lam, R / tau, lam + 2 * mu, R],
        [-tau * R, mixed, R, own],
    ])  # fmt: skip
    if body.inertia == 0:  # so viscous that w = 0 for as long as a wave takes
        return float(np.sqrt((H[0, 0] - H[0, 2] ** 2 / H[2, 2]) / body.density)), 0.0
    A, B, C = H[:2, :2], H[:2, 2:], H[2:, 2:]
    squares, waves = np.linalg.eigh((A - B @ np.linalg.solve(C, B.T)) / body.density)  # ρ̄ = ρ
    return float(np.sqrt(squares[1])), float(waves[1, 1] / waves[0, 1])


def passage(scene: cb.Scene) -> tuple[float, float]:
    """When the middle of the first pulse should pass the probe, and half its duration [s]."""
    pulse = scene.loads[0].history
    return pulse.delay + PROBE[0] / plate_wave(scene.bodies[0])[0], 0.8 / pulse.frequency


def measured_wave(result: cb.Result) -> tuple[float, float]:
    """Speed [m/s] of the first pulse from the left end to the probe, and its ν₁/u₁; on rank 0.

    p makes u₁ = ∫p dt / (ρc) on the left end. From there to the probe, the phase of the frequency
    of which u₁ has most (1/√2 of the Ricker pulse's) tells the time.
    """
    pulse, record = result.scene.loads[0].history, result.probes["front"]
    time, omega = record["time"], np.sqrt(2) * np.pi * pulse.frequency
    middle, half = passage(result.scene)
    first = np.abs(time - middle) < half
    wave = np.exp(-1j * omega * (time[first] - middle)) * np.gradient(time[first])
    u, nu = (record[name][first, 0] @ wave for name in ("u", "nu"))
    late = -np.angle(1j * u) / omega  # u would be a positive multiple of 1/(iω) if it were in time
    return float(PROBE[0] / (middle + late - pulse.delay)), float((nu / u).real)


def check(result: cb.Result) -> str:
    """Energy, and the first pulse: its speed within 1.5 %, and ν₁/u₁ in it within 0.015."""
    comm, pulse = result.scene.mesh.comm, result.scene.loads[0].history
    balance = np.abs(result.ledger["balance"]).max() / result.ledger["work"].max()
    assert balance < 0.01, f"energy is out of balance by {balance:.1e} of the work"
    told = f"energy balanced within {balance:.1e} of the work"
    if result.time < sum(passage(result.scene)) or pulse.frequency < 1.6e6:
        return f"{told}; the pulse has not passed the probe, or overlaps its echo there"
    speed, carried = plate_wave(result.scene.bodies[0])
    found_speed, found = comm.bcast(measured_wave(result) if comm.rank == 0 else None)
    assert abs(found_speed / speed - 1) < 0.015, f"pulse at {found_speed:.0f}, not {speed:.0f} m/s"
    assert abs(found - carried) < 0.015, f"ν₁/u₁ in the pulse is {found:.4f}, not {carried:.4f}"
    return (
        f"first pulse at {found_speed:.0f} m/s (theory {speed:.0f}) with ν₁/u₁ = {found:.3f} "
        f"({carried:.3f}); {told}"
    )


def picture(result: cb.Result, path: Path) -> None:
    """u₁: the pulse beyond the hole. ν₁: what it carries, and ν's own slow wave at the hole."""
    panels = [
        Panel("u", 0, warp="u", label="phonon u₁", unit="m"),
        Panel("nu", 0, warp="u", label="phason ν₁", unit="m"),
    ]
    name = result.scene.bodies[0].name
    functions = {"u": result.u, "nu": result.nu}
    still(path, functions, panels, f"Pulse past a hole: {name}", result.time)
