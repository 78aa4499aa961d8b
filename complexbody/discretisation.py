# SPDX-License-Identifier: LGPL-3.0-or-later
"""A scene as arrays: ordered cells and nodes, cell geometry, lumped volumes, shared nodes.

Nodes carry one record of n = n_u + k components, padded to NR doubles. Cells are ordered so that
those touching shared nodes come first, then by region, then along a Morton curve, in blocks of W;
nodes in the order in which their last cell comes, so that a step can finish a node as soon as no
later cell needs it. Knows no energy and no integrator.
"""

from __future__ import annotations

import copy
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import _compat, native
from complexbody.errors import BodyError, MeshError, agree
from complexbody.halo import Halo, sharing
from complexbody.scene import Scene

Array = npt.NDArray[np.float64]

#: Blocks of cells worked on before their finished nodes are updated, and skipped together while
#: they are quiet. The cost of a step is the same within noise up to 256.
BLOCKS_PER_CHUNK = 16


def padded(components: int) -> int:
    """NR: doubles per node record, so that a record is one aligned vector (or a part of one)."""
    for size in (1, 2, 4, 8):
        if components <= size:
            return size
    return -(-components // 8) * 8


def morton(points: Array) -> npt.NDArray[np.int64]:
    """Position of points (m, d) along a Morton curve of their bounding box (20 bits per axis)."""
    if len(points) == 0:
        return np.zeros(0, np.int64)
    low, size = points.min(axis=0), np.ptp(points, axis=0).max()
    grid = ((points - low) * ((2**20 - 1) / (size or 1.0))).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(20):
        for axis in range(points.shape[1]):
            key |= ((grid[:, axis] >> bit) & 1) << (bit * points.shape[1] + axis)
    return key


class Discretisation:
    """P1 arrays of a scene on this rank; collective.

    Args:
        scene: The scene.
        late: Geometry nodes (local dolfinx numbers) to be updated apart, after all cells, besides
            the shared ones: moving supports.
        group: A whole number per owned cell: cells of one block are of one group (asynchronous
            integrators group cells that act together). One group by default.

    Attributes:
        nodes: Nodes of this rank's owned cells, in own numbering 0 … nodes−1.
        late: First of the nodes updated apart: shared nodes (``shared`` of them) come first.
        dof: dolfinx geometry number of each node; of a periodic scene, of one of its copies.
        number: Own number of each geometry node of dolfinx (−1 if no cell here has it).
        count: Cells of this rank, without padding.
        cells: Node numbers, shape (blocks, d+1, W); padding cells have node number ``nodes``.
        source_cell: dolfinx cell of each (block, lane), −1 for padding.
        region, group: Region and group of each block.
        boundary_blocks: The first blocks, whose cells touch shared nodes.
        geometry: Rows B̃_a (a = 1…d) and √|K|, shape (blocks, d·d + 1, W).
        volume: Lumped volume of each node ∫N_a dx, summed over ranks [m^d].
        region_volume: The same by region, shape (nodes, regions).
        owned: True for nodes this rank counts in global sums.
        position: Coordinates (nodes + 1, 3).
        chunks: Rows (first block, last block, region, nodes finished below).

    Raises:
        MeshError: for flat or non-finite cells (on all ranks).
    """

    def __init__(
        self,
        scene: Scene,
        late: npt.NDArray[np.int32] | None = None,
        group: npt.NDArray[np.int64] | None = None,
    ) -> None:
        self.scene, self.comm = scene, scene.mesh.comm
        self.dim, self.n = scene.mesh.geometry.dim, scene.components
        self.record, self.lanes = padded(self.n), native.lanes()
        mesh = scene.mesh
        owned_cells = _compat.cell_count(mesh)[0]
        corners = nodes = _compat.cell_nodes(mesh)[:owned_cells]
        x = np.asarray(mesh.geometry.x, dtype=np.float64)
        edges = x[nodes[:, 1:], : self.dim] - x[nodes[:, :1], : self.dim]
        self._check_cells(edges, nodes, x)

        self.identified = scene.identified
        if self.identified is not None:
            nodes = self.identified.local[nodes]
        touched = np.zeros(len(x), np.bool_)
        touched[nodes] = True
        used = np.flatnonzero(touched)
        shared = sharing(self.names(used), _compat.node_map(mesh), self.comm)
        shared = {int(used[row]): ranks for row, ranks in shared.items()}
        is_shared = np.zeros(len(x), np.bool_)
        is_shared[list(shared)] = True
        boundary = is_shared[nodes].any(axis=1)

        regions = scene.regions()
        key = morton(x[corners, : self.dim].mean(axis=1))
        groups = np.zeros(owned_cells, np.int64) if group is None else group
        order = np.lexsort((key, groups, regions, ~boundary))
        self._block(order, regions, groups, boundary)
        number = self._number(nodes, touched, is_shared, late)
        lanes = np.where(self.source_cell < 0, 0, self.source_cell)
        table = number[nodes[lanes]]
        table[self.source_cell < 0] = self.nodes
        self.cells = np.ascontiguousarray(table.transpose(0, 2, 1), dtype=np.int32)
        self._geometry(edges[lanes])
        self._chunks(boundary)

        position = {int(number[d]) - self.late: r for d, r in shared.items()}
        names = self.names(self.dof[self.late : self.late + self.shared])
        # Messages are records, back to back: the time loops pack them so.
        self.halo = Halo(self.comm, position, names, self.record)
        self.owned = np.ones(self.nodes, np.bool_)
        self.owned[self.late : self.late + self.shared] = self.halo.owner
        self._volumes(len(scene.bodies))
        self.position = np.zeros((self.nodes + 1, 3))
        self.position[:-1] = x[self.dof]
        if self.identified is not None:
            self.position[:-1] = self.identified.placed(self.dof)

    def reduced(self, scene: Scene) -> Discretisation:
        """This layout for a scene that differs in its components alone; arrays are shared.

        Its messages go over a communicator of its own; collective.
        """
        out = copy.copy(self)
        out.scene, out.n = scene, scene.components
        out.record = padded(out.n)
        out.halo = self.halo.widened(out.record)
        return out

    def _check_cells(self, edges: Array, nodes: Any, x: Array) -> None:
        error: Exception | None = None
        size = np.abs(edges).max(axis=(1, 2), initial=0.0)
        with np.errstate(all="ignore"):
            det = np.abs(np.linalg.det(edges)) if len(edges) else np.zeros(0)
            bad = np.flatnonzero(~(det > 1e-13 * size**self.dim))
        if bad.size:
            cell = int(bad[0])
            error = MeshError(
                f"The mesh has {bad.size} flat or non-finite cells; the first is cell "
                f"{_compat.original_cells(self.scene.mesh)[cell]} at "
                f"{np.round(x[nodes[cell], : self.dim].mean(axis=0), 6).tolist()}. "
                "Repair the mesh: move or merge its vertices."
            )
        agree(self.comm, error)

    def _block(self, order: Any, regions: Any, groups: Any, boundary: Any) -> None:
        """Pad each run of cells (boundary or not, region, group) to whole blocks of W."""
        W = self.lanes
        key = np.stack([~boundary[order], regions[order], groups[order]], axis=1)
        cuts = np.flatnonzero(np.any(np.diff(key, axis=0) != 0, axis=1)) + 1
        parts, labels = [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
        for run in np.split(np.arange(len(order)), cuts):
            if not len(run):
                continue
            blocks = -(-len(run) // W)
            part = np.full(blocks * W, -1, np.int64)
            part[: len(run)] = order[run]
            parts.append(part)
            labels.append(np.repeat(key[run[:1]], blocks, axis=0))
        self.source_cell = np.concatenate(parts).reshape(-1, W)
        interior, self.region, self.group = np.concatenate(labels).T
        self.blocks, self.count = len(self.region), len(order)
        self.boundary_blocks = int(np.sum(interior == 0))

    def _number(self, nodes: Any, touched: Any, is_shared: Any, late: Any) -> Any:
        """Number nodes by their last block; shared nodes, then other late ones, at the end."""
        last = np.full(len(touched), -1, np.int64)
        real = self.source_cell >= 0
        block = np.broadcast_to(np.arange(self.blocks)[:, None], real.shape)[real]
        np.maximum.at(last, nodes[self.source_cell[real]].ravel(), np.repeat(block, self.dim + 1))
        kind = np.zeros(len(touched), np.int64)
        if late is not None:
            kind[late] = 2
        kind[is_shared] = 1
        rank = np.array([0, 1, 2])[kind]
        used = np.flatnonzero(touched)
        self.dof = used[np.lexsort((used, last[used], rank[used]))].astype(np.int64)
        number = np.full(len(touched), -1, np.int64)
        number[self.dof] = np.arange(len(self.dof))
        self.nodes, self.shared = len(used), int(is_shared.sum())
        self.late = int(np.sum(rank[used] == 0))
        self._last = last[self.dof[: self.late]]
        if self.identified is not None:
            number = number[self.identified.local]
        self.number = number
        return number

    def _geometry(self, edges: Array) -> None:
        """Scaled shape gradients: B_a, a = 1…d, are the rows of E⁻ᵀ for edges E = (x_a − x_0)."""
        d, blocks, W = self.dim, self.blocks, self.lanes
        self.geometry = native.aligned((blocks, d * d + 1, W))
        real = self.source_cell >= 0
        for first in range(0, blocks, 65536):  # bounds the memory of temporaries
            part = slice(first, first + 65536)
            E = edges[part][real[part]]
            inverse = np.linalg.inv(E)
            volume = np.abs(np.linalg.det(E)) / [1.0, 1.0, 2.0, 6.0][d]
            rows = inverse.transpose(0, 2, 1).reshape(-1, d * d) * np.sqrt(volume)[:, None]
            full = np.zeros((len(E), d * d + 1))
            full[:, :-1], full[:, -1] = rows, np.sqrt(volume)
            target = np.zeros((*real[part].shape, d * d + 1))
            target[real[part]] = full
            self.geometry[part] = target.transpose(0, 2, 1)

    def _chunks(self, boundary: Any) -> None:
        rows: list[tuple[int, int, int, int]] = []
        first = 0
        for end in (*self._runs(), self.blocks):
            while first < end:
                last = min(first + BLOCKS_PER_CHUNK, end)
                done = int(np.searchsorted(self._last, last, side="left"))
                rows.append((first, last, int(self.region[first]), done))
                first = last
        self.chunks = np.array(rows, np.int64).reshape(-1, 4)
        self.boundary_chunks = int(np.sum(self.chunks[:, 1] <= self.boundary_blocks))

    def _runs(self) -> list[int]:
        change = np.flatnonzero((np.diff(self.region) != 0) | (np.diff(self.group) != 0)) + 1
        return sorted({int(c) for c in change} | {self.boundary_blocks} - {0})

    def _volumes(self, regions: int) -> None:
        """Vertex rule: each cell gives |K|/(d+1) to its vertices; shared nodes are summed."""
        share = self.geometry[:, -1, :] ** 2 / (self.dim + 1)
        by = np.zeros((self.nodes + 1, regions))
        for r in range(regions):
            mine = self.region == r
            for a in range(self.dim + 1):
                at = self.cells[mine, a, :].ravel()
                by[:, r] += np.bincount(at, share[mine].ravel(), minlength=self.nodes + 1)
        self.region_volume = by[:-1]
        self.sum_shared(self.region_volume)
        self.volume = self.region_volume.sum(axis=1)

    def sum_shared(self, values: Array) -> None:
        """Sum partial nodal values (nodes, m) over the ranks that share a node; collective."""
        if self.comm.size > 1:
            part = slice(self.late, self.late + self.shared)
            block = np.ascontiguousarray(values[part])
            self.halo.sum(block)
            values[part] = block

    def cell_values(self, values: Array) -> Array:
        """Values of owned cells (cells, m) in blocks, shape (blocks, m, W); padding is zero."""
        lanes = np.where(self.source_cell < 0, 0, self.source_cell)
        table = values[lanes]
        table[self.source_cell < 0] = 0.0
        out = native.aligned((self.blocks, values.shape[1], self.lanes))
        out[:] = table.transpose(0, 2, 1)
        return out

    def nodal_average(self, values: Array) -> Array:
        """Volume average at the nodes of values of owned cells (cells,): Σ_K v|K| / Σ_K |K|."""
        blocks = self.cell_values(values[:, None])[:, 0, :]
        share = blocks * self.geometry[:, -1, :] ** 2 / (self.dim + 1)
        out = np.zeros((self.nodes + 1, 1))
        for a in range(self.dim + 1):
            at = self.cells[:, a, :].ravel()
            out[:, 0] += np.bincount(at, share.ravel(), minlength=self.nodes + 1)
        total = out[:-1]
        self.sum_shared(total)
        return total[:, 0] / self.volume

    def density(self) -> Array:
        """ρ averaged over each node's volume, shape (nodes,), so that m_a = ρ_a · volume_a.

        Raises:
            BodyError: if a density Function is not DG0 or not positive (on all ranks).
        """
        bodies = self.scene.bodies
        if not any(hasattr(body.density, "function_space") for body in bodies):
            rho = np.array([float(body.density) for body in bodies])
            single = self.region_volume @ rho / self.volume
            pure = self.region_volume.max(axis=1) == self.volume
            # Averages of one region only must be that region's number to the bit.
            return np.where(pure, rho[self.region_volume.argmax(axis=1)], single)
        cells = _compat.cell_count(self.scene.mesh)[0]
        values, regions = np.zeros(cells), self.scene.regions()
        error: Exception | None = None
        for index, body in enumerate(bodies):
            mine = regions == index
            if not hasattr(body.density, "function_space"):
                values[mine] = float(body.density)
            elif _compat.is_cellwise(body.density):
                dofs = _compat.cell_dofs(body.density.function_space)[:cells, 0]
                values[mine] = body.density.x.array[dofs[mine]]
            else:
                error = BodyError(
                    f"The density of {body.name} is not piecewise constant. Give a DG0 Function."
                )
        if error is None and not np.all(values > 0):
            error = BodyError("A density Function is not positive everywhere. Give ρ > 0 in kg/m³.")
        agree(self.comm, error)
        return self.nodal_average(values)

    @cached_property
    def corners(self) -> Array | None:
        """Coordinates of cells' vertices (blocks, W, d+1, 3) where nodes have copies, else None."""
        if self.identified is None:
            return None
        lanes = np.where(self.source_cell < 0, 0, self.source_cell)
        nodes = _compat.cell_nodes(self.scene.mesh)[lanes]
        return np.ascontiguousarray(self.scene.mesh.geometry.x[nodes], dtype=np.float64)

    def names(self, dofs: Any) -> Any:
        """Global numbers that all ranks know geometry nodes by, the same for all copies of one."""
        index_map = _compat.node_map(self.scene.mesh)
        numbers = np.asarray(index_map.local_to_global(dofs.astype(np.int32)), dtype=np.int64)
        return numbers if self.identified is None else self.identified.named(numbers, dofs)

    def gather(self, function_values: Array) -> Array:
        """Records (nodes, m) from an array over dolfinx's nodes (geometry nodes, m)."""
        return np.ascontiguousarray(function_values[self.dof])

    def gather_sum(self, parts: Array) -> Array:
        """Records (nodes, m) from this rank's parts at dolfinx's nodes, those of copies summed."""
        if self.identified is None:
            return self.gather(parts)
        out = np.zeros((self.nodes, *parts.shape[1:]))
        here = self.number >= 0
        np.add.at(out, self.number[here], parts[here])
        return out

    def spread(self, values: npt.NDArray[Any], out: npt.NDArray[Any]) -> None:
        """Set ``out`` (geometry nodes, …) from nodal values (nodes, …), at all copies of nodes."""
        if self.identified is None:
            out[self.dof] = values
        else:
            here = self.number >= 0
            out[here] = values[self.number[here]]

    def scatter(self, values: Array, function: Any) -> None:
        """Set a P1 Function of m components from nodal values (nodes, m); collective."""
        self.spread(values, function.x.array.reshape(-1, values.shape[1]))
        function.x.scatter_forward()
