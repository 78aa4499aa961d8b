# SPDX-License-Identifier: LGPL-3.0-or-later
"""Supports and loads: what they select, what they prescribe, and exact totals of forces."""

import dolfinx
import numpy as np
import pytest
import ufl
from harness import everywhere, refused, wavy
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat, boundary, loading
from complexbody.action import Action
from complexbody.errors import SceneError

SIZE = (2.0, 1.0, 0.5)
LEFT, RIGHT, INSIDE, ABSENT = 1, 2, 3, 9


def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + ufl.inner(nu, nu)


BODY = cb.Body(2, energy, 1.0, 1.0)


def box(comm, dim=3, ghosts=False, shear=0.0):
    """The box of SIZE, its points moved by x += shear·y (or z in three dimensions)."""
    mode = getattr(dolfinx.mesh.GhostMode, "shared_facet" if ghosts else "none")
    corners, cells = [np.zeros(dim), np.array(SIZE[:dim])], [4, 3, 3][:dim]
    if dim == 1:
        mesh = dolfinx.mesh.create_interval(comm, 8, [0.0, SIZE[0]], ghost_mode=mode)
    elif dim == 2:
        mesh = dolfinx.mesh.create_rectangle(comm, corners, cells, ghost_mode=mode)
    else:
        mesh = dolfinx.mesh.create_box(comm, corners, cells, ghost_mode=mode)
    if shear:
        mesh.geometry.x[:, 0] += shear * mesh.geometry.x[:, dim - 1]
    return mesh


def facet_tags(mesh):
    """Tags of the facets at x = 0, x = 2 and x = 1 (inside) of an unsheared box."""
    dim = mesh.topology.dim - 1
    groups = [
        dolfinx.mesh.locate_entities(mesh, dim, lambda x, at=at: np.isclose(x[0], at))
        for at in (0.0, SIZE[0], SIZE[0] / 2)
    ]
    facets = np.concatenate(groups).astype(np.int32)
    values = np.repeat(np.array([LEFT, RIGHT, INSIDE], np.int32), [len(g) for g in groups])
    order = np.argsort(facets)
    return dolfinx.mesh.meshtags(mesh, dim, facets[order], values[order])


def cell_tags(mesh):
    """Tag 1 where x < 1, else 2."""
    cells = np.arange(_compat.cell_count(mesh)[1], dtype=np.int32)
    middle = mesh.geometry.x[_compat.cell_nodes(mesh)].mean(axis=1)[:, 0]
    values = np.where(middle < 1.0, 1, 2).astype(np.int32)
    return dolfinx.mesh.meshtags(mesh, mesh.topology.dim, cells, values)


def supports(mesh, *fixes, tags=None):
    scene = cb.Scene(mesh, BODY, supports=fixes, facet_tags=tags)
    return boundary.supports(scene, Action(scene))


def loads(mesh, *given, tags=None, cells=None, body=BODY):
    scene = cb.Scene(mesh, body, loads=given, facet_tags=tags, cell_tags=cells)
    return loading.loads(scene, Action(scene))


def total(mesh, found, components=5, times=(0.0,)):
    """Resultant over all ranks at the given times, shape (times, components)."""
    out = np.zeros((len(times), components))
    amplitude = found.amplitudes(np.asarray(times))
    for row in range(len(times)):
        forces = amplitude[row, found.group] * found.value
        out[row] = np.bincount(found.component, forces, components)
    return mesh.comm.allreduce(out)


# --- supports ------------------------------------------------------------------------------------


@pytest.mark.parametrize("ghosts", [False, True])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_what_supports_select(comm, dim, ghosts):
    """Every copy of a node, also on ranks that have no facet there."""
    mesh = box(comm, dim, ghosts)
    tags, x = facet_tags(mesh), mesh.geometry.x
    left, right, middle = (np.isclose(x[:, 0], at) for at in (0.0, 2.0, 1.0))
    edge = np.zeros(len(x), bool)
    for axis in range(dim):
        edge |= np.isclose(x[:, axis], 0.0) | np.isclose(x[:, axis], SIZE[axis])
    for where, expected in (
        (LEFT, left),
        ((LEFT, RIGHT), left | right),
        ([INSIDE], middle),
        ("boundary", edge),
        (lambda x: x[0] < 1e-9, left),
        (lambda x: np.isclose(x[0], 1.0), middle),
    ):
        for field, columns in (("u", [0, 1, 2]), ("nu", [3, 4])):
            found = supports(mesh, cb.Fix(field, where), tags=tags)
            mask = np.zeros((len(x), 5), bool)
            mask[np.ix_(expected, columns)] = True
            assert everywhere(comm, np.array_equal(found.fixed, mask))
            assert not found.moving.any() and not found.value.any()


