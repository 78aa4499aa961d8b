# SPDX-License-Identifier: LGPL-3.0-or-later
"""Checkpoints of a run: when they are made, what is in them, which one is good to go on from.

A checkpoint has the run's own :class:`~complexbody.integrators.snapshot.Snapshot`, by the numbers
of the mesh's input, and what the simulation around it knows. Reading never changes a run: with or
without checkpoints it goes the same way, to the bit.
"""

from __future__ import annotations

import json
import signal
import threading
import time as clock
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import statefile
from complexbody.errors import CheckpointError
from complexbody.files import on_first_rank
from complexbody.identity import CLOSE, difference, histories
from complexbody.integrators.snapshot import Snapshot
from complexbody.numbering import Numbering
from complexbody.problem import Problem
from complexbody.together import Interrupted, abort

Array = npt.NDArray[Any]

#: Words that JSON knows, and what makes arrays.
Description = tuple[dict[str, Any], dict[str, Callable[[], Array]]]

#: Seconds between two looks at the clock and for signals, about.
LOOK = 0.2
#: Seconds from a signal to the end of the process if it cannot make its checkpoint.
PATIENCE = 120.0
#: What is done before a run ends by itself: a checkpoint, then the end; USR1: a checkpoint alone.
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
#: Where checkpoints are, in the folder of a run.
FOLDER = "checkpoints"


@dataclass(frozen=True)
class Checkpoint:
    """When to make checkpoints, and how many to keep.

    One is also made at the end, when a run is stopped by Ctrl-C or SIGTERM, and before it stops
    itself: of the last state that was good. SIGUSR1 asks for one, and the run goes on.

    Attributes:
        every: Wall time between two [s]; None: do not look at the clock.
        steps: Steps (or windows) between two; None: do not count.
        keep: How many are kept, the newest ones.
        folder: Where; by default "checkpoints" in the output's folder.

    Raises:
        CheckpointError: for numbers that make no sense.
    """

    every: float | None = 600.0
    steps: int | None = None
    keep: int = 2
    folder: str | Path | None = None

    def __post_init__(self) -> None:
        if self.every is not None and not (np.isfinite(self.every) and self.every > 0):
            raise CheckpointError(f"Checkpoint: every is {self.every}. Give seconds, > 0, or None.")
        for name in ("steps", "keep"):
            value = getattr(self, name)
            whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
            if not (whole and value >= 1 or value is None and name == "steps"):
                raise CheckpointError(f"Checkpoint: {name} is {value!r}. Give a whole number ≥ 1.")

    def place(self, output: Any) -> Path:
        """The folder of a run's checkpoints, given its Output or None.

        Raises:
            CheckpointError: if nothing says where.
        """
        if self.folder is not None:
            return Path(self.folder)
        if output is None:
            raise CheckpointError(
                "Checkpoint: nothing says where. Give a folder, or an output with one."
            )
        return Path(output.folder) / FOLDER


def described(method: Any) -> dict[str, Any]:
    """An integrator in words that JSON knows: its class and options."""
    options = {f.name: getattr(method, f.name) for f in fields(method)}
    known = {k: dict(v) if isinstance(v, Mapping) else v for k, v in options.items()}
    plain = {k: "given" if isinstance(v, np.ndarray) else v for k, v in known.items()}
    told: dict[str, Any] = json.loads(json.dumps(plain, default=str))
    return {"class": type(method).__name__, "options": told}


# --- going on ------------------------------------------------------------------------------------


@dataclass
class Found:
    """A checkpoint to go on from.

    Attributes:
        path: The file; about: its description; arrays: what it has, on rank 0 only.
        same: Whether ranks have the same cells as then, in the same order.
    """

    path: Path
    about: dict[str, Any]
    arrays: Mapping[str, Array] | None
    same: bool = False

    def require(self, step: float, until: float) -> None:
        """Refuse to go on with another step, or to an end that has passed.

        Raises:
            CheckpointError: for it.
        """
        if abs(step - self.about["step"]) > CLOSE * step:
            raise CheckpointError(
                f"{self.path} was made with steps of {self.about['step']:.6g} s, and now they are "
                f"{step:.6g} s. Resume with the version of complexbody that made it, or begin anew."
            )
        if until < self.about["time"] - CLOSE * step:
            raise CheckpointError(
                f"{self.path} is at t = {self.about['time']:.6g} s already, after the end asked "
                f"for, {until:.6g} s. Give a later until."
            )

    def snapshot(self, numbering: Numbering) -> Snapshot:
        """This rank's share of the run's state; collective."""
        # Sums belong to ranks as long as these have the same cells.
        same = self.same = numbering.layout == self.about["layout"]

        def mine(kind: str, name: str, _: Any) -> Array:
            table = None if self.arrays is None else self.arrays[f"{kind}/{name}"]
            if kind == "sums":
                rows = np.asarray(numbering.comm.bcast(table))
                if same:
                    return rows[numbering.comm.rank]
                return rows.sum(axis=0) if numbering.comm.rank == 0 else 0 * rows[0]
            if kind == "nodes":
                return numbering.spread_nodes(table)
            rows = numbering.spread_cells(table)
            if kind == "corners":
                back = np.argsort(numbering.corners, axis=1)
                rows = np.take_along_axis(rows, back[:, :, None], axis=1)
            return rows

        names = {kind: dict.fromkeys(found) for kind, found in self.about["arrays"].items()}
        return Snapshot(self.about["numbers"], **names).mapped(mine)


