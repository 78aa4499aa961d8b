# SPDX-License-Identifier: LGPL-3.0-or-later
"""What does not fit together is refused: by its kind of error, by name, on all ranks."""

import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from harness import bent, everywhere, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat
from complexbody.errors import (
    CoercivityError,
    DivergenceError,
    IntegratorError,
    MeshError,
    OutputError,
    SceneError,
    StepError,
    agree,
)
from complexbody.problem import Problem


def energy(U, nu, N):
    return ufl.inner(U, U) + ufl.inner(N, N) + ufl.inner(nu, nu)


BODY = cb.Body(2, energy, 1.0, 1.0, name="gum")


@pytest.fixture(scope="module")
def mesh(comm):
    return bent(comm, (9, 8))


def tags(mesh, dim, *values):
    """The values, in turn, on all cells or facets of this rank."""
    mesh.topology.create_entities(dim)
    index_map = mesh.topology.index_map(dim)
    entities = np.arange(index_map.size_local + index_map.num_ghosts, dtype=np.int32)
    return dolfinx.mesh.meshtags(mesh, dim, entities, np.resize(values, len(entities)).astype("i4"))


# --- all ranks together ---------------------------------------------------------------------------


def test_agree(comm):
    """The error of the lowest rank that has one, with its rank where ranks differ."""
    agree(comm, None)
    last = comm.size - 1
    mine = MeshError("Cell 7 is flat. Repair the mesh.") if comm.rank == last else None
    with refused(MeshError, "Cell 7 is flat.", f"(rank {last})" if last else "mesh"):
        agree(comm, mine)
    kinds = [SceneError("First. Give it."), MeshError("Second. Give it."), StepError("3. Give it.")]
    with refused(SceneError, "First."):
        agree(comm, kinds[comm.rank])


# --- meshes --------------------------------------------------------------------------------------


def from_points(comm, element, points, cells):
    """A small mesh that rank 0 gives."""
    some = slice(None) if comm.rank == 0 else slice(0)
    points, cells = np.array(points, float)[some], np.array(cells, np.int64)[some]
    domain = ufl.Mesh(element)
    try:
        return dolfinx.mesh.create_mesh(comm, cells, points, domain)
    except TypeError:
        return dolfinx.mesh.create_mesh(comm, cells, domain, points)


def coordinates(name, degree, dim):
    if hasattr(ufl, "VectorElement"):
        return ufl.VectorElement("Lagrange", ufl.Cell(name, geometric_dimension=dim), degree)
    from basix.ufl import element

    return element("Lagrange", name, degree, shape=(dim,))


def test_cells_that_are_no_simplices(comm):
    kind = dolfinx.mesh.CellType
    quads = dolfinx.mesh.create_unit_square(comm, 3, 3, kind.quadrilateral)
    with refused(MeshError, "quadrilateral", "triangles"):
        cb.Scene(quads, BODY)
    bricks = dolfinx.mesh.create_unit_cube(comm, 2, 2, 2, kind.hexahedron)
    with refused(MeshError, "hexahedron", "tetrahedra"):
        cb.Scene(bricks, BODY)


def test_curved_cells(comm):
    six = [[0, 0], [1, 0], [0, 1], [0.5, 0.6], [0, 0.5], [0.5, 0]]
    curved = from_points(comm, coordinates("triangle", 2, 2), six, [[0, 1, 2, 3, 4, 5]])
    with refused(MeshError, "triangle", "degree 2", "straight"):
        cb.Scene(curved, BODY)


def test_surface_in_space(comm):
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 1], [1, 1, 1]]
    shell = from_points(comm, coordinates("triangle", 1, 3), points, [[0, 1, 2], [1, 2, 3]])
    with refused(MeshError, "dimension 2", "dimension 3", "flat mesh"):
        cb.Scene(shell, BODY)


@pytest.mark.parametrize("thing", [None, "mesh.xdmf", np.zeros((3, 3))])
def test_no_mesh_at_all(thing):
    with refused(SceneError, "not a dolfinx mesh"):
        cb.Scene(thing, BODY)


# --- bodies, tags, lists -------------------------------------------------------------------------


