# SPDX-License-Identifier: LGPL-3.0-or-later
"""How a body is drawn, by one process: VTK makes images of it, matplotlib all that is written.

VTK draws without lettering, in parallel projection: so each image has true axes, every panel the
same frame, and all words one typeface. One-dimensional bodies become line plots. Knows no mesh and
no ranks. Matplotlib and pyvista are imported where they are used: both are optional.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from complexbody._compat import Array, Ints
from complexbody.rendering import View, image

WIDTH, DPI = 10.0, 160  # inches and pixels per inch
_SYMBOLS = {"u": "u", "nu": r"\nu", "u_dot": r"\dot{u}", "nu_dot": r"\dot{\nu}"}
_UNITS = {"u": "m", "u_dot": "m/s"}
#: Units that take a prefix: it belongs to their first symbol alone.
_SCALABLE = ("m", "m/s", "s", "Pa", "N", "J/m³", "Hz")
_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
_STYLE = {"font.size": 11.0, "axes.linewidth": 0.6, "axes.edgecolor": "0.4"}
_DEFORMATION = 0.06  # largest displacement in the picture, over the size of the body


@dataclass(frozen=True)
class Panel:
    """One view of the body.

    Attributes:
        field: Name of the function that gives the colours.
        component: A component (from 0), or "norm"; by default the norm of a vector, the value of a
            scalar, and in one dimension all components.
        warp: Name of the function that deforms the body, by a factor the picture tells; or None.
        label: What to call the colours; by default the symbol of the field.
        unit: Their unit; by default m for u, m/s for its rate.
    """

    field: str = "u"
    component: int | str | None = None
    warp: str | None = "u"
    label: str | None = None
    unit: str | None = None


@dataclass
class Visible:
    """What can be seen of a body.

    Attributes:
        dim: Of the body: 1, 2 or 3.
        points: Shape (points, 3).
        faces: Segments, or (surface) triangles, by their points: (faces, 2 or 3).
        values: By name, at points or, of fields constant on cells, on faces: (…, components).
        cellwise: Names of those on faces.
    """

    dim: int
    points: Array
    faces: Ints
    values: dict[str, Array]
    cellwise: frozenset[str]


def draw(
    path: Path, body: Visible, panels: Sequence[Panel], title: str, time: float | None
) -> None:
    """Draw ``panels`` of ``body`` into a PNG file.

    Raises:
        OSError: if the file cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure
    from matplotlib.ticker import EngFormatter

    with mpl.rc_context(_STYLE):
        figure = Figure(dpi=DPI, facecolor="white")
        caption = (_draw_lines if body.dim == 1 else _draw_views)(figure, body, panels)
        stamp = "" if time is None else f"t = {EngFormatter(unit='s')(time)}"
        figure.suptitle("      ".join(filter(None, [title, stamp])), fontsize=14)
        if caption:
            figure.supxlabel(caption, fontsize=9.5, color="0.3")
        figure.savefig(path, format="png")


def _draw_lines(figure: Any, body: Visible, panels: Sequence[Panel]) -> str:
    """Values along a one-dimensional body, one plot below the other."""
    figure.set_size_inches(WIDTH, 1.0 + 2.6 * len(panels))
    figure.set_layout_engine("constrained")
    scale, prefix = _prefix(np.ptp(body.points[:, 0]), "m")
    # Segments from left to right, each with its left end first.
    x = body.points[:, 0]
    order = np.argsort(x[body.faces].mean(axis=1))
    ends = np.take_along_axis(body.faces[order], np.argsort(x[body.faces[order]], axis=1), axis=1)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for ax, panel in zip(axes, panels, strict=True):
        count = body.values[panel.field].shape[1]
        every = panel.component is None and count > 1
        for component in range(count) if every else [panel.component]:
            shown = _Shown(replace(panel, component=component), body, together=every)
            rows = order.repeat(2) if panel.field in body.cellwise else ends.ravel()
            ax.plot(x[ends.ravel()] / scale, shown.values[rows], lw=1.8, label=shown.symbol)
        if every:
            ax.legend(frameon=False, ncols=6, loc="lower right", bbox_to_anchor=(1.0, 0.98))
        ax.set_ylabel(shown.label)
        ax.ticklabel_format(axis="y", style="sci", scilimits=(-2, 4), useMathText=True)
        ax.grid(color="0.9", lw=0.6)
        ax.margins(x=0)
    axes[-1].set_xlabel(f"x [{prefix}m]")
    return ""


class _Shown:
    """What a panel shows: values, label with unit, colour map and limits."""

    def __init__(self, panel: Panel, body: Visible, together: bool = False) -> None:
        given, symbol = body.values[panel.field], _SYMBOLS.get(panel.field, panel.field)
        norm = panel.component == "norm" or (panel.component is None and given.shape[1] > 1)
        component = int(panel.component or 0) if not norm else 0
        values = np.linalg.norm(given, axis=1) if norm else given[:, component]
        index = f"_{{{component + 1}}}" if given.shape[1] > 1 else ""
        name = f"|{symbol}|" if norm else symbol + index
        largest = float(np.nanmax(np.abs(given if together else values), initial=0.0))
        unit = _UNITS.get(panel.field, "") if panel.unit is None else panel.unit
        scale, prefix = _prefix(largest, unit)
        self.values, self.symbol = values / scale, f"${name}$"
        self.label = panel.label or (f"${symbol}$" if together else self.symbol)
        self.label += f"  [{prefix}{unit}]" if unit else ""
        # Components of fields have a sign, even while all are positive: the map must not flip.
        signed = not norm and (panel.field in _SYMBOLS or values.min(initial=0.0) < 0)
        top = largest / scale or 1.0
        self.map, self.limits = ("coolwarm", (-top, top)) if signed else ("viridis", (0.0, top))


