# SPDX-License-Identifier: LGPL-3.0-or-later
"""Facets of a mesh's boundary that a translation takes to one another, wherever ranks have them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.spatial import cKDTree

from complexbody import _compat
from complexbody.errors import MeshError, SceneError, agree

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

#: Nodes match within this share of the face's shortest edge (and of the translation).
TOLERANCE = 1e-6


class Boundary:
    """The owned exterior facets of a mesh.

    Attributes:
        x: Geometry nodes (geometry nodes, 3).
        facets: Numbers of the facets; nodes: their geometry nodes (facets, d).
        corners: Coordinates of these (facets, d, 3).
        middle, normal: Midpoints and outward unit normals (facets, 3).
    """

    def __init__(self, mesh: Any) -> None:
        self.mesh, self.comm, dim = mesh, mesh.comm, mesh.topology.dim
        self.x = np.asarray(mesh.geometry.x, dtype=np.float64)
        self.facets = _compat.exterior_facets(mesh)
        self.nodes = _compat.facet_nodes(mesh, self.facets)
        self.corners = self.x[self.nodes]
        self.middle = self.corners.mean(axis=1)
        cells = mesh.topology.connectivity(dim - 1, dim)
        cells = cells.array[cells.offsets[self.facets]]
        outward = self.middle - self.x[_compat.cell_nodes(mesh)[cells]].mean(axis=1)
        # What is outward and has no part along the facet.
        edges = self.corners[:, 1:] - self.corners[:, :1]
        q = np.linalg.qr(edges.transpose(0, 2, 1))[0]
        normal = outward - np.einsum("fia,fja,fj->fi", q, q, outward)
        self.normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def shortest(self, chosen: Flags) -> float:
        """Shortest edge of some facets of all ranks [m], infinite for points; collective."""
        c = self.corners[chosen]
        d = c.shape[1]
        edges = [np.linalg.norm(c[:, i] - c[:, j], axis=1) for i in range(d) for j in range(i)]
        least = float(np.min(np.concatenate([*edges, [np.inf]])))
        return float(self.comm.allreduce(least, op=MPI.MIN))


def match(
    boundary: Boundary, chosen: Flags, vector: Array, name: str, other: Flags | None = None
) -> tuple[Array, Any]:
    """Pairs of nodes at x and x + vector, from facets that match corner by corner; collective.

    Args:
        boundary: Of the mesh.
        chosen: Its facets at x.
        vector: The translation (3,) [m].
        name: What the user calls it.
        other: All facets at x + vector, if known: none of them may be left over.

    Returns:
        Rows (number, coordinates) of a node and of its copy, shape (pairs, 8), as this rank found
        them; and those of this rank's facets that are on either side.

    Raises:
        SceneError: if there is no facet at x.
        MeshError: if one has no partner, or one on the same side of the body (on all ranks).
    """
    comm, mesh = boundary.comm, boundary.mesh
    nodes = boundary.nodes[chosen]
    numbers = _numbers(mesh, nodes.ravel()).reshape(nodes.shape)
    parts = comm.allgather((boundary.corners[chosen], boundary.normal[chosen], numbers))
    corners, normal, number = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(corners):
        raise SceneError(
            f"{name}: no facet of the boundary is there. Check the predicate's tolerance or the "
            "tag."
        )
    tolerance = TOLERANCE * min(boundary.shortest(chosen), float(np.linalg.norm(vector)))
    moved = corners + vector
    distance, partner = cKDTree(moved.mean(axis=1)).query(boundary.middle, workers=1)
    hits = np.flatnonzero(distance <= tolerance)
    partner = partner[hits]
    # Corner i of a facet here beside corner j of its partner, moved here.
    apart = np.linalg.norm(
        boundary.corners[hits][:, :, None] - moved[partner][:, None], axis=-1
    )  # fmt: skip
    j = apart.argmin(axis=2)
    fits = np.all(apart.min(axis=2) <= tolerance, axis=1)
    hits, partner, j = hits[fits], partner[fits], j[fits]
    count = comm.allreduce(np.bincount(partner, minlength=len(corners)))
    if np.any(count == 0):
        _refuse(boundary, name, corners[count == 0], moved[count == 0], tolerance)
    same = np.einsum("fi,fi->f", boundary.normal[hits], normal[partner]) > -0.99
    left = np.zeros(0, np.int64)
    if other is not None:
        left = np.setdiff1d(np.flatnonzero(other), hits)
    error: Exception | None = None
    if same.any():
        error = MeshError(
            f"{name}: the facets at {_at(corners[partner[same]][0])} and "
            f"{_at(boundary.corners[hits[same]][0])} do not face opposite ways. Give a face and "
            "the vector to the one opposite."
        )
    elif left.size:
        error = MeshError(
            f"{name}: the facet at {_at(boundary.corners[left[0]])} has none opposite to it. Use "
            "faces of the same shape, or cb.Periodic(where, vector) for parts of them."
        )
    agree(comm, error)
    mine = _numbers(mesh, boundary.nodes[hits].ravel())
    theirs = np.take_along_axis(number[partner], j, axis=1).reshape(-1, 1)
    there = np.take_along_axis(corners[partner], j[:, :, None], axis=1).reshape(-1, 3)
    here = boundary.corners[hits].reshape(-1, 3)
    pairs = np.concatenate([theirs, there, mine[:, None], here], axis=1)
    return pairs, np.concatenate([boundary.facets[chosen], boundary.facets[hits]])


def _numbers(mesh: Any, nodes: Any) -> Ints:
    """dolfinx's global numbers of geometry nodes."""
    local = np.ascontiguousarray(nodes, dtype=np.int32)
    return np.asarray(_compat.node_map(mesh).local_to_global(local), dtype=np.int64)


def _at(corners: Array) -> list[float]:
    return [float(v) for v in np.round(corners.mean(axis=0), 9)]


def _refuse(
    boundary: Boundary, name: str, corners: Array, moved: Array, tolerance: float
) -> None:
    """Say which node of facets without partners has no copy, and how far the nearest node is.

    Raises:
        MeshError: on all ranks.
    """
    points, where = moved.reshape(-1, 3), corners.reshape(-1, 3)
    near = np.full(len(points), np.inf)
    if len(boundary.corners):
        near = cKDTree(boundary.corners.reshape(-1, 3)).query(points)[0]
    boundary.comm.Allreduce(MPI.IN_PLACE, near, op=MPI.MIN)
    worst = int(np.argmax(near))
    if near[worst] > tolerance:
        raise MeshError(
            f"{name}: the node at {where[worst].tolist()} has no copy at {points[worst].tolist()}: "
            f"the nearest node of the boundary is {near[worst]:.3g} m away. Make the mesh of both "
            "faces alike, or check the vector."
        )
    raise MeshError(
        f"{name}: the facet at {_at(corners[0])} has none opposite to it, though its nodes have. "
        "Make the two faces of the same facets (gmsh: setPeriodic)."
    )

