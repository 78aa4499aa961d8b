# SPDX-License-Identifier: LGPL-3.0-or-later
"""A mesh shared out by weights is the same mesh, its work is even, and results do not change."""

import numpy as np
import pytest
from dolfinx import mesh as dmesh
from harness import refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat, meshes
from complexbody.errors import MeshError
from complexbody.forms import isotropic_two_field
from complexbody.partition import parts
from complexbody.series import in_input_order


def graded(comm, dim=2, cells=24):
    """A square or cube whose cells are much smaller at one corner."""
    make = {2: meshes.rectangle, 3: meshes.box}[dim]
    mesh = make(comm, (0,) * dim, (1,) * dim, cells)
    mesh.geometry.x[:] = mesh.geometry.x**2.5
    return mesh


def imbalance(comm, mesh, weights):
    """Largest sum of weights of a rank over the mean, minus 1."""
    sums = np.array(comm.allgather(weights.sum()))
    return sums.max() / sums.mean() - 1


def tagged(mesh, tags):
    """{midpoint: value} of tagged entities of all ranks, each counted once."""
    count = mesh.topology.index_map(tags.dim).size_local
    mine = tags.indices < count
    if tags.dim == mesh.topology.dim:
        nodes = _compat.cell_nodes(mesh)[tags.indices[mine]]
    else:
        nodes = _compat.facet_nodes(mesh, tags.indices[mine])
    middle = np.round(mesh.geometry.x[nodes].mean(axis=1), 9)
    rows = [(tuple(m), int(v)) for m, v in zip(middle.tolist(), tags.values[mine], strict=True)]
    return sorted(row for part in mesh.comm.allgather(rows) for row in part)


@pytest.mark.parametrize("dim", [2, 3])
def test_same_mesh_with_even_work(comm, dim):
    """Weights are even within a few per cent; points, cells and their numbers stay."""
    old = graded(comm, dim, {2: 24, 3: 9}[dim])
    (new,) = meshes.balanced(old)
    weights = 1.0 / meshes.altitudes(new)
    assert imbalance(comm, new, weights) < 0.05
    if comm.size > 1:
        owned, local = _compat.cell_count(new)
        assert 0 < owned == local
        assert imbalance(comm, new, np.ones(owned)) > 0.2  # even work, not even numbers
    (points, cells), _ = in_input_order(old)
    (same_points, same_cells), _ = in_input_order(new)
    np.testing.assert_array_equal(points, same_points)
    np.testing.assert_array_equal(np.sort(cells, axis=1), np.sort(same_cells, axis=1))


def test_weights_of_ones_own(comm):
    """Any positive weights of this rank's cells, one of them very heavy."""
    old = graded(comm)
    x = old.geometry.x[_compat.cell_nodes(old)[: _compat.cell_count(old)[0]]].mean(axis=1)

    def work(points):
        return 1.0 + 200.0 * (np.linalg.norm(points - 0.5, axis=1) < 0.2)

    (new,) = meshes.balanced(old, work(x))
    x = new.geometry.x[_compat.cell_nodes(new)].mean(axis=1)
    assert imbalance(comm, new, work(x)) < 0.05


@pytest.mark.serial
@pytest.mark.parametrize("count", [2, 3, 7, 16])
def test_parts(count):
    """Any number of parts, of a structured mesh as well: layers of cells can be cut."""
    mesh = meshes.rectangle(MPI.COMM_SELF, (0, 0), (1, 1), 40)
    x = mesh.geometry.x[_compat.cell_nodes(mesh), :2].mean(axis=1)
    weights = 1.0 / (0.1 + x[:, 0] ** 2 + x[:, 1] ** 2)
    found = parts(MPI.COMM_SELF, x, weights, count)
    sums = np.bincount(found, weights, count)
    assert sums.max() / sums.mean() < 1.06
    uniform = np.bincount(parts(MPI.COMM_SELF, x, np.ones(len(x)), count), minlength=count)
    assert uniform.max() <= len(x) / count * 1.01


def test_tags_follow(comm):
    """Cell and facet tags are where they were, also on a mesh with ghost cells."""
    for mode in ("none", "shared_facet"):
        mesh = dmesh.create_unit_cube(comm, 6, 5, 4, ghost_mode=getattr(dmesh.GhostMode, mode))
        mesh.geometry.x[:] = mesh.geometry.x**2
        cells = np.arange(_compat.cell_count(mesh)[1], dtype=np.int32)
        middle = mesh.geometry.x[_compat.cell_nodes(mesh)].mean(axis=1)
        cell_tags = dmesh.meshtags(mesh, 3, cells, (1 + (middle[:, 0] > 0.3)).astype(np.int32))
        facets = _compat.exterior_facets(mesh)
        height = mesh.geometry.x[_compat.facet_nodes(mesh, facets), 2].mean(axis=1)
        facet_tags = dmesh.meshtags(mesh, 2, facets, (3 + (height > 0.2)).astype(np.int32))
        new, new_cells, new_facets = meshes.balanced(mesh, None, cell_tags, facet_tags)
        assert tagged(new, new_cells) == tagged(mesh, cell_tags)
        assert tagged(new, new_facets) == tagged(mesh, facet_tags)
        assert len(tagged(new, new_facets)) == 2 * 2 * (6 * 5 + 5 * 4 + 6 * 4)


def test_results_do_not_change(comm, shared_path):
    """Fields in the order of the input agree to round-off; local steps are shared out evenly."""
    h5py = pytest.importorskip("h5py")
    body, found, uneven = isotropic_two_field(d=2), [], []
    mesh = graded(comm)
    for name in ("old", "new"):
        shape = cb.Initial(u=lambda x: np.cos(np.pi * x[:2]))
        scene = cb.Scene(mesh, body, [cb.Fix("nu", lambda x: x[0] < 1e-9)], initial=shape)
        output = cb.Output(shared_path / name, fields=("u", "steps"))
        result = cb.simulate(scene, cb.LocalLeapfrog(), until=0.05, output=output)
        sets = result.time_sets
        uneven.append(sets.imbalance)
        (mesh,) = meshes.balanced(mesh, sets.window / sets.steps)
        comm.barrier()
        with h5py.File(shared_path / name / "u.h5", locking=False) as file:
            found.append([np.array(file["Function/u/1"]), np.array(file["Mesh/mesh/geometry"])])
        with h5py.File(shared_path / name / "steps.h5", locking=False) as file:
            found[-1].append(np.array(file["Function/h/0"]))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-12)
    if comm.size > 1:
        assert uneven[1] < 0.02 < uneven[0]


def test_refusals(comm):
    """Weights that are none, on one rank, stop all."""
    mesh = graded(comm, 2, 6)
    weights = np.ones(_compat.cell_count(mesh)[0])
    bad = weights.copy()
    if comm.rank == comm.size - 1:
        bad[0] = 0.0
    for wrong in (bad, weights[:-1], weights * np.nan, -weights):
        with refused(MeshError, "weights"):
            meshes.balanced(mesh, wrong)
