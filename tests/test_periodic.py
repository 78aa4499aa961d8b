# SPDX-License-Identifier: LGPL-3.0-or-later
"""Periodic scenes: nodes that are one, whatever ranks have them, and what belongs to them."""

from dataclasses import replace

import numpy as np
import pytest
import ufl
from busy import cellwise
from dense import Dense, Plain, prepared, quadratic, random_hessian, values, whole
from dolfinx import fem
from dolfinx import mesh as dmesh
from harness import Machine, Reference, everywhere, largest, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat, meshes
from complexbody.errors import IntegratorError, MeshError, SceneError
from complexbody.forms import isotropic_two_field
from complexbody.invariance import invariant_axes
from complexbody.problem import Problem

CELLS = {1: (9,), 2: (6, 4), 3: (4, 3, 3)}
LENGTHS = np.array([1.0, 0.8, 0.7])
FIELDS = ("u", "nu", "u_dot", "nu_dot")


class Torus:
    """A graded box with scattered vertices that repeats itself, cut open ``cut`` cells from x = 0.

    All cuts are the same body: vertices are moved by where they are modulo the periods. Faces are
    no planes, and are known by tags.

    Attributes:
        mesh, arguments: The mesh, and what makes a scene on it periodic.
        node: Number of each node of the whole mesh (rows as in ``dense.whole``), copies alike.
    """

    def __init__(self, comm, dim, cut=0):
        cells = CELLS[dim]
        if dim == 1:
            mesh = meshes.interval(comm, 0.0, float(cells[0]), cells[0])
        else:
            make = (meshes.rectangle, meshes.box)[dim - 2]
            mesh = make(comm, np.zeros(dim), np.array(cells, float), cells)
        faces = [
            dmesh.locate_entities_boundary(mesh, dim - 1, lambda x, a=a: x[a] < 1e-9)
            for a in range(dim)
        ]
        tags = np.repeat(np.arange(1, dim + 1), [len(f) for f in faces]).astype(np.int32)
        order = np.argsort(np.concatenate(faces))
        tags = dmesh.meshtags(mesh, dim - 1, np.concatenate(faces)[order], tags[order])
        x = mesh.geometry.x
        at = np.rint(x[:, :dim]).astype(int)
        at[:, 0] += cut
        turns, rest = np.divmod(at, cells)
        moves = np.random.default_rng(dim).uniform(-0.15, 0.15, (*cells, dim))[tuple(rest.T)]
        sizes = np.linspace(0.5, 1.5, cells[0]) / cells[0]
        along = np.concatenate([[0.0], np.cumsum(sizes)])
        x[:, 0] = along[rest[:, 0]] + moves[:, 0] * sizes.min() + turns[:, 0]
        for a in range(1, dim):
            x[:, a] = (rest[:, a] + moves[:, a]) / cells[a] + turns[:, a]
        x[:, :dim] *= LENGTHS[:dim]
        vectors = np.diag(LENGTHS[:dim])
        pairs = [cb.Periodic(a + 1, v) for a, v in enumerate(vectors)]
        self.mesh, self.arguments = mesh, {"facet_tags": tags, "periodic": pairs}
        owned = _compat.node_map(mesh).size_local
        number = np.ravel_multi_index(tuple(rest[:owned].T), cells)
        self.node = np.concatenate(comm.allgather(number))

    @property
    def spreading(self):
        """T: values of all nodes from those of distinct ones, shape (nodes, distinct)."""
        return (self.node[:, None] == np.arange(self.node.max() + 1)).astype(float)

    def distinct(self, *functions):
        """Values of Functions at distinct nodes; copies must have the same to the bit."""
        given = values(*functions)
        out = np.empty((self.node.max() + 1, given.shape[1]))
        out[self.node] = given
        assert np.array_equal(out[self.node], given)
        return out


def repeating(n, seed, dim, size=1.0, mean=0.0):
    """Callable of x with the periods of the torus."""
    rng = np.random.default_rng(seed)
    number, phase = rng.integers(-2, 3, (dim, n)), rng.uniform(0, 6, (n, 1))
    amplitude = size * rng.uniform(0.3, 1.0, (n, 1))
    q = 2 * np.pi * number / LENGTHS[:dim, None]
    return lambda x: mean + amplitude * np.sin(q.T @ x[:dim] + phase)


