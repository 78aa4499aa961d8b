# SPDX-License-Identifier: LGPL-3.0-or-later
"""The steps of a field for ParaView, meshio and h5py, as they are while a run goes on.

Whatever stands on the disk is complete at any moment: HDF5 files are made in memory and replaced in
one go, and their XDMF index after them. A run killed at any time loses no step that was written, a
full disk harms none, and whoever looks at the files meanwhile disturbs nothing. Knows a mesh, but
no scene, and no field but numbers.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from complexbody import _compat
from complexbody._compat import Array, Ints
from complexbody.errors import MissingPackage, OutputError
from complexbody.files import ANOTHER, replace, settle

_TOPOLOGY = {2: "Polyline", 3: "Triangle", 4: "Tetrahedron"}
_ATTRIBUTE = {1: "Scalar", 3: "Vector", 9: "Tensor"}
#: A file takes steps until it has so many of them or so many bytes: each adds by writing it anew.
STEPS, BYTES = 256, 8 << 20

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
    """The steps of one field: ``<path>.h5``, ``<path>-<step>.h5``, … and the index ``<path>.xdmf``.

    For one process. HDF5 never writes to the disk itself: it survives neither a kill in the middle
    nor a full disk.

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
        self._path, self._index = path, path.with_name(path.name + ".xdmf")
        self._name, self._center, self._last = name, center, -math.inf
        self._steps: list[str] = []
        # The file that steps are added to: its path, its content, and how many it has.
        self._open, self._content, self._count = self._file(0), io.BytesIO(), 0
        self._sealed = False
        mesh = self._first(points, cells, resume)
        self._mesh = _MESH.format(
            kind=_TOPOLOGY[cells.shape[1]], cells=len(cells), corners=cells.shape[1], **mesh
        )
        stale = self._kept(resume) if resume is not None else self._others()
        self._save()
        for file in stale:
            file.unlink(missing_ok=True)

    def _file(self, step: int) -> Path:
        return self._path.with_name(self._path.name + (f"-{step:06d}.h5" if step else ".h5"))

    def _others(self) -> list[Path]:
        """Files of steps besides the first."""
        return sorted(self._path.parent.glob(f"{self._path.name}-[0-9]*.h5"))

    def _first(self, points: Array, cells: Ints, resume: float | None) -> dict[str, str]:
        """The first file, which has the mesh; where that lies, for the index."""
        if resume is not None and self._open.exists():
            self._content = io.BytesIO(self._open.read_bytes())
        with self._edited() as file:
            if "Mesh" not in file:
                file["Mesh/mesh/geometry"], file["Mesh/mesh/topology"] = points, cells
            elif not np.array_equal(file["Mesh/mesh/topology"], cells):
                raise OutputError(f"Output: {self._open} has results on another mesh. {ANOTHER}")
            both = ("topology", "geometry")
            parts = {part: self._item(file[f"Mesh/mesh/{part}"]) for part in both}
        if resume is None or not self._open.exists():
            self._put()
        return parts

    def _kept(self, resume: float) -> list[Path]:
        """Enter the steps up to a time; the files that have none, to be removed."""
        stale = []
        for path in (self._open, *self._others()):
            first = path == self._file(0)
            content = io.BytesIO(path.read_bytes())
            before, self._open, self._content = (self._open, self._content), path, content
            with self._edited() as file:
                steps = file.require_group(f"Function/{self._name}")
                late = [n for n in steps if not steps[n].attrs.get("time", math.inf) <= resume]
                for number in late:
                    del steps[number]
                self._count = len(steps)
                for number in sorted(steps, key=int):
                    self._enter(steps[number])
            if not self._count and not first:
                self._open, self._content = before
                stale.append(path)
            elif late:
                # The index of before names steps that are gone, if only until it is replaced.
                self._save()
                self._put()
        return stale

    def append(self, time: float, values: Array) -> None:
        """Add the values (rows, components) at ``time`` [s], unless the file is as far already."""
        if time <= self._last:
            return
        before = self._open, self._content, self._count, self._sealed
        self._content.seek(0, io.SEEK_END)
        full = self._count >= STEPS or self._content.tell() + values.nbytes > BYTES
        # A file has one step at least: the first one, with a large mesh, would else be made anew.
        if self._sealed or (full and self._count):
            self._open, self._content = self._file(len(self._steps)), io.BytesIO()
            self._count, self._sealed = 0, False
        else:
            self._content = io.BytesIO(self._content.getvalue())
        entered = len(self._steps), self._last
        try:
            with self._edited() as file:
                name = f"Function/{self._name}/{len(self._steps)}"
                data = file.create_dataset(name, data=values)
                data.attrs["time"] = time
                self._enter(data)
            self._count += 1
            self._put()
            self._save()
        except BaseException:
            self._open, self._content, self._count, self._sealed = before
            del self._steps[entered[0] :]
            self._last = entered[1]
            raise

    def _put(self) -> None:
        """The content as the open file, by its name at once."""
        with self._content.getbuffer() as view:  # released, or an error would keep it
            replace(self._open, view)

    def sync(self) -> None:
        """See that all steps are on the disk, in files that are never written again.

        The index is made anew from them when the run is resumed, whatever has become of it.
        """
        if self._count and not self._sealed:
            settle(self._open, self._index)
            self._sealed = True

    def _edited(self) -> Any:
        """The open file in memory."""
        return _h5py().File(self._content, "a")

    def _item(self, data: Any) -> str:
        (rows, columns), kind = data.shape, {"i": "Int", "f": "Float"}[data.dtype.kind]
        return (
            f'<DataItem Dimensions="{rows} {columns}" NumberType="{kind}" Format="HDF" '
            f'Precision="{data.dtype.itemsize}">{self._open.name}:{data.name}</DataItem>'
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
        head = _HEAD.format(name=self._name)
        replace(self._index, "".join([head, *self._steps, _TAIL]).encode())
