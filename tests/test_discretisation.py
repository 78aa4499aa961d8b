# SPDX-License-Identifier: LGPL-3.0-or-later
"""Arrays of a scene: each cell and node once, volumes and masses, orders, meshes that are wrong."""

import re

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from harness import Machine, bent, everywhere, largest, refused, wavy
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat, discretisation, native
from complexbody.discretisation import Discretisation, morton, padded
from complexbody.errors import BodyError, MeshError
from complexbody.masses import Masses

SHAPES = [(37,), (9, 8), (4, 3, 5)]
VOLUMES = [1.0, 1.0, 2.0, 6.0]


def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + U[0, 0] * nu[0] + nu[0] ** 2


def body(density=1.0, **other):
    return cb.Body(1, energy, density, 1.0, displacement=2, **other)


def by_input(mesh, values):
    """Values (geometry nodes, m) of owned nodes by their number in the mesh's input, all ranks."""
    owned = _compat.node_map(mesh).size_local
    numbers = np.asarray(mesh.geometry.input_global_indices)[:owned]
    parts = mesh.comm.allgather((numbers, np.asarray(values)[:owned]))
    numbers, rows = (np.concatenate(p) for p in zip(*parts, strict=True))
    assert len(np.unique(numbers)) == len(numbers)
    return rows[np.argsort(numbers)]


def region_tags(mesh, regions=3):
    """Tags 10, 11, … in stripes, of all local cells."""
    cells = np.arange(_compat.cell_count(mesh)[1], dtype=np.int32)
    middle = np.asarray(mesh.geometry.x)[_compat.cell_nodes(mesh)].mean(axis=1)
    stripe = np.clip((regions * middle[:, 0]).astype(np.int32), 0, regions - 1)
    return dolfinx.mesh.meshtags(mesh, mesh.topology.dim, cells, 10 + stripe)


def regional(mesh, densities=(1.0, 2.0, 3.0)):
    """A scene of one body per stripe."""
    bodies = {10 + i: body(rho) for i, rho in enumerate(densities)}
    return cb.Scene(mesh, bodies, cell_tags=region_tags(mesh, len(densities)))


def test_padded():
    sizes = {1: 1, 2: 2, 3: 4, 4: 4, 5: 8, 8: 8, 9: 16, 16: 16, 17: 24}
    assert {n: padded(n) for n in sizes} == sizes


def test_morton_keys():
    """On a 2^p grid the curve visits quadrants recursively: bit interleaving, x first."""
    axis = np.arange(4.0)
    grid = np.array([(x, y) for y in axis for x in axis])
    order = np.argsort(morton(grid))
    expected = [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (3, 0), (2, 1), (3, 1)]
    assert [tuple(p) for p in grid[order][:8]] == expected
    cube = np.array([(x, y, z) for z in (0.0, 1) for y in (0.0, 1) for x in (0.0, 1)])
    assert np.array_equal(np.argsort(morton(cube)), np.arange(8))
    assert np.array_equal(np.argsort(morton(axis[:, None])), np.arange(4))
    assert len(morton(np.zeros((0, 3)))) == 0
    assert np.array_equal(morton(np.ones((3, 2))), [0, 0, 0])


@pytest.mark.parametrize("ghosts", [False, True])
@pytest.mark.parametrize("cells", SHAPES)
def test_every_cell_and_node_once(comm, cells, ghosts):
    mesh = bent(comm, cells, ghosts)
    scene = regional(mesh)
    disc = Discretisation(scene)
    owned, d = _compat.cell_count(mesh)[0], len(cells)
    real = disc.source_cell >= 0
    assert everywhere(comm, np.array_equal(np.sort(disc.source_cell[real]), np.arange(owned)))
    # Nodes of each cell, in dolfinx's order; padding points behind the last node.
    nodes = disc.cells.transpose(0, 2, 1)
    table = _compat.cell_nodes(mesh)
    assert np.array_equal(disc.dof[nodes[real]], table[disc.source_cell[real]])
    assert np.all(nodes[~real] == disc.nodes)
    assert np.all(np.argsort(~real, axis=1, kind="stable") == np.arange(disc.lanes))  # at ends
    assert np.array_equal(np.sort(disc.dof), np.unique(table[:owned]))
    assert np.array_equal(disc.number[disc.dof], np.arange(disc.nodes))
    assert np.array_equal(disc.position[:-1], mesh.geometry.x[disc.dof])
    assert comm.allreduce(int(disc.owned.sum())) == _compat.node_map(mesh).size_global
    assert np.array_equal(disc.region[:, None] * real, scene.regions()[disc.source_cell] * real)
    # Gradients of the shape functions, scaled by the root of the volume.
    x = mesh.geometry.x[table[disc.source_cell[real]], :d]
    B = disc.geometry.transpose(0, 2, 1)[real]
    volume = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / VOLUMES[d]
    np.testing.assert_allclose(B[:, -1] ** 2, volume, rtol=1e-12)
    products = np.einsum("maj,mbj->mab", B[:, :-1].reshape(-1, d, d), x[:, 1:] - x[:, :1])
    expected = np.eye(d) * B[:, -1, None, None]
    np.testing.assert_allclose(products, expected, atol=1e-12)
    assert not disc.geometry.transpose(0, 2, 1)[~real].any()
    assert disc.geometry.ctypes.data % 64 == 0
    disc.halo.close()