def start(dim, n_u, k, mean=0.0):
    return cb.Initial(
        repeating(n_u, 1, dim, 0.3), repeating(k, 2, dim, 0.4, 1.5 * mean),
        repeating(n_u, 3, dim, 0.5, mean), repeating(k, 4, dim, 0.2),
    )  # fmt: skip


ETA = np.array([[0.5, -0.2], [-0.2, 0.7]])


def body(torus, kind):
    """Two components each: "linear", "varying" (density, stiffness, prestress), "quartic", ….

    The last ones go through FFCx, with a coefficient of x; "general" has no constant inertia.
    """
    mesh = torus.mesh
    dim, wave = mesh.geometry.dim, 2 * np.pi / LENGTHS[0]
    if kind == "linear":
        base = quadratic(random_hessian(4 + dim, 2, 2, dim), dim)
        return cb.Body(2, base, 1.3, 0.8, ETA, displacement=2)
    x = ufl.SpatialCoordinate(mesh)
    # Without coordinates that vary in a cell: code is generated.
    stiff = cellwise(mesh, lambda x: 1.0 + 0.5 * np.sin(wave * x[0]))
    smooth = 1.0 + 0.5 * ufl.sin(wave * x[0])
    rho = cellwise(mesh, lambda x: 1.5 + np.cos(wave * x[0]))

    def energy(U, nu, N):
        value = 0.6 * ufl.inner(U, U) + 0.4 * ufl.inner(N, N) + 0.5 * ufl.inner(nu, nu)
        value += 0.3 * U[0, 0] * N[1, dim - 1] + 0.2 * U[1, dim - 1] * nu[0]
        value += stiff * U[1, 0] ** 2 + 0.1 * stiff * (U[0, 0] - nu[1])
        return value if kind == "varying" else value + smooth * (nu[0] ** 4 + N[1, 0] ** 4)

    def inertia(nu, v):
        return (0.5 + 0.1 * nu[0] ** 2) * v[0] ** 2 + 0.4 * v[1] ** 2

    return cb.Body(2, energy, rho, inertia if kind == "general" else 0.8, 0.3, displacement=2)


@pytest.mark.parametrize(
    "dim, kind", [(1, "varying"), (1, "quartic"), (2, "varying"), (2, "quartic"), (3, "quartic")]
)
def test_forces_and_masses_are_dolfinx_s_condensed(comm, dim, kind):
    """T'F and T'M of what dolfinx assembles, T giving all nodes the values of distinct ones."""
    torus = Torus(comm, dim)
    mesh, form = torus.mesh, body(torus, kind)
    machine = Machine(mesh, form, **torus.arguments)
    assert machine.kernels.densities.generated == [kind == "varying"]
    given = np.concatenate([repeating(2, s, dim)(mesh.geometry.x.T) for s in (1, 2)]).T
    machine.set(given)
    dolfinx = Reference(mesh, 2, 2)
    dolfinx.set(given)
    parts = dolfinx.U, dolfinx.nu, dolfinx.N
    expected = dolfinx.forces(form.energy(*parts) * ufl.dx)
    found, forces = (fem.Function(_compat.vector_space(mesh, 4)) for _ in range(2))
    forces.x.array[:] = expected.ravel()
    T, n = torus.spreading, machine.disc.n
    expected = T.T @ values(forces)
    machine.disc.scatter(machine.forces(), found)
    assert abs(torus.distinct(found) - expected).max() < 1e-12 * abs(expected).max()
    assert n == 4 and comm.allreduce(int(machine.disc.owned.sum())) == np.prod(CELLS[dim])
    # Forces of stored energies on a body without ends: no resultant.
    assert abs(machine.total(machine.forces())[:2]).max() < 1e-12 * abs(expected).max()
    mass = (machine.disc.volume * machine.disc.density())[:, None]
    whole_mass = comm.allreduce(fem.assemble_scalar(_compat.form(form.density * ufl.dx)))
    assert machine.total(mass)[0] == pytest.approx(whole_mass, rel=1e-13)
    v = ufl.TestFunction(_compat.vertex_space(mesh))
    lumped = fem.Function(v.ufl_function_space())
    fem.assemble_vector(lumped.x.array, _compat.form(form.density * v * ufl.dx))
    _compat.accumulate(lumped)
    one = fem.Function(_compat.vector_space(mesh, 1))
    machine.disc.scatter(mass, one)
    np.testing.assert_allclose(torus.distinct(one)[:, 0], T.T @ values(lumped)[:, 0], rtol=1e-13)
    machine.close()


