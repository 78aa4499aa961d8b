# SPDX-License-Identifier: LGPL-3.0-or-later
"""The picture of a chart: error against cost, fronts, slopes, and who wins at which error.

A column for the total error and one for the time error, a row for seconds and one for element
updates. All points are small, what no other point of a method beats is joined. Knows rows, and runs
nothing.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from complexbody import fronts
from complexbody.contenders import Contender, contenders

if TYPE_CHECKING:
    from complexbody.workprecision import Chart

#: Errors below this share of the largest are not shown: they would press all others together.
DEPTH = 1e-9
_NORMS = {
    "fields": "relative L2 error, the larger of u and ν", "energy_norm": "error in the energy norm",
    "energy": "relative error of the energy",
    **{name: f"relative L2 error of {sign}" for name, sign in (
        ("u", "u"), ("nu", "ν"), ("u_dot", "u̇"), ("nu_dot", "ν̇"))},
}  # fmt: skip
_COSTS = {"seconds": "processor seconds of stepping", "updates": "element updates"}


def draw(chart: Chart, path: Path) -> None:
    """Draw a chart into a file; on one rank."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = chart.rows
    styles = {c.name: c for c in contenders().values()}
    kinds = [k for k in fronts.ERRORS if chart.knows(k)]
    with plt.rc_context({
        "axes.spines.top": False, "axes.spines.right": False, "font.size": 10,
        "axes.titlesize": 11, "axes.titlelocation": "left",
    }):  # fmt: skip
        columns = max(len(kinds), 1)
        figure, axes = plt.subplots(
            2, columns, figsize=(2.4 + 5.9 * columns, 10.2), squeeze=False, sharey="col"
        )
        for column, kind in enumerate(kinds):
            for row, cost in enumerate(fronts.COSTS):
                panel = _Panel(axes[row, column], chart, styles, kind, cost)
                panel.draw()
                if row == 0:
                    axes[row, column].set_title(_title(chart, kind))
        for ax in axes.flat if not kinds else ():
            ax.text(0.5, 0.5, "no method ran to the end", ha="center", transform=ax.transAxes)
        names = [n for n, own in fronts.by_method(rows).items() if any(map(_shown, own))]
        handles = [_handle(styles.get(name), name) for name in names]
        width, ncols = (190, 4) if columns > 1 else (105, 2)
        note = _footnote(chart, rows, width)
        below = 0.012 + 0.0135 * (note.count("\n") + 1)
        above = below + 0.02 + 0.021 * -(-len(names) // ncols)
        figure.legend(
            handles=handles, loc="lower center", bbox_to_anchor=(0.5, below), ncols=ncols,
            frameon=False, fontsize=9.5,
        )  # fmt: skip
        figure.suptitle(_heading(chart), x=0.012, y=0.992, ha="left", fontsize=13)
        figure.text(0.012, 0.008, note, color="0.3", fontsize=8, va="bottom")
        # Not tight_layout, which draws everything twice: room for winners right of each panel.
        figure.subplots_adjust(
            left=0.78 / figure.get_figwidth(), right=1 - 2.05 / figure.get_figwidth(), top=0.93,
            bottom=above + 0.055, wspace=0.7, hspace=0.2,
        )  # fmt: skip
        figure.savefig(path, dpi=130)
        plt.close(figure)


def _style(contender: Contender | None, name: str) -> dict[str, Any]:
    c = contender or Contender(name, name, lambda factor, step: None)
    face = "white" if c.peer else c.colour
    return {
        "color": c.colour, "linestyle": c.line, "marker": c.marker, "markerfacecolor": face,
        "markersize": 5.5, "linewidth": 1.7,
    }  # fmt: skip


def _handle(contender: Contender | None, name: str) -> Any:
    from matplotlib.lines import Line2D

    label = name + (" (peer)" if contender is not None and contender.peer else "")
    return Line2D([], [], label=label, **_style(contender, name))


class _Panel:
    """One error against one cost."""

    def __init__(
        self, axes: Any, chart: Chart, styles: Mapping[str, Contender], kind: str, cost: str
    ) -> None:
        self.axes, self.chart, self.styles, self.kind, self.cost = axes, chart, styles, kind, cost
        self.rows = chart.of(kind)

    def draw(self) -> None:
        """Points, fronts, what blew up, slopes, winners."""
        axes, norm = self.axes, self.chart.norm
        everything = fronts.points(self.rows, self.cost, self.kind, norm)
        top = max((e for _, e in everything), default=1.0)
        for name, own in fronts.by_method(self.rows).items():
            style = _style(self.styles.get(name), name)
            shown = [
                p for p in fronts.points(own, self.cost, self.kind, norm) if p[1] > DEPTH * top
            ]
            if not shown:
                continue
            alone = {**style, "linestyle": "none", "markersize": 3.5, "alpha": 0.45}
            axes.loglog(*zip(*shown, strict=True), **alone)
            axes.loglog(*zip(*fronts.front(shown), strict=True), **style)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.margins(0.06, 0.06)
        self._blown_up()
        self._ticks()
        axes.grid(True, which="major", lw=0.5, color="0.88")
        axes.set_axisbelow(True)
        axes.set_xlabel(_COSTS[self.cost])
        axes.set_ylabel(_NORMS[norm])
        if len(everything) > 1:
            self._slopes()
            self._winners()

    def _blown_up(self) -> None:
        """Crosses at the top edge, at the cost of a whole run."""
        for row in self.rows:
            if row["status"] == "unstable" and row.get(self.cost):
                colour = _style(self.styles.get(row["method"]), row["method"])["color"]
                self.axes.plot(
                    row[self.cost], 0.985, "x", color=colour, ms=8, mew=2, clip_on=False,
                    transform=self.axes.get_xaxis_transform(),
                )  # fmt: skip

    def _ticks(self) -> None:
        """Plain numbers where an axis has less than two decades: 10⁰ alone says too little."""
        from matplotlib.ticker import LogFormatter, NullFormatter

        for axis, (low, high) in (
            (self.axes.xaxis, self.axes.get_xlim()), (self.axes.yaxis, self.axes.get_ylim()),
        ):  # fmt: skip
            few = math.log10(high / low) < 1.3
            axis.set_minor_formatter(
                LogFormatter(minor_thresholds=(2, 0.6)) if few else NullFormatter()
            )

    def _slopes(self) -> None:
        """How errors fall with cost by the orders of the schemes, in the lower left corner."""
        axes, dim = self.axes, self.chart.head.get("dimension", 1)
        (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
        width, height = math.log10(right / left), math.log10(high / low)
        start = left * 10 ** (0.04 * width), low * 10 ** (0.36 * height)
        slopes = (
            [(2 / (dim + 1), "order 2 in mesh and step")] if self.kind == "total"
            else [(1, "order 1 in the step"), (2, "2"), (4, "4")]
        )  # fmt: skip
        for slope, text in slopes:
            run = min(0.16 * width, 0.32 * height / slope)
            end = start[0] * 10**run, start[1] * 10 ** (-slope * run)
            axes.plot(*zip(start, end, strict=True), ":", color="0.35", lw=1.3, scalex=False,
                      scaley=False)  # fmt: skip
            at = dict(xytext=(0, 4), textcoords="offset points") if self.kind == "total" else {}
            place = start if self.kind == "total" else end
            axes.annotate(" " + text, place, color="0.3", fontsize=8, va="center", zorder=0, **at)
        axes.set_xlim(left, right)
        axes.set_ylim(low, high)

    def _winners(self) -> None:
        """Right of the panel, at each decade: the cheapest method, and what a peer would cost."""
        axes, (low, high) = self.axes, self.axes.get_ylim()
        place = axes.get_yaxis_transform()
        axes.text(1.015, 1.0, "cheapest ×margin over the second", transform=axes.transAxes,
                  fontsize=8, color="0.35", va="bottom")  # fmt: skip
        for won in self.chart.winners(self.cost, self.kind):
            if not low <= won["error"] <= high:
                continue
            colour = _style(self.styles.get(won["winner"]), won["winner"])["color"]
            text = _short(won["winner"])
            if won["margin"] is not None:
                text += f" ×{won['margin']:.3g}"
            text += " ?" if won["short"] else ""
            axes.text(1.015, won["error"], text, transform=place, fontsize=8.5, color=colour,
                      va="bottom", weight="bold")  # fmt: skip
            if won["over_peer"] is not None:
                axes.text(
                    1.015, won["error"], _against(won), transform=place, fontsize=7.5, color="0.3",
                    va="top",
                )  # fmt: skip
            axes.axhline(won["error"], color="0.6", lw=0.7, zorder=0)


def _against(won: Mapping[str, Any]) -> str:
    """The other side: what the best peer (or, where a peer wins, the best of ours) costs."""
    over = won["over_peer"]
    if won["peer"]:
        return f"ours: {_short(won['best_own'])} ×{1 / over:.3g}"
    return f"peers: {_short(won['best_peer'])} ×{over:.3g}"


def _short(name: str) -> str:
    """A name that fits beside a panel."""
    for long, short in (
        ("PETSc TS, ", "TS "), ("leapfrog, ", ""), ("AVI, balanced octaves", "AVI balanced"),
        ("AVI, plain windows", "AVI windows"), ("AVI, real steps corrected", "AVI real steps"),
        ("generalised α", "gen.-α"), ("Runge–Kutta 4", "RK4"), ("Crank–Nicolson", "CN"),
    ):  # fmt: skip
        name = name.replace(long, short)
    return name


def _title(chart: Chart, kind: str) -> str:
    """What a column shows."""
    against = chart.references.get("total", {}).get("kind", "")
    if kind == "total":
        return f"Total error, against {against}"
    last = chart.rows[-1]
    mesh = ", ".join(f"{k}={v}" for k, v in last["mesh"].items())
    return f"Error of time stepping alone, {mesh + ', ' if mesh else ''}{last['cells']} cells"


def _heading(chart: Chart) -> str:
    until = chart.head.get("until")
    return chart.head.get("title", "") + (f", t = {until:g}" if until is not None else "")


def _shown(row: Mapping[str, Any]) -> bool:
    return row["status"] in ("done", "unstable")


def _footnote(chart: Chart, rows: Sequence[Mapping[str, Any]], width: int) -> str:
    """Who is missing and why; where and by what this was measured."""
    lines = []
    for status, what in (
        ("refused", "Refused"), ("too long", "Left out, beyond the budget"),
        ("unstable", "Blew up (crosses at the top edge)"),
    ):  # fmt: skip
        found: dict[str, int] = {}
        for row in rows:
            if row["status"] == status:
                found[row["method"]] = found.get(row["method"], 0) + 1
        if found:
            told = "; ".join(f"{name} ({n})" if n > 1 else name for name, n in found.items())
            lines.append(f"{what}: {told}.")
    if "total" not in chart.references:
        lines.append("No total error: one mesh, and no exact solution.")
    if any(row["status"] == "done" and row["message"] for row in rows):
        lines.append("Some references are not known to a tenth of the error: see chart.json.")
    each = [won for k in fronts.ERRORS for c in fronts.COSTS for won in chart.winners(c, k)]
    if any(won["short"] for won in each):
        lines.append("?: a cheaper method stops above this error, and a smaller step might do.")
    head = chart.head
    cpu, commit = (head.get("machine") or {}).get("cpu", "?"), head.get("commit") or "unknown"
    commit = commit[:10] + ("+" if commit.endswith("+") else "")
    ranks = rows[0]["ranks"] if rows else 1
    runs = max((row["runs"] for row in rows), default=0)
    lines.append(
        f"Errors at the end over the reference's largest norm in the run. Fastest of up to {runs} "
        f"runs, {ranks} rank{'s' if ranks > 1 else ''} on {cpu}; complexbody {commit}. "
        "Solid: ours; dashed: peers."
    )
    return "\n".join(textwrap.fill(line, width) for line in lines)