@pytest.mark.parametrize("groups", [1, 3])
@pytest.mark.parametrize("cells", SHAPES)
def test_order_of_cells(comm, cells, groups):
    """Cells at shared nodes first, then by region, by group, and along the Morton curve."""
    mesh = bent(comm, cells)
    group = _compat.original_cells(mesh)[: _compat.cell_count(mesh)[0]] % groups
    disc = Discretisation(regional(mesh), group=None if groups == 1 else group)
    real = disc.source_cell >= 0
    assert disc.count == real.sum() == _compat.cell_count(mesh)[0]
    assert np.array_equal(disc.group[:, None] * real, group[disc.source_cell] * real)
    nodes = disc.cells.transpose(0, 2, 1)
    at_shared = ((nodes >= disc.late) & (nodes < disc.late + disc.shared)).any(axis=2)
    per_block = [set(at_shared[b][real[b]]) for b in range(disc.blocks)]
    assert all(len(s) == 1 for s in per_block)
    edge = np.array([s.pop() for s in per_block], bool)
    assert np.array_equal(edge, np.arange(disc.blocks) < disc.boundary_blocks)
    key = morton(disc.position[:, : len(cells)][nodes].mean(axis=2)[real])
    where = np.repeat(np.arange(disc.blocks), real.sum(axis=1))
    runs = np.stack([~edge[where], disc.region[where], disc.group[where], key], axis=1)
    assert runs.tolist() == sorted(runs.tolist())
    # Blocks are full but where a run ends.
    label = np.stack([~edge, disc.region, disc.group], axis=1)
    ends = np.any(np.diff(label, axis=0, append=-1) != 0, axis=1)
    assert np.all(ends | real.all(axis=1))
    disc.halo.close()


@pytest.mark.parametrize("late", [False, True])
def test_chunks(comm, monkeypatch, late):
    """No node is finished before its last cell, and none later than it could be."""
    monkeypatch.setattr(discretisation, "BLOCKS_PER_CHUNK", 2)
    mesh = bent(comm, (9, 8))
    x = mesh.geometry.x
    apart = np.flatnonzero(x[:, 0] < 0.3).astype(np.int32) if late else None
    disc = Discretisation(regional(mesh), apart)
    first, last, region, done = disc.chunks.T
    assert first[0] == 0 and last[-1] == disc.blocks
    assert np.array_equal(first[1:], last[:-1])
    assert np.all((last > first) & (last <= first + 2))
    for row in range(len(disc.chunks)):
        assert np.all(disc.region[first[row] : last[row]] == region[row])
    ends_with = np.zeros(disc.nodes + 1, int)
    for block in range(disc.blocks):
        ends_with[disc.cells[block].ravel()] = block
    expected = [np.sum(ends_with[: disc.late] < end) for end in last]
    assert np.array_equal(done, expected) and done[-1] == disc.late
    for row in range(len(disc.chunks)):
        assert np.all(ends_with[: done[row]] < last[row])
    # Cells at shared nodes are all in the boundary chunks, and no others.
    shared = np.zeros(disc.nodes + 1, bool)
    shared[disc.late : disc.late + disc.shared] = True
    touching = [bool(shared[disc.cells[a:b]].any()) for a, b in zip(first, last, strict=True)]
    assert touching == [row < disc.boundary_chunks for row in range(len(disc.chunks))]
    # Late nodes: shared ones first, then those asked for; no others.
    rest = set(disc.dof[disc.late + disc.shared :])
    used = set(disc.dof)
    wanted = used & set(apart) if late else set()
    assert rest == wanted - set(disc.dof[disc.late : disc.late + disc.shared])
    disc.halo.close()


