# SPDX-License-Identifier: LGPL-3.0-or-later
"""Files that survive whatever happens to who writes them: replaced in one go, or only added to.

A file that is there is complete at any moment, be the process killed or the disk full. Knows bytes
and tables of numbers, and no mesh.
"""

from __future__ import annotations

import csv
import errno
import io
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

from complexbody.errors import ComplexBodyError, OutputError, agree

ANOTHER = "Resume in the folder of the run that the checkpoint comes from, or give a new folder."


def on_first_rank(comm: Any, path: Path, task: Callable[[], None], hdf5: bool = False) -> None:
    """Let rank 0 run ``task``, which writes at ``path``; all ranks raise what it raises.

    Raises:
        OutputError: if the file system refuses (h5py has more words for it than OSError).
    """
    refusals = (OSError, RuntimeError, ValueError) if hdf5 else (OSError,)
    error: Exception | None = None
    cause: Exception | None = None
    if comm.rank == 0:
        try:
            task()
        except Exception as found:
            error = cause = found
            if isinstance(found, refusals) and not isinstance(found, ComplexBodyError):
                error = OutputError(
                    f"Output: {path} cannot be written ({found}). Make room or give another folder."
                )
    try:
        agree(comm, error)
    except Exception as agreed:
        raise agreed from cause


def replace(path: Path, content: bytes | memoryview) -> None:
    """Write a file so that at any moment, whatever kills the process, it is the old or the new one.

    What is to survive the computer as well needs :func:`settle`, which takes its time.

    Raises:
        OSError: if the file system refuses; the old file is as it was.
    """
    draft = path.with_name(path.name + ".part")
    try:
        with draft.open("wb", buffering=0) as file, memoryview(content) as view:
            written = 0
            while written < len(view):
                with view[written:] as rest:  # released, or an error would keep the content
                    written += file.write(rest)
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise


def settle(*paths: Path) -> None:
    """See that files or folders are on the disk.

    Raises:
        OSError: if they cannot be.
    """
    for path in paths:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno != errno.EINVAL:  # folders of some network file systems
                raise
        finally:
            os.close(handle)


class CsvWriter:
    """A table that grows with the run, in full precision; only rank 0 writes.

    Args:
        path: The file; its folder is made if it is missing.
        columns: Unit by name of each column (may be empty); the first column is the time.
        comm: Ranks that share the table. Making and writing it are collective.
        resume: Keep an earlier run's rows up to this time [s]; None keeps none.

    Raises:
        OutputError: if the file cannot be written, or the rows to be kept have other columns.
    """

    def __init__(
        self,
        path: str | Path,
        columns: Mapping[str, str],
        comm: Any = MPI.COMM_SELF,
        resume: float | None = None,
    ) -> None:
        self.path, self._comm = Path(path), comm
        self._file: Any = None
        #: Rows of an earlier run that are kept, on rank 0.
        self.kept: list[list[float]] = []
        header = [f"{name} [{unit}]" if unit else name for name, unit in columns.items()]

        def start() -> None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            kept: list[list[str]] = []
            if resume is not None and self.path.exists():
                with self.path.open(newline="", encoding="utf-8") as file:
                    found, *kept = csv.reader(file)
                if found != header:
                    raise OutputError(f"Output: {self.path} has other columns. {ANOTHER}")
                # A run that was killed may have left a part of a row.
                kept = [row for row in kept if len(row) == len(header)]
                kept = [row for row in kept if float(row[0]) <= resume]
            self.kept = [[float(value) for value in row] for row in kept]
            replace(self.path, _lines([header, *kept]))
            self._file = self.path.open("ab", buffering=0)

        on_first_rank(comm, self.path, start)

    def write(self, rows: Iterable[Sequence[Any]]) -> None:
        """Append rows, one number per column, and see that they reach the file."""
        on_first_rank(self._comm, self.path, lambda: self._rows(rows))

    def _rows(self, rows: Iterable[Sequence[Any]]) -> None:
        view, size = memoryview(_lines(rows)), self._file.seek(0, os.SEEK_END)
        try:
            while len(view):
                view = view[self._file.write(view) :]
        except OSError:
            self._file.truncate(size)  # no part of a row stays
            raise

    def sync(self) -> None:
        """See that all rows last, even if the computer does not; collective."""
        on_first_rank(self._comm, self.path, lambda: os.fsync(self._file.fileno()))

    def close(self) -> None:
        """Close the file; nothing is lost without it."""
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> CsvWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _lines(rows: Iterable[Sequence[Any]]) -> bytes:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()