@pytest.mark.parametrize("scheme", ["exact", "symmetric", "forward"])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_run_is_that_of_condensed_matrices(comm, dim, scheme):
    torus = Torus(comm, dim)
    form = body(torus, "linear")
    scene = cb.Scene(torus.mesh, form, initial=start(dim, 2, 2), **torus.arguments)
    run = prepared(scene, cb.Synchronous(dissipation=scheme), until=1.0)
    dense, T = Dense(torus.mesh, form), np.kron(torus.spreading, np.eye(4))
    K, M, D = (T.T @ A @ T for A in (dense.K, dense.full(dense.M), dense.full(dense.D)))
    plain = Plain(M, D, run.step, scheme)
    first = run.problem.functions(run.problem.initial_fields, run.problem.initial_rates)
    x = torus.distinct(first["u"], first["nu"]).ravel()
    rate = torus.distinct(first["u_dot"], first["nu_dot"]).ravel()
    expected = np.concatenate([f(dense.points.T) for f in (scene.initial.u, scene.initial.nu)]).T
    assert abs(torus.spreading @ x.reshape(-1, 4) - expected).max() < 1e-14
    x = plain.begin(x, rate, -K @ x)
    for _ in range(24):
        x = plain.step(x, -K @ x)
    run.advance(25)
    now = run.problem.functions(*run.sample())
    assert abs(torus.distinct(now["u"], now["nu"]).ravel() - x).max() < 1e-12
    known = plain.rate(-K @ x)
    assert abs(torus.distinct(now["u_dot"], now["nu_dot"]).ravel() - known).max() < 1e-11


METHODS = {
    "synchronous": cb.Synchronous(), "windows": cb.AVI(), "plain": cb.AVI(balanced=False),
    "octaves": cb.AVI(schedule="octaves"), "exact": cb.AVI(schedule="exact"),
    "published": cb.AVI.as_published(), "local leapfrog": cb.LocalLeapfrog(),
    "implicit in ν": cb.Implicit(forces="implicit"), "general": cb.Implicit(),
}  # fmt: skip
RUNS = [(name, kind) for name in METHODS if name != "general" for kind in ("varying", "quartic")
        if (name, kind) != ("local leapfrog", "quartic")]  # fmt: skip


@pytest.mark.parametrize("method, kind", [*RUNS, ("general", "general")])
def test_neither_the_cut_nor_ranks_matter(comm, method, kind):
    """The body cut open elsewhere, computed by each rank for itself: what was a face is inside."""
    results = []
    for cut, ranks in ((0, comm), (2, MPI.COMM_SELF)):
        torus = Torus(ranks, 2, cut)
        form = body(torus, kind)
        scene = cb.Scene(torus.mesh, form, initial=start(2, 2, 2, 0.4), **torus.arguments)
        result = cb.simulate(scene, METHODS[method], until=0.8, ledger_steps=3)
        fields = [torus.distinct(getattr(result, name)) for name in FIELDS]
        results.append((result, fields))
    (result, fields), (other, expected) = results
    assert result.stats.nodes == other.stats.nodes == np.prod(CELLS[2])
    assert result.stats.steps == other.stats.steps
    close = 1e-9 if isinstance(METHODS[method], cb.Implicit) else 1e-11  # solvers' tolerance
    for name, mine, known in zip(FIELDS, fields, expected, strict=True):
        assert abs(known).max() > 1e-2
        assert abs(mine - known).max() < close * abs(known).max(), name
    for column in ("kinetic_u", "kinetic_nu", "stored", "dissipated"):
        size = abs(other.ledger["stored"]).max()
        assert abs(result.ledger[column] - other.ledger[column]).max() < close * size, column
    for i in (1, 2):  # a free body
        momentum = result.ledger[f"momentum_{i}"]
        assert abs(momentum).min() > 0.1
        assert np.ptp(momentum) < 1e-13 * abs(momentum).max()
    assert abs(result.ledger["identity"]).max() < 1e-12


def shuffled(comm, seed):
    """A jiggled rectangle whose cells are on ranks drawn by lot."""
    points, cells = whole(meshes.rectangle(MPI.COMM_SELF, (0, 0), (1, 0.8), (7, 5)))
    ranks = np.random.default_rng(seed).integers(0, comm.size, len(cells)).astype(np.int32)
    if comm.rank > 0:
        points, cells, ranks = points[:0], cells[:0], ranks[:0]
    return meshes.jiggled(_compat.create_mesh(comm, cells, points, ranks), 0.2)