def test_components_and_values(comm):
    """Numbers, one per component, and functions of the position; several supports at a node."""
    mesh = box(comm)
    x = mesh.geometry.x
    left = x[:, 0] < 1e-9
    found = supports(
        mesh,
        cb.Fix("u", lambda x: x[0] < 1e-9, value=(1.0, 2.0), components=(2, 0)),
        cb.Fix("nu", lambda x: x[0] < 1e-9, value=lambda x: [x[1], 3 * x[2]]),
        cb.Fix("u", "boundary", value=lambda x: x[1] - 7, components=1),
        cb.Fix("nu", lambda x: x[0] > 2 - 1e-9, value=4.0),
    )
    expected = np.zeros((len(x), 5))
    expected[left, 2], expected[left, 0] = 1.0, 2.0
    expected[left, 3:] = np.stack([x[:, 1], 3 * x[:, 2]], axis=1)[left]
    edge = np.any(np.isclose(x, 0) | np.isclose(x, SIZE), axis=1)
    expected[edge, 1] = x[edge, 1] - 7
    expected[x[:, 0] > 2 - 1e-9, 3:] = 4.0
    np.testing.assert_array_equal(found.value, expected)
    assert np.array_equal(found.fixed[:, 0], left) and np.array_equal(found.fixed[:, 2], left)
    assert np.array_equal(found.fixed[:, 1], edge)
    rows, columns = np.nonzero(found.fixed)
    assert np.array_equal(found.targets(rows, columns, 3.0), expected[rows, columns])


def test_histories_of_supports(comm):
    """Moving parts only where a history says so; equal histories are one."""
    mesh = box(comm)
    found = supports(
        mesh,
        cb.Fix("u", lambda x: x[0] < 1e-9, value=(2.0, 0.0, 1.0), history=cb.sine(0.25)),
        cb.Fix("nu", lambda x: x[0] < 1e-9, value=5.0, history=cb.sine(0.25), components=1),
        cb.Fix("nu", lambda x: x[0] > 2 - 1e-9, value=3.0, history=cb.ramp(2.0)),
        cb.Fix("u", lambda x: x[0] > 2 - 1e-9, value=6.0),
    )
    x = mesh.geometry.x
    left, right = x[:, 0] < 1e-9, x[:, 0] > 2 - 1e-9
    assert len(found.histories) == 3
    moving = np.zeros((len(x), 5), bool)
    moving[np.ix_(left, [0, 1, 2, 4])] = moving[np.ix_(right, [3, 4])] = True
    assert np.array_equal(found.moving, moving)
    rows, columns = np.nonzero(found.fixed)
    state = np.zeros((len(x), 5))
    state[rows, columns] = found.targets(rows, columns, 1.0)
    expected = np.zeros((len(x), 5))
    expected[left] = [2.0, 0.0, 1.0, 0.0, 5.0]  # sin(π/2) = 1
    expected[right] = [6.0, 6.0, 6.0, 1.5, 1.5]  # half way up
    np.testing.assert_allclose(state, expected, atol=1e-15)


def test_supports_that_overlap(comm):
    """May, if they say the same; a corner with two values is named, on all ranks."""
    mesh = box(comm)
    same = supports(
        mesh,
        cb.Fix("u", lambda x: x[0] < 1e-9, value=1.0),
        cb.Fix("u", lambda x: x[1] < 1e-9, value=lambda x: 1.0 + 0 * x),
    )
    assert same.fixed.any() or comm.size > 1
    clash = [cb.Fix("u", lambda x: x[0] < 1e-9, value=1.0), cb.Fix("u", lambda x: x[1] < 1e-9)]
    with refused(SceneError, "'u'", "different values", "[0.0, 0.0,"):
        supports(mesh, *clash)
    with refused(SceneError, "different values"):  # in time only
        supports(
            mesh,
            cb.Fix("u", lambda x: x[0] < 1e-9, value=1.0),
            cb.Fix("u", lambda x: x[1] < 1e-9, value=1.0, history=cb.sine(1.0)),
        )
    # Different components do not clash.
    supports(
        mesh,
        cb.Fix("u", lambda x: x[0] < 1e-9, value=1.0, components=0),
        cb.Fix("u", lambda x: x[1] < 1e-9, value=2.0, components=(1, 2)),
    )