def find(
    where: str | Path, problem: Problem, method: Any, known: Mapping[str, list[Any]]
) -> Found:
    """The newest checkpoint that is whole and of this scene and integrator; collective.

    Args:
        where: A run's folder, its checkpoints' folder, or one file.
        problem: The scene, made ready; method: The integrator.
        known: The scene's identity.

    Raises:
        CheckpointError: if there is none, with the reason why the newest one is not.
    """
    comm, place = problem.comm, Path(where)
    folder = place / FOLDER if (place / FOLDER).is_dir() else place
    paths = comm.bcast([place] if place.is_file() else statefile.listed(folder))
    if not paths:
        raise CheckpointError(f"No checkpoint in {place}. Give the folder of a run that made some.")
    refused: list[str] = []
    for path in paths:
        found, why = None, ""
        if comm.rank == 0:
            try:
                found = Found(path, *statefile.read(path))
            except CheckpointError as error:
                why = str(error)
        why = comm.bcast(why)
        about = comm.bcast(None if found is None else found.about)
        if about is not None:
            why = _foreign(path, about, problem, method, known)
        if not why:
            if refused and comm.rank == 0:
                told = f"{' '.join(refused)} {path.name} is used instead."
                warnings.warn(told, UserWarning, stacklevel=2)
            return found or Found(path, about, None)
        refused.append(why)
    raise CheckpointError(refused[0] + (" There is no older one." if len(paths) > 1 else ""))


def _foreign(
    path: Path, about: Mapping[str, Any], problem: Problem, method: Any, known: Mapping[str, Any]
) -> str:
    """Why a checkpoint is of another run, or ""."""
    acting = histories(problem, about["time"])
    now = {k: [*v, *acting.get(k, [])] for k, v in known.items()}
    what = difference(about["identity"], now)
    if not what and described(method) != about["integrator"]:
        what = f"another integrator ({about['integrator']['class']} {about['integrator']['options']})"
    if not what:
        return ""
    return (
        f"{path} is of another run: it has {what}. Use the scene and the integrator that "
        "it was made with."
    )


# --- making them ---------------------------------------------------------------------------------