def test_bodies_of_a_scene(comm, mesh):
    """In the order of their tags; regions index them."""
    soft, hard = cb.Body(2, energy, 1.0, 1.0), cb.Body(2, energy, 9.0, 1.0)
    scene = cb.Scene(mesh, {7: hard, 3: soft}, cell_tags=tags(mesh, 2, 3, 3, 7))
    assert scene.bodies == (soft, hard)
    owned = _compat.cell_count(mesh)[0]
    assert np.array_equal(scene.regions(), np.resize([0, 0, 1], owned))
    assert (scene.displacement, scene.descriptor, scene.components) == (3, 2, 5)
    assert scene.components_of("u").tolist() == [0, 1, 2]
    assert scene.components_of("nu").tolist() == [3, 4]
    assert cb.Scene(mesh, BODY, supports=cb.Fix("u", "boundary")).supports[0].field == "u"


def test_tags_on_some_ranks_only(comm, mesh):
    """A region may lie on one rank; cells without a body count over all of them."""
    cells, facets = tags(mesh, 2, 1), tags(mesh, 1, 5)
    last = comm.rank == comm.size - 1
    lone = tags(mesh, 2, 1, 2) if last else cells
    scene = cb.Scene(mesh, {1: BODY, 2: cb.Body(2, energy, 2.0, 1.0)}, cell_tags=lone)
    assert everywhere(comm, len(scene.bodies) == 2)
    with refused(SceneError, "cells have no body", "[1]"):
        cb.Scene(mesh, {1: BODY}, cell_tags=lone)
    one = tags(mesh, 1, 5, 6) if last else facets
    found = cb.Scene(mesh, BODY, supports=[cb.Fix("u", 6)], facet_tags=one)
    assert len(found.supports) == 1


@pytest.mark.parametrize(
    "arguments, kind, words",
    [
        ({"body": "steel"}, SceneError, ("neither a Body nor",)),
        ({"body": {}}, SceneError, ("neither a Body nor",)),
        ({"body": {1: energy}, "cell_tags": (1,)}, SceneError, ("not a Body",)),
        ({"body": {1: BODY}}, SceneError, ("needs cell_tags",)),
        ({"body": {1: BODY, 2: BODY}, "cell_tags": (1,)}, SceneError, ("no cell has tag 2",)),
        ({"body": {1: BODY}, "cell_tags": (1, 2)}, SceneError, ("cells have no body", "[1]")),
        (
            {"body": {1: BODY, 2: cb.Body(1, energy, 1.0, 1.0)}, "cell_tags": (1, 2)},
            SceneError,
            ("different (displacement, descriptor)", "(3, 2)", "(3, 1)"),
        ),
        ({"supports": [cb.Fix("u", 4)]}, SceneError, ("Fix", "where=4", "no facet_tags")),
        (
            {"supports": [cb.Fix("u", 4)], "facet_tags": (1, 2)},
            SceneError,
            ("Fix", "tag 4", "facet_tags"),
        ),
        (
            {"loads": [cb.Pressure((1, 5), 1.0)], "facet_tags": (1, 2)},
            SceneError,
            ("Pressure", "tag 5"),
        ),
        (
            {"loads": [cb.BodyForce((0, 0, 1), where=3)], "cell_tags": (1, 2)},
            SceneError,
            ("BodyForce", "tag 3", "cell_tags"),
        ),
        ({"loads": [cb.BodyForce((0, 0, 1), where=3)]}, SceneError, ("BodyForce", "no cell_tags")),
        (
            {"loads": [cb.BodyForce((0, 0, 1), where="boundary")]},
            SceneError,
            ("BodyForce", "'boundary'", "cell tags"),
        ),
        (
            {"loads": [cb.BodyForce((0, 0, 1), where=lambda x: x[0] < 1)]},
            SceneError,
            ("BodyForce", "cell tags"),
        ),
        ({"supports": [cb.Fix("u", "left")]}, SceneError, ("Fix", "'left'", "'boundary'")),
        ({"supports": [cb.Fix("u", None)]}, SceneError, ("Fix", "None")),
        ({"loads": [cb.Traction(None, (0, 0, 1))]}, SceneError, ("Traction", "None")),
        ({"supports": [cb.Pressure("boundary", 1.0)]}, SceneError, ("Pressure", "supports")),
        ({"loads": [cb.Fix("u", "boundary")]}, SceneError, ("Fix", "loads")),
        ({"loads": "none"}, SceneError, ("loads",)),
        ({"initial": {"u": 0.0}}, SceneError, ("initial", "cb.Initial")),
        ({"self_action": "exact"}, SceneError, ("self_action", "'exact'", "'lumped'")),
        ({"cell_tags": "facets"}, SceneError, ("cell_tags", "dimension 2")),
        ({"facet_tags": "cells"}, SceneError, ("facet_tags", "dimension 1")),
        ({"facet_tags": [1, 2, 3]}, SceneError, ("facet_tags", "MeshTags")),
    ],
)
def test_parts_that_do_not_fit(mesh, arguments, kind, words):
    arguments = {"body": BODY} | arguments
    for name, dim in (("cell_tags", 2), ("facet_tags", 1)):
        given = arguments.get(name)
        if isinstance(given, tuple):
            arguments[name] = tags(mesh, dim, *given)
        elif isinstance(given, str):
            arguments[name] = tags(mesh, 3 - dim, 1)
    with refused(kind, *words):
        cb.Scene(mesh, **arguments)