@pytest.mark.parametrize("method", ["synchronous", "windows", "exact", "local leapfrog"])
def test_any_share_of_cells_among_ranks(comm, method):
    """Copies of a node on the same rank, on others, and where no cell of a rank is near."""
    results = []
    for ranks in (comm, MPI.COMM_SELF):
        mesh, form = shuffled(ranks, 5), isotropic_two_field(d=2, viscosity=0.2)
        scene = cb.Scene(mesh, form, initial=start(2, 2, 2), periodic=(0, 1))
        result = cb.simulate(scene, METHODS[method], until=0.8)
        fields = np.concatenate(
            [getattr(result, n).x.array.reshape(_compat.node_count(mesh), -1) for n in FIELDS], 1
        )  # fmt: skip
        order = np.asarray(mesh.geometry.input_global_indices)
        results.append((fields, order, result.stats))
    (mine, order, stats), (known, rows, other) = results
    expected = np.empty_like(known)
    expected[rows] = known
    assert stats.nodes == other.nodes == 35
    assert largest(comm, mine - expected[order]) < 1e-11 * abs(known).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_strip_is_a_bar(comm, dim):
    """What does not vary along periodic axes is that of a mesh without them, to round-off.

    Held at one copy of an edge's nodes only, loaded by a traction at the other end.
    """
    sizes = (9, 3, 2)[:dim]
    form = cb.Body(
        2, quadratic(random_hessian(9, 2, 2, dim), dim), 1.3, 0.8, ETA, displacement=2
    )  # fmt: skip
    mesh = (meshes.rectangle, meshes.box)[dim - 2](comm, [0] * dim, LENGTHS[:dim], sizes)
    bar = meshes.interval(MPI.COMM_SELF, 0.0, 1.0, 9)
    shape = lambda x: np.stack([np.sin(3 * x[0]), np.cos(2 * x[0])])  # noqa: E731
    end, ends = (lambda x: x[0] < 1e-9), (lambda x: (x[0] < 1e-9) | (x[0] > 1 - 1e-9))
    found = []
    for domain, periodic, held, all_ends in (
        (mesh, tuple(range(1, dim)), lambda x: end(x) & (x[1] > 1e-9), "boundary"),
        (bar, (), end, ends),
    ):
        scene = cb.Scene(
            domain, form,
            [cb.Fix("u", held, (0.1, -0.2), history=cb.sine(0.7, 0.4)),
             cb.Fix("nu", all_ends, components=0)],
            [cb.Traction(lambda x: x[0] > 1 - 1e-9, (0.3, 0.1), cb.ramp(0.4)),
             cb.BodyForce(shape), cb.BodyForce((0.2, -0.4), field="nu")],
            cb.Initial(nu=lambda x: 0.2 * x[0] * shape(x), u_dot=lambda x: x[0] * shape(x)),
            periodic=periodic,
        )  # fmt: skip
        result = cb.simulate(scene, cb.Synchronous(0.01), until=0.6)
        found.append([values(getattr(result, name)) for name in FIELDS])
    column = np.rint(9 * whole(mesh)[0][:, 0]).astype(int)
    line = np.rint(9 * whole(bar)[0][:, 0]).astype(int)
    for name, mine, known in zip(FIELDS, *found, strict=True):
        expected = np.empty_like(known)
        expected[line] = known
        assert abs(known).max() > 0.05
        assert abs(mine - expected[column]).max() < 1e-11 * abs(known).max(), name


