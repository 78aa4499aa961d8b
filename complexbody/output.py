# SPDX-License-Identifier: LGPL-3.0-or-later
"""What leaves a run: which fields, when and where, and what is derived from them per cell.

Each field has an XDMF index beside HDF5 files, with nodes and cells in the order of the mesh's
input: the files do not depend on the number of ranks. ``dolfinx.io.XDMFFile`` could not write them:
dolfinx 0.5 takes vectors and tensors per cell for nodal values in one and two dimensions. Knows no
time stepping, and writes only what it is given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from complexbody import _compat
from complexbody._compat import Array
from complexbody.action import Action
from complexbody.derived import CELL_FIELDS, NODAL_FIELDS, Derived
from complexbody.errors import OutputError, SceneError
from complexbody.files import CsvWriter, on_first_rank, settle
from complexbody.given import is_finite, is_positive, is_whole, numbers, short
from complexbody.probes import Probes
from complexbody.series import Series, in_input_order

__all__ = ["CELL_FIELDS", "NODE_FIELDS", "STEP_FIELDS", "CsvWriter", "Output", "Probes", "Writer"]

NODE_FIELDS = ("u", "nu", "u_dot", "nu_dot")
#: Fields per cell that a run decides once, at its start.
STEP_FIELDS = {"steps": "h", "levels": "level"}
MOST_TIMES = 1_000_000


@dataclass(frozen=True)
class Output:
    """What a simulation writes, where and when.

    Attributes:
        folder: Where everything goes; made if it is missing.
        every: Time between outputs [s]. The start and the end are always written.
        times: Output times [s] instead of ``every``; those after the end are passed over.
        fields: Of "u", "nu", "u_dot", "nu_dot" (per node), "stress" P, "self_action" z,
            "microstress" S, "energy_density" ρe and the others of :mod:`complexbody.derived` (per
            cell, at its midpoint; with "_at_nodes" behind the name averaged to nodes); and, written
            once, each cell's step "steps" h_K [s] and "levels", its octave below the longest.
        probes: Points by name, one coordinate per dimension of the mesh [m], whose fields go to a
            table.
        probe_steps: Rows of that table are this many steps apart.
        picture: Whether to draw the final state.

    Raises:
        OutputError: for times, fields or numbers that make no sense.
        SceneError: for probes that are not points.
    """

    folder: str | Path
    every: float | None = None
    times: Sequence[float] = ()
    fields: Sequence[str] = NODE_FIELDS
    probes: Mapping[str, Sequence[float]] = field(default_factory=dict)
    probe_steps: int = 10
    picture: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.folder, str | Path) or "\0" in str(self.folder):
            raise OutputError(f"Output: folder is {short(self.folder)}. Give a path.")
        given = (self.fields,) if isinstance(self.fields, str) else self.fields
        known = (*NODE_FIELDS, *CELL_FIELDS, *STEP_FIELDS)
        if not isinstance(given, Sequence):
            raise OutputError(f"Output: fields are {short(given)}. Give some of {known}.")
        for name in given:
            if not isinstance(name, str) or name not in (*known, *NODAL_FIELDS):
                raise OutputError(
                    f"Output: field {short(name)} is not known. Give {', '.join(known)}."
                )
        empty = isinstance(self.times, Sequence) and not self.times
        times = np.zeros(0) if empty else numbers(self.times)
        if times is None or times.ndim > 1:
            raise OutputError(f"Output: times are {short(self.times)}. Give numbers in seconds.")
        object.__setattr__(self, "folder", Path(self.folder))
        object.__setattr__(self, "fields", tuple(dict.fromkeys(given)))
        object.__setattr__(self, "times", tuple(np.atleast_1d(times).tolist()))
        if self.every is not None and len(self.times):
            raise OutputError("Output: every and times exclude each other. Give one of them.")
        if self.every is not None and not is_positive(self.every):
            raise OutputError(
                f"Output: every is {short(self.every)}. Give a positive time in seconds."
            )
        if not all(is_finite(time) and time >= 0 for time in self.times):
            raise OutputError("Output: times has a negative or non-finite entry. Give seconds ≥ 0.")
        steps = self.probe_steps
        if not (is_whole(steps) and steps > 0):
            raise OutputError(f"Output: probe_steps is {short(steps)}. Give a whole number from 1.")
        if not isinstance(self.probes, Mapping):
            raise SceneError("Output: probes is not a mapping. Give probes={'name': (x, y, …)}.")
        for name, point in self.probes.items():
            place = numbers(point)
            if place is None or not 1 <= place.size <= 3 or not np.all(np.isfinite(place)):
                raise SceneError(
                    f"Output: probe {short(name)} is at {short(point)}. Give one finite "
                    "coordinate per dimension of the mesh."
                )
            if not isinstance(name, str) or Path(name).name != name or "\0" in name or not name:
                raise SceneError(
                    f"Output: probe name {short(name)} names no file. Give a plain name."
                )

    def schedule(self, until: float) -> Array:
        """Sorted output times from 0 to ``until`` [s], both included.

        Raises:
            OutputError: if ``until`` is not positive, or there would be over a million outputs.
        """
        if not is_positive(until):
            raise OutputError(f"Output: the end is at {until!r} s. Give a positive, finite time.")
        times = np.asarray(self.times, dtype=np.float64)
        if self.every is not None:
            if until / self.every > MOST_TIMES:
                raise OutputError(
                    f"Output: every={self.every!r} s asks for {until / self.every:.1g} outputs "
                    f"until {until!r} s. Choose a larger every."
                )
            times = self.every * np.arange(math.ceil(until / self.every))
        # A last multiple that misses the end by round-off is the end.
        times = times[times < until * (1 - 1e-9)]
        return np.unique(np.concatenate([[0.0], times, [until]]))


class Writer:
    """Writes the fields of a run; made collectively before the long work, so that it fails early.

    Args:
        action: The forms of the scene.
        output: What to write, and where.
        resume: Keep the steps up to this time [s] that an earlier run of the scene wrote in the
            same folder; None replaces its files.

    Raises:
        OutputError: if the folder cannot be written, or the steps to be kept are on another mesh.
        MissingPackage: if h5py is missing.
    """

    def __init__(self, action: Action, output: Output, resume: float | None = None) -> None:
        mesh, self._folder = action.scene.mesh, Path(output.folder)
        self._comm, self._nodes = mesh.comm, _compat.node_map(mesh).size_local
        self._fields = tuple(name for name in output.fields if name not in STEP_FIELDS)
        self._once = tuple(name for name in output.fields if name in STEP_FIELDS)
        derived = {**CELL_FIELDS, **NODAL_FIELDS}
        self._derived = Derived(action, [name for name in self._fields if name in derived])
        (points, cells), self._order = in_input_order(mesh)
        self._series: dict[str, Series] = {}

        def start() -> None:
            self._folder.mkdir(parents=True, exist_ok=True)
            cellwise = {**CELL_FIELDS, **STEP_FIELDS}
            for name in output.fields:
                symbol = {**cellwise, **NODAL_FIELDS}.get(name, name)
                center = "Cell" if name in cellwise else "Node"
                path = self._folder / name
                self._series[name] = Series(path, symbol, center, points, cells, resume)

        on_first_rank(self._comm, self._folder, start, hdf5=True)

    def write(self, time: float, state: Mapping[str, Any]) -> None:
        """Append the fields at ``time`` [s]; a time that the files already have is passed over.

        Collective.

        Args:
            time: When.
            state: Blocked P1 Functions on the scene's mesh by name: those of "u", "nu", "u_dot",
                "nu_dot" that are written, and all four where a derived field is.

        Raises:
            OutputError: if rank 0 cannot write.
        """
        derived = self._derived.evaluate(state)
        values: dict[str, Array] = {}
        for name in self._fields:
            mine = derived[name] if name in derived else _owned(state[name], self._nodes)
            parts = self._comm.gather(_padded(name, mine))
            if parts is not None:
                values[name] = np.concatenate(parts)[self._order[name in CELL_FIELDS]]
        self._append(float(time), values)

    def write_steps(self, steps: Mapping[str, Array]) -> None:
        """Write those of "steps" and "levels" that were asked for, at t = 0; collective.

        Args:
            steps: By name, values of this rank's owned cells (cells,).

        Raises:
            OutputError: if rank 0 cannot write.
        """
        values: dict[str, Array] = {}
        for name in self._once:
            parts = self._comm.gather(np.asarray(steps[name])[:, None])
            if parts is not None:
                values[name] = np.concatenate(parts)[self._order[1]]
        self._append(0.0, values)

    def _append(self, time: float, values: Mapping[str, Array]) -> None:
        def append() -> None:
            for name, table in values.items():
                self._series[name].append(time, table)

        on_first_rank(self._comm, self._folder, append, hdf5=True)

    def sync(self) -> None:
        """See that what was written lasts, even if the computer does not; collective."""

        def sync() -> None:
            for series in self._series.values():
                series.sync()
            settle(self._folder)

        on_first_rank(self._comm, self._folder, sync)

    def close(self) -> None:
        """Do nothing: the files are complete after each step."""

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _owned(function: Any, nodes: int) -> Array:
    """Values of a blocked P1 Function at this rank's own nodes, shape (nodes, components)."""
    block = function.function_space.dofmap.index_map_bs
    return function.x.array.reshape(-1, block)[:nodes]


def _padded(name: str, values: Array) -> Array:
    """With zeros to make two components a vector, and two rows a tensor, as ParaView wants them."""
    count = values.shape[1]
    full = {6: 9} if "stress" in name else {2: 3}
    return np.pad(values, ((0, 0), (0, full.get(count, count) - count)))
