# SPDX-License-Identifier: LGPL-3.0-or-later
"""Curves against time: the ledger's energies and whether they balance, and what probes recorded."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from complexbody._compat import Array
from complexbody.drawing import DPI, STYLE, WIDTH
from complexbody.scales import prefixed

#: Columns of the ledger, their names and colours (Okabe and Ito's, told apart by all eyes).
_ENERGIES = {
    "kinetic_u": ("kinetic, u", "#0072B2"), "kinetic_nu": ("kinetic, ν", "#56B4E9"),
    "stored": ("stored", "#009E73"), "potential": ("potential", "#CC79A7"),
    "work": ("work of loads", "#E69F00"), "support_work": ("work of supports", "#8C6D00"),
    "dissipated": ("dissipated", "#D55E00"),
}  # fmt: skip

_ROUND_OFF = 1e-17  # errors below are none


def write_ledger(path: Path, columns: Mapping[str, Array], title: str, units: bool = True) -> None:
    """Draw energies and works, and below what is missing in the books, into a PNG file.

    Args:
        path: The file.
        columns: Of the ledger, by name.
        title: Stands above.
        units: Whether to tell them.

    Raises:
        OSError: if the file cannot be written.
    """
    drawn = {n: columns[n] for n in _ENERGIES if n in columns and np.any(columns[n])}
    total = sum((columns[n] for n in ("kinetic_u", "kinetic_nu", "stored", "potential")), 0.0)
    largest = max((np.abs(values).max() for values in drawn.values()), default=0.0)
    scale, unit = _unit(largest, "J", units)
    time, label = _time(columns["time"], units)
    figure = _figure(6.6, title)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.8, 1))
    for name, values in drawn.items():
        said, colour = _ENERGIES[name]
        dashes = (0, (4, 1.5)) if "work" in name or name == "dissipated" else "-"
        upper.plot(time, values / scale, color=colour, lw=1.6, ls=dashes, label=said)
    upper.plot(time, total / scale, color="black", lw=2.0, label="total of the body")
    upper.set_ylabel(f"energy{unit}")
    upper.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    balance, identity = np.abs(columns["balance"]) / (largest or 1), np.abs(columns["identity"])
    told = False
    for said, colour, error in (
        ("of the energy balance", "#D55E00", balance),
        ("of the discrete identity", "#0072B2", identity),
    ):
        if error.any():
            told = True
            lower.semilogy(time, np.where(error > 0, error, np.nan), color=colour, lw=1.2,
                           label=said)  # fmt: skip
    if told:
        lower.set_ylim(bottom=_ROUND_OFF)
        lower.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5), title="error")
    else:
        lower.text(0.5, 0.5, "no error at all", transform=lower.transAxes, ha="center")
    lower.set_ylabel("error / largest energy")
    lower.set_xlabel(label)
    _finish(figure, (upper, lower), path)


def write_probes(
    path: Path,
    probes: Mapping[str, Mapping[str, Array]],
    points: Mapping[str, Sequence[float]],
    title: str,
    units: bool = True,
) -> None:
    """Draw u and ν at each probe, a row each, into a PNG file.

    Args:
        path: The file.
        probes: By name, columns by name: time, u1, …, nu1, ….
        points: Where they are [m], of those that is known.
        title: Stands above.
        units: Whether to tell them.

    Raises:
        OSError: if the file cannot be written.
    """
    import matplotlib

    figure = _figure(1.2 + 2.3 * len(probes), title)
    axes = figure.subplots(len(probes), 2, sharex=True, sharey="col", squeeze=False)
    everything = [columns for columns in probes.values()]
    time_scale, _ = _time(np.concatenate([columns["time"] for columns in everything]), units, False)
    colours = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"]
    colours += [matplotlib.colors.to_hex(matplotlib.colormaps["tab20"](i)) for i in range(20)]
    for column, (start, name, base) in enumerate((("u", "u", "m"), ("nu", r"\nu", ""))):
        members = [n for n in everything[0] if n.removeprefix(start).isdigit()]
        largest = max((np.abs(c[n]).max() for c in everything for n in members), default=0.0)
        scale, unit = _unit(largest, base, units)
        for row, (probe, columns) in zip(axes, probes.items(), strict=True):
            ax = row[column]
            for number, member in enumerate(members):
                index = f"_{{{member.removeprefix(start)}}}" if len(members) > 1 else ""
                ax.plot(columns["time"] / time_scale, columns[member] / scale, lw=1.4,
                        color=colours[number % len(colours)], label=f"${name}{index}$")  # fmt: skip
            ax.set_ylabel(f"${name}${unit}")
            if len(members) > 1:
                ax.legend(frameon=False, loc="upper left", fontsize=9)
            if column == 0:
                ax.set_title(_where(probe, points.get(probe, ()), units), loc="left", fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel(_time(np.concatenate([c["time"] for c in everything]), units)[1])
    _finish(figure, axes.ravel(), path)


def _where(name: str, point: Sequence[float], units: bool) -> str:
    place = ", ".join(f"{x:.4g}" for x in point)
    place = f"({place})" if len(point) > 1 else f"x = {place}"
    return f"{name} at {place}{' m' if units else ''}" if len(point) else name


def _unit(largest: float, base: str, units: bool) -> tuple[float, str]:
    scale, prefix = prefixed(float(largest), base if units else "")
    return scale, f"  [{prefix}{base}]" if units and base else ""


def _time(times: Array, units: bool, scaled: bool = True) -> Any:
    scale, prefix = prefixed(float(times.max()), "s" if units else "")
    label = f"time [{prefix}s]" if units else "time"
    return (times / scale if scaled else scale), label


def _figure(height: float, title: str) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((WIDTH, height), dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=14)
    return figure


def _finish(figure: Any, axes: Any, path: Path) -> None:
    import matplotlib as mpl

    for ax in axes:
        ax.grid(color="0.9", lw=0.6)
        ax.margins(x=0)
        if ax.get_yscale() == "linear":
            ax.ticklabel_format(axis="y", style="sci", scilimits=(-2, 4), useMathText=True)
        for side in ax.spines.values():
            side.set(linewidth=STYLE["axes.linewidth"], edgecolor=STYLE["axes.edgecolor"])
    with mpl.rc_context(STYLE):
        figure.savefig(path, format="png")
