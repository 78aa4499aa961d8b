# SPDX-License-Identifier: LGPL-3.0-or-later
"""Files that grow with a run: a field's steps for ParaView and meshio, and tables of numbers.

They are complete after every step: HDF5 files are open only while rank 0 appends to them, and their
XDMF index is then replaced in one go. A run killed between steps loses nothing, and whoever looks
at the files meanwhile disturbs nothing. Knows a mesh, but no scene, and no field but numbers.
"""

from __future__ import annotations

import csv
import math
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from complexbody import _compat
from complexbody._compat import Array, Ints
from complexbody.errors import ComplexBodyError, MissingPackage, OutputError, agree

_TOPOLOGY = {2: "Polyline", 3: "Triangle", 4: "Tetrahedron"}
_ATTRIBUTE = {1: "Scalar", 3: "Vector", 9: "Tensor"}
SLACK = 1 << 16  # bytes that a step may take besides its values
_ANOTHER = "Resume in the folder of the run that the checkpoint comes from, or give a new folder."

_HEAD = """<?xml version="1.0"?>
<Xdmf Version="3.0"><Domain><Grid Name="{name}" GridType="Collection" CollectionType="Temporal">
"""
# Each step names the mesh: beside a mesh of its own the series would be one of several blocks.
_STEP = """<Grid Name="{name}" GridType="Uniform"><Time Value="{time!r}"/>
{mesh}
<Attribute Name="{name}" AttributeType="{kind}" Center="{center}">
{values}</Attribute></Grid>
"""
_MESH = """<Topology TopologyType="{kind}" NumberOfElements="{cells}" NodesPerElement="{corners}">
{topology}</Topology>
<Geometry GeometryType="XYZ">
{geometry}</Geometry>"""
_TAIL = "</Grid></Domain></Xdmf>\n"


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


def in_input_order(domain: Any) -> tuple[tuple[Array, Ints], tuple[Ints, Ints]]:
    """The mesh on rank 0, collective.

    Returns:
        Points (nodes, 3) and cells (cells, d+1) in the order of the mesh's input; and which of the
        nodes, and of the cells, gathered rank by rank, is the first, second, …
    """
    nodes, cells = _compat.node_map(domain), _compat.cell_count(domain)[0]
    parts = domain.comm.gather(
        (
            np.asarray(domain.geometry.input_global_indices)[: nodes.size_local],
            _compat.original_cells(domain)[:cells],
            domain.geometry.x[: nodes.size_local],
            nodes.local_to_global(_compat.cell_nodes(domain)[:cells].ravel()),
        )
    )
    if parts is None:
        return (np.zeros((0, 3)), np.zeros((0, 0), np.int32)), (np.zeros(0, np.int32),) * 2
    gathered = (np.concatenate(part) for part in zip(*parts, strict=True))
    numbers, cell_numbers, points, corners = gathered
    order, cell_order = np.argsort(numbers), np.argsort(cell_numbers)
    place = np.empty(len(order), dtype=np.int32)
    place[order] = np.arange(len(order))
    table = place[corners].reshape(len(cell_order), -1)[cell_order]
    return (points[order], table), (order, cell_order)


def _h5py() -> Any:
    try:
        import h5py
    except ImportError:
        raise MissingPackage("Output: no h5py. Run: apt-get install python3-h5py") from None
    return h5py