@pytest.mark.parametrize("cells", SHAPES)
def test_volumes(comm, cells):
    """Of nodes and regions: equal to dolfinx's ∫N_a dx over each tag."""
    mesh = bent(comm, cells)
    scene = regional(mesh)
    disc = Discretisation(scene)
    v = ufl.TestFunction(_compat.vector_space(mesh, 1))
    dx = ufl.dx(domain=mesh, subdomain_data=scene.cell_tags)
    for region, tag in enumerate((10, 11, 12)):
        function = fem.Function(_compat.vector_space(mesh, 1))
        fem.assemble_vector(function.x.array, _compat.form(v[0] * dx(tag)))
        _compat.accumulate(function)
        found = disc.region_volume[:, region]
        np.testing.assert_allclose(found, function.x.array[disc.dof], rtol=1e-13, atol=1e-16)
    np.testing.assert_array_equal(disc.volume, disc.region_volume.sum(axis=1))
    disc.halo.close()


def total_mass(disc):
    """Σ_a m_a over the body, from the classes that integrators use."""
    masses = Masses(disc, np.zeros((disc.nodes, disc.n), bool))
    m = masses.density[masses.classes[:-1]] * disc.volume
    return disc.comm.allreduce(m[disc.owned].sum())


@pytest.mark.parametrize("cells", SHAPES)
def test_total_mass(comm, cells):
    """∫ρ dx for a number, numbers by region, and a DG0 function: the same on one rank."""
    found = []
    for which in (comm, MPI.COMM_SELF):
        mesh = bent(which, cells)
        cellwise = fem.Function(_compat.cell_space(mesh))
        # P0 values of a position: the midpoint's.
        cellwise.interpolate(lambda x: 1.5 + np.sin(4 * x[0] + x[1] - x[2]))
        cellwise.x.scatter_forward()
        scenes = [cb.Scene(mesh, body(7.0)), regional(mesh, (1.0, 2.0, 5.0))]
        scenes.append(cb.Scene(mesh, body(cellwise)))
        row = []
        for scene in scenes:
            disc = Discretisation(scene)
            row.append(total_mass(disc))
            disc.halo.close()
        tags = scenes[1].cell_tags
        dx = ufl.dx(domain=mesh, subdomain_data=tags)
        one = fem.Constant(mesh, 1.0)
        forms = [7 * one * dx, one * dx(10) + 2 * one * dx(11) + 5 * one * dx(12), cellwise * dx]
        exact = [which.allreduce(fem.assemble_scalar(_compat.form(form))) for form in forms]
        assert row == pytest.approx(exact, rel=1e-14)
        found.append(row)
    assert found[0] == pytest.approx(found[1], rel=1e-14)


def test_cellwise_density_at_nodes(comm):
    """ρ_a averages the cells around a node by volume, over all ranks, mixed with numbers."""
    mesh = bent(comm, (9, 8))
    cellwise = fem.Function(_compat.cell_space(mesh))
    cellwise.interpolate(lambda x: 1.5 + np.sin(4 * x[0] + x[1]))
    scene = cb.Scene(
        mesh, {10: body(cellwise), 11: body(4.0), 12: body(0.5)}, cell_tags=region_tags(mesh)
    )
    disc = Discretisation(scene)
    v = ufl.TestFunction(_compat.vector_space(mesh, 1))
    dx = ufl.dx(domain=mesh, subdomain_data=scene.cell_tags)
    function = fem.Function(_compat.vector_space(mesh, 1))
    form = cellwise * v[0] * dx(10) + 4.0 * v[0] * dx(11) + 0.5 * v[0] * dx(12)
    fem.assemble_vector(function.x.array, _compat.form(form))
    _compat.accumulate(function)
    expected = function.x.array[disc.dof]
    np.testing.assert_allclose(disc.density() * disc.volume, expected, rtol=1e-13)
    disc.halo.close()


def test_density_functions_that_are_none(comm):
    mesh = bent(comm, (9, 8))
    linear = fem.Function(_compat.vector_space(mesh, 1))
    linear.x.array[:] = 1.0
    hole = fem.Function(_compat.cell_space(mesh))
    hole.x.array[:] = 1.0
    last = comm.size - 1
    if comm.rank == last:
        hole.x.array[0] = -1.0
    gap = fem.Function(_compat.cell_space(mesh))
    gap.x.array[:] = 1.0
    if comm.rank == last:
        gap.x.array[0] = np.nan
    for density, word in ((linear, "piecewise constant"), (hole, "positive"), (gap, "positive")):
        disc = Discretisation(cb.Scene(mesh, body(density)))
        with refused(BodyError, "density", word):
            disc.density()
        disc.halo.close()


