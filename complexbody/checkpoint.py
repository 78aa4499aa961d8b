# SPDX-License-Identifier: LGPL-3.0-or-later
"""Checkpoints, as the user says them, and which one is good to go on from.

A checkpoint has the run's own :class:`~complexbody.integrators.snapshot.Snapshot`, by the numbers
of the mesh's input, and what the simulation around it knows. Who makes them is
:mod:`complexbody.keeper`.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import statefile
from complexbody.errors import CheckpointError
from complexbody.given import is_path, is_positive, is_whole, short
from complexbody.identity import CLOSE, difference, histories
from complexbody.integrators.snapshot import Snapshot
from complexbody.numbering import Numbering
from complexbody.problem import Problem
from complexbody.wellformed import flaw, misfit

Array = npt.NDArray[Any]

#: Where checkpoints are, in the folder of a run.
FOLDER = "checkpoints"
#: What to do with one that is whole and yet none of ours.
FOREIGN = "Use a checkpoint that complexbody made of this run, or begin anew."


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
        if self.every is not None and not is_positive(self.every):
            raise CheckpointError(
                f"Checkpoint: every is {short(self.every)}. Give seconds, > 0, or None."
            )
        for name in ("steps", "keep"):
            value = getattr(self, name)
            fits = is_whole(value) and value >= 1
            if not fits and not (value is None and name == "steps"):
                raise CheckpointError(
                    f"Checkpoint: {name} is {short(value)}. Give a whole number ≥ 1."
                )
        if self.folder is not None and not is_path(self.folder):
            raise CheckpointError(f"Checkpoint: folder is {short(self.folder)}. Give a path.")

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
                f"{step:.6g} s. Use the version of complexbody that made it, or begin anew."
            )
        if until < self.about["time"] - CLOSE * step:
            raise CheckpointError(
                f"{self.path} is at t = {self.about['time']:.6g} s already, after the end asked "
                f"for, {until:.6g} s. Give a later until."
            )

    def snapshot(self, numbering: Numbering, like: Snapshot, columns: int) -> Snapshot:
        """This rank's share of the run's state; collective.

        Args:
            numbering: Of this rank's nodes and cells.
            like: A snapshot of the run as it begins.
            columns: Of its ledger.

        Raises:
            CheckpointError: for a state that is none of such a run.
        """
        why, rows = "", numbering.rows()
        if self.arrays is not None:
            why = misfit(self.about, self.arrays, like, rows, columns)
        why = numbering.comm.bcast(why)
        if why:
            raise CheckpointError(f"{self.path} has {why}. {FOREIGN}")
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

        names: dict[str, dict[str, Any]] = {
            kind: dict.fromkeys(found) for kind, found in self.about["arrays"].items()
        }
        return Snapshot(self.about["numbers"], **names).mapped(mine)


def find(
    where: str | Path, problem: Problem, method: Any, known: Mapping[str, list[Any]]
) -> Found:
    """The newest checkpoint that is whole and of this scene and integrator; collective.

    Args:
        where: A run's folder, its checkpoints' folder, or one file.
        problem: The scene, made ready.
        method: The integrator.
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
                lacks = flaw(found.about)
                if lacks:
                    found, why = None, f"{path} has {lacks}. {FOREIGN}"
            except CheckpointError as error:
                why = str(error)
        why = comm.bcast(why)
        about = comm.bcast(None if found is None else found.about)
        if about is not None:
            # One word for all: round-off need not be the same on all ranks.
            why = comm.bcast(_foreign(path, about, problem, method, known))
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
        was = about["integrator"]
        what = f"another integrator ({was['class']} {was['options']})"
    if not what:
        return ""
    return (
        f"{path} is of another run: it has {what}. Use the scene and the integrator that "
        "it was made with."
    )
