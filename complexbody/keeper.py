# SPDX-License-Identifier: LGPL-3.0-or-later
"""Who makes a run's checkpoints: by the clock, by steps, when a signal asks, before the run ends.

Looks at the clock and for signals between steps, on all ranks together, and writes what the run and
the simulation around it say. Reading never changes a run: with or without checkpoints it goes the
same way, to the bit.
"""

from __future__ import annotations

import signal
import threading
import time as clock
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import statefile
from complexbody.checkpoint import Checkpoint
from complexbody.errors import CheckpointError
from complexbody.files import on_first_rank
from complexbody.identity import histories
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
        self._noted = self._price = 0.0

        on_first_rank(self.comm, folder, lambda: folder.mkdir(parents=True, exist_ok=True))
        clear(self.comm, folder, "step-*.npz*" if fresh else "step-*.part")

    # --- when ------------------------------------------------------------------------------------

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Note Ctrl-C, SIGTERM and SIGUSR1 until a checkpoint is made; a second one does not wait.

        What was done about them before is done afterwards, or at the second one.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        old: dict[int, Any] = {number: signal.getsignal(number) for number in SIGNALS}
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

        for number in old:
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
        steps = self.run.steps
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
        """Remember the run as it is, its books being in order; for a per cent of its time."""
        now = clock.monotonic()
        found = np.array([self._noted - now, self._price])
        self.comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
        if -found[0] < 100 * found[1]:
            return
        self._good = self.run.snapshot().copy(), self._describe()
        self._noted = clock.monotonic()
        self._price = self._noted - now

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


def clear(comm: Any, folder: Path, pattern: str = "step-*.npz*") -> None:
    """Remove what an earlier run has left in a folder of checkpoints; collective.

    Raises:
        OutputError: if that is refused.
    """

    def remove() -> None:
        for path in list(folder.glob(pattern)):
            path.unlink()

    on_first_rank(comm, folder, remove)


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
