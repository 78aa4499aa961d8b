# SPDX-License-Identifier: LGPL-3.0-or-later
"""``complexbody show``: its options; the work is :mod:`complexbody.show`'s."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

from complexbody.errors import CommandError
from complexbody.movie import KINDS
from complexbody.reel import VIEWS, Look
from complexbody.show import show
from complexbody.together import say, together

_TEXT = "pictures and films of a run, finished or still running, from the files in its folder"
_EPILOG = f"""\
Without options: a picture of each field at the last time, sheet.png (all fields at four times; of a
one-dimensional body its space–time diagrams), ledger.png (energies, and the error of the books) and
probes.png. Options of the first group ask for the fields alone; --ledger and --probes add these.
Colours are blue to red about zero for what has a sign, dark to light for what has none, and the
same in all pictures of one call: from the least to the greatest value at the times shown.

views: {", ".join(VIEWS)}, or the direction to where it is looked at from, as 1,-1,0.5
What begins with a minus is given with an equals sign: --view=-x

examples:
  complexbody show results/impact
  complexbody show results/impact --animate mp4 --field nu --component 0
  complexbody show results/impact --field u,stress --time 2e-6 --view z --out talk
  complexbody show results/impact --field stress --component 0,4 --clim=-5e7,5e7
  complexbody show results/impact --field u --clip y=7e-3 --warp 0
  complexbody show results/impact --ledger
"""


def declare(command: Callable[..., argparse.ArgumentParser]) -> None:
    """Add the command to the command line.

    Args:
        command: Makes a command's parser of its name, function, description and epilogue.
    """
    to = command("show", run, _TEXT, _EPILOG)
    to.add_argument("folder", metavar="DIR", help="the folder that run wrote")
    group = to.add_argument_group("what")
    group.add_argument("--field", metavar="NAMES", help="by commas; default: all that are there")
    when = group.add_mutually_exclusive_group()
    when.add_argument("--time", metavar="T", help="of the times written the nearest [s]")
    when.add_argument("--times", metavar="A,B,…", help="several times [s]")
    when.add_argument(
        "--every", metavar="N", type=int, help="every N-th of the times written, and the last"
    )
    group.add_argument(
        "--animate", choices=(*KINDS, "auto"),
        help="a film instead of pictures; auto: mp4 where there is ffmpeg, else gif",
    )  # fmt: skip
    group.add_argument(
        "--fps", metavar="N", type=float, default=12.0, help="pictures per second; default 12"
    )
    group.add_argument("--ledger", action="store_true", help="energies against time")
    group.add_argument("--probes", action="store_true", help="u and ν at the probes against time")
    group = to.add_argument_group("how")
    group.add_argument(
        "--component", metavar="I,J,…",
        help="a panel each: numbers from 0 (of a tensor row by row: 0 is 11, 4 is 22), or norm; "
        "default: norm of a vector, and in one dimension all",
    )  # fmt: skip
    group.add_argument(
        "--warp", metavar="F", default="auto",
        help="how many times as large u is drawn; default: such that it can be seen; 0: not at all",
    )  # fmt: skip
    group.add_argument(
        "--clim", metavar="A,B",
        help="values at the ends of the colours, in SI units; or P%%, to hold that share of the "
        "values at each time",
    )  # fmt: skip
    group.add_argument("--colormap", metavar="NAME", help="one of matplotlib's")
    group.add_argument("--view", metavar="V", help="solids: from where; see below")
    group.add_argument(
        "--clip", metavar="AXIS=C", help="solids: cut open by the plane x, y or z = C [m]"
    )
    group.add_argument("--size", metavar="WxH", help="pixels; default 1600 wide, gif 960x540")
    group.add_argument("--no-units", action="store_true", help="the scene is in scaled units")
    group = to.add_argument_group("output")
    group.add_argument("--out", metavar="DIR", help="folder of the pictures; default DIR/show")
    group.add_argument("--quiet", action="store_true", help="print only warnings and errors")


def run(a: argparse.Namespace, ranks: Any) -> None:
    """``complexbody show``: draw, and name the files; collective."""
    with together(ranks):
        look = _look(a)
        times = a.times if a.times is not None else a.time
        moments = None if times is None else _numbers("--time", times)
        names = None if a.field is None else [n.strip() for n in a.field.split(",") if n.strip()]
    narrowed = (names, moments, a.every, a.animate) != (None,) * 4
    curves = [part for part, wanted in (("ledger", a.ledger), ("probes", a.probes)) if wanted]
    parts = [*(["fields"] if narrowed else []), *curves] if curves else None
    with together(ranks):
        show(
            a.folder, names, times=moments, every=a.every, animate=a.animate, fps=a.fps, look=look,
            parts=parts, out=a.out, comm=MPI.COMM_WORLD, tell=None if a.quiet else _tell,
            progress=False if a.quiet else None,
        )  # fmt: skip


def _tell(line: str) -> None:
    say(MPI.COMM_SELF, line)  # by rank 0, which is the only one to draw


def _look(a: argparse.Namespace) -> Look:
    """How fields are drawn.

    Raises:
        CommandError, ResultsError: for what makes no sense.
    """
    components = None
    if a.component is not None:
        listed = [part.strip() for part in a.component.split(",")]
        components = [int(part) if part.isdigit() else part for part in listed]
    limits: Any = None
    if a.clim is not None:
        percent = a.clim.endswith("%")
        values = _numbers("--clim", a.clim.removesuffix("%"))
        if len(values) != (1 if percent else 2):
            raise CommandError(f"--clim {a.clim}: not a range. Give A,B, or a percentage as 99%.")
        limits = values[0] if percent else (values[0], values[1])
    view = a.view
    if view is not None and "," in view:
        view = _numbers("--view", view)
    clip = None
    if a.clip is not None:
        axis, _, at = a.clip.partition("=")
        clip = (axis.strip(), *_numbers("--clip", at))
    size = None
    if a.size is not None:
        parts = a.size.lower().split("x")
        if len(parts) != 2 or not all(part.isdigit() for part in parts):
            raise CommandError(f"--size {a.size}: not a size. Give WIDTHxHEIGHT, as 1280x720.")
        size = (int(parts[0]), int(parts[1]))
    warp = a.warp if a.warp == "auto" else _numbers("--warp", a.warp)[0]
    return Look(
        components, warp, limits, a.colormap, view, clip, size, units=not a.no_units
    )  # fmt: skip


def _numbers(option: str, text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise CommandError(f"{option} {text}: not numbers. Give them by commas.") from None