@pytest.mark.parametrize("lanes", [4, 8])
def test_same_forces_for_every_partition(comm, monkeypatch, lanes):
    """Ghost cells or none, one rank or many: by the input's numbers of nodes."""
    monkeypatch.setattr(native, "lanes", lambda: lanes)
    results = []
    for which, ghosts in ((comm, False), (comm, True), (MPI.COMM_SELF, False)):
        mesh = bent(which, (9, 8), ghosts)
        machine = Machine(mesh, body())
        machine.set(wavy(mesh, 3))
        forces = fem.Function(machine.action.space)
        machine.disc.scatter(machine.forces(), forces)
        results.append(by_input(mesh, forces.x.array.reshape(-1, 3)))
        # Ghost nodes hold their owners' values.
        copy = forces.x.array.copy()
        forces.x.scatter_forward()
        assert np.array_equal(copy, forces.x.array)
        assert np.array_equal(machine.disc.gather(forces.x.array.reshape(-1, 3)), machine.forces())
        machine.close()
    scale = np.abs(results[0]).max()
    for other in results[1:]:
        assert largest(comm, other - results[0]) < 1e-13 * scale


def test_cell_values_and_nodal_average(comm):
    mesh = bent(comm, (4, 3, 5))
    disc = Discretisation(cb.Scene(mesh, body()))
    owned = _compat.cell_count(mesh)[0]
    values = np.stack([np.arange(owned) + 1.0, -np.arange(owned)], axis=1)
    blocks = disc.cell_values(values).transpose(0, 2, 1)
    real = disc.source_cell >= 0
    assert np.array_equal(blocks[real], values[disc.source_cell[real]])
    assert not blocks[~real].any()
    np.testing.assert_allclose(disc.nodal_average(np.full(owned, 3.5)), 3.5, rtol=1e-14)
    middle = mesh.geometry.x[_compat.cell_nodes(mesh)[:owned]].mean(axis=1)[:, 0]
    average = disc.nodal_average(middle)
    whole = comm.allreduce((average * disc.volume)[disc.owned].sum())
    volume = disc.geometry[:, -1, :] ** 2
    first_moment = comm.allreduce((disc.cell_values(middle[:, None])[:, 0, :] * volume).sum())
    assert whole == pytest.approx(first_moment, rel=1e-13)
    assert everywhere(comm, np.all(np.abs(average - disc.position[:-1, 0]) < 0.4))
    disc.halo.close()


def corners_of(cells, number):
    """Input numbers of the vertices of the input's cell ``number``, and its midpoint."""
    mesh = bent(MPI.COMM_SELF, cells)
    row = int(np.flatnonzero(_compat.original_cells(mesh) == number)[0])
    nodes = _compat.cell_nodes(mesh)[row]
    return np.asarray(mesh.geometry.input_global_indices)[nodes], mesh.geometry.x[nodes]


def moved(comm, cells, vertex, position):
    """The mesh with one vertex, by its input number, elsewhere: on every rank that has it."""
    mesh = bent(comm, cells)
    here = np.asarray(mesh.geometry.input_global_indices) == vertex
    mesh.geometry.x[here] = position
    return mesh


@pytest.mark.parametrize("cells, number", [((37,), 20), ((9, 8), 77), ((4, 3, 5), 201)])
def test_flat_cell(comm, cells, number):
    """Named by the number the user's input gave it, on every rank."""
    vertices, x = corners_of(cells, number)
    # Onto the opposite facet: this cell is flat, its neighbours may turn over, which is no harm.
    mesh = moved(comm, cells, vertices[0], x[1:].mean(axis=0))
    with refused(MeshError, f"cell {number} ", "flat"):
        Discretisation(cb.Scene(mesh, body()))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_coordinates_that_are_no_numbers(comm, value):
    vertices, x = corners_of((9, 8), 77)
    broken = x[0].copy()
    broken[1] = value
    mesh = moved(comm, (9, 8), vertices[0], broken)
    with refused(MeshError, "non-finite") as told:
        Discretisation(cb.Scene(mesh, body()))
    alone = bent(MPI.COMM_SELF, (9, 8))
    numbers = np.asarray(alone.geometry.input_global_indices)[_compat.cell_nodes(alone)]
    around = _compat.original_cells(alone)[(numbers == vertices[0]).any(axis=1)]
    assert int(re.search(r"cell (\d+)", told[0])[1]) in around


def test_sliver(comm):
    """Thin cells are the user's business: 1e-7 of their size is enough to stand."""
    vertices, x = corners_of((9, 8), 77)
    base = x[1:].mean(axis=0)
    mesh = moved(comm, (9, 8), vertices[0], base + 1e-7 * (x[0] - base))
    disc = Discretisation(cb.Scene(mesh, body()))
    smallest = comm.allreduce(disc.geometry[:, -1, :][disc.source_cell >= 0].min() ** 2, MPI.MIN)
    edges = x[1:] - x[:1]
    area = 0.5 * abs(np.linalg.det(edges[:, :2]))
    assert smallest == pytest.approx(1e-7 * area, rel=1e-6)
    disc.halo.close()
