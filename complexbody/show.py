# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pictures of a run from the files in its folder, finished or running: stills, films, curves.

Rank 0 reads and draws, off screen, while the others wait. Knows no scene and starts no simulation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from complexbody.curves import write_ledger, write_probes
from complexbody.errors import ResultsError
from complexbody.files import on_first_rank
from complexbody.movie import KINDS, kind_of, require_movie, write_movie
from complexbody.output import STEP_FIELDS
from complexbody.picture import require_tools
from complexbody.progress import counted
from complexbody.reading import Results
from complexbody.reel import Look, Reel
from complexbody.sheet import ACROSS, DOWN, write_sheet

__all__ = ["Look", "show"]

PARTS = ("fields", "sheet", "ledger", "probes")
_GIF = (960, 540)  # pixels: each frame has colours of its own, and little is saved between frames


def show(
    folder: str | Path,
    fields: Sequence[str] | str | None = None,
    *,
    times: Sequence[float] | float | None = None,
    every: int | None = None,
    animate: str | None = None,
    fps: float = 12.0,
    look: Look | None = None,
    parts: Sequence[str] | str | None = None,
    out: str | Path | None = None,
    comm: Any = MPI.COMM_WORLD,
    tell: Callable[[str], None] | None = None,
    progress: bool | None = None,
) -> list[Path]:
    """Draw what a run has left in its folder; collective.

    Args:
        folder: The run's output folder.
        fields: Which; all that were written by default.
        times: When [s]: of the times written, the nearest. By default the last.
        every: Instead, each so-many-th of them, and the last; of a film 1 by default.
        animate: "mp4" or "gif" for a film of each field instead of stills; "auto" is mp4 where
            there is ffmpeg, else gif.
        fps: Pictures per second of films.
        look: Component, deformation, colours and frame.
        parts: Of "fields" (a picture or film of each), "sheet" (all on one page: several times, or
            the space–time diagrams of a one-dimensional body), "ledger" and "probes". By default
            all that are there; with ``fields``, ``times``, ``every`` or ``animate`` the fields.
        out: Where pictures go; by default the folder "show" in the run's.
        comm: Ranks; rank 0 does it all.
        tell: Gets a line for each file, on rank 0.
        progress: Whether to show films' progress; None shows it on a terminal.

    Returns:
        The files, on all ranks.

    Raises:
        ResultsError: if the folder, a field, component or time is not there, or options clash.
        MissingPackage: if matplotlib, pyvista, a GL library, ffmpeg or Pillow is missing.
        OutputError: if the files cannot be written.
    """
    names = [fields] if isinstance(fields, str) else None if fields is None else list(fields)
    which = (parts,) if isinstance(parts, str) else parts
    moments = None if times is None else np.atleast_1d(np.asarray(times, dtype=float)).tolist()
    _check(which, moments, every, animate, fps)
    if which is None:
        narrowed = (names, moments, every, animate) != (None,) * 4
        which = ("fields",) if narrowed else PARTS
    target = Path(folder) / "show" if out is None else Path(out)
    made: list[Path] = []

    def work() -> None:
        maker = _Maker(Results(folder), look or Look(), target, made, tell, progress)
        if parts is None and which == PARTS:
            chosen = maker.there()
        else:
            chosen = tuple(which)
        if {"fields", "sheet"} & set(chosen):
            maker.require(names, animate)
        for part in chosen:
            if part == "fields" and animate:
                maker.films(names, moments, every or 1, animate, fps)
            elif part == "fields":
                maker.stills(names, moments, every or 0)
            elif part == "sheet":
                maker.sheet(names, moments)
            elif part == "ledger":
                maker.ledger()
            else:
                maker.probes()

    on_first_rank(comm, target, work)
    found: list[Path] = comm.bcast(made)
    return found


def _check(
    parts: Sequence[str] | None, times: Any, every: int | None, animate: str | None, fps: float
) -> None:
    for part in parts or ():
        if part not in PARTS:
            raise ResultsError(f"Show: there is no part {part!r}. Give {', '.join(PARTS)}.")
    if times is not None and every is not None:
        raise ResultsError("Show: times and every exclude each other. Give one of them.")
    if times is not None and not (len(times) and np.isfinite(times).all()):
        raise ResultsError(f"Show: times are {times!r}. Give finite times in seconds.")
    if every is not None and (not isinstance(every, int | np.integer) or every < 1):
        raise ResultsError(f"Show: every is {every!r}. Give a whole number from 1.")
    if animate not in (None, "auto", *KINDS):
        raise ResultsError(f"Show: no film of kind {animate!r}. Give {', '.join(KINDS)} or auto.")
    if not (np.isfinite(fps) and 0.1 <= fps <= 100):
        raise ResultsError(f"Show: fps is {fps!r}. Give pictures per second from 0.1 to 100.")


