# SPDX-License-Identifier: LGPL-3.0-or-later
"""What ``complexbody stability`` prints and writes: tables, JSON, CSV and PNG.

Words, numbers and files only: measures nothing.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from complexbody.bars import BARS, Bars
from complexbody.criticalsteps import CriticalStep
from complexbody.files import on_first_rank
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.resonances import TOLERANCE
from complexbody.stability import SCHEDULES, Stability
from complexbody.stability_picture import draw_bars, draw_scene

#: Growth below this is round-off.
NOTHING = 1e-9


def critical_table(rows: Sequence[CriticalStep]) -> list[str]:
    """Critical steps with their ratios to the cells' bound."""
    lines = [
        "  critical steps [s], and over the cells' bound",
        f"  {'dissipation':<12s}{'cells':>12s}{'body (SLEPc)':>14s}{'measured':>12s}"
        f"{'body':>8s}{'measured':>10s}   judged by",
    ]
    for row in rows:
        values = [row.elemental, row.overall, row.measured]
        ratios = [
            "–" if v is None or row.elemental is None else f"{v / row.elemental:.4f}"
            for v in values[1:]
        ]
        shown = ["–" if v is None else f"{v:.6g}" for v in values]
        lines.append(
            f"  {row.scheme:<12s}{shown[0]:>12s}{shown[1]:>14s}{shown[2]:>12s}"
            f"{ratios[0]:>8s}{ratios[1]:>10s}   {row.how}"
        )
    return lines


def growth_table(found: Stability) -> list[str]:
    """Per schedule: growth at the default, the first unstable α, and the worst."""
    lines = [
        "  growth per coarse step, |λ| − 1",
        f"  {'schedule':<24s}{'default α':>10s}{'there':>10s}{'first > 1e-3':>14s}{'worst':>10s}"
        f"{'at α':>7s}   judged by",
    ]
    for name in dict.fromkeys(p.schedule for p in found.points):
        mine = [p for p in found.points if p.schedule == name]
        ran = [p for p in mine if not p.refused]
        if not ran:
            lines.append(f"  {name:<24s}refused: {mine[0].refused}")
            continue
        default = SCHEDULES[name].default
        there = [p for p in ran if abs(p.safety - default) < 1e-9]
        first = next((f"{p.safety:g}" for p in ran if p.unstable), "none")
        worst = max(ran, key=lambda p: p.growth)
        shown = _growth(there[0]) if there else "–"
        ways = ", ".join(sorted({p.how for p in ran}))
        lines.append(
            f"  {name:<24s}{default:>10g}{shown:>10s}{first:>14s}{_growth(worst):>10s}"
            f"{worst.safety:>7g}   {ways}"
        )
    return lines


def _growth(p: Any) -> str:
    least = max(p.resolution, NOTHING)
    return f"{p.growth:.1e}" if p.growth > least else ("< " + f"{least:.0e}")


def springs_table(found: Bars) -> list[str]:
    """Two springs: bands and peaks, predicted / measured."""
    lines = [
        "  two springs on one mass, k1 = k2/n²: predicted / measured",
        f"  {'n':<4s}{'schedule':<16s}{'Ω from':>18s}{'to':>18s}{'growth per h1':>20s}{'at Ω':>9s}",
    ]
    for r in found.springs:
        lines.append(
            f"  {r['ratio']:<4d}{r['schedule']:<16s}{r['low']:>9.4f} /{r['low_measured']:>7.4f}"
            f"{r['high']:>9.4f} /{r['high_measured']:>7.4f}{r['predicted']:>10.4f} /"
            f"{r['measured']:>8.4f}{r['omega']:>9.4f}"
        )
    return lines