class Series:
    """The steps of one field: ``<path>.h5`` and its index ``<path>.xdmf``; for one process.

    Args:
        path: The files, without their endings.
        name: What ParaView calls the field.
        center: "Node" or "Cell".
        points: Nodes (nodes, 3).
        cells: Node numbers of cells (cells, d+1).
        resume: Keep the steps up to this time [s] that an earlier run wrote; None keeps none.

    Raises:
        OutputError: if the steps to be kept are on another mesh.
        OSError: if the files cannot be written.
    """

    def __init__(
        self, path: Path, name: str, center: str, points: Array, cells: Ints, resume: float | None
    ) -> None:
        h5py = _h5py()
        self._index, self._data = (path.with_name(path.name + end) for end in (".xdmf", ".h5"))
        self._name, self._center, self._last = name, center, -math.inf
        self._steps: list[str] = []
        # The lock would let a reader of an earlier step stop the run.
        with h5py.File(self._data, "w" if resume is None else "a", locking=False) as file:
            if "Mesh" not in file:
                file["Mesh/mesh/geometry"], file["Mesh/mesh/topology"] = points, cells
            elif not np.array_equal(file["Mesh/mesh/topology"], cells):
                raise OutputError(f"Output: {self._data} has results on another mesh. {_ANOTHER}")
            self._mesh = _MESH.format(
                kind=_TOPOLOGY[cells.shape[1]],
                cells=len(cells),
                corners=cells.shape[1],
                topology=self._item(file["Mesh/mesh/topology"]),
                geometry=self._item(file["Mesh/mesh/geometry"]),
            )
            steps = file.require_group(f"Function/{name}")
            for number in sorted(steps, key=int):
                # A run that was killed may have left a step without a time.
                if resume is not None and steps[number].attrs.get("time", math.inf) <= resume:
                    self._enter(steps[number])
                else:
                    del steps[number]
        self._save()

    def append(self, time: float, values: Array) -> None:
        """Add the values (rows, components) at ``time`` [s], unless the file is as far already."""
        if time <= self._last:
            return
        # HDF5 does not survive a full disk: the process would crash at its end.
        if shutil.disk_usage(self._data.parent).free < values.nbytes + SLACK:
            raise OSError("No space left on device")
        with _h5py().File(self._data, "a", locking=False) as file:
            data = file.create_dataset(f"Function/{self._name}/{len(self._steps)}", data=values)
            data.attrs["time"] = time
            self._enter(data)
        self._save()

    def _item(self, data: Any) -> str:
        (rows, columns), kind = data.shape, {"i": "Int", "f": "Float"}[data.dtype.kind]
        return (
            f'<DataItem Dimensions="{rows} {columns}" NumberType="{kind}" Format="HDF" '
            f'Precision="{data.dtype.itemsize}">{self._data.name}:{data.name}</DataItem>'
        )

    def _enter(self, data: Any) -> None:
        self._last = float(data.attrs["time"])
        self._steps.append(
            _STEP.format(
                name=self._name,
                mesh=self._mesh,
                time=self._last,
                kind=_ATTRIBUTE.get(data.shape[1], "Matrix"),
                center=self._center,
                values=self._item(data),
            )
        )

    def _save(self) -> None:
        """Replace the index: readers see the old one or the new one, never a part."""
        draft, head = self._index.with_suffix(".part"), _HEAD.format(name=self._name)
        draft.write_text("".join([head, *self._steps, _TAIL]), encoding="utf-8")
        draft.replace(self._index)


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
        header = [f"{name} [{unit}]" if unit else name for name, unit in columns.items()]

        def start() -> None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            kept: list[list[str]] = []
            if resume is not None and self.path.exists():
                with self.path.open(newline="", encoding="utf-8") as file:
                    found, *kept = csv.reader(file)
                if found != header:
                    raise OutputError(f"Output: {self.path} has other columns. {_ANOTHER}")
                # A run that was killed may have left a part of a row.
                kept = [row for row in kept if len(row) == len(header)]
                kept = [row for row in kept if float(row[0]) <= resume]
            draft = self.path.with_name(self.path.name + ".part")
            self._file = draft.open("w", newline="", encoding="utf-8")
            self._rows([header, *kept])
            draft.replace(self.path)

        on_first_rank(comm, self.path, start)

    def write(self, rows: Iterable[Sequence[Any]]) -> None:
        """Append rows, one number per column, and see that they reach the file."""
        on_first_rank(self._comm, self.path, lambda: self._rows(rows))

    def _rows(self, rows: Iterable[Sequence[Any]]) -> None:
        csv.writer(self._file, lineterminator="\n").writerows(rows)
        self._file.flush()

    def close(self) -> None:
        """Close the file; nothing is lost without it."""
        if self._file is not None:
            self._file.close()

    def __enter__(self) -> CsvWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
