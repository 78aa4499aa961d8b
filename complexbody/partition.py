# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which rank works on which cells: a mesh shared out anew, so that work is even, not cells.

dolfinx shares out cells by a graph partitioner without weights. With a step for every cell, the few
small ones have most of the work. Here cells are cut in two along the longest side of their box,
where the weights on both sides are as the numbers of ranks, and so on. Knows meshes, and no bodies.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import mesh as dmesh
from mpi4py import MPI

from complexbody import _compat
from complexbody._compat import Array, Ints
from complexbody.errors import MeshError, agree

#: Cuts are found by counting weights in so many slices, and those in the slice met, so many times.
_SLICES, _ROUNDS = 64, 9
#: Cut planes are tilted by so much, for structured meshes have layers of cells of one coordinate.
_TILT = np.array([1.0, 1.37e-3, 0.73e-3])


def balanced(mesh: dmesh.Mesh, weights: Array | None = None, *tags: Any) -> tuple[Any, ...]:
    """The same mesh, shared out so that every rank has the same sum of weights; collective.

    Cells and nodes keep their numbers in the mesh's input: results and files are as before.

    For ``LocalLeapfrog`` and ``AVI(schedule="octaves")``, whose exchanges are few. Parts cut
    through where the weights are, and windows exchange at every time at which a cell of the
    interface acts: in demos/graded_crack.py on 2 ranks 1700 times per window instead of 45, which
    costs far more than even work saves. There, leave the mesh as it is.

    Args:
        mesh: A mesh of straight simplices; it is not changed. The new one has no ghost cells.
        weights: Work of each of this rank's owned cells, shape (cells,), for instance
            ``result.time_sets.window / result.time_sets.steps``; by default 1 over the altitudes of
            :func:`complexbody.meshes.altitudes`, which are as the critical steps of one material.
        tags: Cell and facet tags on the mesh.

    Returns:
        The new mesh, and the tags on it; what was given if there is one rank.

    Raises:
        MeshError: if weights are not positive numbers, one for each cell (on all ranks).
    """
    from complexbody.meshes import altitudes

    comm, owned = mesh.comm, _compat.cell_count(mesh)[0]
    w = 1.0 / altitudes(mesh) if weights is None else np.asarray(weights, dtype=np.float64)
    error: Exception | None = None
    if w.shape != (owned,) or not (np.all(np.isfinite(w)) and np.all(w > 0)):
        error = MeshError(
            f"balanced: weights of shape {w.shape} for {owned} cells, or not positive. Give a "
            "positive number for each of this rank's cells."
        )
    agree(comm, error)
    if comm.size == 1:
        return (mesh, *tags)
    nodes, dim = _compat.cell_nodes(mesh)[:owned], mesh.geometry.dim
    numbers = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)
    rank = parts(comm, mesh.geometry.x[nodes, :dim].mean(axis=1), w, comm.size)
    # Rows come in the order of the input, so that the new mesh has its numbers.
    count = comm.allreduce(owned)
    table = np.column_stack([numbers[nodes], rank])
    cells = _in_blocks(comm, _compat.original_cells(mesh)[:owned], table, count)
    mine = slice(_compat.node_map(mesh).size_local)
    most = int(comm.allreduce(int(numbers.max(initial=-1)), op=MPI.MAX)) + 1
    points = _in_blocks(comm, numbers[mine], mesh.geometry.x[mine, :dim], most)
    made = _compat.create_mesh(
        comm, np.ascontiguousarray(cells[:, :-1]), points, cells[:, -1].astype(np.int32)
    )
    made.name = mesh.name
    if tags and most != _compat.node_map(mesh).size_global:
        raise MeshError(
            "balanced: the mesh's input has points that no cell uses, so that tags cannot follow. "
            "Remove those points, or tag the new mesh."
        )
    return (made, *(_moved(given, mesh, made, numbers) for given in tags))


def parts(comm: Any, points: Array, weights: Array, count: int) -> Ints:
    """Part of each point, 0 to ``count`` − 1, of equal sums of weights; collective.

    Args:
        comm: Ranks that have the points.
        points: This rank's, shape (m, d).
        weights: Positive, shape (m,).
        count: Number of parts.
    """
    part = np.zeros(len(points), dtype=np.int32)
    open_parts = [(0, count)]
    while open_parts:
        first, last = open_parts.pop()
        if last - first < 2:
            continue
        here, middle = part == first, (first + last) // 2
        share = (middle - first) / (last - first)
        part[np.flatnonzero(here)[_above(comm, points[here], weights[here], share)]] = middle
        open_parts += [(first, middle), (middle, last)]
    return part


def _above(comm: Any, points: Array, weights: Array, share: float) -> Any:
    """True for points above the plane with ``share`` of the weights below; collective."""
    dim = points.shape[1]
    low, high = _bounds(comm, points)
    key = points @ np.roll(_TILT[:dim], int(np.argmax(high - low)))
    a, b = (float(bound[0]) for bound in _bounds(comm, key[:, None]))
    wanted = share * comm.allreduce(float(weights.sum()))
    for _ in range(_ROUNDS):
        edges = np.linspace(a, b, _SLICES + 1)
        slices = np.searchsorted(edges[1:-1], key, side="right")
        here = key <= b  # whatever lies below a is counted with the first slice
        sums = np.bincount(slices[here], weights[here], _SLICES)
        below = np.cumsum(comm.allreduce(sums))
        at = min(int(np.searchsorted(below, wanted)), _SLICES - 1)
        a, b = float(edges[at]), float(edges[at + 1])
        if not b > a:
            break
    return key > 0.5 * (a + b)


def _bounds(comm: Any, points: Array) -> tuple[Array, Array]:
    """Smallest and largest coordinates of all ranks' points; collective."""
    low, high = np.min(points, axis=0, initial=np.inf), np.max(points, axis=0, initial=-np.inf)
    lows, highs = zip(*comm.allgather((low, high)), strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _in_blocks(comm: Any, numbers: Any, rows: Any, count: int) -> Any:
    """Rows by their numbers: this rank's stretch of 0 … count − 1, zero where nobody has a row.

    Collective.
    """
    bounds = np.arange(comm.size + 1) * count // comm.size
    to = np.searchsorted(bounds, numbers, side="right") - 1
    heard = comm.alltoall([(numbers[to == r], rows[to == r]) for r in range(comm.size)])
    out = np.zeros((bounds[comm.rank + 1] - bounds[comm.rank], rows.shape[1]), rows.dtype)
    for which, values in heard:
        out[which - bounds[comm.rank]] = values
    return out


def _moved(tags: Any, old: dmesh.Mesh, new: dmesh.Mesh, numbers: Any) -> Any:
    """Cell or facet tags of the old mesh on the new one; collective."""
    tdim, nodes = old.topology.dim, _compat.cell_nodes(old)
    index_map = old.topology.index_map(tags.dim)
    mine = tags.indices < index_map.size_local
    entities, values = tags.indices[mine], tags.values[mine]
    corners = nodes[entities] if tags.dim == tdim else _compat.facet_nodes(old, entities)
    out = _compat.tags_from_nodes(new, tags.dim, numbers[corners], values)
    out.name = tags.name
    return out
