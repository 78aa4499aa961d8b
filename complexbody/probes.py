# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points at which fields are watched: the cells they lie in, and their weights there.

A P1 field at a point is the sum of its values at the nodes of the cell, weighted by the point's
barycentric coordinates. Knows no field: it says which nodes, and brings values to rank 0.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from complexbody import _compat
from complexbody._compat import Array, Ints
from complexbody.errors import SceneError
from complexbody.scene import Scene

#: A point is in a cell if none of its barycentric coordinates is below minus this.
TOLERANCE = 1e-8
#: Cells looked at together: their arrays should fit into a cache.
BLOCK = 1 << 15


class Probes:
    """Each point in an owned cell of exactly one rank; collective.

    Args:
        scene: The scene.
        points: Points by name, one coordinate per dimension of the mesh [m].

    Attributes:
        names: Names of all points.
        indices: Numbers of those that are this rank's, shape (mine,). A point that touches cells of
            several ranks belongs to the lowest.
        cells_nodes: dolfinx geometry nodes of the cells they lie in, shape (mine, d+1).
        weights: Barycentric coordinates in these cells, shape (mine, d+1).

    Raises:
        SceneError: for points outside the body, or without one coordinate per dimension.
    """

    def __init__(self, scene: Scene, points: Mapping[str, Sequence[float]]) -> None:
        mesh = scene.mesh
        self._comm, self.names, dim = mesh.comm, tuple(points), mesh.geometry.dim
        for name, point in points.items():
            if np.size(point) != dim:
                raise SceneError(
                    f"Probe {name!r} at {point!r} is not a point of a mesh with {dim} dimensions. "
                    "Give one coordinate for each."
                )
        targets = np.array([np.ravel(p) for p in points.values()], dtype=float).reshape(-1, dim)
        x = mesh.geometry.x[:, :dim]
        nodes = _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
        depth, cell, weights = _locate(targets, x, nodes)
        inside = np.array(self._comm.allgather(depth)) >= -TOLERANCE
        if not inside.any(axis=0).all():
            self._refuse(targets, np.flatnonzero(~inside.any(axis=0)), x)
        self.indices = np.flatnonzero(inside.argmax(axis=0) == self._comm.rank)
        self.cells_nodes: Ints = nodes[cell[self.indices]]
        self.weights: Array = weights[self.indices]

    def gather(self, values: Array) -> Array | None:
        """Bring each rank's ``values`` (mine, components) to rank 0: (points, components) or None.

        Collective.
        """
        parts = self._comm.gather((self.indices, np.asarray(values)))
        if parts is None:
            return None
        everything = np.concatenate([part for _, part in parts])
        return everything[np.argsort(np.concatenate([indices for indices, _ in parts]))]

    def _refuse(self, targets: Array, outside: Ints, x: Array) -> None:
        """Name the points outside, each with the node nearest to it; collective."""
        told = []
        for i in outside:
            distance = np.linalg.norm(x - targets[i], axis=1)
            node = int(distance.argmin()) if len(x) else -1
            mine = (distance[node], x[node].tolist()) if len(x) else (np.inf, [])
            nearest = min(self._comm.allgather(mine))[1]
            told.append(f"{self.names[i]!r} at {targets[i].tolist()} (nearest node: {nearest})")
        raise SceneError(f"Outside the body: probe {', '.join(told)}. Move inside what is watched.")


def _locate(targets: Array, x: Array, nodes: Ints) -> tuple[Array, Ints, Array]:
    """The cell in which each point lies deepest.

    Args:
        targets: Points (points, d).
        x: Nodes (nodes, d).
        nodes: Node numbers of cells (cells, d+1).

    Returns:
        Depth (the least barycentric coordinate, −∞ far from all cells), cell, and barycentric
        coordinates of each point: shapes (points,), (points,) and (points, d+1).
    """
    depth, cell = np.full(len(targets), -np.inf), np.zeros(len(targets), dtype=np.int32)
    weights = np.zeros((len(targets), nodes.shape[1]))
    for first in range(0, len(nodes), BLOCK):
        corners = x[nodes[first : first + BLOCK]]
        low, high = corners.min(axis=1), corners.max(axis=1)
        slack = TOLERANCE * (high - low).max(axis=1, keepdims=True)
        for i, target in enumerate(targets):
            near = (low - slack <= target) & (target <= high + slack)
            for candidate in np.flatnonzero(near.all(axis=1)):
                # Columns: edges from corner 0. Cells that are flat hold no point.
                origin, *others = corners[candidate]
                edges = (np.array(others) - origin).T
                if np.linalg.det(edges) == 0:
                    continue
                inner = np.linalg.solve(edges, target - origin)
                coordinates = np.array([1 - inner.sum(), *inner])
                if coordinates.min() > depth[i]:
                    depth[i], cell[i] = coordinates.min(), first + candidate
                    weights[i] = coordinates
    return depth, cell, weights