def bars_table(found: Bars) -> list[str]:
    """Bars: first unstable α by size ratio, growth up to the default, and the checks by runs."""
    lines = [
        "  bars of 10 + 10 cells, lengths r to 1: first α with growth above 1e-3 per coarse step"
    ]
    lines.append(f"  {'r':<6s}" + "".join(f"{name:>16.15s}" for name in found.maps))
    for i, ratio in enumerate(next(iter(found.maps.values()))["ratio"]):
        cells = []
        for name, part in found.maps.items():
            growth, alphas = np.array(part["growth"][i]), np.array(part["alpha"])
            bad = np.flatnonzero(growth > TOLERANCE)
            mark = ""
            if len(bad) and alphas[bad[0]] <= default(name) + 1e-9:
                mark = "*"
            cells.append((f"{alphas[bad[0]]:g}" if len(bad) else "none") + mark)
        lines.append(f"  {ratio:<6s}" + "".join(f"{cell:>16s}" for cell in cells))
    lines.append("  * below the default safety factor")
    if found.checks:
        worst = max(abs(c["measured"] / c["predicted"] - 1) for c in found.checks)
        lines.append(
            f"  predicted against long runs: {len(found.checks)} points, at most {worst:.1%} apart"
        )
    return lines


def default(name: str) -> float:
    """Default safety factor of one of the bars' integrators."""
    return LocalLeapfrog.safety if name.startswith("local") else AVI.safety


def write_scene(found: Stability, folder: Path, comm: Any, picture: bool = True) -> list[Path]:
    """stability.json, .csv and .png of a scene; rank 0 writes.

    Raises:
        OutputError: where it cannot (on all ranks).
    """
    record = {
        **found.origin, "name": found.name, "cells": found.cells,
        "critical": [asdict(row) for row in found.critical],
        "points": [asdict(p) | {"unstable": p.unstable} for p in found.points],
    }  # fmt: skip
    rows = [asdict(p) for p in found.points]

    def drawn(path: Path) -> None:
        draw_scene(found, {name: s.default for name, s in SCHEDULES.items()}, path)

    return _write(folder, comm, record, rows, drawn if picture and found.points else None)


def write_bars(found: Bars, folder: Path, comm: Any, picture: bool = True) -> list[Path]:
    """stability.json, .csv (points that grow only) and .png of the bars; rank 0 writes.

    Raises:
        OutputError: where it cannot (on all ranks).
    """
    maps = {
        name: part
        | {"growth": [[g if g > NOTHING else 0.0 for g in row] for row in part["growth"]]}
        for name, part in found.maps.items()
    }
    record = {**found.origin, "springs": found.springs, "checks": found.checks, "maps": maps}
    rows = [
        {"schedule": name, "ratio": ratio, "alpha": alpha, "growth": growth,
         "how": "runs" if part["apart"] is None else "predicted"}
        for name, part in found.maps.items()
        for ratio, line in zip(part["ratio"], part["growth"], strict=True)
        for alpha, growth in zip(part["alpha"], line, strict=True)
        if growth > NOTHING
    ]  # fmt: skip

    def drawn(path: Path) -> None:
        draw_bars(found, {name: default(name) for name in BARS}, path)

    return _write(folder, comm, record, rows, drawn if picture else None)


def _write(
    folder: Path, comm: Any, record: dict[str, Any], rows: list[dict[str, Any]], drawn: Any
) -> list[Path]:
    paths = [folder / f"stability.{end}" for end in ("json", "csv", "png")]

    def write() -> None:
        folder.mkdir(parents=True, exist_ok=True)
        paths[0].write_text(json.dumps(_plain(record)) + "\n", encoding="utf-8")
        with paths[1].open("w", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, list(rows[0]) if rows else [], lineterminator="\n")
            table.writeheader()
            table.writerows([_plain(row) for row in rows])
        if drawn is not None:
            drawn(paths[2])

    on_first_rank(comm, folder, write)
    return paths if drawn is not None else paths[:2]


def _plain(value: Any) -> Any:
    """Numbers that JSON knows: six digits are more than is measured; None for what is none."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
