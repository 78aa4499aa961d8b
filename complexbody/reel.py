# SPDX-License-Identifier: LGPL-3.0-or-later
"""One field of a run at chosen times: what all pictures of it share, and what each of them shows.

Colours, the factor of displacements and the frame are those of all the times together: pictures of
one reel can be compared, and a film of them does not flicker. Knows results in files, no scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from complexbody._compat import Array
from complexbody.drawing import Drawing, Frame, displacement, factor_of
from complexbody.errors import ResultsError
from complexbody.output import STEP_FIELDS
from complexbody.reading import Results, Series
from complexbody.rendering import View
from complexbody.scales import UNITS, Panel, Visible, chosen, ends, stamps
from complexbody.surface import Surface

#: Directions to where a solid is looked at from.
VIEWS = {
    "aslant": None, "x": (1.0, 0.0, 0.0), "-x": (-1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, 1.0), "-z": (0.0, 0.0, -1.0),
}  # fmt: skip
_LEAST, _MOST = 160, 8000  # pixels


@dataclass(frozen=True)
class Look:
    """How fields are drawn.

    Attributes:
        components: Each a panel: numbers (from 0; of a tensor row by row) or "norm"; by default the
            norm of a vector, the value of a scalar, and in one dimension all components.
        warp: How many times as large u is drawn; "auto" is such that it can be seen, 0 not at all.
        limits: Values at the ends of the colours, in the field's unit; or a percentage of the
            values of each time that they are to hold; by default all of them.
        colours: A colour map of matplotlib.
        view: Where a solid is looked at from: one of ``VIEWS``, or a direction (x, y, z).
        clip: "x", "y" or "z" and the coordinate [m] of a plane that cuts a solid open.
        size: Width and height [pixels].
        units: Whether to tell units (scenes may be in scaled ones).

    Raises:
        ResultsError: for what makes no sense.
    """

    components: Sequence[int | str] | None = None
    warp: float | str = "auto"
    limits: Sequence[float] | float | None = None
    colours: str | None = None
    view: str | Sequence[float] | None = None
    clip: tuple[str, float] | None = None
    size: tuple[int, int] | None = None
    units: bool = True

    def __post_init__(self) -> None:
        if self.warp != "auto" and not (_is_number(self.warp) and float(self.warp) >= 0):
            raise ResultsError(f"Show: warp is {self.warp!r}. Give 'auto', or a factor ≥ 0.")
        if isinstance(self.limits, Sequence):
            object.__setattr__(self, "limits", tuple(self.limits))
            if len(self.limits) != 2 or not all(map(_is_number, self.limits)) or (
                self.limits[0] >= self.limits[1]
            ):
                raise ResultsError(f"Show: limits are {self.limits!r}. Give two rising numbers.")
        elif self.limits is not None and not 0 < self.limits <= 100:
            raise ResultsError(f"Show: limits={self.limits!r}. Give a percentage up to 100.")
        if self.clip is not None and (
            self.clip[0] not in ("x", "y", "z") or not _is_number(self.clip[1])
        ):
            raise ResultsError(f"Show: clip is {self.clip!r}. Give an axis and a coordinate in m.")
        if self.size is not None and not all(_LEAST <= s <= _MOST for s in self.size):
            raise ResultsError(
                f"Show: a size of {self.size!r} pixels. Give a width and a height from {_LEAST} to "
                f"{_MOST}."
            )
        _ = self.eye

    @property
    def eye(self) -> tuple[float, float, float] | None:
        """Direction of the view (3,); None is aslant."""
        if self.view is None:
            return None
        if isinstance(self.view, str):
            if self.view in VIEWS:
                return VIEWS[self.view]
        elif len(self.view) == 3 and all(map(_is_number, self.view)) and any(self.view):
            x, y, z = map(float, self.view)
            return x, y, z
        raise ResultsError(
            f"Show: view is {self.view!r}. Give {', '.join(VIEWS)}, or three numbers: the "
            "direction to where it is looked at from."
        )


class Reel:
    """A field at some of its steps.

    Args:
        results: The run's folder.
        name: The field.
        times: When [s], of its steps the nearest; None takes the last.
        look: How it is drawn.
        every: With ``times`` None, all steps so far apart instead, and the last; 0 the last alone.

    Attributes:
        series: The field's steps.
        steps: Numbers of those that are shown.
        panels: What is shown.
        frame: How it is framed.
        stamps: The times in words.

    Raises:
        ResultsError: if there is no such field, component or time, or it cannot be read.
    """

    def __init__(
        self, results: Results, name: str, times: Sequence[float] | None, look: Look, every: int = 0
    ) -> None:
        import matplotlib

        if look.colours is not None and look.colours not in matplotlib.colormaps:
            raise ResultsError(
                f"Show: matplotlib has no colour map {look.colours!r}. Give one such as viridis, "
                "inferno, coolwarm or RdBu_r."
            )
        self.series: Series = results.series(name)
        series, count = self.series, self.series.values(-1).shape[1]
        self.steps = self._chosen(times, every)
        flat = series.dim < 3
        if flat and (look.clip is not None or look.eye is not None):
            raise ResultsError(
                f"{results.folder} has a body in {series.dim} dimension{'s'[: series.dim - 1]}. "
                "Leave out view and clip: they are for solids."
            )
        self._u = self._displacements(results, look)
        clip = None if look.clip is None else ("xyz".index(look.clip[0]), float(look.clip[1]))
        eye = None if look.eye is None else np.array(look.eye)
        self._surface = Surface(series.points, series.cells, clip, eye)
        for component in look.components or ():
            if component != "norm" and not (isinstance(component, int) and 0 <= component < count):
                raise ResultsError(
                    f"{name!r} has no component {component!r}. Give 'norm', or a number from 0 to "
                    f"{count - 1}."
                )
        panel = Panel(
            name, None, None if self._u is None else "u",
            unit=None if look.units else "", colours=look.colours,
            limits=(look.limits[0], look.limits[1]) if isinstance(look.limits, Sequence) else None,
        )  # fmt: skip
        panels = [replace(panel, component=c) for c in look.components or ()] or [panel]
        shown = series.times[self.steps]
        self.stamps = (
            [""] if name in STEP_FIELDS else stamps(shown.tolist(), "s" if look.units else "")
        )
        self._survey(panels, look)

    def __len__(self) -> int:
        return len(self.steps)

    def _chosen(self, times: Sequence[float] | None, every: int) -> list[int]:
        series = self.series
        last = len(series.times) - 1
        if series.name in STEP_FIELDS:
            return [last]
        if times is not None:
            return [series.nearest(float(time)) for time in times]
        if not every:
            return [last]
        return sorted({*range(0, last + 1, every), last})

    def _displacements(self, results: Results, look: Look) -> Series | None:
        """u where it is there for all these times on the same mesh, and is to deform the body."""
        if self.series.dim == 1 or "u" not in results.names or look.warp == 0:
            return None
        u = results.series("u")
        if u.cellwise or u.points.shape != self.series.points.shape:
            return None
        if u.values(-1).shape[1] < self.series.dim:
            return None  # it leaves the plane
        there = all(u.at(self.series.times[step]) is not None for step in self.steps)
        return u if there and self.series.name not in STEP_FIELDS else None

    def body(self, number: int) -> Visible:
        """What is seen at the ``number``-th of the steps."""
        step = self.steps[number]
        fields = {self.series.name: (self.series.values(step), self.series.cellwise)}
        if self._u is not None and self.series.name != "u":
            at = self._u.at(self.series.times[step])
            assert at is not None
            fields["u"] = (self._u.values(at), False)
        return self._surface.see(fields)

    def _survey(self, panels: Sequence[Panel], look: Look) -> None:
        """Go through all steps for limits, factor and frame."""
        percent = float(look.limits) if isinstance(look.limits, int | float) else 100.0
        ranges = [_Range(panel, self.series, percent) for panel in panels]
        factors: list[float] = []
        moves: list[Array] = []
        view: View | None = None
        for number in range(len(self)):
            body = self.body(number)
            for found in ranges:
                found.widen(body.values[self.series.name])
            if body.dim > 1:
                view = view or View.of(body.points, body.dim == 3, look.eye)
                moved = displacement(body, "u", 1.0) @ view.screen.T
                moves.append(np.stack([moved.min(axis=0), moved.max(axis=0)]))
                factors.append(factor_of(body, "u") if self._u is not None else 0.0)
        factor = min((f for f in factors if f > 0), default=0.0)
        if self._u is not None and look.warp != "auto":
            factor = float(look.warp)
        if view is not None:
            least, most = np.min(moves, axis=0)[0], np.max(moves, axis=0)[1]
            room = View(view.screen, view.low + factor * least, view.high + factor * most)
            view = view.and_also(room)
        self.panels = tuple(found.panel() for found in ranges)
        name = {"u": factor} if self._u is not None else {}
        self.frame = Frame(name, view, look.eye, look.size, "m" if look.units else "")

    def told(self) -> str:
        """The limits in words."""
        unit = UNITS.get(self.series.name, "") if self.frame.length else ""
        parts = [
            f"{panel.limits[0]:.3g} to {panel.limits[1]:.3g} {unit}".rstrip()
            if panel.limits else "zero" for panel in self.panels
        ]  # fmt: skip
        return "; ".join(parts)

    def drawing(self, number: int, title: str, oversampling: float = 2.0) -> Drawing:
        """The picture at the ``number``-th of the steps."""
        frame = replace(self.frame, oversampling=oversampling)
        return Drawing(self.body(number), self.panels, title, self.stamps[number], frame)


class _Range:
    """Values of a panel over all times: its limits, and which component it is to show."""

    def __init__(self, panel: Panel, series: Series, percent: float) -> None:
        self._panel, self._percent, self._line = panel, percent, series.dim == 1
        self._count, self._alive = 1, np.zeros(1, dtype=bool)
        self._low, self._top = 0.0, 0.0

    def widen(self, table: Array) -> None:
        """Take in the values (…, components) of one more time."""
        self._count = table.shape[1]
        self._alive = self._alive | table.any(axis=0)
        together = self._line and self._panel.component is None
        values = table.ravel() if together else chosen(self._panel, table)
        values = values[np.isfinite(values)]
        if len(values):
            self._low = min(self._low, float(values.min()))
            self._top = max(self._top, float(np.percentile(np.abs(values), self._percent)))

    def panel(self) -> Panel:
        """The panel with limits; of a vector with one component that is not zero, this one."""
        panel, given = self._panel, self._panel.limits
        if panel.component is None and self._count > 1 and self._alive.sum() == 1:
            panel = replace(panel, component=int(self._alive.argmax()))
            low = -self._top  # a norm does not tell
        else:
            low = self._low
        if given is not None or self._top == 0:
            return panel
        one = replace(panel, component=0) if self._line and panel.component is None else panel
        limits = ends(one, self._count, low, self._top)
        return replace(panel, limits=limits, beyond=self._percent < 100)


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float | np.integer | np.floating)
        and not isinstance(value, bool)
        and math.isfinite(value)
    )
