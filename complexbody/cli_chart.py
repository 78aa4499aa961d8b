# SPDX-License-Identifier: LGPL-3.0-or-later
"""``complexbody chart``: the options, and the command; the work is :mod:`workprecision`'s."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

from complexbody import fronts
from complexbody.contenders import contenders
from complexbody.errors import CommandError
from complexbody.scenefile import SceneFile, assignments
from complexbody.together import say, together
from complexbody.workprecision import chart as measured

TEXT = (
    "speed against accuracy: run a scene by every method at several steps (and on several meshes), "
    "and say which is the cheapest for each decade of error"
)
_EPILOG = """\
A point is one method with one step on one mesh. Cost is the processor time of stepping (the least
of the repeats, the largest of any rank) and the number of element updates. The time error is
against the same mesh's equations solved exactly; the total error against exact(t, …) of the scene
file, else, with several meshes and on one process, against a mesh twice as fine as the finest.
DIR gets chart.json (everything), chart.csv and chart.png. A chart that was interrupted goes on
where it stopped: points that are in chart.json are not run again.

methods (the last ones are what one would take elsewhere):
  {methods}

examples:
  complexbody chart benchmarks/scenes/bar.py --meshes cells=50,100,200
  complexbody chart demos/graded_crack.py --set refine=0.5 --methods synchronous,avi --steps 3
  complexbody chart demos/graded_crack.py --meshes refine=0.4,0.8 --norm energy_norm --out results/x
"""

#: Adds a command's parser: name, function, text, epilog.
Add = Callable[..., argparse.ArgumentParser]


def add(command: Add, scene: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add the command to the command line's parser."""
    listed = "\n  ".join(f"{key:16s} {c.name}" for key, c in contenders().items())
    made = command("chart", chart, TEXT, _EPILOG.format(methods=listed))
    scene(made)
    group = made.add_argument_group("chart")
    group.add_argument("--methods", metavar="A,B", help="which; default: all that fit the scene")
    group.add_argument(
        "--meshes", metavar="NAME=A,B",
        help="a parameter of scene() and its values, from the coarsest mesh to the finest",
    )  # fmt: skip
    group.add_argument(
        "--steps", metavar="N", default="4",
        help="how many steps per method, each half of the one before, from the stable limit down "
        "(implicit methods: from 64 times the explicit limit down, by 4); or the factors of the "
        "critical step themselves, as 0.9,0.3 (default 4)",
    )  # fmt: skip
    group.add_argument(
        "--repeats", metavar="N", type=int, default=3, help="runs of each point (default 3)"
    )
    group.add_argument(
        "--budget", metavar="S", type=float, default=60.0,
        help="seconds after which a point is not repeated, and beyond which it is not run "
        "(default 60)",
    )  # fmt: skip
    group.add_argument(
        "--norm", choices=fronts.NORMS, default="fields",
        help="the error that is judged and drawn: the larger of those of u and nu (fields, the "
        "default), of one field, the energy norm, or the energy",
    )  # fmt: skip
    group.add_argument("--out", metavar="DIR", help="folder; default results/chart-NAME of FILE")
    group.add_argument("--fresh", action="store_true", help="forget the points that are in DIR")
    group.add_argument("--quiet", action="store_true", help="print only warnings and errors")


def _meshes(text: str | None) -> dict[str, list[Any]] | None:
    """``--meshes``: one name and its values.

    Raises:
        CommandError: for anything else.
    """
    if text is None:
        return None
    values = assignments([text])
    (name, found), *_ = values.items()
    found = list(found) if isinstance(found, tuple) else [found]
    if not all(isinstance(v, int | float) for v in found):
        raise CommandError(f"--meshes {text}: not NAME=A,B. Give, for instance, cells=20,40.")
    return {name: found}


def _steps(text: str) -> int | list[float]:
    """``--steps``: a whole number, or factors.

    Raises:
        CommandError: for anything else.
    """
    try:
        return int(text) if text.isdigit() else [float(part) for part in text.split(",")]
    except ValueError:
        raise CommandError(
            f"--steps {text}: neither a number nor factors. Give 4, or 0.9,0.3."
        ) from None


def chart(a: argparse.Namespace, ranks: Any) -> None:
    """``complexbody chart``: measure, draw, and name the winners."""
    with together(ranks):
        file = SceneFile(a.file)
        parameters, meshes = file.complete(assignments(a.set)), _meshes(a.meshes)
        for name in meshes or {}:
            for value in (meshes or {})[name]:
                file.complete({**parameters, name: value})
        until = a.until if a.until is not None else file.defaults.get("until")
        if until is None:
            raise CommandError(
                f"Nothing says when to stop. Give --until T, or DEFAULTS in {a.file}."
            )
        steps = _steps(a.steps)
    out = Path(a.out or Path("results") / f"chart-{file.path.stem}")

    def made(comm: Any, **values: Any) -> Any:
        return file.scene(comm, values)

    with together(ranks):
        found = measured(
            made, until, a.methods.split(",") if a.methods else None, steps, meshes,
            file.exact if file.has("exact") else None, out, a.repeats, a.budget,
            parameters=parameters, comm=MPI.COMM_WORLD, norm=a.norm, fresh=a.fresh,
            source=file.source, tell=None if a.quiet else print,
        )  # fmt: skip
    if a.quiet:
        return
    for kind in fronts.ERRORS:
        if found.knows(kind):
            head = f"The cheapest method by {kind} error ({a.norm}):"
            say(ranks, "", head, found.table(error=kind))
    if found.error == "time":
        say(ranks, "", "No total error: one mesh and no exact solution.")
    say(ranks, "", f"files {out}")
