# SPDX-License-Identifier: LGPL-3.0-or-later
"""Growth maps as pictures: safety factor across, schedules or size ratios up, growth in colour.

Colours run from light to dark in one direction of brightness (viridis), so that they can be told
apart with any eyes and in print; what is stable is nearly white.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.errors import MissingPackage
from complexbody.resonances import TOLERANCE

Array = npt.NDArray[np.float64]

#: Growth per coarse step at the ends of the colour scale.
LEAST, MOST = 1e-5, 1.0


def _plt() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise MissingPackage("No matplotlib for the picture. Run: tools/setup.sh") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def draw_map(
    ax: Any, alphas: Array, labels: Sequence[str], growth: Array, defaults: Sequence[float]
) -> Any:
    """One map; returns what a colour bar needs.

    Args:
        ax: matplotlib axes.
        alphas: Safety factors, rising (a,).
        labels: Of the rows.
        growth: Per coarse step (rows, a); NaN where there is no run.
        defaults: Default safety factor of each row, marked by a line.
    """
    import matplotlib
    from matplotlib.colors import LogNorm

    colours = matplotlib.colormaps["viridis_r"].with_extremes(under="#f4f4f4", bad="white")
    middle = 0.5 * (alphas[1:] + alphas[:-1])
    x = np.concatenate([[alphas[0]], middle, [alphas[-1]]])
    y = np.arange(len(labels) + 1) - 0.5
    shown = np.where(np.isnan(growth), np.nan, np.maximum(growth, 1e-16))
    mesh = ax.pcolormesh(
        x, y, np.minimum(shown, MOST), cmap=colours,
        norm=LogNorm(LEAST, MOST), rasterized=True,
    )  # fmt: skip
    _outline(ax, x, y, np.nan_to_num(growth, nan=0.0) > TOLERANCE)
    ax.hlines(y[1:-1], x[0], x[-1], colors="white", linewidths=1.0, zorder=2)
    for row, default in enumerate(defaults):
        ax.plot([default] * 2, [row - 0.5, row + 0.5], color="#d1495b", lw=2.0, zorder=4)
    for row in range(len(labels)):
        if np.isnan(growth[row]).all():
            ax.text(np.mean(x[[0, -1]]), row, "refused", ha="center", va="center", color="0.4")
    ax.set_yticks(range(len(labels)), labels)
    ax.set_xlim(x[0], x[-1])
    ax.tick_params(length=0, axis="y")
    return mesh


def _outline(ax: Any, x: Array, y: Array, inside: npt.NDArray[np.bool_]) -> None:
    """Black line around the cells of a map whose growth is above the tolerance."""
    from matplotlib.collections import LineCollection

    padded = np.pad(inside, 1)
    lines = []
    for row, column in np.argwhere(padded[:, 1:] != padded[:, :-1]):
        if 0 < row <= len(inside):
            lines.append([(x[column], y[row - 1]), (x[column], y[row])])
    for row, column in np.argwhere(padded[1:] != padded[:-1]):
        if 0 < column <= inside.shape[1]:
            lines.append([(x[column - 1], y[row]), (x[column], y[row])])
    ax.add_collection(LineCollection(lines, colors="black", linewidths=0.7, zorder=3))


def _bar(figure: Any, mesh: Any, axes: Any) -> None:
    bar = figure.colorbar(mesh, ax=axes, extend="min", pad=0.02, aspect=30)
    bar.set_label("growth per coarse step, |λ| − 1")
    bar.ax.axhline(TOLERANCE, color="black", lw=1.2)


def _style(plt: Any) -> None:
    plt.rcParams.update({"font.size": 10, "axes.titlesize": 10, "axes.titlelocation": "left"})


def draw_scene(found: Any, defaults: Mapping[str, float], path: Path) -> None:
    """The growth map of a scene: a row per schedule.

    Args:
        found: A :class:`complexbody.stability.Stability`.
        defaults: Default safety factor by schedule.
        path: The PNG file.
    """
    plt = _plt()
    _style(plt)
    names = list(dict.fromkeys(p.schedule for p in found.points))
    alphas = np.array(sorted({p.safety for p in found.points}))
    growth = np.full((len(names), len(alphas)), np.nan)
    for p in found.points:
        known = p.how != "long run" or p.growth > p.resolution
        growth[names.index(p.schedule), np.searchsorted(alphas, p.safety)] = (
            p.growth if known else 0.0 * p.growth
        )
    figure, ax = plt.subplots(figsize=(8.2, 1.6 + 0.42 * len(names)), layout="constrained")
    names_shown = names[::-1]
    mesh = draw_map(ax, alphas, names_shown, growth[::-1], [defaults[n] for n in names_shown])
    ax.set_xlabel("safety factor α (red: the default)")
    ax.set_title(f"{found.name}, {found.cells} cells: black outlines, growth above 1e-3")
    _bar(figure, mesh, ax)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _binned(part: Mapping[str, Any], width: float = 0.01) -> tuple[Array, Array]:
    """The largest growth within intervals of α, so that thin bands are seen."""
    alphas, growth = np.array(part["alpha"]), np.array(part["growth"])
    place = np.floor((alphas - alphas[0]) / width + 1e-6).astype(int)
    first = np.flatnonzero(np.diff(place, prepend=-1))
    return alphas[first], np.maximum.reduceat(growth, first, axis=1)


def _free_of_resonance(ax: Any, labels: Sequence[str]) -> None:
    """Where windows of ⌈r⌉ = n fine steps begin to meet modes: α = (n/r) sin(π/2n)."""
    for row, label in enumerate(labels):
        ratio = float(Fraction(label))
        n = int(np.ceil(ratio))
        if n > 1:
            ax.plot(
                [n / ratio * np.sin(0.5 * np.pi / n)] * 2, [row - 0.5, row + 0.5],
                color="#4477aa", lw=1.6, ls=(0, (2, 1)), zorder=4,
            )  # fmt: skip
    ax.text(0.47, 0.0, "blue: left of it no mode is met", color="#33557f", va="center", fontsize=9)


def draw_bars(found: Any, defaults: Mapping[str, float], path: Path) -> None:
    """The maps of the bars of two rates, a panel per schedule, and predicted against measured.

    Args:
        found: A :class:`complexbody.bars.Bars`.
        defaults: Default safety factor by schedule.
        path: The PNG file.
    """
    plt = _plt()
    _style(plt)
    figure, axes = plt.subplots(
        2, 3, figsize=(12.5, 8.2), layout="constrained", sharex=True, sharey=True
    )
    mesh = None
    for ax, (name, part) in zip(axes.flat, found.maps.items(), strict=True):
        labels, (alphas, growth) = part["ratio"], _binned(part)
        mesh = draw_map(ax, alphas, labels, growth, [defaults[name]] * len(labels))
        ax.set_title(name + (" (predicted)" if part["apart"] is not None else " (measured)"))
        if name == "plain windows":
            _free_of_resonance(ax, labels)
    for ax in axes[1]:
        ax.set_xlabel("safety factor α (red: the default)")
    for ax in axes[:, 0]:
        ax.set_ylabel("size of coarse over fine cells")
    figure.suptitle("Bars of 10 + 10 cells of two sizes; black outlines, growth above 1e-3", x=0.4)
    _bar(figure, mesh, axes)
    figure.savefig(path, dpi=130)
    plt.close(figure)