@pytest.mark.parametrize("make", [cb.Fix, cb.Traction])
def test_unknown_fields(make):
    with refused(SceneError, make.__name__, "'v'", "'nu'"):
        make("v", "boundary") if make is cb.Fix else make("boundary", (0, 0, 1), field="v")
    with refused(SceneError, "BodyForce", "'nu_dot'"):
        cb.BodyForce((0, 0, 1), field="nu_dot")


# --- initial data --------------------------------------------------------------------------------


def spoilt(comm, mesh):
    """A P1 function of ν with one value that is no number, on the last rank."""
    function = fem.Function(_compat.vector_space(mesh, 2))
    if comm.rank == comm.size - 1:
        function.x.array[0] = np.nan
    return function


def _fail(x):
    raise KeyError("profile")


@pytest.mark.parametrize(
    "initial, words",
    [
        (lambda c, m: cb.Initial(u=(1.0, 2.0)), ("Initial: u ", "3 finite")),
        (lambda c, m: cb.Initial(nu="hot"), ("Initial: nu ", "2 finite")),
        (lambda c, m: cb.Initial(u_dot=np.inf), ("Initial: u_dot ", "3 finite")),
        (lambda c, m: cb.Initial(nu_dot=lambda x: x), ("Initial: nu_dot ", "2 finite")),
        (
            lambda c, m: cb.Initial(u=lambda x: 0 * x + (np.nan if c.rank == c.size - 1 else 0.0)),
            ("Initial: u ", "3 finite"),
        ),
        (
            lambda c, m: cb.Initial(nu=lambda x: _fail(x) if c.rank == c.size - 1 else 0 * x[:2]),
            ("Initial: nu ", "KeyError: 'profile'"),
        ),
        (lambda c, m: cb.Initial(nu=spoilt(c, m)), ("Initial: nu ", "2 finite")),
        (lambda c, m: cb.Initial(u=spoilt(c, m)), ("Initial: u ", "3 finite")),
    ],
)
def test_initial_data_that_fail(comm, mesh, initial, words):
    """Also where it goes wrong on one rank only."""
    with refused(SceneError, *words):
        Problem(cb.Scene(mesh, BODY, initial=initial(comm, mesh)))


def test_initial_data(comm, mesh):
    """Numbers, tuples, callables and Functions arrive at the nodes; supports come before them."""
    function = fem.Function(_compat.vector_space(mesh, 2))
    function.interpolate(lambda x: np.stack([x[0] * x[1], x[1]]))
    scene = cb.Scene(
        mesh,
        BODY,
        supports=[cb.Fix("u", lambda x: x[0] < 0.3, value=7.0, components=0)],
        initial=cb.Initial(
            u=lambda x: np.stack([x[0], 2 * x[1], 0 * x[0]]),
            nu=function,
            u_dot=(1.0, 2.0, 3.0),
            nu_dot=5.0,
        ),
    )
    problem = Problem(scene)
    x, y, _ = problem.disc.position[:-1].T
    fixed = x < 0.3
    expected = np.stack([np.where(fixed, 7.0, x), 2 * y, 0 * x, x * y, y], axis=1)
    np.testing.assert_allclose(problem.initial_fields, expected, atol=1e-15)
    rates = np.tile([1.0, 2.0, 3.0, 5.0, 5.0], (len(x), 1))
    rates[fixed, 0] = 0.0
    np.testing.assert_array_equal(problem.initial_rates, rates)
    problem.close()


