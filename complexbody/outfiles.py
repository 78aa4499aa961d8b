# SPDX-License-Identifier: LGPL-3.0-or-later
"""What leaves a run: fields, probes and ledger, in memory and in the files of its output."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.files import CsvWriter
from complexbody.ledger import Ledger
from complexbody.output import Output, Writer
from complexbody.problem import Problem
from complexbody.receivers import Receivers

Array = npt.NDArray[np.float64]


class Outfiles:
    """Of one run; made without a file, so that what is wrong is refused before any; collective.

    Args:
        problem: The scene, made ready.
        output: What to write and where; None for nothing.

    Attributes:
        functions: u, nu, u_dot, nu_dot as they were filled last.
        written: Time of the fields that were written last [s], −1 before.
        receivers: Probes, if there are any.

    Raises:
        SceneError: for probes that are no points of the body.
    """

    def __init__(self, problem: Problem, output: Output | None) -> None:
        self._problem, self._output, self.written = problem, output, -1.0
        self.functions = problem.functions(problem.initial_fields, problem.initial_rates)
        self.receivers = None if output is None else Receivers.of(problem, output)
        self._fields: Writer | None = None
        self._ledger: CsvWriter | None = None

    @property
    def folder(self) -> Path | None:
        """Of the output."""
        return None if self._output is None else Path(self._output.folder)

    def times(self, until: float) -> Array:
        """When fields are written [s]."""
        return np.zeros(0) if self._output is None else self._output.schedule(until)

    def open(
        self, ledger: Ledger, steps: Mapping[str, Array], since: tuple[float, float] | None = None
    ) -> None:
        """Make the files.

        Args:
            ledger: Whose columns they have.
            steps: Step and level of this rank's cells.
            since: Keep an earlier run's fields and rows up to these times [s]; None replaces them.

        Raises:
            OutputError: if they cannot be made.
        """
        output, folder = self._output, self.folder
        if output is None or folder is None:
            return
        written, reached = since or (None, None)
        self._fields = Writer(self._problem.whole_action, output, written)
        self.written = -1.0 if written is None else written
        self._fields.write_steps(steps)
        if self.receivers is not None:
            self.receivers.open(folder, reached)
        columns = dict(zip(ledger.columns, ledger.units(), strict=True))
        self._ledger = CsvWriter(folder / "ledger.csv", columns, self._problem.comm, reached)

    def fill(self, x: Array, rates: Array) -> None:
        """Node records of fields and rates into the functions."""
        self._problem.fill(self.functions, x, rates)

    def write(self, t: float, x: Array, rates: Array) -> None:
        """Fields at t [s], unless there is nothing to write or it is there."""
        if self._fields is not None and t > self.written:
            self.fill(x, rates)
            self._fields.write(t, self.functions)
            self.written = t

    def rows(self, new: Iterable[list[float]]) -> None:
        """New rows of the ledger, and what probes recorded so far."""
        if self._ledger is not None:
            self._ledger.write(new)
        if self.receivers is not None:
            self.receivers.flush()

    def probes(self) -> dict[str, dict[str, Any]]:
        """Histories at the probes so far, on rank 0."""
        return {} if self.receivers is None else self.receivers.table()

    def sync(self) -> None:
        """See that all that is written so far is in the files, and stays there."""
        for thing in (self._fields, self.receivers, self._ledger):
            if thing is not None:
                thing.sync()

    def close(self) -> None:
        """Close the files."""
        for thing in (self._fields, self._ledger, self.receivers):
            if thing is not None:
                thing.close()
