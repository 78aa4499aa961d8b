"""Meshes: sizes, tags and quality; and the same mesh for every number of ranks."""

import signal
import sys

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

from complexbody import _compat, meshes
from complexbody.errors import MeshError, MissingPackage
from complexbody.meshes import Side

LENGTH, WIDTH, THICKNESS, RADIUS, CENTRE = 2.0, 1.0, 0.1, 0.2, (0.9, 0.5)
SIZE, SIZE_AT_HOLE = 0.1, 0.03
SMALL = (LENGTH, WIDTH, THICKNESS, RADIUS, SIZE, SIZE_AT_HOLE, CENTRE)


def boxes(comm):
    """One uniform mesh per dimension, with cells of size 1/4."""
    yield meshes.interval(comm, 0.0, 2.0, 8)
    yield meshes.rectangle(comm, (0.0, 0.0), (1.0, 2.0), (4, 8))
    yield meshes.box(comm, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 4)


def integral(mesh, measure):
    """∫1 over a measure, of all ranks."""
    form = _compat.form(fem.Constant(mesh, 1.0) * measure)
    return mesh.comm.allreduce(fem.assemble_scalar(form))


def positions(mesh):
    """Nodes of all ranks' own in the order of the mesh's input, shape (nodes, 3)."""
    owned = _compat.node_map(mesh).size_local
    numbers = np.asarray(mesh.geometry.input_global_indices)[:owned]
    parts = mesh.comm.allgather((numbers, mesh.geometry.x[:owned]))
    numbers, points = (np.concatenate(part) for part in zip(*parts, strict=True))
    return points[np.argsort(numbers)]


def everywhere(mesh, values):
    return np.concatenate(mesh.comm.allgather(values))


@pytest.fixture(scope="module")
def plate(comm):
    return meshes.perforated_plate(comm, *SMALL)


def test_boxes_have_the_cells_asked_for_and_no_ghosts(comm):
    for mesh, cells in zip(boxes(comm), (8, 4 * 8 * 2, 4**3 * 6), strict=True):
        owned, local = _compat.cell_count(mesh)
        assert (comm.allreduce(owned), local) == (cells, owned)


def test_altitudes_of_boxes(comm):
    for mesh, shape in zip(boxes(comm), (1.0, np.sqrt(0.5), np.sqrt(0.5)), strict=True):
        assert meshes.altitudes(mesh) == pytest.approx(0.25 * shape)


def test_graded_interval_has_the_sizes_given(comm):
    sizes = np.geomspace(1.0, 30.0, 17)
    mesh = meshes.graded_interval(comm, sizes, start=-3.0)
    assert np.sort(everywhere(mesh, meshes.altitudes(mesh))) == pytest.approx(sizes)
    points = np.sort(positions(mesh)[:, 0])
    assert points == pytest.approx(-3.0 + np.concatenate([[0.0], np.cumsum(sizes)]))


@pytest.mark.parametrize("sizes", [[], [1.0, 0.0], [1.0, -1.0], [np.nan], [[1.0]]])
def test_graded_interval_refuses_cells_without_a_size(comm, sizes):
    with pytest.raises(MeshError, match="positive"):
        meshes.graded_interval(comm, sizes)


def test_jiggled_meshes_are_the_same_on_every_number_of_ranks(comm):
    for many, one in zip(boxes(comm), boxes(MPI.COMM_SELF), strict=True):
        moved = positions(meshes.jiggled(many, 0.24, seed=3))
        assert moved == pytest.approx(positions(meshes.jiggled(one, 0.24, seed=3)), abs=1e-14)


def test_jiggled_moves_the_interior_by_the_amount_and_not_the_boundary(comm):
    for mesh, upper in zip(boxes(comm), ((2.0,), (1.0, 2.0), (1.0,) * 3), strict=True):
        before, dim = positions(mesh), len(upper)
        assert meshes.jiggled(mesh, 0.2) is mesh
        moves = np.abs(positions(mesh) - before)
        inside = np.all((before[:, :dim] > 0.1) & (before[:, :dim] < np.array(upper) - 0.1), axis=1)
        assert np.all(moves[~inside] == 0.0) and np.all(moves[:, dim:] == 0.0)
        # Uniform in ±0.2 of the cells' size, 1/4.
        assert moves[inside].max() <= 0.05 * (1 + 1e-12)
        assert moves[inside, :dim].max() > 0.03 and np.all(moves[inside, :dim] > 0.0)


def test_another_seed_moves_otherwise(comm):
    first, second = (
        positions(meshes.jiggled(meshes.box(comm, (0,) * 3, (1,) * 3, 4), seed=s)) for s in (0, 1)
    )
    assert np.abs(first - second).max() > 0.01