def _on_last_rank(comm, function, rows=()):
    """A callable that works but on the last rank, where it calls ``function``."""
    last = comm.rank == comm.size - 1
    return lambda x: function(x) if last else np.zeros((*rows, x.shape[1]), bool)


def _two_nodes(x):
    """The ends of an edge of the box."""
    z = np.minimum(np.abs(x[2]), np.abs(x[2] - SIZE[2]))
    return np.abs(x[0]) + np.abs(x[1]) + z < 1e-9


def _fail(x):
    raise RuntimeError("no such luck")


@pytest.mark.parametrize(
    "fix, words",
    [
        (lambda c: cb.Fix("u", lambda x: x[0] < -5.0), ("Fix('u'", "selects no node")),
        (lambda c: cb.Fix("nu", lambda x: 1 * (x[0] > -9.0)), ()),  # 0 and 1 are fine
        (
            lambda c: cb.Fix("nu", _on_last_rank(c, lambda x: x[0])),
            ("Fix('nu')", "float64, no truth values"),
        ),
        (
            lambda c: cb.Fix("nu", lambda x: np.zeros((2, 2), bool)),
            ("Fix('nu')", "predicate", "(2, 2)"),
        ),
        (
            lambda c: cb.Fix("u", _on_last_rank(c, _fail)),
            ("Fix('u')", "predicate", "RuntimeError: no such luck"),
        ),
        (
            lambda c: cb.Fix("u", _on_last_rank(c, lambda x: x)),
            ("Fix('u')", "predicate", "shape (3, "),
        ),
        (
            lambda c: cb.Fix("u", "boundary", value=_on_last_rank(c, _fail)),
            ("Fix('u')", "value", "RuntimeError: no such luck"),
        ),
        (
            lambda c: cb.Fix("nu", "boundary", value=_on_last_rank(c, lambda x: x[0] * np.nan)),
            ("Fix('nu')", "2 finite"),
        ),
        (lambda c: cb.Fix("nu", "boundary", value=(1.0, 2.0, 3.0)), ("Fix('nu')", "2 finite")),
        (lambda c: cb.Fix("nu", "boundary", value="much"), ("Fix('nu')", "much")),
        (lambda c: cb.Fix("nu", "boundary", components=2), ("Fix('nu')", "components=2", "has 2")),
        (lambda c: cb.Fix("u", "boundary", components=(-1, 0)), ("Fix('u')", "(-1, 0)")),
        (lambda c: cb.Fix("u", "boundary", components=0.5), ("Fix('u')", "0.5")),
        (lambda c: cb.Fix("u", "boundary", components=()), ("Fix('u')", "()")),
        *(
            (lambda c, given=given: cb.Fix("u", "boundary", components=given), ("each once",))
            for given in ((0, 0), [[0]], True, [False], np.array([[0, 1]]))
        ),
        (lambda c: cb.Fix("nu", "boundary", value=lambda x: x[:1]), ("Fix('nu')", "2 finite")),
        (lambda c: cb.Fix("nu", "boundary", value=[[1.0, 2.0]]), ("Fix('nu')", "2 finite")),
        # As many nodes as components: not a number for each node by chance.
        (lambda c: cb.Fix("nu", _two_nodes, value=lambda x: (1.0, 2.0)), ("Fix('nu')", "2 finite")),
    ],
)
def test_supports_that_fail(comm, fix, words):
    """Wherever it goes wrong, all ranks hear of it."""
    mesh = box(comm)
    if not words:
        assert everywhere(comm, supports(mesh, fix(comm)).fixed[:, 3].sum() > 0)
        return
    with refused(SceneError, *words):
        supports(mesh, fix(comm))


