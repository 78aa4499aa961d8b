# SPDX-License-Identifier: LGPL-3.0-or-later
"""How a body is drawn, by one process: VTK makes images of it, matplotlib all that is written.

VTK draws without lettering, in parallel projection: so each image has true axes, every panel the
same frame, and all words one typeface. One-dimensional bodies become line plots. Knows no mesh and
no ranks. Matplotlib and pyvista are imported where they are used: both are optional.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from complexbody._compat import Array
from complexbody.rendering import View, image
from complexbody.scales import SYMBOLS, Panel, Shown, Visible, prefixed

__all__ = ["Drawing", "Frame", "Panel", "Visible", "displacement", "draw", "factor_of"]

WIDTH, DPI = 10.0, 160  # inches and pixels per inch
STYLE = {"font.size": 11.0, "axes.linewidth": 0.6, "axes.edgecolor": "0.4"}
_DEFORMATION = 0.06  # largest displacement in the picture, over the size of the body


@dataclass(frozen=True)
class Frame:
    """How a picture is framed.

    Attributes:
        factors: How many times as large displacements are drawn, by name of the field; those of
            others are chosen to be visible.
        view: What is seen; by default all of the body.
        eye: Direction to where a solid is looked at from (3,), if there is no view.
        size: Width and height [pixels]; by default 1600 pixels wide and as high as it takes.
        length: Unit of lengths.
        oversampling: Pixels of VTK's images for each one of the picture, along a side.
    """

    factors: Mapping[str, float] = field(default_factory=dict)
    view: View | None = None
    eye: tuple[float, float, float] | None = None
    size: tuple[int, int] | None = None
    length: str = "m"
    oversampling: float = 2.0


def draw(
    path: Path, body: Visible, panels: Sequence[Panel], title: str, time: float | None
) -> None:
    """Draw ``panels`` of ``body`` into a PNG file.

    Raises:
        OSError: if the file cannot be written.
    """
    from matplotlib.ticker import EngFormatter

    stamp = "" if time is None else f"t = {EngFormatter(unit='s')(time)}"
    Drawing(body, panels, title, stamp).save(path)


class Drawing:
    """A figure of panels; it can be drawn again with other values, in the same layout.

    Args:
        body: What is seen.
        panels: What is shown of it.
        title: Stands above, in front of the time.
        stamp: The time, in words.
        frame: How it is framed.
    """

    def __init__(
        self,
        body: Visible,
        panels: Sequence[Panel],
        title: str = "",
        stamp: str = "",
        frame: Frame | None = None,
    ) -> None:
        import matplotlib as mpl
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        frame = frame or Frame()
        with mpl.rc_context(STYLE):
            dpi = DPI if frame.size is None else frame.size[0] / WIDTH
            self._figure = Figure(dpi=dpi, facecolor="white")
            self._canvas = FigureCanvasAgg(self._figure)
            kind = _Lines if body.dim == 1 else _Views
            self._parts: Any = kind(self._figure, body, panels, frame)
            if frame.size is not None:
                width, height = frame.size
                self._figure.set_size_inches(WIDTH, height * WIDTH / width)
            self._title = title
            self._head = self._figure.suptitle(self._words(stamp), fontsize=14)
            if self._parts.caption:
                self._figure.supxlabel(self._parts.caption, fontsize=9.5, color="0.3")

    def _words(self, stamp: str) -> str:
        return "      ".join(filter(None, [self._title, stamp]))

    def update(self, body: Visible, stamp: str) -> None:
        """Show other values of the same body."""
        self._head.set_text(self._words(stamp))
        self._parts.update(body)

    def save(self, path: Path) -> None:
        """Write a PNG file.

        Raises:
            OSError: if it cannot be written.
        """
        self._figure.savefig(path, format="png")

    def pixels(self) -> Any:
        """Colours from the top, shape (height, width, 3), of type uint8."""
        canvas: Any = self._canvas
        canvas.draw()
        # Layout takes longer than all else, and must not move from frame to frame.
        self._figure.set_layout_engine("none")
        return np.asarray(canvas.buffer_rgba())[:, :, :3].copy()


class _Lines:
    """Values along a one-dimensional body, one plot below the other."""

    caption = ""

    def __init__(
        self, figure: Any, body: Visible, panels: Sequence[Panel], frame: Frame
    ) -> None:
        figure.set_size_inches(WIDTH, 1.0 + 2.6 * len(panels))
        figure.set_layout_engine("constrained")
        scale, prefix = prefixed(np.ptp(body.points[:, 0]), frame.length)
        # Segments from left to right, each with its left end first.
        x = body.points[:, 0]
        self._order = np.argsort(x[body.faces].mean(axis=1))
        left = np.argsort(x[body.faces[self._order]], axis=1)
        self._ends = np.take_along_axis(body.faces[self._order], left, axis=1).ravel()
        self._curves: list[tuple[Any, Panel, bool]] = []
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for ax, panel in zip(axes, panels, strict=True):
            count = body.values[panel.field].shape[1]
            every = panel.component is None and count > 1
            for component in range(count) if every else [panel.component]:
                one = replace(panel, component=component)
                shown = Shown(one, body, together=every)
                [line] = ax.plot(
                    x[self._ends] / scale, self._along(shown, one, body), lw=1.8,
                    label=shown.symbol,
                )  # fmt: skip
                self._curves.append((line, one, every))
            if every:
                ax.legend(frameon=False, ncols=6, loc="lower right", bbox_to_anchor=(1.0, 0.98))
            if panel.limits is not None:
                margin = 0.05 * (shown.limits[1] - shown.limits[0])
                ax.set_ylim(shown.limits[0] - margin, shown.limits[1] + margin)
            ax.set_ylabel(shown.label)
            ax.ticklabel_format(axis="y", style="sci", scilimits=(-2, 4), useMathText=True)
            ax.grid(color="0.9", lw=0.6)
            ax.margins(x=0)
        axes[-1].set_xlabel(f"x [{prefix}{frame.length}]" if frame.length else "x")

    def _along(self, shown: Shown, panel: Panel, body: Visible) -> Array:
        cellwise = panel.field in body.cellwise
        return shown.values[self._order.repeat(2) if cellwise else self._ends]

    def update(self, body: Visible) -> None:
        for line, panel, every in self._curves:
            line.set_ydata(self._along(Shown(panel, body, together=every), panel, body))


class _Views:
    """Images with colour bars."""

    def __init__(
        self, figure: Any, body: Visible, panels: Sequence[Panel], frame: Frame
    ) -> None:
        names = dict.fromkeys(panel.warp or "" for panel in panels)
        self._factors = {
            name: frame.factors[name] if name in frame.factors else factor_of(body, name)
            for name in names
        }  # fmt: skip
        self._panels = panels
        moved = [self._places(body, panel) for panel in panels]
        view = frame.view or View.of(
            np.concatenate([body.points, *moved]), body.dim == 3, frame.eye
        )
        self._view = view
        columns = len(panels) if view.aspect > 0.45 else 1
        rows = len(panels) // columns
        width = WIDTH / columns - (1.9 if body.dim == 2 else 1.3)
        height = min(width * view.aspect, 6.5)
        self._pixels = round(frame.oversampling * figure.dpi * height)
        figure.set_size_inches(WIDTH, rows * (height + (0.7 if body.dim == 2 else 0.2)) + 0.8)
        figure.set_layout_engine("compressed")
        scale, prefix = prefixed(float(np.ptp(body.points, axis=0).max()), frame.length)
        unit = f" [{prefix}{frame.length}]" if frame.length else ""
        axes, self._images = figure.subplots(rows, columns, squeeze=False).ravel(), []
        for ax, panel, points in zip(axes, panels, moved, strict=True):
            shown = Shown(panel, body)
            (left, bottom), (right, top) = view.low / scale, view.high / scale
            self._images.append(
                ax.imshow(
                    self._image(body, shown, points), extent=(left, right, bottom, top),
                    interpolation="antialiased",
                )
            )  # fmt: skip
            if body.dim == 2:
                ax.set_xlabel(f"x{unit}")
                ax.set_ylabel(f"y{unit}")
            else:
                ax.set_axis_off()
            colour_bar(figure, ax.inset_axes((1.03, 0.0, 0.18 / width, 1.0)), shown)
        if body.dim == 3:
            axes_cross(axes[-1], view.screen)
        self.caption = caption(body, self._factors, scale, prefix + frame.length)

    def _places(self, body: Visible, panel: Panel) -> Array:
        name = panel.warp or ""
        return body.points + displacement(body, name, self._factors[name])

    def _image(self, body: Visible, shown: Shown, points: Array) -> Any:
        colours = (shown.map, shown.limits)
        return image(
            self._view, self._pixels, body.faces, body.points, points, shown.values, colours
        )

    def update(self, body: Visible) -> None:
        for artist, panel in zip(self._images, self._panels, strict=True):
            artist.set_data(self._image(body, Shown(panel, body), self._places(body, panel)))


def colour_bar(figure: Any, ax: Any, shown: Shown) -> None:
    """The bar of what is shown, in axes of its own."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colouring = ScalarMappable(Normalize(*shown.limits), shown.map)
    bar = figure.colorbar(colouring, cax=ax, extend=shown.extend)
    bar.set_label(shown.label, fontsize=13)
    bar.outline.set_linewidth(0.6)
    bar.formatter.set_useMathText(True)
    bar.formatter.set_powerlimits((-2, 4))


