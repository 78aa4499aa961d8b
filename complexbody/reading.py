# SPDX-License-Identifier: LGPL-3.0-or-later
"""Reads what a run has left, or is leaving, in its folder: fields by their XDMF indices, tables.

Any XDMF index is read that names its values in HDF5 files (or has them in the text), one grid per
time: those of :mod:`complexbody.files`, of ``dolfinx.io.XDMFFile`` and of meshio. Files are opened
for reading alone and without a lock: a run that goes on is not disturbed. Knows no picture.
"""

from __future__ import annotations

import csv
import json
import time as clock
import warnings
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from complexbody._compat import Array, Ints
from complexbody.errors import MissingPackage, ResultsError

#: Dimension by XDMF's name of the cells.
_DIMENSIONS = {"polyline": 1, "triangle": 2, "tetrahedron": 3}
_TRIES, _PAUSE = 5, 0.2  # a step that is just being written is there a moment later


@dataclass(frozen=True)
class _Step:
    """Where the values at one time [s] are."""

    time: float
    values: Any  # a DataItem


class Series:
    """The steps of one field.

    Args:
        name: What it is called here: its file, or the attribute where a file has several.
        index: The XDMF file.
        grids: Its grids by time, with the attribute and a mesh: (time, attribute, mesh grid).

    Attributes:
        name: As above.
        cellwise: Whether there is a value per cell, instead of per node.
        dim: Of its cells: 1, 2 or 3.
        times: [s], rising (steps,).
        points, cells: Nodes (nodes, 3) and their numbers in each cell (cells, dim+1).

    Raises:
        ResultsError: for cells that are no simplices, and where no step can be read.
    """

    def __init__(self, name: str, index: Path, grids: list[tuple[float, Any, Any]]) -> None:
        self.name, self._index = name, index
        _, attribute, mesh = grids[0]
        self.cellwise = attribute.get("Center", "Node").lower() == "cell"
        topology, geometry = mesh.find("Topology"), mesh.find("Geometry")
        kind = (topology.get("TopologyType") or topology.get("Type", "")).lower()
        if kind not in _DIMENSIONS:
            raise ResultsError(
                f"{index} has cells of the kind {kind!r}, which are not drawn here. Give results "
                "on intervals, triangles or tetrahedra, or open it in ParaView."
            )
        self.dim = _DIMENSIONS[kind]
        points = self._read(geometry.find("DataItem"))
        self.points: Array = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        self.cells: Ints = self._read(topology.find("DataItem")).astype(np.int64)
        # A run that went on from an earlier time may have written a time twice.
        last = {time: attribute.find("DataItem") for time, attribute, _ in grids}
        self._steps = [_Step(time, last[time]) for time in sorted(last)]
        self._trim()
        self.times: Array = np.array([step.time for step in self._steps])

    def _trim(self) -> None:
        """Leave out steps at the end that cannot be read (yet)."""
        given = len(self._steps)
        problem: Exception | None = None
        while self._steps:
            try:
                self.values(-1)
                break
            except ResultsError as error:
                problem = error
                self._steps.pop()
        if not self._steps:
            raise ResultsError(
                f"{self._index} has no step that can be read. Wait for the run to write one, or "
                "run it again."
            ) from problem
        if len(self._steps) < given:
            at = self._steps[-1].time
            warnings.warn(f"{self._index}: what was written after t = {at:g} s is incomplete and "
                          "left out.", stacklevel=2)  # fmt: skip

    def values(self, step: int) -> Array:
        """Values at step number ``step``: (nodes or cells, components).

        Raises:
            ResultsError: if they cannot be read, or are not one row per node or cell.
        """
        table = self._read(self._steps[step].values).astype(np.float64)
        table = table.reshape(len(table), -1)
        rows = len(self.cells if self.cellwise else self.points)
        if len(table) != rows:
            raise ResultsError(
                f"{self._index} has {len(table)} values at t = {self._steps[step].time:g} s for "
                f"{rows} {'cells' if self.cellwise else 'nodes'}. Run the scene again."
            )
        return table

    def at(self, time: float) -> int | None:
        """The step at ``time`` [s], or None."""
        near = int(np.abs(self.times - time).argmin())
        span = float(np.abs(self.times).max())
        return near if abs(self.times[near] - time) <= 1e-9 * span else None

    def nearest(self, time: float) -> int:
        """The step nearest to ``time`` [s].

        Raises:
            ResultsError: if the time is before the first step or after the last.
        """
        first, last = float(self.times[0]), float(self.times[-1])
        slack = 1e-6 * max(last - first, abs(last))
        if not first - slack <= time <= last + slack:
            raise ResultsError(
                f"{self.name} has no values at t = {time:g} s. Give a time from {first:g} to "
                f"{last:g} s."
            )
        return int(np.abs(self.times - time).argmin())

    def _read(self, item: Any) -> Any:
        text = (item.text or "").strip()
        if item.get("Format", "XML").upper() == "XML":
            shape = [int(size) for size in item.get("Dimensions", "-1").split()]
            return np.array(text.split(), dtype=float).reshape(shape)
        file, _, place = text.rpartition(":")
        return _dataset(self._index.parent / file, place)