def test_jiggled_refuses_to_turn_cells_over_and_restores_the_mesh(comm):
    for mesh in boxes(comm):
        before = mesh.geometry.x.copy()
        with pytest.raises(MeshError, match="cells would turn over"):
            meshes.jiggled(mesh, 5.0)
        assert np.array_equal(mesh.geometry.x, before)


def test_plate_has_its_volume_and_sides(plate):
    mesh, cell_tags, facet_tags = plate
    hole = np.pi * RADIUS**2
    volume = THICKNESS * (LENGTH * WIDTH - hole)
    dx = ufl.Measure("dx", domain=mesh, subdomain_data=cell_tags)
    assert integral(mesh, dx(1)) == pytest.approx(volume, rel=1e-3)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    areas = {
        Side.LEFT: WIDTH * THICKNESS,
        Side.RIGHT: WIDTH * THICKNESS,
        Side.BOTTOM: LENGTH * THICKNESS,
        Side.TOP: LENGTH * THICKNESS,
        Side.BACK: LENGTH * WIDTH - hole,
        Side.FRONT: LENGTH * WIDTH - hole,
        Side.HOLE: 2 * np.pi * RADIUS * THICKNESS,
    }
    assert list(areas) == [side for side in Side if side != Side.NOTCH]
    for side, area in areas.items():
        assert integral(mesh, ds(int(side))) == pytest.approx(area, rel=2e-3), side


def test_sides_of_the_plate_lie_where_their_names_say(plate):
    mesh, _, facet_tags = plate
    x = ufl.SpatialCoordinate(mesh)
    radius = ufl.sqrt((x[0] - CENTRE[0]) ** 2 + (x[1] - CENTRE[1]) ** 2)
    planes = (x[0], x[0] - LENGTH, x[1], x[1] - WIDTH, x[2], x[2] - THICKNESS)
    away = (*planes, radius - RADIUS)
    ds = ufl.Measure("ds", domain=mesh, subdomain_data=facet_tags)
    sides = [side for side in Side if side != Side.NOTCH]
    for side, distance in zip(sides, away, strict=True):
        form = _compat.form(abs(distance) * ds(int(side)))
        mean = mesh.comm.allreduce(fem.assemble_scalar(form))
        # Chords of the circle lie inside by up to (their length)²/8 of the radius.
        assert mean < (1e-3 if side == Side.HOLE else 1e-9) * THICKNESS


def test_cells_grow_smoothly_from_the_hole(plate):
    mesh = plate[0]
    edges, nodes = meshes._edges(mesh)
    size = np.linalg.norm(edges, axis=2).mean(axis=1)
    middle = mesh.geometry.x[nodes].mean(axis=1)
    distance = np.hypot(*(middle[:, :2] - CENTRE).T) - RADIUS
    size, distance = everywhere(mesh, size), everywhere(mesh, distance)
    wanted = np.minimum(SIZE, SIZE_AT_HOLE + 0.25 * distance)
    for low, high in ((0.0, 0.03), (0.03, 0.1), (0.1, 0.2), (0.2, 0.3), (0.3, 1.2)):
        here = (distance >= low) & (distance < high)
        assert np.median(size[here] / wanted[here]) == pytest.approx(1.1, abs=0.25)


def test_plate_has_no_slivers(plate):
    altitudes = everywhere(plate[0], meshes.altitudes(plate[0]))
    assert altitudes.min() > 0.2 * SIZE_AT_HOLE  # a regular tetrahedron's is 0.82 of its edges
    assert altitudes.max() < 1.5 * SIZE


def test_plate_is_the_same_on_every_number_of_ranks(comm, plate):
    alone = meshes.perforated_plate(MPI.COMM_SELF, *SMALL)[0] if comm.rank == 0 else None
    points = positions(plate[0])
    if alone is not None:
        assert np.array_equal(points, positions(alone))


def test_plate_may_be_of_any_size(comm):
    for unit in (1e-6, 1e3):
        lengths = [unit * v for v in SMALL[:6]]
        mesh, _, _ = meshes.perforated_plate(comm, *lengths)  # the hole in the middle
        every = everywhere(mesh, meshes.altitudes(mesh)) / unit
        assert every.min() > 0.2 * SIZE_AT_HOLE
        points = positions(mesh) / unit
        assert points.max(axis=0) == pytest.approx((LENGTH, WIDTH, THICKNESS))
        middle = np.hypot(points[:, 0] - LENGTH / 2, points[:, 1] - WIDTH / 2)
        assert middle.min() == pytest.approx(RADIUS)