# --- loads ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ghosts", [False, True])
def test_totals_of_tractions(comm, ghosts):
    """Area times t, however the facets are chosen; P1 loads are integrated exactly."""
    mesh = box(comm, ghosts=ghosts)
    tags, area = facet_tags(mesh), SIZE[1] * SIZE[2]
    t = np.array([1.0, -2.0, 3.0])
    for where in (RIGHT, [RIGHT], (RIGHT, INSIDE), lambda x: x[0] > 2 - 1e-9):
        found = loads(mesh, cb.Traction(where, tuple(t)), tags=tags)
        assert total(mesh, found)[0] == pytest.approx([*(t * area), 0, 0], rel=1e-13, abs=1e-15)
    both = total(mesh, loads(mesh, cb.Traction((LEFT, RIGHT), tuple(t)), tags=tags))[0]
    assert both[:3] == pytest.approx(2 * t * area, rel=1e-13)
    surface = 2 * (SIZE[0] * SIZE[1] + SIZE[1] * SIZE[2] + SIZE[0] * SIZE[2])
    whole = total(mesh, loads(mesh, cb.Traction("boundary", tuple(t))))[0]
    assert whole[:3] == pytest.approx(t * surface, rel=1e-13)
    # ∫ (y, 2z, 1) over the face
    found = loads(mesh, cb.Traction(RIGHT, lambda x: [x[1], 2 * x[2], 1 + 0 * x[0]]), tags=tags)
    expected = [area / 2 * SIZE[1], area * SIZE[2], area]
    assert total(mesh, found)[0][:3] == pytest.approx(expected, rel=1e-13)
    # A facet is loaded if the predicate holds at all its vertices: two thirds of the face.
    found = loads(mesh, cb.Traction(lambda x: (x[0] > 2 - 1e-9) & (x[1] < 0.7), tuple(t)))
    assert total(mesh, found)[0][:3] == pytest.approx(t * area * 2 / 3, rel=1e-13)
    # Forces sit where the load is.
    x = mesh.geometry.x[found.node]
    assert everywhere(comm, np.all((x[:, 0] > 2 - 1e-9) & (x[:, 1] < 0.7)))


def test_microtraction(comm):
    """On ν's components, one number each."""
    mesh = box(comm)
    found = loads(mesh, cb.Traction(RIGHT, (4.0, -1.0), field="nu"), tags=facet_tags(mesh))
    assert total(mesh, found)[0] == pytest.approx([0, 0, 0, 2.0, -0.5], rel=1e-13, abs=0)
    found = loads(mesh, cb.BodyForce((4.0, -1.0), field="nu"))
    assert total(mesh, found)[0] == pytest.approx([0, 0, 0, 4.0, -1.0], rel=1e-13, abs=0)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_pressure(comm, dim):
    """−p n on an inclined face; a closed surface bears no resultant."""
    shear, p = (0.4 if dim > 1 else 0.0), 3.0
    mesh = box(comm, dim, shear=shear)
    face = lambda x: np.isclose(x[0], SIZE[0] + shear * x[dim - 1])  # noqa: E731
    other = float(np.prod(SIZE[1:dim]))
    expected = np.zeros(5)
    expected[0] = -p * other
    if dim > 1:
        expected[dim - 1] = p * shear * other
    found = total(mesh, loads(mesh, cb.Pressure(face, p)))[0]
    assert found == pytest.approx(expected, rel=1e-13, abs=1e-15)
    closed = total(mesh, loads(mesh, cb.Pressure("boundary", p)))[0]
    assert closed == pytest.approx(np.zeros(5), abs=1e-14)
    assert comm.allreduce(len(loads(mesh, cb.Pressure("boundary", p)).value)) > 0


def test_pressure_acts_along_the_normal_of_each_facet(comm):
    """On a plane body with fewer components of u than dimensions, the ones it has."""
    mesh = box(comm, 2, shear=0.4)
    scalar = cb.Body(1, energy, 1.0, 1.0, displacement=1)
    face = lambda x: np.isclose(x[0], SIZE[0] + 0.4 * x[1])  # noqa: E731
    found = loads(mesh, cb.Pressure(face, 3.0), body=scalar)
    assert total(mesh, found, 2)[0] == pytest.approx([-3.0, 0.0], rel=1e-13)


def test_body_forces(comm):
    """Volume times b, everywhere, on one tag, on two; functions of the position."""
    mesh = box(comm)
    cells, volume = cell_tags(mesh), float(np.prod(SIZE))
    b = np.array([0.5, 0.0, -9.81])
    for where, part in ((None, 1.0), (1, 0.5), (2, 0.5), ((1, 2), 1.0), ([2], 0.5)):
        found = loads(mesh, cb.BodyForce(tuple(b), where=where), cells=cells)
        assert total(mesh, found)[0][:3] == pytest.approx(b * volume * part, rel=1e-13)
    found = loads(mesh, cb.BodyForce(lambda x: [x[0], x[1], 0 * x[0]], where=1), cells=cells)
    expected = [0.5 * volume / 2, 0.5 * volume / 2, 0.0]
    assert total(mesh, found)[0][:3] == pytest.approx(expected, rel=1e-13, abs=1e-16)


