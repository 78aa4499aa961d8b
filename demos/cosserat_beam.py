# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Thin foam beams ring too high: the size effect of a Cosserat solid.

Lakes' dense polyurethane foam (real constants, recalled: :func:`complexbody.forms.cosserat`; its
micro-inertia alone is a guess, and not felt here) in plane strain, u = (u₁, u₂) and the rotation φ
of the foam's cells:

.. math:: \rho e = \tfrac12\lambda(\mathrm{tr}\,\varepsilon)^2
          + (\mu + \tfrac12\kappa)|\varepsilon|^2 + \kappa(r - \varphi)^2
          + \tfrac12\gamma|\nabla\varphi|^2, \qquad r = \tfrac12(u_{2,1} - u_{1,2}).

Bending turns the cells, and neighbours resist being turned differently: a beam of thickness h has
the stiffness E'h³/12 + γh, E' = 4G(λ + G)/(λ + 2G) with G = μ + ½κ. In a thin one the second term
is the larger; the frequency does not fall with h as it should, but is higher by
√(1 + 12γ/(E'h²)) if cells turn as the beam does.

**Formula.** They do so only if the wave is long, and beams shear. With deflection w, rotation ψ of
sections and φ, all ∝ cos or sin kx (k = π/L), energy per length (5/6: shear varies over h)

.. math:: \tfrac12E'\tfrac{h^3}{12}k^2\psi^2 + h\big[\tfrac12\cdot\tfrac56G(kw - \psi)^2
          + \kappa(\tfrac12(kw + \psi) - \varphi)^2 + \tfrac12\gamma k^2\varphi^2\big],

and kinetic energy ½ρ(hẇ² + h³ψ̇²/12 + hjφ̇²), ω² is the smallest eigenvalue of a 3×3 pencil:
Timoshenko's beam with cells that turn. ``check`` lets beams of five thicknesses go, L = 20 h, all
on two meshes: P1 triangles are too stiff in bending, by 7 % in ω for six layers of them, but with
an error that goes with h² and is extrapolated away. It asserts that what is left is within 1.5 % of
the formula, and that the thinnest beam rings at least twice as high as an ordinary solid's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from _snapshots import on_grid
from scipy.linalg import eigh

import complexbody as cb
from complexbody.forms import plane_cosserat
from complexbody.meshes import rectangle

MM, SLENDER = 1e-3, 20
FOAM = plane_cosserat()
LAM, MU, KAPPA, GAMMA = (FOAM.constants[name] for name in ("lam", "mu", "kappa", "gamma"))
G = MU + KAPPA / 2
MODULUS = 4 * G * (LAM + G) / (LAM + 2 * G)
BENDING = np.sqrt(GAMMA / (4 * G))  # Lakes' l_b
THICKNESSES = np.array([0.5, 1.0, 2.0, 4.0, 8.0]) * MM
KNOWN: dict[int, Any] = {}  #: What check found, by layers, for the picture.
DEFAULTS = {"until": 3e-4, "every": 1e-5, "fields": ("u", "nu"), "integrator": "synchronous"}


def pencil(h: float, polar: bool) -> tuple[Any, Any]:
    """Stiffness and mass of the formula for (w, ψ, φ), or (w, ψ) of an ordinary solid."""
    k, kappa, gamma = np.pi / (SLENDER * h), KAPPA, GAMMA
    lag, shear = np.array([k / 2, 0.5, -1.0]), np.array([k, -1.0, 0.0])
    K = h * (5 / 6 * G * np.outer(shear, shear) + 2 * kappa * np.outer(lag, lag))
    K += np.diag([0.0, MODULUS * h**3 / 12 * k**2, h * gamma * k**2])
    M = FOAM.density * np.diag([h, h**3 / 12, h * FOAM.inertia / FOAM.density])
    if polar:
        return K, M
    K = h * 5 / 6 * G * np.outer(shear, shear)[:2, :2] + np.diag([0, MODULUS * h**3 / 12 * k**2])
    return K, M[:2, :2]


def formula(h: float, polar: bool = True) -> tuple[float, Any]:
    """Lowest frequency [rad/s] of a beam of thickness h [m] and its shape (w = 1, ψ, φ)."""
    squares, shapes = eigh(*pencil(h, polar))
    return float(np.sqrt(squares[0])), shapes[:, 0] / shapes[0, 0]


def scene(comm: Any, layers: int = 9, thickness: float = 1.0 * MM) -> cb.Scene:
    """A beam on two supports, let go from a bow.

    Args:
        comm: Communicator.
        layers: Of cells through the thickness.
        thickness: h [m]; the beam is 20 h long.
    """
    length, k, bow = SLENDER * thickness, np.pi / (SLENDER * thickness), 1e-3 * thickness
    _, psi, phi = formula(thickness)[1]

    def bent(x: Any) -> Any:
        across = 1 - LAM / (LAM + 2 * G) * psi * k * x[1] ** 2 / 2  # free faces: no stress there
        return bow * np.stack([-psi * x[1] * np.cos(k * x[0]), across * np.sin(k * x[0])])

    mesh = rectangle(comm, (0.0, -thickness / 2), (length, thickness / 2),
                     (SLENDER * layers, layers))  # fmt: skip
    ends = cb.Fix("u", lambda x: (x[0] < 1e-9) | (x[0] > length - 1e-9), components=1)
    start = cb.Initial(u=bent, nu=lambda x: bow * phi * np.cos(k * x[0]))
    return cb.Scene(mesh, FOAM, supports=[ends], initial=start,
                    name=f"foam beam, {thickness / MM:g} mm")  # fmt: skip


def frequency(result: cb.Result) -> float:
    """ω [rad/s] of a beam let go, from the energy it stores: ½E(1 + cos 2ωt)."""
    time, stored = result.ledger["time"], result.ledger["stored"]
    half = (stored[:-1] > stored[0] / 2) & (stored[1:] <= stored[0] / 2)
    i = int(np.flatnonzero(half)[0])  # ωt = π/4
    part = (stored[i] - stored[0] / 2) / (stored[i] - stored[i + 1])
    return float(np.pi / 4 / (time[i] + part * (time[i + 1] - time[i])))


def measured(comm: Any, layers: int) -> Any:
    """ω of beams of all thicknesses on a mesh; collective."""
    return np.array([
        frequency(cb.simulate(scene(comm, layers, h), until=0.3 * np.pi / formula(h)[0],
                              ledger_steps=20, progress=False))
        for h in THICKNESSES
    ])  # fmt: skip


def extrapolated(result: cb.Result) -> Any:
    """ω of beams of all thicknesses, from as many layers as the run had and a third fewer."""
    comm, cells = result.scene.mesh.comm, result.scene.mesh.topology.index_map(2).size_global
    fine = round((cells / (2 * SLENDER)) ** 0.5)
    coarse = 2 * fine // 3
    if fine not in KNOWN:
        one, two = measured(comm, fine), measured(comm, coarse)
        KNOWN[fine] = (fine**2 * one - coarse**2 * two) / (fine**2 - coarse**2)
    return KNOWN[fine]


def check(result: cb.Result) -> str:
    """Frequencies against the formula, and the thinnest beam against an ordinary one."""
    found = extrapolated(result)
    exact, ordinary = (np.array([formula(h, polar)[0] for h in THICKNESSES])
                       for polar in (True, False))  # fmt: skip
    error, higher = np.abs(found / exact - 1), found / ordinary
    assert error.max() < 0.015, f"frequencies {found} rad/s, but {exact} by the formula"
    assert higher[0] > 2, f"the thinnest beam rings {higher[0]:.2f} times as high as an ordinary"
    return (
        f"frequencies within {100 * error.max():.2f} % of the formula; beams of "
        f"{', '.join(f'{h / MM:g}' for h in THICKNESSES)} mm ring "
        f"{', '.join(f'{r:.2f}' for r in higher)} times as high as of an ordinary solid"
    )


def picture(result: cb.Result, path: Path) -> None:
    """The bent beam with its turned cells, and frequencies against thickness; rank 0 draws."""
    import matplotlib

    found, grid = extrapolated(result), on_grid(result.u, result.nu)
    if grid is None:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    x, y, u, phi = grid
    h = float(y[-1] - y[0])
    figure, (top, bottom) = plt.subplots(2, 1, figsize=(9, 6.6), layout="constrained",
                                         height_ratios=(1, 1.7))  # fmt: skip
    larger = 2 * h / np.abs(u).max()
    X, Y = x[None] + larger * u[..., 0], y[:, None] + larger * u[..., 1]
    most = 1e3 * np.abs(phi).max()
    drawn = top.pcolormesh(X / MM, Y / MM, 1e3 * phi[..., 0], cmap="RdBu_r", vmin=-most, vmax=most,
                           shading="gouraud")  # fmt: skip
    figure.colorbar(drawn, ax=top, label="rotation φ [mrad]")
    top.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]", title=f"{h / MM:g} mm "
            f"thick, t = {1e6 * result.time:.0f} µs, deflection × {larger:.0f}")  # fmt: skip
    fine = np.geomspace(0.4, 10, 100) * MM
    curve = [formula(t)[0] / formula(t, False)[0] for t in fine]
    ideal = np.sqrt(1 + 12 * GAMMA / (MODULUS * fine**2))
    ordinary = np.array([formula(t, False)[0] for t in THICKNESSES])
    bottom.semilogx(fine / MM, ideal, "0.6", ls="--", lw=1, label="√(1 + 12γ/(E′h²))")
    bottom.semilogx(fine / MM, curve, "k", lw=1, label="Timoshenko beam with turning cells")
    bottom.semilogx(THICKNESSES / MM, found / ordinary, "o", color="C3", ms=8, label="measured")
    bottom.axhline(1, color="C0", lw=1, label="ordinary solid")
    bottom.axvline(BENDING / MM, color="0.8", lw=1)
    bottom.annotate("l_b", (BENDING / MM, 1.2), xytext=(4, 0), textcoords="offset points")
    bottom.set(xlabel="thickness h [mm]", ylabel="frequency over an ordinary beam's", ylim=(0.8, 4),
               xlim=(0.3, 10))  # fmt: skip
    bottom.legend(frameon=False)
    figure.suptitle("Size effect: foam beams, 20 times as long as thick (Lakes' foam)")
    figure.savefig(path, dpi=100)
    plt.close(figure)