@pytest.mark.parametrize(
    "changes",
    [
        {"centre": (0.1, 0.5)},
        {"centre": (1.0, 0.9)},
        {"radius": 0.5},
        {"radius": 0.0},
        {"thickness": -1.0},
        {"length": np.inf},
        {"size": np.nan},
        {"size_at_hole": 0.2},
        {"growth": 0.0},
    ],
)
def test_impossible_plates_are_refused(comm, changes):
    names = ("length", "width", "thickness", "radius", "size", "size_at_hole", "centre")
    with pytest.raises(MeshError, match="perforated_plate: no hole"):
        meshes.perforated_plate(comm, **{**dict(zip(names, SMALL, strict=True)), **changes})


NOTCHED = {"length": 3.0, "width": 1.2, "notch": 1.1, "opening": 0.03, "size": 0.12,
           "size_at_tip": 0.12 / 80}  # fmt: skip


@pytest.mark.parametrize("thickness", [None, 0.1])
def test_notched_plate(comm, thickness):
    """Volume, sides with their lengths, and cells that grow from the tip by a factor over 64."""
    fine = {} if thickness is None else {"size": 0.2, "size_at_tip": 0.2 / 70}
    given = {**NOTCHED, **fine}
    mesh, cells, facets = meshes.notched_plate(comm, **given, thickness=thickness, growth=0.3)
    deep = 1.0 if thickness is None else thickness
    area = 3.0 * 1.2 - 0.5 * 0.03 * 1.1
    assert integral(mesh, ufl.dx(domain=mesh)) == pytest.approx(area * deep)
    assert np.all(cells.values == 1)
    ds = ufl.ds(domain=mesh, subdomain_data=facets)
    face = np.hypot(1.1, 0.015)
    expected = {Side.LEFT: 1.17, Side.RIGHT: 1.2, Side.BOTTOM: 3.0, Side.TOP: 3.0,
                Side.NOTCH: 2 * face}  # fmt: skip
    for side, length in expected.items():
        assert integral(mesh, ds(int(side))) == pytest.approx(length * deep), side
    if thickness is not None:
        for side in (Side.BACK, Side.FRONT):
            assert integral(mesh, ds(int(side))) == pytest.approx(area)
    sizes = everywhere(mesh, meshes.altitudes(mesh))
    assert sizes.max() / sizes.min() > 64
    owned = _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
    middle = everywhere(mesh, mesh.geometry.x[owned].mean(axis=1))
    distance = np.hypot(middle[:, 0] - 1.1, middle[:, 1] - 0.6)
    wanted = np.minimum(given["size_at_tip"] + 0.3 * distance, given["size"])
    near = np.sort(sizes / wanted)  # an equilateral triangle's altitude is 0.87 of its edge
    assert np.median(near) == pytest.approx(0.75, abs=0.2)


@pytest.mark.parametrize(
    "changes", [{"notch": 3.5}, {"opening": 2.0}, {"size_at_tip": 0.5}, {"width": -1.0},
                {"thickness": 0.0}, {"growth": np.nan}],
)  # fmt: skip
def test_impossible_notches_are_refused(comm, changes):
    with pytest.raises(MeshError, match="notched_plate: no notch"):
        meshes.notched_plate(comm, **{**NOTCHED, **changes})


def test_missing_gmsh_is_told_on_all_ranks(comm, monkeypatch):
    if comm.rank == 0:
        monkeypatch.setitem(sys.modules, "gmsh", None)
    with pytest.raises(MissingPackage, match="apt install python3-gmsh"):
        meshes.perforated_plate(comm, *SMALL)


def test_failure_of_gmsh_is_told_on_all_ranks(comm, monkeypatch):
    def fail(*_):
        raise Exception("no luck")

    if comm.rank == 0:
        monkeypatch.setattr(meshes, "_draw", fail)
    with pytest.raises(MeshError, match="cannot mesh this plate: no luck"):
        meshes.perforated_plate(comm, *SMALL)


def test_gmsh_is_quiet_and_leaves_interrupts_alone(comm, capfd):
    def handler(*_):
        pass

    before = signal.signal(signal.SIGINT, handler)
    try:
        meshes.perforated_plate(comm, *SMALL)
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert capfd.readouterr() == ("", "")


@pytest.mark.serial
def test_a_gmsh_that_is_running_keeps_its_model_and_options(comm):
    gmsh = pytest.importorskip("gmsh")
    before = signal.getsignal(signal.SIGINT)
    gmsh.initialize([], readConfigFiles=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.option.setNumber("Mesh.OptimizeThreshold", 0.125)
        gmsh.model.add("the user's")
        gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
        gmsh.model.occ.synchronize()
        meshes.perforated_plate(comm, *SMALL)
        assert gmsh.model.list() == ["", "the user's"]
        assert gmsh.model.getCurrent() == "the user's"
        assert len(gmsh.model.getEntities(3)) == 1
        assert gmsh.option.getNumber("Mesh.OptimizeThreshold") == 0.125
    finally:
        gmsh.finalize()
        signal.signal(signal.SIGINT, before)