class Keeper:
    """Makes a run's checkpoints; every method is collective.

    Args:
        problem: The scene, whose arrays are as the run has them.
        run: The run.
        plan: When; folder: Where.
        about: What stays the same: identity, integrator, and so on.
        describe: What the simulation around the run knows now: words, and what makes arrays of it.
        settle: See that what the simulation has written so far lasts.
        fresh: Whether what is in the folder is of an earlier run, and to be removed.

    Attributes:
        stride: Steps after which to look again.
        seconds: Spent on checkpoints.

    Raises:
        CheckpointError: if the run can make none.
        OutputError: if the folder cannot be written.
    """

    def __init__(
        self, problem: Problem, run: Any, plan: Checkpoint, folder: Path,
        about: Mapping[str, Any], describe: Callable[[], Description],
        settle: Callable[[], None], fresh: bool,
    ) -> None:  # fmt: skip
        require_snapshots(run)
        self.problem, self.run, self.plan, self.folder = problem, run, plan, folder
        self.comm, self.about = problem.comm, about
        self._describe, self._settle = describe, settle
        self.numbering = Numbering(problem.disc)
        self.stride, self.seconds = 1, 0.0
        self._next, self._seen = run.steps, run.steps
        self._saved = -1 if fresh else run.steps
        self._begun = self._last = clock.monotonic()
        self._good: tuple[Snapshot, Description] | None = None
        self._signal = 0

        def prepare() -> None:
            folder.mkdir(parents=True, exist_ok=True)
            for path in folder.glob("step-*.npz*" if fresh else "step-*.part"):
                path.unlink()

        on_first_rank(self.comm, folder, prepare)

    # --- when ------------------------------------------------------------------------------------

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Note Ctrl-C, SIGTERM and SIGUSR1 until a checkpoint can be made; a second one does not wait.

        What was done about them before is done afterwards, or at the second one.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        old = {number: signal.getsignal(number) for number in SIGNALS}
        last: list[threading.Timer] = []

        def handler(number: int, frame: Any) -> None:
            if number == signal.SIGUSR1:
                self._signal = self._signal or number
                return
            if self._signal in (0, signal.SIGUSR1):
                self._signal = number
                told = f"stopped by {signal.Signals(number).name}, without a checkpoint"
                last.append(threading.Timer(PATIENCE, abort, (self.comm, 128 + number, told)))
                last[0].daemon = True
                last[0].start()
                return
            before = old[number]
            if callable(before):
                before(number, frame)
            raise Interrupted(number)

        for number in SIGNALS:
            signal.signal(number, handler)
        try:
            yield
        finally:
            for timer in last:
                timer.cancel()
            for number, before in old.items():
                signal.signal(number, signal.SIG_DFL if before is None else before)

    def pause(self, steps: int) -> int:
        """The next number of steps after ``steps`` at which to stop for a checkpoint."""
        each = self.plan.steps
        return 2**62 if each is None else (steps // each + 1) * each

    def look(self) -> None:
        """Make a checkpoint if one is due or asked for; between steps.

        Raises:
            Interrupted: if a signal wants the run to end.
        """
        run, steps = self.run, self.run.steps
        counted = self.plan.steps is not None and steps % self.plan.steps == 0
        if steps < self._next and not counted:
            return
        now = clock.monotonic()
        found = np.array([float(self._signal), now - self._begun, now - self._last])
        self.comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
        asked, elapsed, since = found
        if steps > self._seen:
            wanted = int(LOOK * (steps - self._seen) / max(elapsed, 1e-9))
            self.stride = max(1, min(wanted, 2 * self.stride))
        number = int(asked)
        due = self.plan.every is not None and since >= self.plan.every
        if number or due or (counted and steps > 0):
            self.save()
        self._seen, self._next, self._begun = steps, steps + self.stride, clock.monotonic()
        if number:
            self._signal = 0
        if number in (signal.SIGINT, signal.SIGTERM):
            raise Interrupted(number)

    # --- how -------------------------------------------------------------------------------------

    def save(self) -> None:
        """Make a checkpoint of the run as it is, unless there is one.

        Raises:
            OutputError: if it cannot be written.
        """
        if self.run.steps != self._saved:
            begun = clock.monotonic()
            self._settle()
            self.seconds += clock.monotonic() - begun
            self._write(self.run.snapshot(), self._describe())

    def note(self) -> None:
        """Remember the run as it is: its books have been found in order."""
        self._good = self.run.snapshot().copy(), self._describe()

    def fall_back(self) -> None:
        """Make a checkpoint of the last state whose books were in order, and remove later ones."""
        if self._good is None:
            return
        steps = int(self._good[0].numbers["steps"])

        def remove() -> None:
            for path in statefile.listed(self.folder):
                if statefile.steps_of(path) > steps:
                    path.unlink()

        on_first_rank(self.comm, self.folder, remove)
        self._write(*self._good)

    def _write(self, snapshot: Snapshot, description: Description) -> None:
        begun = clock.monotonic()
        # A state that is not finite is of no use: the next look at the books will say so.
        if not self.comm.allreduce(snapshot.finite, op=MPI.LAND):
            return
        names: dict[str, list[str]] = {}
        snapshot.mapped(lambda kind, name, _: names.setdefault(kind, []).append(name))
        steps = int(snapshot.numbers["steps"])
        acting = histories(self.problem, steps * self.run.step)
        identity = self.about["identity"]
        told = {
            **self.about, **description[0], "numbers": snapshot.numbers, "arrays": names,
            "identity": {k: [*v, *acting.get(k, [])] for k, v in identity.items()},
            "layout": self.numbering.layout, "ranks": self.comm.size, "steps": steps,
            "time": steps * self.run.step, "step": self.run.step,
        }  # fmt: skip
        parts = self._gathered(snapshot, description[1])
        path = statefile.path_of(self.folder, steps)
        if self.comm.rank > 0:
            for _ in parts:
                pass

        def write() -> None:
            try:
                statefile.write(path, told, parts)
            finally:
                for _ in parts:  # the others send what they have in any case
                    pass
            for old in statefile.listed(self.folder)[self.plan.keep :]:
                with suppress(OSError):
                    old.unlink()

        on_first_rank(self.comm, path, write)
        self._saved, self._last = steps, clock.monotonic()
        self.seconds += self._last - begun

    def _gathered(
        self, snapshot: Snapshot, more: Mapping[str, Callable[[], Array]]
    ) -> Iterator[tuple[str, Array]]:
        """Arrays of all ranks one after the other, on rank 0; the others have nothing of use."""
        parts: list[tuple[str, str, Array]] = []
        snapshot.mapped(lambda kind, name, array: parts.append((kind, name, array)))
        numbering = self.numbering
        for kind, name, array in parts:
            if kind == "sums":
                rows = self.comm.gather(array)
                table = None if rows is None else np.stack(rows)
            elif kind == "nodes":
                table = numbering.gather_nodes(array)
            else:
                if kind == "corners":
                    array = np.take_along_axis(array, numbering.corners[:, :, None], axis=1)
                table = numbering.gather_cells(array)
            yield f"{kind}/{name}", np.zeros(0) if table is None else table
        for name, make in more.items():
            yield name, make()


def require_snapshots(run: Any) -> None:
    """Refuse runs of which no checkpoint can be made.

    Raises:
        CheckpointError: for them.
    """
    why = getattr(run, "unsaved", "" if hasattr(run, "snapshot") else "it has no snapshots")
    if why:
        raise CheckpointError(
            f"No checkpoints of {type(run).__name__}: {why}. Use another integrator, or leave out "
            "checkpoint= (--checkpoint-every 0)."
        )