def test_histories_of_loads(comm):
    """Each group by its own factor; equal histories share one."""
    mesh = box(comm)
    found = loads(
        mesh,
        cb.Traction(lambda x: x[0] > 2 - 1e-9, (2.0, 0.0, 0.0), cb.sine(0.25)),
        cb.BodyForce((0.0, 3.0, 0.0)),
        cb.Pressure(lambda x: x[2] < 1e-9, 1.0, cb.sine(0.25)),
        cb.BodyForce((0.0, 0.0, 5.0), cb.step(0.5)),
    )
    assert len(found.histories) == 3
    result = total(mesh, found, times=(0.0, 1.0))
    assert result[0] == pytest.approx([0, 3, 0, 0, 0], abs=1e-14)
    assert result[1] == pytest.approx([1, 3, 2 + 5, 0, 0], abs=1e-13)
    nothing = loads(mesh)
    assert nothing.amplitudes(np.zeros(3)).shape == (3, 1) and len(nothing.value) == 0


def test_forces_do_not_depend_on_the_ranks(comm):
    """Nodal forces of all loads together, by the input's numbers of nodes."""
    results = []
    for which in (comm, MPI.COMM_SELF):
        mesh = box(which)
        mesh.geometry.x[:] += 0.01 * wavy(mesh, 3)
        found = loads(
            mesh,
            cb.Traction("boundary", lambda x: [x[1], x[0], x[2]]),
            cb.Pressure("boundary", 2.0),
            cb.BodyForce((1.0, 2.0), field="nu", where=2),
            cells=cell_tags(mesh),
        )
        node = np.asarray(mesh.geometry.input_global_indices)[found.node]
        count = _compat.node_map(mesh).size_global
        forces = np.bincount(5 * node + found.component, found.value, 5 * count)
        results.append(which.allreduce(forces))
    assert everywhere(comm, np.abs(results[1]).max() > 0.1)
    np.testing.assert_allclose(results[0], results[1], atol=1e-14)


@pytest.mark.parametrize(
    "load, words",
    [
        (lambda c: cb.Traction(lambda x: x[0] < -5, (0, 0, 1)), ("Traction", "no boundary facet")),
        (lambda c: cb.Pressure(lambda x: x[0] < -5, 1.0), ("Pressure", "no boundary facet")),
        (lambda c: cb.Traction(INSIDE, (0, 0, 1)), ("Traction", "3", "no boundary facet")),
        (lambda c: cb.Traction("boundary", (0, 1)), ("Traction", "(0, 1)", "3 finite")),
        (lambda c: cb.Traction("boundary", 1.0), ("Traction", "1.0", "3 finite")),
        (lambda c: cb.Traction("boundary", (0, 0, np.nan)), ("Traction", "3 finite")),
        (lambda c: cb.Traction("boundary", (0, 0, 1), field="nu"), ("Traction", "2 finite")),
        (lambda c: cb.BodyForce("down"), ("BodyForce", "vector")),
        (lambda c: cb.Pressure("boundary", np.nan), ("Pressure", "nan", "finite")),
        (lambda c: cb.Pressure("boundary", "high"), ("Pressure", "'high'", "finite")),
        (
            lambda c: cb.BodyForce(_on_last_rank(c, _fail, (2,)), field="nu"),
            ("BodyForce", "vector", "RuntimeError: no such luck"),
        ),
        (
            lambda c: cb.BodyForce(
                lambda x: np.full((3, x.shape[1]), np.nan if c.rank == c.size - 1 else 1.0)
            ),
            ("BodyForce", "not finite"),
        ),
        (
            lambda c: cb.Traction(_on_last_rank(c, _fail), (0, 0, 1)),
            ("Traction", "predicate", "RuntimeError: no such luck"),
        ),
        (
            lambda c: cb.Traction(_on_last_rank(c, lambda x: x[:, :1]), (0, 0, 1)),
            ("Traction", "predicate", "shape (3, 1)"),
        ),
    ],
)
def test_loads_that_fail(comm, load, words):
    mesh = box(comm)
    with refused(SceneError, *words):
        loads(mesh, load(comm), tags=facet_tags(mesh))
