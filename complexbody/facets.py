# SPDX-License-Identifier: LGPL-3.0-or-later
"""Exterior facets as arrays: vertices, cells, outward normals, areas."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import _compat

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[Any]


@dataclass(frozen=True)
class Facets:
    """Exterior facets of this rank.

    Attributes:
        nodes: Geometry nodes, shape (facets, d).
        cells: dolfinx cell of each.
        normals: Outward unit normals, shape (facets, 3).
        areas: Lengths in 2D, areas in 3D, 1 in 1D.
        centres: Shape (facets, 3).
    """

    nodes: Ints
    cells: Ints
    normals: Array
    areas: Array
    centres: Array


def exterior(mesh: Any, facets: Ints) -> Facets:
    """Geometry of some exterior facets of a simplicial mesh."""
    dim, x = mesh.geometry.dim, np.asarray(mesh.geometry.x)
    nodes = _compat.facet_nodes(mesh, facets)
    to_cell = mesh.topology.connectivity(dim - 1, dim)
    cells = np.asarray(to_cell.array[to_cell.offsets[facets]], dtype=np.int64)
    corners = x[nodes].reshape(len(facets), dim, 3)
    centres = corners.mean(axis=1)
    out = centres - x[_compat.cell_nodes(mesh)[cells]].mean(axis=1)
    if dim == 1:
        normals, areas = out * [1.0, 0.0, 0.0], np.ones(len(facets))
    else:
        edges = corners[:, 1:] - corners[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1] if dim == 3 else [0.0, 0.0, 1.0])
        areas = np.linalg.norm(normals, axis=1) / (2.0 if dim == 3 else 1.0)
    normals = normals * np.sign(np.einsum("fi,fi->f", normals, out))[:, None]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # Round-off of meshes along axes, so that their components stay apart and facets alike.
    normals = np.where(np.abs(normals) < 1e-13, 0.0, normals)
    return Facets(nodes, cells, normals, areas, centres)
