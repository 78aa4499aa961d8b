# SPDX-License-Identifier: LGPL-3.0-or-later
"""All fields of a run on one page: a row each, at several times or, in one dimension, over all.

One-dimensional fields become space–time diagrams, in which waves are straight lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from complexbody.drawing import DPI, STYLE, WIDTH, axes_cross, caption, colour_bar, displacement
from complexbody.reel import Reel
from complexbody.rendering import image
from complexbody.scales import Shown, prefixed

ACROSS = 4  # times
DOWN = 400  # at most so many times in a space–time diagram


def write_sheet(path: Path, reels: Sequence[Reel], title: str) -> None:
    """Draw the sheet into a PNG file.

    Args:
        path: The file.
        reels: A row each; in two and three dimensions with equally many steps.
        title: Stands above.

    Raises:
        OSError: if the file cannot be written.
    """
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context({**STYLE, "font.size": 9.5}):
        figure = Figure(dpi=DPI, facecolor="white")
        FigureCanvasAgg(figure)
        (_diagrams if reels[0].series.dim == 1 else _images)(figure, reels)
        figure.suptitle(title, fontsize=13)
        figure.savefig(path, format="png")


def _images(figure: Any, reels: Sequence[Reel]) -> None:
    columns = max(map(len, reels))
    views = [reel.frame.view for reel in reels if reel.frame.view is not None]
    aspect = max(view.aspect for view in views)
    width = (WIDTH - 1.3) / columns
    height = min(width * aspect, 3.2)
    figure.set_size_inches(WIDTH, len(reels) * (height + 0.3) + 0.7)
    figure.set_layout_engine("compressed")
    axes = figure.subplots(len(reels), columns, squeeze=False)
    for row, (reel, view) in zip(axes, zip(reels, views, strict=True), strict=True):
        for ax in row:
            ax.set_axis_off()
        [panel, *_], factor = reel.panels, reel.frame.factors.get("u", 0.0)
        for number, ax in enumerate(row[: len(reel)]):
            body = reel.body(number)
            shown = Shown(panel, body)
            points = body.points + displacement(body, "u", factor)
            picture = image(
                view, round(2 * DPI * height), body.faces, body.points, points, shown.values,
                (shown.map, shown.limits),
            )  # fmt: skip
            ax.imshow(picture, interpolation="antialiased")
            ax.set_title(reel.stamps[number], fontsize=10)
            if number == len(reel) - 1:
                bar = ax.inset_axes((1.04, 0.0, 0.1 / width, 1.0))
                colour_bar(figure, bar, shown)
    length = reels[0].frame.length
    scale, prefix = prefixed(float(np.ptp(reels[0].series.points, axis=0).max()), length)
    said = caption(reels[0].body(0), reels[0].frame.factors, scale, prefix + length)
    figure.supxlabel(said or " ", fontsize=9.5, color="0.3")
    if reels[0].series.dim == 3:
        axes_cross(axes[-1, -1], views[0].screen)  # the last one: others would be drawn over it


def _diagrams(figure: Any, reels: Sequence[Reel]) -> None:
    figure.set_size_inches(WIDTH, len(reels) * 2.3 + 1.0)
    figure.set_layout_engine("constrained")
    axes = figure.subplots(len(reels), 1, sharex=True, squeeze=False)[:, 0]
    for ax, reel in zip(axes, reels, strict=True):
        series, length = reel.series, reel.frame.length
        [panel, *_] = reel.panels
        bodies = [reel.body(number) for number in range(len(reel))]
        count = bodies[0].values[series.name].shape[1]
        # The curves' limits hold all components; those of a norm begin at zero.
        if panel.component is None and count > 1:
            panel = replace(panel, limits=None)
            norms = [np.linalg.norm(body.values[series.name], axis=1) for body in bodies]
            panel = replace(panel, limits=(0.0, max(np.max(norms), 1e-300)))
        shown = [Shown(panel, body) for body in bodies]
        x = series.points[:, 0]
        x = x[series.cells].mean(axis=1) if series.cellwise else x
        order, times = np.argsort(x), series.times[reel.steps]
        space, prefix = prefixed(np.ptp(series.points[:, 0]), length)
        scale, time_prefix = prefixed(times.max(), "s" if length else "")
        values = np.array([one.values[order] for one in shown])
        ax.pcolormesh(
            x[order] / space, times / scale, values, cmap=shown[0].map, vmin=shown[0].limits[0],
            vmax=shown[0].limits[1], shading="nearest" if series.cellwise else "gouraud",
            rasterized=True,
        )  # fmt: skip
        ax.set_ylabel(f"t [{time_prefix}s]" if length else "t")
        colour_bar(figure, ax.inset_axes((1.015, 0.0, 0.015, 1.0)), shown[-1])
    axes[-1].set_xlabel(f"x [{prefix}{length}]" if length else "x")
