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
import ufl
from dolfinx import fem

from complexbody import _compat
from complexbody._compat import Array
from complexbody.action import Action
from complexbody.densities import scalar
from complexbody.errors import OutputError, SceneError
from complexbody.files import CsvWriter, on_first_rank, settle
from complexbody.probes import Probes
from complexbody.series import Series, in_input_order

__all__ = ["CELL_FIELDS", "NODE_FIELDS", "STEP_FIELDS", "CsvWriter", "Output", "Probes", "Writer"]

NODE_FIELDS = ("u", "nu", "u_dot", "nu_dot")
#: Fields per cell and the symbols they are stored under.
CELL_FIELDS = {"stress": "P", "self_action": "z", "microstress": "S", "energy_density": "e"}
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
            "microstress" S and "energy_density" ρe (per cell, at its midpoint); and, written once,
            each cell's step "steps" h_K [s] and "levels", its octave below the longest.
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
        fields = (self.fields,) if isinstance(self.fields, str) else tuple(self.fields)
        object.__setattr__(self, "folder", Path(self.folder))
        object.__setattr__(self, "fields", tuple(dict.fromkeys(fields)))
        object.__setattr__(self, "times", tuple(np.atleast_1d(self.times)))
        known = (*NODE_FIELDS, *CELL_FIELDS, *STEP_FIELDS)
        for name in self.fields:
            if name not in known:
                raise OutputError(f"Output: field {name!r} is not known. Give {', '.join(known)}.")
        if self.every is not None and len(self.times):
            raise OutputError("Output: every and times exclude each other. Give one of them.")
        if self.every is not None and not (_is_finite(self.every) and self.every > 0):
            raise OutputError(f"Output: every is {self.every!r}. Give a positive time in seconds.")
        if not all(_is_finite(time) and time >= 0 for time in self.times):
            raise OutputError("Output: times has a negative or non-finite entry. Give seconds ≥ 0.")
        steps = self.probe_steps
        if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
            raise OutputError(f"Output: probe_steps is {steps!r}. Give a whole number from 1.")
        if not isinstance(self.probes, Mapping):
            raise SceneError("Output: probes is not a mapping. Give probes={'name': (x, y, …)}.")
        for name, point in self.probes.items():
            if not 1 <= np.size(point) <= 3 or not all(_is_finite(x) for x in np.ravel(point)):
                raise SceneError(
                    f"Output: probe {name!r} is at {point!r}. Give one finite coordinate per "
                    "dimension of the mesh."
                )
            if not isinstance(name, str) or Path(name).name != name:
                raise SceneError(f"Output: probe name {name!r} names no file. Give a plain name.")

    def schedule(self, until: float) -> Array:
        """Sorted output times from 0 to ``until`` [s], both included.

        Raises:
            OutputError: if ``until`` is not positive, or there would be over a million outputs.
        """
        if not (_is_finite(until) and until > 0):
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
        self._derived = _Derived(action, [name for name in self._fields if name in CELL_FIELDS])
        (points, cells), self._order = in_input_order(mesh)
        self._series: dict[str, Series] = {}

        def start() -> None:
            self._folder.mkdir(parents=True, exist_ok=True)
            cellwise = {**CELL_FIELDS, **STEP_FIELDS}
            for name in output.fields:
                symbol = cellwise.get(name, name)
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
                "nu_dot" that are written, and "u" and "nu" where a field per cell is.

        Raises:
            OutputError: if rank 0 cannot write.
        """
        derived = self._derived.evaluate(state)
        values: dict[str, Array] = {}
        for name in self._fields:
            mine = derived[name] if name in derived else _owned(state[name], self._nodes)
            parts = self._comm.gather(_padded(name, mine))
            if parts is not None:
                values[name] = np.concatenate(parts)[self._order[name in derived]]

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


class _Derived:
    """Fields per cell: derivatives of each body's energy at cell midpoints, compiled once."""

    def __init__(self, action: Action, names: Sequence[str]) -> None:
        self._names, self._scene = names, action.scene
        if not names:
            return
        self._q, self._regions = fem.Function(action.space), action.scene.regions()
        self._expressions = []
        for body in action.scene.bodies:
            _, *arguments = action.fields(self._q)
            nu, U, N = (ufl.variable(argument) for argument in arguments)
            energy = scalar(f"energy of {body.name}", body.energy, U, nu, N)
            values = [*(ufl.diff(energy, argument) for argument in (U, nu, N)), energy]
            fields = dict(zip(CELL_FIELDS, values, strict=True))
            self._shapes = [fields[name].ufl_shape for name in names]
            # q[0] ties the expression to the mesh, also where the energy does not depend on q.
            parts = [self._q[0]]
            for name in names:
                shape = fields[name].ufl_shape
                parts += [fields[name][i] if shape else fields[name] for i in np.ndindex(shape)]
            space = _compat.cell_space(action.scene.mesh)  # its one point is the midpoint
            self._expressions.append(_compat.expression(ufl.as_vector(parts), space))

    def evaluate(self, state: Mapping[str, Any]) -> dict[str, Array]:
        """Each field on this rank's owned cells, shape (cells, components, row by row)."""
        if not self._names:
            return {}
        scene, nodes = self._scene, _compat.node_map(self._scene.mesh).size_local
        record = self._q.x.array.reshape(-1, scene.components)
        for name in ("u", "nu"):
            record[:nodes, scene.components_of(name)] = _owned(state[name], nodes)
        self._q.x.scatter_forward()
        sizes = [math.prod(shape) for shape in self._shapes]
        values = np.zeros((len(self._regions), 1 + sum(sizes)))
        for region, expression in enumerate(self._expressions):
            cells = np.flatnonzero(self._regions == region).astype(np.int32)
            values[cells] = _compat.evaluate(expression, scene.mesh, cells)
        columns = np.split(values, np.cumsum([1, *sizes]), axis=1)[1:-1]
        return dict(zip(self._names, columns, strict=True))


def _owned(function: Any, nodes: int) -> Array:
    """Values of a blocked P1 Function at this rank's own nodes, shape (nodes, components)."""
    block = function.function_space.dofmap.index_map_bs
    return function.x.array.reshape(-1, block)[:nodes]


def _padded(name: str, values: Array) -> Array:
    """With zeros to make two components a vector, and two rows a tensor, as ParaView wants them."""
    count = values.shape[1]
    full = {6: 9} if name in ("stress", "microstress") else {2: 3}
    return np.pad(values, ((0, 0), (0, full.get(count, count) - count)))


def _is_finite(value: Any) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and math.isfinite(value)
