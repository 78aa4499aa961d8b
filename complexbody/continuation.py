# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a simulation goes on from, and what it leaves to go on with: between run and checkpoints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import machine
from complexbody.checkpoint import FOLDER, FOREIGN, Checkpoint, Found, described, find
from complexbody.errors import CheckpointError
from complexbody.identity import identity
from complexbody.keeper import Description, Keeper, clear
from complexbody.numbering import Numbering
from complexbody.output import Output
from complexbody.problem import Problem


class Continuation:
    """The checkpoints of one simulation, old and new; every call is collective.

    Args:
        problem: The scene, made ready, before a run is prepared.
        method: The integrator.
        output: What is written, or None.
        checkpoint: When checkpoints are made, or None.
        resume: Whether, or from where, to go on.

    Attributes:
        found: The checkpoint to go on from, or None.

    Raises:
        CheckpointError: if there is none to go on from, or no place for new ones.
    """

    def __init__(
        self, problem: Problem, method: Any, output: Output | None, checkpoint: Checkpoint | None,
        resume: bool | str | Path,
    ) -> None:  # fmt: skip
        self._problem, self._method, self._output = problem, method, output
        self._plan = checkpoint
        self._folder = None if checkpoint is None else checkpoint.place(output)
        self._known: dict[str, list[Any]] = {}
        self.found: Found | None = None
        if self._folder is not None or resume is not False:
            self._known = identity(problem, Numbering(problem.disc))
        if resume is not False:
            place = (checkpoint or Checkpoint()).place(output) if resume is True else resume
            self.found = find(place, problem, method, self._known)

    def begun_for(self, until: float) -> float:
        """End of the run that chose the step [s]: a run keeps the one that it began with."""
        return until if self.found is None else float(self.found.about["until"])

    @property
    def since(self) -> tuple[float, float] | None:
        """Times of the last fields and rows that are kept [s]; None if it begins anew."""
        about = None if self.found is None else self.found.about
        return None if about is None else (float(about["written"]), float(about["time"]))

    def restore(self, run: Any, until: float, columns: int) -> npt.NDArray[np.float64]:
        """Bring a run to the checkpoint; the rows of its ledger so far, of so many columns.

        Raises:
            CheckpointError: if the checkpoint is of another step, later, or has no such state.
        """
        found, problem = self.found, self._problem
        assert found is not None
        found.require(run.step, until)
        state = found.snapshot(Numbering(problem.disc), run.snapshot(), columns)
        try:
            run.restore(state)
        except (KeyError, TypeError, ValueError) as error:  # the same on all ranks, as names are
            raise CheckpointError(f"{found.path} lacks {error}. {FOREIGN}") from error
        rows = None if found.arrays is None else found.arrays["ledger"]
        return np.asarray(problem.comm.bcast(rows)).reshape(-1, columns)

    def keeper(
        self, run: Any, until: float, describe: Callable[[], Description],
        settle: Callable[[], None],
    ) -> Keeper | None:  # fmt: skip
        """Who makes new checkpoints, if any are asked for; else old ones go with their run.

        Args:
            run: The run.
            until: Its end [s].
            describe: What is to be kept of all around it.
            settle: Sees that all that is written so far stays.
        """
        output, fresh = self._output, self.found is None
        if self._plan is not None and self._folder is not None:
            about = self._about(until)
            return Keeper(
                self._problem, run, self._plan, self._folder, about, describe, settle, fresh
            )
        if output is not None and fresh:
            clear(self._problem.comm, Path(output.folder) / FOLDER)
        return None

    def _about(self, until: float) -> dict[str, Any]:
        """What stays the same in all checkpoints of the run."""
        output = None
        if self._output is not None:
            output = {f.name: getattr(self._output, f.name) for f in fields(self._output)}
            output = {k: v for k, v in output.items() if k != "folder"}
        return {
            "identity": self._known, "integrator": described(self._method), "end": until,
            "until": self.begun_for(until), "output": output, "versions": machine.versions(),
        }  # fmt: skip