def _dataset(path: Path, place: str) -> Any:
    try:
        import h5py
    except ImportError:
        raise MissingPackage("Show: no h5py. Run: apt-get install python3-h5py") from None
    problem: Exception | None = None
    for attempt in range(_TRIES):
        if attempt:
            clock.sleep(_PAUSE)
        try:
            with h5py.File(path, "r", locking=False) as file:
                return file[place][()]
        except (FileNotFoundError, KeyError) as error:
            problem = error
            break
        except (OSError, RuntimeError) as error:  # perhaps it is just being written
            problem = error
    raise ResultsError(
        f"{path}:{place} cannot be read ({problem}). Wait for the run to write it, or run the "
        "scene again."
    )


def _grids(path: Path) -> dict[str, list[tuple[float, Any, Any]]]:
    """Of each attribute in an index, its grids; of an index that is cut off, the whole ones."""
    whole: list[Any] = []
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    try:
        parser.feed(path.read_text(encoding="utf-8"))
        for event, element in parser.read_events():
            if event == "end" and element.tag == "Grid" and not element.findall("Grid"):
                whole.append(element)
    except ElementTree.ParseError:
        pass
    has_mesh = [g for g in whole if g.find("Topology/DataItem") is not None]
    found: dict[str, list[tuple[float, Any, Any]]] = {}
    for grid in whole:
        stamp = grid.find("Time")
        time = 0.0 if stamp is None else float(stamp.get("Value"))
        # dolfinx includes the first mesh of the file by an XPointer.
        mesh = grid if grid in has_mesh else next(iter(has_mesh), None)
        for attribute in grid.findall("Attribute"):
            if mesh is not None and attribute.find("DataItem") is not None:
                name = attribute.get("Name", path.stem)
                found.setdefault(name, []).append((time, attribute, mesh))
    return found


class Results:
    """What is in the folder of a run.

    Args:
        folder: The folder.

    Attributes:
        folder: The folder.
        record: What run.json says; empty without it.
        names: Of the fields that are there.

    Raises:
        ResultsError: if there is no such folder, or no results are in it.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise ResultsError(f"There is no folder {self.folder}. Give the folder of a run.")
        self._found: dict[str, tuple[Path, list[tuple[float, Any, Any]]]] = {}
        for path in sorted(self.folder.glob("*.xdmf")):
            grids = _grids(path)
            for attribute, steps in grids.items():
                self._found[path.stem if len(grids) == 1 else attribute] = (path, steps)
        self._read: dict[str, Series] = {}
        known = ("u", "nu", "u_dot", "nu_dot")
        self.names = sorted(self._found, key=lambda n: (known.index(n) if n in known else 9, n))
        self._probes = sorted(self.folder.glob("probe-*.csv"))
        if not (self.names or self._probes or (self.folder / "ledger.csv").exists()):
            raise ResultsError(
                f"{self.folder} has no results: no step in an .xdmf file, no ledger.csv, no "
                "probe-*.csv. Give the folder of a run, or wait until it has written something."
            )
        self.record: dict[str, Any] = {}
        try:
            self.record = json.loads((self.folder / "run.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            pass  # runs from Python have none

    @property
    def title(self) -> str:
        """Name of the scene, else of the folder."""
        return str(self.record.get("scene") or self.folder.resolve().name)

    def series(self, name: str) -> Series:
        """The steps of a field.

        Raises:
            ResultsError: if it is not there.
        """
        if name not in self._found:
            there = f"There are {', '.join(self.names)}" if self.names else "There are none"
            raise ResultsError(f"{self.folder} has no field {name!r}. {there}.")
        if name not in self._read:
            self._read[name] = Series(name, *self._found[name])
        return self._read[name]

    def ledger(self) -> dict[str, Array]:
        """Columns of the ledger by name.

        Raises:
            ResultsError: if there is none, or no row in it.
        """
        return table(self.folder / "ledger.csv")[0]

    def probes(self) -> dict[str, dict[str, Array]]:
        """By name of the probe, its columns by name; those without a row yet are left out."""
        found = {}
        for path in self._probes:
            try:
                found[path.stem.removeprefix("probe-")] = table(path)[0]
            except ResultsError:
                continue
        return found


def table(path: Path) -> tuple[dict[str, Array], dict[str, str]]:
    """Columns of a table that grows with a run, and their units, by name.

    Raises:
        ResultsError: if it is not there, or has no row.
    """
    if not path.exists():
        raise ResultsError(f"There is no {path}. Give the folder of a run.")
    # What follows the last line break is part of a row that is just being written.
    lines = path.read_text(encoding="utf-8").split("\n")[:-1]
    header, *rows = list(csv.reader(lines)) or [[]]
    numbers = np.array([[float(v) for v in row] for row in rows if len(row) == len(header)])
    if not len(numbers):
        raise ResultsError(f"{path} has no row yet. Wait until the run has written one.")
    names = [entry.partition(" [")[0] for entry in header]
    units = [entry.partition(" [")[2].removesuffix("]") for entry in header]
    return dict(zip(names, numbers.T, strict=True)), dict(zip(names, units, strict=True))
