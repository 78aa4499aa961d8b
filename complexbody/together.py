# SPDX-License-Identifier: LGPL-3.0-or-later
"""How a command ends: on all ranks, with one message and one exit code.

An error that only one rank meets must not leave the others waiting for it, and a signal must leave
readable files. Knows no scene and no simulation.
"""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from complexbody.errors import ComplexBodyError

#: Seconds that a rank with an error waits for the others before it stops the whole run.
PATIENCE = 30.0
#: Seconds from a signal to the end of the process, whatever it is doing.
GRACE = 10.0


class Interrupted(BaseException):
    """Ctrl-C or SIGTERM. No Exception, so that nothing that handles errors swallows it."""

    def __init__(self, number: int) -> None:
        self.name = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        self.exit_code = 128 + number
        super().__init__(f"stopped by {self.name}")


class Elsewhere(Exception):
    """Another rank has met an error that is none of complexbody's, and shows it itself."""


@contextmanager
def together(comm: Any, patience: float = PATIENCE) -> Iterator[None]:
    """Leave the block on all ranks, or raise on all of them; collective.

    Args:
        comm: A communicator that nothing inside the block uses, of the ranks that enter it.
        patience: Seconds to wait for ranks that may wait for this one for ever.

    Raises:
        Exception: the error of the lowest rank that has one: there as it is, elsewhere a
            ComplexBodyError of the same kind that names the rank, or :class:`Elsewhere`.
    """
    error: Exception | None = None
    try:
        yield
    except Exception as own:
        if is_agreed(own):  # by a block inside this one: all ranks have it
            raise
        error = own
    if comm.size > 1:
        if not arrive(comm, None if error is None else patience):
            _give_up(comm, error, patience)
        found = comm.allgather(None if error is None else (_kind(error), str(error)))
        raised = [rank for rank, entry in enumerate(found) if entry is not None]
        if raised and comm.rank != raised[0]:
            kind, text = found[raised[0]]
            everywhere = all(entry == found[0] for entry in found)
            copy = kind(text if everywhere else f"{text} (rank {raised[0]})")
            copy.__dict__.update(_agreed=True, _copy=True)
            raise copy from error
    if error is not None:
        error.__dict__["_agreed"] = True
        raise error


def is_agreed(error: BaseException) -> bool:
    """Whether all ranks have this error, by :func:`together`."""
    return "_agreed" in error.__dict__


def is_copy(error: BaseException) -> bool:
    """Whether another rank has the original, and its traceback."""
    return "_copy" in error.__dict__


def _kind(error: Exception) -> type[Exception]:
    """The class of complexbody's that the error is one of: other ranks know no others."""
    for kind in type(error).__mro__:
        if kind.__module__.startswith("complexbody.") and issubclass(kind, ComplexBodyError):
            return kind
    return Elsewhere


def _give_up(comm: Any, error: Exception | None, patience: float) -> NoReturn:
    known = isinstance(error, ComplexBodyError)
    what = str(error) if known else f"{type(error).__name__}: {error}"
    late = f"The other ranks did not follow within {patience:g} s, so the run is stopped."
    code = error.exit_code if isinstance(error, ComplexBodyError) else 1
    abort(comm, code, f"error: {what} (rank {comm.rank}). {late}")


def arrive(comm: Any, patience: float | None) -> bool:
    """Wait for all ranks; False if they are not there within ``patience`` seconds (None: ever)."""
    everyone = comm.Ibarrier()
    deadline = math.inf if patience is None else time.monotonic() + patience
    while not everyone.Test():
        if time.monotonic() > deadline:
            return False
        time.sleep(1e-3)
    return True


def abort(comm: Any, code: int, message: str) -> NoReturn:
    """Stop all ranks at once: for ranks that can no longer agree."""
    os.write(2, f"complexbody: {message}\n".encode())
    if comm.size > 1:
        comm.Abort(code)
    os._exit(code)


@contextmanager
def signals(comm: Any, grace: float = GRACE) -> Iterator[None]:
    """Turn the first Ctrl-C or SIGTERM into :class:`Interrupted`; later ones are ignored.

    Raising unwinds what runs, which closes files. A rank that waits inside MPI for one that has
    gone is not reached: after ``grace`` seconds those that were reached stop all.
    """
    last: list[threading.Timer] = []

    def handler(number: int, frame: Any) -> None:
        if last:
            return
        stop = Interrupted(number)
        message = f"{stop} (rank {comm.rank}), and not done within {grace:g} s."
        last.append(threading.Timer(grace, abort, (comm, stop.exit_code, message)))
        last[0].daemon = True
        last[0].start()
        raise stop

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    old = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for timer in last:
            timer.cancel()
            timer.join()
        for number, before in old.items():
            # None: a handler that was not set from Python, which cannot be set again.
            signal.signal(number, signal.SIG_DFL if before is None else before)


def say(comm: Any, *lines: str, stream: Any = None) -> None:
    """Print lines on rank 0, at once."""
    if comm.rank == 0:
        print(*lines, sep="\n", file=stream or sys.stdout, flush=True)
