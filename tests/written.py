# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes with known fields to write, and what others read of them; for several tests."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

from complexbody import _compat
from complexbody.body import Body
from complexbody.output import NODE_FIELDS

LAM, MU, K0, K1 = 1.5, 0.7, 2.0, 0.3
GRADIENT = np.array([[0.1, 0.2, -0.3], [0.4, -0.5, 0.6], [0.7, 0.8, 0.9]])


def domain(comm, dim, cells=None):
    """A unit interval, square or cube with so many cells along each side, or a few."""
    maker = {1: mesh.create_unit_interval, 2: mesh.create_unit_square, 3: mesh.create_unit_cube}
    few = {1: (11,), 2: (5, 4), 3: (3, 2, 4)}[dim]
    return maker[dim](comm, *(few if cells is None else [cells] * dim))


def body(n_u=3, k=2, stiffness=1.0):
    """Isotropic elasticity beside a descriptor; quartic where n_u is not 3."""

    def energy(U, nu, N):
        if n_u == 3:
            e = ufl.sym(U)
            elastic = 0.5 * LAM * ufl.tr(e) ** 2 + MU * ufl.inner(e, e)
        else:
            elastic = 0.25 * ufl.inner(U, U) ** 2
        return stiffness * elastic + 0.5 * K0 * ufl.dot(nu, nu) + 0.5 * K1 * ufl.inner(N, N)

    return Body(k, energy, density=1.0, inertia=1.0, displacement=n_u)


def fields(scene, value):
    """Functions by name whose components are ``value(x, i)``, i counting through all four."""
    state, first = {}, 0
    for name in NODE_FIELDS:
        count = scene.displacement if name.startswith("u") else scene.descriptor
        state[name] = fem.Function(_compat.vector_space(scene.mesh, count))
        rows = range(first, first + count)
        state[name].interpolate(lambda x, rows=rows: np.array([value(x, i) for i in rows]))
        first += count
    return state


def wavy(x, i):
    """A different field for each i."""
    return np.sin((i + 1.3) * x[0]) + x[1] ** 2 * (i + 1) - x[2] * x[0]


def read(path):
    """What meshio sees of a series: points, cells, [(time, values)]."""
    meshio = pytest.importorskip("meshio")
    with meshio.xdmf.TimeSeriesReader(path) as reader:
        points, cells = reader.read_points_cells()
        steps = []
        for number in range(reader.num_steps):
            time, nodal, cellwise = reader.read_data(number)
            assert len(nodal) + len(cellwise) == 1
            [(name, values)] = [*nodal.items(), *cellwise.items()]
            steps.append((time, name, values if nodal else values[0]))
    return points, cells[0].data, steps