def _prefix(largest: float, unit: str) -> tuple[float, str]:
    """Power of 1000 that brings ``largest`` between 0.5 and 500 if ``unit`` takes its prefix."""
    if unit not in _SCALABLE or not (math.isfinite(largest) and largest > 0):
        return 1.0, ""
    power = min(max(3 * math.floor(math.log10(2 * largest) / 3), -12), 9)
    return 10.0**power, _PREFIXES[power]


def _draw_views(figure: Any, body: Visible, panels: Sequence[Panel]) -> str:
    """Images with colour bars; returns what to say about them all."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    factors = {name: _factor(body, name) for name in dict.fromkeys(p.warp or "" for p in panels)}
    moves = [_displacement(body, name, factors[name]) for name in (p.warp or "" for p in panels)]
    places = [body.points + move for move in moves]
    view = View.of(np.concatenate([body.points, *places]), solid=body.dim == 3)
    columns = len(panels) if view.aspect > 0.45 else 1
    rows = len(panels) // columns
    width = WIDTH / columns - (1.9 if body.dim == 2 else 1.3)
    height = min(width * view.aspect, 6.5)
    figure.set_size_inches(WIDTH, rows * (height + (0.7 if body.dim == 2 else 0.2)) + 0.8)
    figure.set_layout_engine("compressed")
    scale, prefix = _prefix(float(np.ptp(body.points, axis=0).max()), "m")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, panel, points in zip(axes, panels, places, strict=True):
        shown = _Shown(panel, body)
        colours, pixels = (shown.map, shown.limits), round(2 * DPI * height)
        picture = image(view, pixels, body.faces, body.points, points, shown.values, colours)
        (left, bottom), (right, top) = view.low / scale, view.high / scale
        ax.imshow(picture, extent=(left, right, bottom, top), interpolation="antialiased")
        if body.dim == 2:
            ax.set_xlabel(f"x [{prefix}m]")
            ax.set_ylabel(f"y [{prefix}m]")
        else:
            ax.set_axis_off()
        colouring = ScalarMappable(Normalize(*shown.limits), shown.map)
        bar = figure.colorbar(colouring, cax=ax.inset_axes((1.03, 0.0, 0.18 / width, 1.0)))
        bar.set_label(shown.label, fontsize=13)
        bar.outline.set_linewidth(0.6)
        bar.formatter.set_useMathText(True)
        bar.formatter.set_powerlimits((-2, 4))
    if body.dim == 3:
        _axes_cross(axes[0], view.screen)
    return _caption(body, factors, scale, prefix)


def _caption(body: Visible, factors: dict[str, float], scale: float, prefix: str) -> str:
    told = []
    if body.dim == 3:
        sizes = " × ".join(f"{size:.3g}" for size in np.ptp(body.points, axis=0) / scale)
        told.append(f"body of {sizes} {prefix}m")
    for name, factor in factors.items():
        if factor > 0:
            times = f"{factor:g}" if factor < 1e5 else f"{factor:.0e}".replace("e+0", "e+")
            drawn = "to scale" if factor == 1 else f"{times} times as large"
            told.append(f"${_SYMBOLS.get(name, name)}$ drawn {drawn}, edges at rest in grey")
    return "      ".join(told)


def _factor(body: Visible, name: str) -> float:
    """1, 2 or 5 times a power of ten that makes displacements visible; 0 if there are none."""
    values = np.linalg.norm(_displacement(body, name, 1.0), axis=1)
    largest = float(values.max(initial=0.0))
    # What remains of a motion out of the picture's plane may be round-off.
    if largest == 0 or largest < 1e-9 * np.nanmax(np.abs(body.values[name])):
        return 0.0
    wanted = _DEFORMATION * float(np.linalg.norm(np.ptp(body.points, axis=0))) / largest
    if not math.isfinite(wanted) or 0.2 < wanted < 2:
        return 1.0
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(digit for digit in (1, 2, 5) if digit <= wanted / power * (1 + 1e-9))


def _displacement(body: Visible, name: str, factor: float) -> Array:
    """Shape (points, 3); components that leave the plane of a flat body are left out."""
    moves = np.zeros_like(body.points)
    if factor and name in body.values and body.values[name].shape[1] >= body.dim:
        moves[:, : body.dim] = factor * np.nan_to_num(body.values[name][:, : body.dim])
    return moves


def _axes_cross(ax: Any, screen: Array) -> None:
    """Arrows along x, y and z in the lower left corner."""
    for name, arrow in zip("xyz", screen.T, strict=True):
        ax.annotate(
            name,
            xy=(24, 24),
            xycoords="figure points",
            xytext=tuple(28 * arrow),
            textcoords="offset points",
            annotation_clip=False,
            in_layout=False,
            ha="center",
            va="center",
            color="0.3",
            arrowprops={"arrowstyle": "<|-", "color": "0.3", "lw": 1.0, "shrinkB": 0},
        )