def caption(body: Visible, factors: Mapping[str, float], scale: float, unit: str) -> str:
    """The size of a solid, and how displacements are drawn."""
    told = []
    if body.dim == 3:
        sizes = " × ".join(f"{size:.3g}" for size in np.ptp(body.points, axis=0) / scale)
        told.append(f"body of {sizes} {unit}".rstrip())
    for name, factor in factors.items():
        if factor > 0:
            times = f"{factor:g}" if factor < 1e5 else f"{factor:.0e}".replace("e+0", "e+")
            drawn = "to scale" if factor == 1 else f"{times} times as large"
            told.append(f"${SYMBOLS.get(name, name)}$ drawn {drawn}, edges at rest in grey")
    return "      ".join(told)


def factor_of(body: Visible, name: str) -> float:
    """1, 2 or 5 times a power of ten that makes displacements visible; 0 if there are none."""
    values = np.linalg.norm(displacement(body, name, 1.0), axis=1)
    largest = float(values.max(initial=0.0))
    # What remains of a motion out of the picture's plane may be round-off.
    if largest == 0 or largest < 1e-9 * np.nanmax(np.abs(body.values[name])):
        return 0.0
    wanted = _DEFORMATION * float(np.linalg.norm(np.ptp(body.points, axis=0))) / largest
    if not math.isfinite(wanted) or 0.2 < wanted < 2:
        return 1.0
    power = 10.0 ** math.floor(math.log10(wanted))
    return power * max(digit for digit in (1, 2, 5) if digit <= wanted / power * (1 + 1e-9))


def displacement(body: Visible, name: str, factor: float) -> Array:
    """Shape (points, 3); components that leave the plane of a flat body are left out."""
    moves = np.zeros_like(body.points)
    if factor and name in body.values and body.values[name].shape[1] >= body.dim:
        moves[:, : body.dim] = factor * np.nan_to_num(body.values[name][:, : body.dim])
    return moves


def axes_cross(ax: Any, screen: Array) -> None:
    """Arrows along x, y and z in the lower left corner."""
    for name, arrow in zip("xyz", screen.T, strict=True):
        if np.linalg.norm(arrow) < 0.1:  # straight towards the eye
            continue
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
