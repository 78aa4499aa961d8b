# SPDX-License-Identifier: LGPL-3.0-or-later
"""``complexbody stability``: its options, and what it does with them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from complexbody import report, stability_report
from complexbody.criticalsteps import DENSE, STEPS
from complexbody.errors import CommandError
from complexbody.masses import SCHEMES
from complexbody.scenefile import SceneFile, assignments
from complexbody.stability import SCHEDULES, stability
from complexbody.together import say, together

_TEXT = (
    "critical steps and growth of a scene's runs, over safety factor and schedule; or of bars with "
    "known resonances, predicted and measured"
)
_EPILOG = f"""\
The scene's loads are left out and its supports held at zero. Growth is per coarse step (step,
window, or largest step of any cell): the spectral radius of the run's own map where it is small, or
the slope of a long run from rough data. Files: DIR/stability.json, .csv and .png.

schedules:
  {", ".join(SCHEDULES)}

examples:
  complexbody stability demos/standing_wave.py
  complexbody stability demos/standing_wave.py --schedules "balanced windows,local leapfrog"
  complexbody stability --bars --out docs/charts
  mpirun -n 2 complexbody stability demos/impact.py --no-map      critical steps alone
"""


def declare(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the command to the command line.

    Args:
        command: Makes a command's parser of its name, function, description and epilogue.
    """
    to = command("stability", run, _TEXT, _EPILOG)
    to.add_argument("file", metavar="FILE", nargs="?", help="a scene file")
    to.add_argument("--bars", action="store_true", help="the bars and springs instead of a scene")
    group = to.add_argument_group("scene")
    group.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[],
        help="a parameter of the file's scene(), a Python literal or a string; repeatable",
    )  # fmt: skip
    group = to.add_argument_group("what is measured")
    group.add_argument("--no-map", action="store_true", help="critical steps alone")
    group.add_argument("--no-critical", action="store_true", help="the growth map alone")
    group.add_argument(
        "--safeties", metavar="A,B,…",
        help="safety factors, or FROM:TO:STEP; default 0.3:1:0.05, by 0.1 on large meshes, and the "
        "defaults",
    )  # fmt: skip
    group.add_argument("--schedules", metavar="NAMES", help="some of those below, by commas")
    group.add_argument(
        "--dissipation", choices=SCHEMES, default="exact", help="of the map; default exact"
    )
    group.add_argument(
        "--steps", metavar="N", type=int,
        help=f"coarse steps of a long run, which tells growth above 8/N; default {STEPS}, fewer on "
        "large meshes",
    )  # fmt: skip
    group.add_argument(
        "--dense", metavar="N", type=int, default=DENSE,
        help=f"largest state whose map is made, on one rank; default {DENSE}",
    )  # fmt: skip
    group = to.add_argument_group("output")
    group.add_argument(
        "--out", metavar="DIR", help="folder; default results/NAME of the file, or results/bars"
    )
    group.add_argument("--no-picture", action="store_true", help="do not draw")
    group.add_argument("--quiet", action="store_true", help="print only warnings and errors")


def run(a: argparse.Namespace, ranks: Any) -> None:
    """``complexbody stability``: measure, print, write and draw; collective."""
    if a.bars == (a.file is not None):
        raise CommandError("stability: Give a scene file, or --bars.")
    progress = False if a.quiet else None
    if a.bars:
        _bars(a, ranks, progress)
        return
    with together(ranks):
        file = SceneFile(a.file)
        parameters = file.complete(assignments(a.set))
        safeties = _numbers(a.safeties) if a.safeties else None
        names = [n.strip() for n in a.schedules.split(",") if n.strip()] if a.schedules else None
        if a.steps is not None and a.steps < 100:
            raise CommandError(f"stability: --steps is {a.steps}. Give 100 or more.")
    with together(ranks):
        scene = file.scene(MPI.COMM_WORLD, dict(parameters))
    if not a.quiet:
        say(ranks, report.heading(file.path, scene, parameters))
    with together(ranks):
        found = stability(
            scene, safeties=safeties, schedules=[] if a.no_map else names,
            dissipation=a.dissipation, critical=not a.no_critical, steps=a.steps, dense=a.dense,
            progress=progress,
        )  # fmt: skip
    if not a.quiet and found.critical:
        say(ranks, *stability_report.critical_table(found.critical))
    if not a.quiet and found.points:
        say(ranks, *stability_report.growth_table(found))
    folder = Path(a.out or Path("results") / file.path.stem)
    with together(ranks):
        paths = stability_report.write_scene(found, folder, ranks, not a.no_picture)
    if not a.quiet:
        say(ranks, report.entry("files", ", ".join(map(str, paths))))


def _bars(a: argparse.Namespace, ranks: Any, progress: bool | None) -> None:
    from complexbody.bars import bars

    folder = Path(a.out or Path("results") / "bars")
    with together(ranks):
        # Every rank has the whole: they are bars of twenty cells.
        found = bars(progress=progress)
        paths = stability_report.write_bars(found, folder, ranks, not a.no_picture)
    if not a.quiet:
        say(ranks, *stability_report.springs_table(found), *stability_report.bars_table(found))
        say(ranks, report.entry("files", ", ".join(map(str, paths))))


def _numbers(text: str) -> list[float]:
    """Safety factors of "0.3,0.45" or "0.3:0.9:0.05"."""
    try:
        if ":" in text:
            low, high, by = map(float, text.split(":"))
            values = np.round(np.arange(low, high + 1e-9, by), 9).tolist()
        else:
            values = [float(part) for part in text.split(",")]
    except (ValueError, ZeroDivisionError):
        values = []
    if not values or not all(np.isfinite(v) and v > 0 for v in values):
        raise CommandError(
            f"stability: --safeties is {text!r}. Give positive numbers by commas, or FROM:TO:STEP."
        )
    return sorted(set(values))
