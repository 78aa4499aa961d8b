# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Point sources: a force F at a point x_s, or a moment M_ij = F_i d_j of a couple of them.

The virtual power of F δ(x − x_s) − Div(M δ(x − x_s)) on P1 fields is that of the nodal forces

.. math:: f_a = F N_a(x_s) + M \nabla N_a(x_s)

at the vertices of the cell in which x_s lies. On facets, edges and vertices all cells around the
point share it by their volumes: which rank has which cell does not matter, and ∇N is a mean. The
shape functions add up to one, so that the total force is F to round-off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import _compat
from complexbody.conditions import PointSource
from complexbody.errors import SceneError
from complexbody.given import finite, short
from complexbody.scene import Scene

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[Any]


#: A point is in a cell if none of its barycentric coordinates is below minus this.
TOLERANCE = 1e-10


def point_load(scene: Scene, source: PointSource) -> tuple[Ints, Ints, Array]:
    """Geometry nodes, components and values of a source's nodal forces on this rank; collective.

    Raises:
        SceneError: for points outside the body and vectors or moments that misfit (on all ranks).
    """
    mesh, dim = scene.mesh, scene.mesh.geometry.dim
    at = np.ravel(np.asarray(source.at, dtype=np.float64))
    if len(at) > dim and not np.any(at[dim:]):
        at = at[:dim]
    if len(at) != dim:
        raise SceneError(
            f"PointSource: at={source.at!r} is not a point of a mesh with {dim} dimensions. Give "
            "one coordinate for each."
        )
    rows = scene.components_of(source.field)
    vector, moment = _shaped(source, len(rows))
    x = np.asarray(mesh.geometry.x)[:, :dim]
    nodes = _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
    cells, weights, gradients, volumes = _around(at, x, nodes)
    total = mesh.comm.allreduce(float(volumes.sum()))
    if total == 0:
        raise SceneError(
            f"PointSource: the point {at.tolist()} is outside the body. Move it inside, or onto "
            "the boundary."
        )
    share = volumes / total
    forces = np.einsum("c,ca,i->cai", share, weights, vector)
    forces += np.einsum("c,caj,ij->cai", share, gradients, moment[:, :dim])
    vertices = nodes[cells].astype(np.int64)
    node, value = np.repeat(vertices.ravel(), len(rows)), forces.ravel()
    acts = value != 0
    return node[acts], np.tile(rows, vertices.size)[acts], value[acts]


def _around(at: Array, x: Array, nodes: Ints) -> tuple[Ints, Array, Array, Array]:
    """Owned cells that a point touches, its N_a and ∇N_a there, and the cells' volumes × d!."""
    dim = len(at)
    low, high = x[nodes[:, 0]].copy(), x[nodes[:, 0]].copy()
    for vertex in range(1, dim + 1):
        np.minimum(low, x[nodes[:, vertex]], out=low)
        np.maximum(high, x[nodes[:, vertex]], out=high)
    slack = TOLERANCE * (high - low).max(axis=1, initial=0.0, keepdims=True)
    near = np.flatnonzero(np.all((low - slack <= at) & (at <= high + slack), axis=1))
    corners = x[nodes[near]]
    edges = corners[:, 1:] - corners[:, :1]
    # Flat cells hold no point; they are refused elsewhere.
    volumes = np.abs(np.linalg.det(edges)) if len(near) else np.zeros(0)
    near, corners, edges = near[volumes > 0], corners[volumes > 0], edges[volumes > 0]
    gradients = np.zeros((len(near), dim + 1, dim))
    gradients[:, 1:] = np.linalg.inv(edges).transpose(0, 2, 1)
    gradients[:, 0] = -gradients[:, 1:].sum(axis=1)
    weights = np.einsum("caj,cj->ca", gradients, at - corners[:, 0])
    weights[:, 0] += 1.0
    inside = weights.min(axis=1, initial=1.0) >= -TOLERANCE
    return near[inside], weights[inside], gradients[inside], volumes[volumes > 0][inside]


def _shaped(source: PointSource, count: int) -> tuple[Array, Array]:
    """F (count,) and M (count, 3) of a source."""
    vector, moment = np.zeros(count), np.zeros((count, 3))
    if source.vector is not None:
        given = finite(source.vector)
        if given is None or np.atleast_1d(given).shape != (count,):
            raise SceneError(
                f"PointSource: vector {short(source.vector)} does not have {count} finite "
                "components. Give one number per component of the field."
            )
        vector = np.atleast_1d(given)
    if source.moment is not None:
        given = finite(source.moment)
        if given is None:
            raise SceneError(
                f"PointSource: moment is {short(source.moment)}. Give finite numbers."
            )
        table = np.atleast_2d(given)
        if table.ndim != 2 or len(table) != count or table.shape[1] > 3:
            raise SceneError(
                f"PointSource: moment has shape {table.shape}, but the field has {count} "
                "components. Give one row for each, with a column per direction."
            )
        moment[:, : table.shape[1]] = table
    return vector, moment