def test_skew_translations(comm):
    """A parallelogram that repeats itself along its sides; a mesh with ghost cells."""
    mesh = dmesh.create_rectangle(
        comm, [np.zeros(2), np.array([1, 0.8])], [6, 4], ghost_mode=dmesh.GhostMode.shared_facet
    )  # fmt: skip
    mesh.geometry.x[:, 0] += 0.5 * mesh.geometry.x[:, 1]
    pairs = [
        cb.Periodic(lambda x: x[1] < 1e-9, (0.4, 0.8)),
        cb.Periodic(lambda x: x[0] - 0.5 * x[1] < 1e-9, (1.0, 0.0)),
    ]
    sheared = lambda x: np.stack([np.sin(2 * np.pi * (x[0] - 0.5 * x[1]))] * 2)  # noqa: E731
    scene = cb.Scene(
        mesh, isotropic_two_field(d=2), initial=cb.Initial(u=sheared), periodic=pairs
    )  # fmt: skip
    problem = Problem(scene)
    assert comm.allreduce(int(problem.disc.owned.sum())) == 24
    alike = np.full(24, 0.8 / 24)  # a lattice
    volume = np.concatenate(comm.allgather(problem.disc.volume[problem.disc.owned]))
    np.testing.assert_allclose(volume, alike, rtol=1e-12)
    assert invariant_axes(problem) == []
    result = cb.simulate(scene, until=0.5)
    q = 2 * np.pi * (mesh.geometry.x[:, 0] - 0.5 * mesh.geometry.x[:, 1])
    u = result.u.x.array.reshape(-1, 2)
    # The wave keeps its shape: it is one of the lattice's.
    basis = np.stack([np.sin(q), np.cos(q)], axis=1)
    square, cross = comm.allreduce(basis.T @ basis), comm.allreduce(basis.T @ u)
    assert largest(comm, u - basis @ np.linalg.solve(square, cross)) < 1e-12
    problem.close()


def test_live_components_and_quiet_cells_change_nothing(comm):
    """A pulse beside a face: components at rest left out, cells at rest skipped on both sides."""
    mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (4, 0.2), (160, 8)), 0.2)
    form = isotropic_two_field(d=2)
    # Across periodic faces the nearest way, so that the pulse is on both sides.
    near = lambda x: np.minimum(x[0], 4 - x[0])  # noqa: E731
    pulse = lambda x: np.maximum(0, 1 - near(x) / 0.1) * np.array([[1.0], [0.0]])  # noqa: E731
    scene = cb.Scene(mesh, form, initial=cb.Initial(u=pulse), periodic=(0, 1))
    for method in (cb.Synchronous(), cb.AVI()):
        full, skipped = (
            cb.simulate(scene, method, until=0.4, plan=plan, quiet=plan) for plan in (False, True)
        )
        assert full.stats.quiet == 0 and skipped.stats.quiet > 0.05
        for name in FIELDS:
            known, found = (getattr(r, name).x.array for r in (full, skipped))
            assert everywhere(comm, np.array_equal(known, found)), name
    line = cb.Body(
        2, lambda U, nu, N: ufl.inner(U, U) + ufl.inner(N, N) + ufl.inner(nu, nu) + U[0, 0] * nu[0],
        1.0, 1.0, displacement=2,
    )  # fmt: skip
    scene = cb.Scene(mesh, line, initial=cb.Initial(u=pulse), periodic=(0, 1))
    full, fewer = (cb.simulate(scene, until=0.2, plan=plan) for plan in (False, True))
    assert fewer.plan.left_out == ("u2", "nu2")
    scale = largest(comm, full.u_dot.x.array)
    for name in FIELDS:
        known, found = (getattr(r, name).x.array for r in (full, fewer))
        assert largest(comm, known - found) < 1e-13 * scale


def test_probes_time_sets_and_output_at_copies(comm, shared_path):
    torus = Torus(comm, 2)
    scene = cb.Scene(
        torus.mesh, body(torus, "linear"), initial=start(2, 2, 2), **torus.arguments
    )  # fmt: skip
    points, cells = whole(torus.mesh)
    corner = points[torus.node == torus.node[np.argmin(points.sum(axis=1))]]
    assert len(corner) == 4
    inside = {f"copy {i}": p + (0.5 * LENGTHS[:2] - p) * 1e-9 for i, p in enumerate(corner)}
    output = cb.Output(shared_path / "out", fields=("u", "stress"), probes=inside, probe_steps=2)
    result = cb.simulate(scene, cb.AVI(), until=0.5, output=output)
    if comm.rank == 0:
        first, *others = (probe["u"] for probe in result.probes.values())
        assert abs(first).max() > 0.01
        for other in others:
            assert abs(other - first).max() < 1e-6
    sets, mesh = result.time_sets, torus.mesh
    # The cells of all copies make a node's time set.
    owned = _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
    index = _compat.node_map(mesh)
    numbers = np.asarray(index.local_to_global(np.arange(_compat.node_count(mesh), dtype=np.int32)))
    every = np.concatenate(comm.allgather(sets.steps))
    for node in np.unique(owned):
        around = (torus.node[cells] == torus.node[numbers[node]]).any(axis=1)
        expected = {0.0}
        for divisions in np.rint(sets.window / every[around]).astype(int):
            expected |= set((np.arange(divisions + 1) / divisions * sets.window).tolist())
        np.testing.assert_allclose(sets.of_node(int(node)), sorted(expected), rtol=1e-12)