class _Maker:
    """Makes the files of one call; for one process."""

    def __init__(
        self, results: Results, look: Look, out: Path, made: list[Path],
        tell: Callable[[str], None] | None, progress: bool | None,
    ) -> None:  # fmt: skip
        self._results, self._look, self._out, self._made = results, look, out, made
        self._tell, self._progress = tell, progress

    def there(self) -> tuple[str, ...]:
        """The parts for which there is something."""
        results = self._results
        found = ["fields", "sheet"] if results.names else []
        try:
            results.ledger()
            found.append("ledger")
        except ResultsError:  # not yet
            pass
        return (*found, *(["probes"] if results.probes() else []))

    def _names(self, names: Sequence[str] | None) -> list[str]:
        found = list(dict.fromkeys(self._results.names if names is None else names))
        if not found:
            raise ResultsError(
                f"{self._results.folder} has no fields. Run the scene with --fields u,nu, or ask "
                "for the ledger."
            )
        return found

    def require(self, names: Sequence[str] | None, animate: str | None) -> None:
        """See that there is all it takes to draw the fields, before the long work."""
        for name in self._names(names):
            require_tools(self._results.series(name).dim)
        if animate is not None:
            require_movie(kind_of(animate))

    def _file(self, name: str) -> Path:
        self._out.mkdir(parents=True, exist_ok=True)
        return self._out / name

    def _done(self, path: Path, about: str) -> None:
        self._made.append(path)
        if self._tell is not None:
            self._tell(f"{path}  {about}")

    def stills(self, names: Sequence[str] | None, times: Any, every: int) -> None:
        """A picture of each field at each time."""
        for name in self._names(names):
            reel = Reel(self._results, name, times, self._look, every)
            for number, step in enumerate(reel.steps):
                path = self._file(f"{name}.png" if len(reel) == 1 else f"{name}-{step:04d}.png")
                reel.drawing(number, self._results.title).save(path)
                self._done(path, f"{reel.stamps[number]}, colours {reel.told()}".lstrip(", "))

    def films(
        self, names: Sequence[str] | None, times: Any, every: int, animate: str, fps: float
    ) -> None:
        """A film of each field; colours and frame are those of all its pictures."""
        kind, look = kind_of(animate), self._look
        if kind == "gif" and look.size is None:
            look = replace(look, size=_GIF)
        names = [n for n in self._names(names) if names is not None or n not in STEP_FIELDS]
        for name in names:
            reel = Reel(self._results, name, times, look, every)
            path = self._file(f"{name}.{kind}")
            count = write_movie(path, self._frames(reel), fps)
            about = f"{count} pictures, {count / fps:.3g} s, {reel.stamps[0]} to {reel.stamps[-1]}"
            self._done(path, f"{about}, colours {reel.told()}")

    def _frames(self, reel: Reel) -> Iterator[Any]:
        drawing = reel.drawing(0, self._results.title, oversampling=1.0)  # VTK takes longest
        for number in counted(range(len(reel)), reel.series.name, self._progress):
            if number:
                drawing.update(reel.body(number), reel.stamps[number])
            yield drawing.pixels()

    def sheet(self, names: Sequence[str] | None, times: Any) -> None:
        """All fields on one page."""
        reels, look = [], self._look
        for name in self._names(names):
            series = self._results.series(name)
            if name in STEP_FIELDS:
                continue
            last = len(series.times) - 1
            if series.dim == 1:
                wanted = series.times[:: max(1, len(series.times) // DOWN)]
                if last == 0:
                    continue  # a time is no diagram
            else:
                wanted = series.times[np.unique(np.linspace(0, last, ACROSS + 1).astype(int)[1:])]
            moments = wanted.tolist() if times is None else times
            reels.append(Reel(self._results, name, moments, look))
        if reels:
            path = self._file("sheet.png")
            write_sheet(path, reels, self._results.title)
            self._done(path, f"{', '.join(reel.series.name for reel in reels)}")

    def ledger(self) -> None:
        """Energies, works and the error of the books."""
        require_tools(1)
        columns = self._results.ledger()
        path = self._file("ledger.png")
        write_ledger(path, columns, self._results.title, self._look.units)
        self._done(path, f"{len(columns['time'])} rows")

    def probes(self) -> None:
        """The record of each probe."""
        require_tools(1)
        found = self._results.probes()
        if not found:
            raise ResultsError(
                f"{self._results.folder} has no record of a probe. Run the scene with --probe "
                "NAME=X,Y,Z, or wait for its first rows."
            )
        points = (self._results.record.get("settings") or {}).get("probes") or {}
        path = self._file("probes.png")
        write_probes(path, found, points, self._results.title, self._look.units)
        self._done(path, ", ".join(found))