def test_more_ranks_than_cells(comm, shared_path):
    """A rank without cells takes part in everything; the ledger is that of one rank."""
    ledgers = []
    for which in (comm, MPI.COMM_SELF):
        small = bent(which, (2,))
        function = fem.Function(_compat.vector_space(small, 2))
        function.interpolate(lambda x: np.stack([x[0], 1 - x[0]]))
        scene = cb.Scene(
            small,
            cb.Body(2, lambda U, nu, N: energy(U, nu, N) + nu[0] ** 4, 1.0, 1.0, viscosity=0.5),
            supports=[cb.Fix("u", lambda x: x[0] < 0.3, value=0.1, history=cb.sine(1.0))],
            loads=[
                cb.Traction(lambda x: x[0] > 0.8, (1.0, 0.0, 0.0)),
                cb.BodyForce(lambda x: 0 * x + 1.0),
            ],
            initial=cb.Initial(u=lambda x: 0 * x + x[:1], nu=function),
        )
        folder = shared_path / ("all" if which is comm else f"rank-{comm.rank}")
        output = cb.Output(folder, probes={"middle": (0.5,)})
        ledgers.append(cb.simulate(scene, until=1.0, output=output).ledger)
    scale = np.abs(ledgers[1]["stored"]).max()
    assert len(ledgers[0]) > 1
    for column in ("kinetic_u", "kinetic_nu", "stored", "work", "support_work", "dissipated"):
        np.testing.assert_allclose(ledgers[0][column], ledgers[1][column], atol=1e-12 * scale)


# --- bodies, integrators, runs -------------------------------------------------------------------


def test_indefinite_energy(mesh):
    body = cb.Body(2, lambda U, nu, N: ufl.inner(U, U) - N[0, 1] ** 2 + N[1, 0] ** 2, 1.0, 1.0)
    with refused(CoercivityError, "(A1)", "N12"):
        cb.simulate(cb.Scene(mesh, body), until=1.0)


def test_inertia_that_no_explicit_integrator_takes(mesh):
    chi = lambda nu, nu_dot: (1 + nu[0] ** 2) * ufl.inner(nu_dot, nu_dot)  # noqa: E731
    body = cb.Body(2, energy, 1.0, chi, name="foam")
    with refused(IntegratorError, "Synchronous", "foam", "k×k"):
        cb.simulate(cb.Scene(mesh, body), cb.Synchronous(), until=1.0)


@pytest.mark.parametrize(
    "options, kind, words",
    [
        ({"dissipation": "none"}, IntegratorError, ("dissipation", "'none'", "symmetric")),
        ({"start": "soft"}, IntegratorError, ("start", "'soft'", "trapezoidal")),
        ({"critical": "guess"}, IntegratorError, ("critical", "'guess'", "cells")),
        ({"step": 0.0}, StepError, ("step", "0.0")),
        ({"step": np.nan}, StepError, ("step", "nan")),
        ({"safety": -1}, StepError, ("safety", "-1")),
        ({"safety": np.inf}, StepError, ("safety", "inf")),
    ],
)
def test_integrator_options(options, kind, words):
    with refused(kind, "Synchronous", *words):
        cb.Synchronous(**options)


def test_step_above_the_critical_one(mesh):
    """Both steps are told; whoever insists sees the run stopped."""
    scene = cb.Scene(mesh, BODY, initial=cb.Initial(u=lambda x: np.sin(20 * x)))
    stats = cb.simulate(scene, until=0.1, plan=False).stats
    large = 3 * stats.critical  # the cells' bound is cautious
    with refused(StepError, f"{large:.6g}", f"{stats.critical:.6g}", "unstable_ok=True"):
        cb.simulate(scene, cb.Synchronous(step=large), until=1.0, plan=False)
    insisting = cb.Synchronous(step=large, unstable_ok=True)
    with refused(DivergenceError, "critical", "smaller"):
        cb.simulate(scene, insisting, until=400 * large)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"until": 0.0}, ("until", "0.0")),
        ({"until": np.nan}, ("until", "nan")),
        ({"until": 1.0, "ledger_steps": 0}, ("ledger_steps", "0")),
    ],
)
def test_simulate_options(mesh, options, words):
    with refused(SceneError, "simulate", *words):
        cb.simulate(cb.Scene(mesh, BODY), **options)


def test_output_that_cannot_be_written(mesh, shared_path, comm):
    """A file stands where the folder should be; a probe stands outside."""
    if comm.rank == 0:
        (shared_path / "taken").write_text("")
    comm.barrier()
    scene = cb.Scene(mesh, BODY)
    with refused(OutputError, "taken"):
        cb.simulate(scene, until=1e-3, output=cb.Output(shared_path / "taken" / "run"))
    output = cb.Output(shared_path / "run", probes={"far": (9.0, 9.0)})
    with refused(SceneError, "'far'", "[9.0, 9.0]"):
        cb.simulate(scene, until=1e-3, output=output)