def test_supports_reach_copies_on_other_ranks(comm):
    """Held where only the last copy is selected, and a history that clashes across a face."""
    torus = Torus(comm, 3)
    points, _ = whole(torus.mesh)
    target = points[np.argmax(points.sum(axis=1))]
    near = lambda x: np.linalg.norm(x.T - target, axis=1) < 1e-9  # noqa: E731
    form = body(torus, "linear")
    scene = cb.Scene(
        torus.mesh, form, cb.Fix("u", near, (0.1, 0.2), history=cb.sine(1.0, 0.5)),
        **torus.arguments,
    )  # fmt: skip
    result = cb.simulate(scene, until=0.3)
    u = torus.distinct(result.u)
    held = torus.node[np.argmax(points.sum(axis=1))]
    exact = np.array([0.1, 0.2]) * np.sin(2 * np.pi * 0.3 + 0.5)
    np.testing.assert_allclose(u[held], exact, rtol=1e-10)
    assert (torus.node == held).sum() == 8
    other = points[torus.node == held][0]
    there = lambda x: np.linalg.norm(x.T - other, axis=1) < 1e-9  # noqa: E731
    first = cb.Fix("u", near, (0.1, 0.2))
    same = cb.Fix("u", there, (0.1, 0.2))
    for clash in (cb.Fix("u", there, (0.1, 0.3)), replace(same, history=cb.ramp(1.0))):
        with refused(SceneError, "across a periodic face", "component"):
            Problem(cb.Scene(torus.mesh, form, [first, clash], **torus.arguments))
    Problem(cb.Scene(torus.mesh, form, [first, same], **torus.arguments)).close()



def test_plan_and_stability_of_a_periodic_scene(comm):
    mesh = meshes.rectangle(comm, (0, 0), (1, 0.3), (8, 3))
    wave = lambda x: np.stack([np.sin(2 * np.pi * x[0]), 0 * x[0]])  # noqa: E731
    scene = cb.Scene(mesh, isotropic_two_field(d=2), initial=cb.Initial(u=wave), periodic=(0, 1))
    problem = Problem(scene)
    assert invariant_axes(problem) == [1]
    problem.close()
    assert "along y" in str(cb.plan(scene, until=1.0)), str(cb.plan(scene, until=1.0))
    found = cb.stability(
        scene, safeties=[0.9], schedules=["synchronous", "balanced windows"], progress=False,
        steps=200,
    )  # fmt: skip
    assert all(not point.unstable for point in found.points)


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "periodic, words",
    [
        ((2,), ("0 to 1",)), ((0, 0), ("once",)), ((True,), ("True",)), ("x", ("'x'",)),
        ([cb.Periodic(lambda x: x[0] < 0, (1.0, 0.0, 0.0))], ("in 2D",)),
        ([cb.Periodic(7, (1.0, 0.0))], ("facet_tags",)),
    ],
)  # fmt: skip
def test_scenes_refuse_what_is_no_face(comm, periodic, words):
    mesh = meshes.rectangle(comm, (0, 0), (1, 1), (3, 3))
    with refused(SceneError, *words):
        cb.Scene(mesh, isotropic_two_field(d=2), periodic=periodic)


@pytest.mark.parametrize("vector", [(0.0, 0.0), (np.nan, 1.0), 3.0])
def test_vectors_that_are_none(vector):
    with refused(SceneError, "vector"):
        cb.Periodic(lambda x: x[0] < 1e-9, vector)


def twisted(comm):
    """A box whose face at x = 1 is that at x = 0 turned by 90°: the same nodes, other facets."""
    mesh = meshes.box(comm, (0, 0, 0), (1, 1, 1), (6, 2, 2))
    x = mesh.geometry.x
    c, s = np.cos(0.5 * np.pi * x[:, 0]), np.sin(0.5 * np.pi * x[:, 0])
    y, z = x[:, 1] - 0.5, x[:, 2] - 0.5
    x[:, 1], x[:, 2] = 0.5 + c * y - s * z, 0.5 + s * y + c * z
    return mesh


