# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A band gap: what a micromorphic bar lets through, from the record of one blow.

Mindlin's bar, u and the micro-deformation ψ (:func:`complexbody.forms.mindlin_bar`), in *scaled*
units: ρ = A = B = 1, ρ̄ = 0.1 and C = 10⁻⁴ belong to no material.

.. math:: \rho e = \tfrac12Au'^2 + \tfrac12B(u' - \psi)^2 + \tfrac12C\psi'^2, \quad
          \rho\ddot u = (Au' + B(u' - \psi))', \quad
          \bar\rho\ddot\psi = C\psi'' + B(u' - \psi).

**Exact.** Waves obey (ρω² − (A+B)q²)(ρ̄ω² − Cq² − B) = B²q². The acoustic branch flattens at
ω₁ = √(AB/((A+B)ρ̄)) = 2.24, the optical one begins at ω₂ = √(B/ρ̄) = 3.16. Between them lies the
gap: of the two q² at a frequency one is negative there, so that q is imaginary and a wave dies away
within 1/|q|, 0.4 at the middle. (The other q² is that of short waves, which C > 0 takes up from the
plateau into the gap: they carry little of u, and creep at hundredths of the speed of sound.)

**Measured.** One pulse on the end x = 0 has all frequencies. With û(x) = ∫u e^{i(ω + iσ)t} dt at
two places, û(x₂)/û(x₁) = exp(iq(ω + iσ)(x₂ − x₁)): σ = 8/T makes the finite record T as good as
an endless one, and the formulas above hold as well at complex frequencies. ``check`` asserts q
below, in and above the gap within 1 %, in the gap as a decay length.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import complexbody as cb
from complexbody.forms import mindlin_bar
from complexbody.meshes import interval

BAR = mindlin_bar(A=1.0, B=1.0, C=1e-4, density=1.0, inertia=0.1)
A, B, C = (BAR.constants[name] for name in "ABC")
GAP = (np.sqrt(A * B / ((A + B) * BAR.inertia)), np.sqrt(B / BAR.inertia))
#: Receivers, and those between which waves are measured.
PLACES = np.linspace(0.0, 4.0, 17)
FIRST, SECOND = 4, 12
DEFAULTS = {
    "until": 100.0, "every": 10.0, "fields": ("u", "nu"), "probe_steps": 4,
    "probes": {f"x={x:g}": (x,) for x in PLACES},
}  # fmt: skip


def scene(comm: Any, cells: int = 4800, length: float = 72.0) -> cb.Scene:
    """The bar, struck at x = 0, and so long that no echo comes back in time.

    Args:
        comm: Communicator.
        cells: Along the bar.
        length: More than half of what √((A+B)/ρ) goes until the end.
    """
    return cb.Scene(
        interval(comm, 0.0, length, cells), BAR,
        supports=[cb.Fix("u", lambda x: x[0] > length - 1e-9)],
        loads=[cb.Traction(lambda x: x[0] < 1e-9, 1.0, cb.ricker(0.5))],
        name="blow on a micromorphic bar (scaled units)",
    )  # fmt: skip


def wave_number(omega: Any) -> Any:
    """q of the wave that carries u at (complex) frequencies, decaying where it goes."""
    a, b = BAR.density * omega**2, BAR.inertia * omega**2 - B
    # (a − (A+B)Q)(b − CQ) = B²Q with Q = q², as αQ² + βQ + γ = 0; of its roots the smaller one.
    alpha, beta, gamma = (A + B) * C, -(a * C + (A + B) * b + B**2), a * b
    root = np.sqrt(beta**2 - 4 * alpha * gamma)
    larger = np.where(np.abs(beta + root) > np.abs(beta - root), beta + root, beta - root)
    q = np.sqrt(-2 * gamma / larger)
    return np.where(q.imag < 0, -q, q)


def spectra(result: cb.Result, omega: Any) -> Any:
    """û at all receivers, shape (places, frequencies); on rank 0."""
    record = [result.probes[name] for name in DEFAULTS["probes"]]
    time = record[0]["time"]
    u = np.stack([p["u"][:, 0] for p in record])
    return u @ (np.exp(1j * np.outer(time, omega)) * np.gradient(time)[:, None])


def measured(result: cb.Result, omega: Any) -> Any:
    """q between the two receivers at frequencies ω + iσ; on rank 0."""
    found = spectra(result, omega)
    distance = PLACES[SECOND] - PLACES[FIRST]
    q = -1j * np.log(found[SECOND] / found[FIRST]) / distance
    # Whole turns that the phase does not show: those nearest to the exact ones.
    turn = 2 * np.pi / distance
    return q + turn * np.round((wave_number(omega) - q).real / turn)


def check(result: cb.Result) -> str:
    """Wave numbers below and above the gap, and decay in it, within 1 % of the exact ones."""
    comm, told = result.scene.mesh.comm, ""
    if comm.rank == 0:
        sigma = 8 / result.time
        bands = {"below": (0.8, 1.2, 1.6), "in": (2.6, 2.8, 3.0), "above": (3.6, 4.2, 4.8)}
        for where, frequencies in bands.items():
            omega = np.array(frequencies) + 1j * sigma
            found, exact = measured(result, omega), wave_number(omega)
            error = np.abs(found / exact - 1).max()
            assert error < 0.01, f"{where} the gap q is {found}, but {exact} is exact"
            told += f"{where} the gap q within {100 * error:.2f} %, "
        told += f"a wave at ω = 2.8 dies away within {1 / found_decay(result, 2.8):.3f}"
    return str(comm.bcast(told))


def found_decay(result: cb.Result, frequency: float) -> float:
    """Measured Im q at a frequency; on rank 0."""
    return float(measured(result, np.array([frequency + 8j / result.time]))[0].imag)


def picture(result: cb.Result, path: Path) -> None:
    """Bands with measured points, and how deep each frequency gets; rank 0 draws."""
    import matplotlib

    if result.scene.mesh.comm.rank > 0:
        return
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, middle, right) = plt.subplots(
        1, 3, figsize=(12, 4.6), sharey=True, layout="constrained", width_ratios=(1.1, 0.8, 1.2)
    )
    sigma = 8j / result.time
    fine, points = np.linspace(0.2, 6, 400), np.linspace(0.4, 5.6, 40)
    exact, found = wave_number(fine + sigma), measured(result, points + sigma)
    for part, sign, colour in (("real", 1, "C0"), ("imag", -1, "C3")):
        left.plot(sign * getattr(exact, part), fine, color=colour, lw=1.2)
        left.plot(sign * getattr(found, part), points, ".", color=colour)
    left.set(xlabel="− Im q  |  Re q", ylabel="frequency ω", title="Bands: exact, measured",
             xlim=(-5, 7))  # fmt: skip
    left.axvline(0, color="0.5", lw=0.5)
    distance = PLACES[SECOND] - PLACES[FIRST]
    middle.semilogx(np.exp(-exact.imag * distance), fine, color="k", lw=1.2)
    middle.semilogx(np.exp(-found.imag * distance), points, ".", color="C3")
    middle.set(xlabel="|û(3)/û(1)|", title="What is let through", xlim=(1e-4, 2))
    heights = np.linspace(0.2, 6, 160)
    spectrum = np.abs(spectra(result, heights + sigma))
    shown = 20 * np.log10(spectrum / spectrum[0])
    drawn = right.pcolormesh(PLACES, heights, shown.T, cmap="inferno", vmin=-60, vmax=0,
                             shading="gouraud", rasterized=True)  # fmt: skip
    figure.colorbar(drawn, ax=right, label="|û(x)/û(0)| [dB]", extend="both")
    right.set(xlabel="x", title="How deep each frequency gets")
    for ax in (left, middle):
        ax.axhspan(*GAP, color="0.88", zorder=0)
    figure.suptitle("Band gap of a micromorphic bar, from one blow (scaled units; grey: the gap)")
    figure.savefig(path, dpi=100)
    plt.close(figure)
