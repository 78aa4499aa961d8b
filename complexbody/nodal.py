# SPDX-License-Identifier: LGPL-3.0-or-later
"""From cells to nodes: sums over the cells that meet there. Knows meshes and no scene."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from complexbody import _compat

Array = npt.NDArray[np.float64]


def volumes(mesh: Any) -> Array:
    """Volume of each of this rank's own cells [m^d], shape (cells,)."""
    dim, nodes = mesh.geometry.dim, _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
    corners = mesh.geometry.x[nodes][:, :, :dim]
    return np.asarray(
        np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / math.factorial(dim)
    )


def sums(mesh: Any, values: Array) -> fem.Function:
    """At each node the sum of values (own cells, m) of all cells that meet there; collective."""
    function = fem.Function(_compat.vector_space(mesh, values.shape[1]))
    dofs = _compat.cell_dofs(function.function_space)[: len(values)]
    table = function.x.array.reshape(-1, values.shape[1])
    np.add.at(table, dofs, values[:, None, :])
    _compat.accumulate(function)
    return function


def averages(mesh: Any, values: Array) -> fem.Function:
    """At each node the average of values (own cells, m) by volume, a P1 Function; collective."""
    volume = volumes(mesh)[:, None]
    function = sums(mesh, volume * np.concatenate([values, np.ones_like(volume)], axis=1))
    table = function.x.array.reshape(-1, values.shape[1] + 1)
    out = fem.Function(_compat.vector_space(mesh, values.shape[1]))
    out.x.array[:] = (table[:, :-1] / table[:, -1:]).ravel()
    return out