def moved(comm):
    """A rectangle with one node of its right face 0.02 too high."""
    mesh = meshes.rectangle(comm, (0, 0), (1, 1), (4, 4))
    x = mesh.geometry.x
    x[np.linalg.norm(x - [1, 0.5, 0], axis=1) < 1e-9, 1] += 0.02
    return mesh


def unequal(comm):
    """A face of one facet on the left, of two on the right."""
    points = np.array([[0.0, 0], [0, 1], [1, 0], [1, 1], [1, 2]])
    cells = np.array([[0, 2, 3], [0, 3, 1], [1, 3, 4]])
    if comm.rank > 0:
        points, cells = points[:0], cells[:0]
    return _compat.create_mesh(comm, cells, points)


BOTTOM = lambda x: x[1] < 1e-9  # noqa: E731
BAD = {
    "nearest": (moved, (0,), MeshError, ("[0.0, 0.5", "[1.0, 0.5", "0.02 m away")),
    "vector": (moved, [cb.Periodic(BOTTOM, (0.0, 0.9))], MeshError, ("0.1 m away",)),
    "facets": (twisted, (0,), MeshError, ("though its nodes have",)),
    "left over": (unequal, (0,), MeshError, ("[1.0, 1.5",)),
    "one side": (
        lambda comm: meshes.rectangle(comm, (0, 0), (1, 1), (4, 4)),
        [cb.Periodic(lambda x: BOTTOM(x) & (x[0] < 0.51), (0.5, 0.0))],
        MeshError, ("opposite ways",),
    ),
    "one cell": (
        lambda comm: meshes.rectangle(comm, (0, 0), (1, 1), (4, 1)), (1,), MeshError,
        ("two cells",),
    ),
    "nothing": (moved, [cb.Periodic(lambda x: x[0] > 3, (1.0, 0.0))], SceneError, ("no facet",)),
    "predicate": (moved, [cb.Periodic(lambda x: x[7], (1.0, 0.0))], SceneError, ("evaluated",)),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_faces_that_do_not_match(comm, case):
    make, periodic, error, words = BAD[case]
    mesh = make(comm)
    with refused(error, *words):
        Problem(cb.Scene(mesh, isotropic_two_field(d=mesh.geometry.dim), periodic=periodic))


def test_data_that_do_not_repeat(comm):
    mesh, form = meshes.rectangle(comm, (0, 0), (1, 1), (4, 3)), isotropic_two_field(d=2)

    def scene(periodic=(0,), **more):
        return cb.Scene(mesh, form, periodic=periodic, **more)

    ramp = lambda x: np.stack([x[0], x[1]])  # noqa: E731
    for name, what in (("u", "fields"), ("nu_dot", "rates")):
        with refused(SceneError, f"Initial: {what} differ", "component"):
            Problem(scene(initial=cb.Initial(**{name: ramp})))
    side = lambda x: x[0] > 1 - 1e-9  # noqa: E731
    for load in (cb.Traction(side, (1.0, 0.0)), cb.Pressure(side, 1.0)):
        with refused(SceneError, type(load).__name__, "periodic face", "[1.0,"):
            Problem(scene(loads=[load]))
    with refused(SceneError, "selects no node"):
        Problem(scene((0, 1), supports=[cb.Fix("u", "boundary")]))
    with refused(SceneError, "selects no boundary facet"):
        Problem(scene((0, 1), loads=[cb.Pressure("boundary", 1.0)]))
    # The rest of the boundary is what it was: a pressure on top and bottom is balanced.
    problem = Problem(scene(loads=[cb.Pressure("boundary", 1.0)]))
    forces = comm.allreduce(np.bincount(
        problem.loads.component, np.abs(problem.loads.value), minlength=4
    ))  # fmt: skip
    np.testing.assert_allclose(forces, [0, 2, 0, 0], atol=1e-14)
    problem.close()


@pytest.mark.parametrize(
    "method",
    [cb.AssembledLeapfrog(), cb.Newmark(0.01), cb.PetscTS("rk4"),
     cb.Implicit(solve="always", quadrature="consistent")],
    ids=lambda m: type(m).__name__,
)  # fmt: skip
def test_what_assembles_with_dolfinx_is_refused(comm, method):
    mesh = meshes.rectangle(comm, (0, 0), (1, 1), (4, 3))
    scene = cb.Scene(mesh, isotropic_two_field(d=2), periodic=(0,))
    with refused(IntegratorError, type(method).__name__, "periodic", "Synchronous()"):
        cb.simulate(scene, method, until=0.1)
