# SPDX-License-Identifier: LGPL-3.0-or-later
"""Re-entrant corners and edges of a body, where its fields are singular."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]

#: Interior angles over a flat one from which on a corner is no bend of a curve that a mesh follows.
BEND = 1.25


def widest(problem: Problem) -> float:
    """The largest interior angle at the boundary over a flat one (π, in 3D 2π); collective.

    1 in one dimension; 2 at the tip of a slit. Of periodic scenes too, whose faces are none, it is
    that of the mesh.
    """
    disc, scene = problem.disc, problem.whole
    mesh, dim = scene.mesh, disc.dim
    if dim == 1 or scene.identified is not None:
        return 1.0
    cells = disc.cells.transpose(0, 2, 1)[disc.source_cell >= 0]
    total = np.zeros((disc.nodes, 2))
    for a in range(dim + 1):
        others = [b for b in range(dim + 1) if b != a]
        rays = disc.position[cells[:, others]] - disc.position[cells[:, a]][:, None]
        total[:, 0] += np.bincount(cells[:, a], _angle(rays), minlength=disc.nodes)
    outer = _compat.facet_nodes(mesh, _compat.exterior_facets(mesh))
    total[np.unique(disc.number[outer]), 1] = 1.0
    disc.sum_shared(total)
    flat = np.pi if dim == 2 else 2 * np.pi
    here = float(np.max(total[total[:, 1] > 0, 0], initial=0.0)) / flat
    return float(problem.comm.allreduce(here, op=MPI.MAX))


def _angle(rays: Array) -> Array:
    """Angle between two rays, or solid angle of three, shape (m,), of rays (m, d, 3)."""
    r = rays / np.linalg.norm(rays, axis=2, keepdims=True)
    if r.shape[1] == 2:
        return np.asarray(np.arccos(np.clip(np.einsum("mi,mi->m", r[:, 0], r[:, 1]), -1.0, 1.0)))
    # After A. van Oosterom and J. Strackee (1983).
    volume = np.abs(np.linalg.det(r))
    dots = sum(np.einsum("mi,mi->m", r[:, i], r[:, j]) for i, j in ((0, 1), (1, 2), (2, 0)))
    return np.asarray(2 * np.arctan2(volume, 1 + dots))
