# SPDX-License-Identifier: LGPL-3.0-or-later
"""Re-entrant corners are found by their angles, and told of where an accuracy is asked for."""

import warnings

import numpy as np
import pytest
import ufl

import complexbody as cb
from complexbody import _compat, corners, meshes
from complexbody.problem import Problem


def energy(U, nu, N):
    return 0.5 * ufl.inner(U, U) + 0.5 * ufl.inner(N, N) + 0.2 * ufl.inner(U, N)


def cut(comm, mesh, keep):
    """The cells of a mesh on one rank whose centres are kept, shared out anew."""
    points, cells = np.zeros((0, mesh.geometry.dim)), np.zeros((0, mesh.geometry.dim + 1), int)
    if comm.rank == 0:
        x, nodes = mesh.geometry.x[:, : mesh.geometry.dim], _compat.cell_nodes(mesh)
        used, cells = np.unique(nodes[keep(x[nodes].mean(axis=1).T)], return_inverse=True)
        points, cells = x[used], cells.reshape(-1, mesh.geometry.dim + 1)
    return _compat.create_mesh(comm, cells, points)


def square(comm, n=8):
    return meshes.rectangle(comm, (0, 0), (1, 1), (n, n))


def cube(comm, n=4):
    return meshes.box(comm, (0, 0, 0), (1, 1, 1), (n, n, n))


def missing_quarter(x):
    return (x[0] < 0.5) | (x[1] < 0.5)


def scene(mesh, **more):
    start = cb.Initial(u=lambda x: np.cos(2 * np.pi * x[0])[None])
    return cb.Scene(mesh, cb.Body(1, energy, 1.0, 1.0, displacement=1), initial=start, **more)


def widest(mesh, **more):
    problem = Problem(scene(mesh, **more))
    try:
        return corners.widest(problem)
    finally:
        problem.close()


@pytest.mark.parametrize("made", [square, cube])
def test_angles(comm, made):
    """Convex bodies have none; the corner of an L, the edge of its extrusion, is 3/2 of flat."""
    alone = made(comm.Split(comm.rank))
    assert widest(made(comm)) == pytest.approx(1.0, abs=1e-12)
    assert widest(cut(comm, alone, missing_quarter)) == pytest.approx(1.5, abs=1e-12)
    octant = cut(comm, alone, lambda x: missing_quarter(x) | (x[-1] < 0.5))
    assert widest(octant) == pytest.approx(1.75 if made is cube else 1.5, abs=1e-12)


def test_what_has_no_corners(comm):
    """In one dimension, and where opposite faces are one."""
    assert widest(meshes.interval(comm, 0.0, 1.0, 5)) == 1.0
    assert widest(square(comm), periodic=(0, 1)) == 1.0


@pytest.mark.serial
def test_a_request_near_the_meshs_error_is_doubted(comm):
    """Beside a corner the estimate of the mesh's error may see a third of it."""
    for keep, doubted in ((missing_quarter, True), (lambda x: x[0] > -1, False)):
        made = scene(cut(comm, square(comm, 24), keep))
        first = cb.simulate(made, until=0.6, accuracy=0.3).accuracy
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            cb.simulate(made, until=0.6, accuracy=2.5 * first.mesh)
        assert any("interior angle" in str(w.message) for w in told) == doubted
