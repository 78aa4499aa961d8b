# SPDX-License-Identifier: LGPL-3.0-or-later
"""What colours and curves of a picture mean: symbols, units with prefixes, colour maps, their ends.

Knows tables of numbers and names of fields; draws nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from complexbody._compat import Array, Ints

#: Symbols of fields that have a sign; and of those that have none.
SIGNED = {
    "u": "u", "nu": r"\nu", "u_dot": r"\dot{u}", "nu_dot": r"\dot{\nu}", "stress": "P",
    "self_action": "z", "microstress": "S",
}  # fmt: skip
SYMBOLS = {**SIGNED, "energy_density": r"\rho e", "steps": "h_K", "levels": "level"}
UNITS = {"u": "m", "u_dot": "m/s", "stress": "Pa", "energy_density": "J/m³", "steps": "s"}
TENSORS = ("stress", "microstress")  # row by row, three columns
#: Units that take a prefix: it belongs to their first symbol alone.
_SCALABLE = ("m", "m/s", "s", "Pa", "N", "J", "J/m³", "Hz")
_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}


@dataclass(frozen=True)
class Panel:
    """One view of the body.

    Attributes:
        field: Name of the function that gives the colours.
        component: A component (from 0), or "norm"; by default the norm of a vector, the value of a
            scalar, and in one dimension all components.
        warp: Name of the function that deforms the body, by a factor the picture tells; or None.
        label: What to call the colours; by default the symbol of the field.
        unit: Their unit; by default m for u, m/s for its rate, Pa for the stress.
        limits: Values at the ends of the colours, in that unit without a prefix; by default those
            of the picture, symmetric where the field has a sign.
        colours: A colour map of matplotlib; by default "coolwarm" where there is a sign, "viridis"
            elsewhere.
        beyond: Whether values beyond the limits are to be expected: the bar then ends in arrows.
    """

    field: str = "u"
    component: int | str | None = None
    warp: str | None = "u"
    label: str | None = None
    unit: str | None = None
    limits: tuple[float, float] | None = None
    colours: str | None = None
    beyond: bool = False


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


def is_norm(panel: Panel, count: int) -> bool:
    """Whether the panel shows the norm of a field with ``count`` components."""
    return panel.component == "norm" or (panel.component is None and count > 1)


def chosen(panel: Panel, table: Array) -> Array:
    """The component that the panel shows, or the norm: (…,) of a table (…, components)."""
    if is_norm(panel, table.shape[1]):
        return np.linalg.norm(table, axis=1)
    return table[:, int(panel.component or 0)]


def symbol(field: str, component: int | None, count: int) -> str:
    """In TeX, without dollars: u_{2}, P_{12}; the norm |u| where ``component`` is None."""
    name = SYMBOLS.get(field, field)
    if component is None:
        return f"|{name}|"
    if count == 1:
        return name
    tensor = field in TENSORS and count % 3 == 0
    index = f"{component // 3 + 1}{component % 3 + 1}" if tensor else f"{component + 1}"
    return f"{name}_{{{index}}}"


def has_sign(panel: Panel, count: int, low: float) -> bool:
    """Whether zero is the middle of the colours; ``low`` is the least value shown.

    Components of fields have a sign, even while all are positive: the map must not flip.
    """
    return not is_norm(panel, count) and (panel.field in SIGNED or low < 0)


def ends(panel: Panel, count: int, low: float, high: float) -> tuple[float, float]:
    """Limits that hold values between ``low`` and ``high``: from −a to a, or from 0."""
    top = max(abs(low), abs(high))
    top = top if math.isfinite(top) and top > 0 else 1.0
    return (-top if has_sign(panel, count, low) else 0.0, top)


class Shown:
    """What a panel shows of a body: values, label with unit, colour map and limits.

    Args:
        panel: The panel.
        body: Has its field.
        together: With the limits of all components, for plots of them all.
    """

    def __init__(self, panel: Panel, body: Visible, together: bool = False) -> None:
        given = body.values[panel.field]
        count, self.values = given.shape[1], chosen(panel, given)
        name = symbol(
            panel.field, None if is_norm(panel, count) else int(panel.component or 0), count
        )
        table = given if together else self.values
        low = float(np.nanmin(table, initial=0.0))
        limits = panel.limits or ends(panel, count, low, float(np.nanmax(table, initial=0.0)))
        largest = max(map(abs, limits))
        unit = UNITS.get(panel.field, "") if panel.unit is None else panel.unit
        # Limits of 1 may stand for a field that vanishes: it takes no prefix.
        self.scale, prefix = prefixed(largest, unit) if table.any() or panel.limits else (1.0, "")
        self.values, self.symbol = self.values / self.scale, f"${name}$"
        all_of_them = f"${SYMBOLS.get(panel.field, panel.field)}$"
        self.label = panel.label or (all_of_them if together else self.symbol)
        self.label += f"  [{prefix}{unit}]" if unit else ""
        self.limits = (limits[0] / self.scale, limits[1] / self.scale)
        self.map = panel.colours or ("coolwarm" if limits[0] < 0 else "viridis")
        self.extend = "neither"
        if panel.beyond:
            self.extend = "both" if limits[0] < 0 else "max"


def prefixed(largest: float, unit: str) -> tuple[float, str]:
    """Power of 1000 that brings ``largest`` between 0.5 and 500 if ``unit`` takes its prefix."""
    if unit not in _SCALABLE or not (math.isfinite(largest) and largest > 0):
        return 1.0, ""
    power = min(max(3 * math.floor(math.log10(2 * largest) / 3), -12), 9)
    return 10.0**power, _PREFIXES[power]


def stamps(times: Sequence[float], unit: str = "s") -> list[str]:
    """Times in words, all with the same prefix and digits, as few as tell them apart."""
    scale, prefix = prefixed(max(map(abs, times), default=0.0), unit)
    values = np.array(times) / scale
    gap = np.diff(np.unique(values)).min(initial=abs(values).max(initial=0.0))
    digits = 0
    # Whole multiples of the gap are written in full, others to a hundredth of it.
    while gap > 0 and digits < 6:
        rounded = np.round(values, digits)
        if np.abs(rounded - values).max() <= 0.01 * gap:
            break
        digits += 1
    text = f" {prefix}{unit}".rstrip()
    return [f"t = {value:.{digits}f}{text}" for value in values]
