# SPDX-License-Identifier: LGPL-3.0-or-later
"""Components that no source reaches are left out, no others, and no result changes."""

import h5py
import numpy as np
import pytest
import ufl
from dense import halves
from harness import everywhere, largest
from mpi4py import MPI

import complexbody as cb
from complexbody import boundary, loading, meshes
from complexbody.action import Action
from complexbody.errors import CoercivityError
from complexbody.kernels.library import Densities
from complexbody.live import live
from complexbody.problem import Problem

HAT = lambda x: np.exp(-20 * ((x[0] - 0.4) ** 2 + (x[1] - 0.4) ** 2))  # noqa: E731


def bump(n, *components, size=1.0):
    """A callable that is a bump in some of n components."""
    return lambda x: np.stack([size * HAT(x) if i in components else 0 * x[0] for i in range(n)])


def cosserat(U, nu, N):
    """Microrotations φ, held a little: in the plane u1, u2, φ3 and u3, φ1, φ2 fall apart."""
    curl = ufl.as_vector([U[2, 1] - U[1, 2], U[0, 2] - U[2, 0], U[1, 0] - U[0, 1]])
    turn = 0.5 * curl - nu
    strain = ufl.sym(U)
    return (0.5 * ufl.tr(strain) ** 2 + 1.3 * ufl.inner(strain, strain)
            + 0.6 * ufl.inner(turn, turn) + 0.4 * ufl.inner(N, N)
            + 0.1 * ufl.inner(nu, nu))  # fmt: skip


def apart(U, nu, N):
    """u and ν in one body, not coupled."""
    strain = ufl.sym(U)
    return (0.5 * ufl.tr(strain) ** 2 + ufl.inner(strain, strain) + 0.5 * ufl.inner(N, N)
            + 0.2 * ufl.inner(nu, nu))  # fmt: skip


def body(energy=cosserat, inertia=0.7, viscosity=0.0, potential=None):
    """ρ = 1, three components each."""
    return cb.Body(3, energy, 1.0, inertia, viscosity, potential)


def plane(comm, which=None, cells=(9, 8), **more):
    """A scattered mesh of the unit square."""
    mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 1), cells), 0.2, 3)
    return cb.Scene(mesh, which or body(), **more)


def reached(scene):
    """Live components, without making anything ready to run."""
    action = Action(scene)
    data = boundary.supports(scene, action), loading.loads(scene, action)
    found = live(scene, Densities(action), *data, boundary.initial(scene, action))
    return list(found.components)


def components(scene):
    """Live components as the problem finds them, the same on all ranks."""
    problem = Problem(scene, reduce=True)
    found = problem.live.components
    assert everywhere(scene.mesh.comm, found == scene.mesh.comm.bcast(found))
    assert problem.disc.n == len(found) and problem.kernels.x.shape[1] >= len(found)
    problem.close()
    return list(found)


OUT, IN = [2, 3, 4], [0, 1, 5]
LEFT = lambda x: x[0] < 1e-9  # noqa: E731


@pytest.mark.parametrize(
    "more, expected",
    [
        ({"initial": cb.Initial(u=bump(3, 2))}, OUT),
        ({"initial": cb.Initial(nu_dot=bump(3, 0))}, OUT),
        ({"initial": cb.Initial(u_dot=bump(3, 0))}, IN),
        ({"initial": cb.Initial(nu=bump(3, 2))}, IN),
        ({"loads": [cb.Traction(LEFT, (0, 0, 1.0), cb.ricker(1.0))]}, OUT),
        ({"loads": [cb.BodyForce((0, 1.0, 0), field="nu")]}, OUT),
        ({"loads": [cb.Pressure(LEFT, 1.0)]}, IN),
        ({"supports": [cb.Fix("u", LEFT, (0, 0, 0.1), history=cb.sine(1.0))]}, OUT),
        ({"supports": [cb.Fix("u", LEFT)], "initial": cb.Initial(u=bump(3, 2))}, OUT),
        # Almost: something small is something, and nothing at all leaves everything.
        ({"initial": cb.Initial(u=bump(3, 2), nu=bump(3, 2, size=1e-300))}, [*range(6)]),
        ({"initial": cb.Initial(u=bump(3, 2)), "loads": [cb.Pressure(LEFT, 1e-30)]}, [*range(6)]),
        ({}, [*range(6)]),
    ],
)
def test_sources(comm, more, expected):
    assert components(plane(comm, **more)) == sorted(expected)


def with_term(term, energy=cosserat):
    return lambda U, nu, N: energy(U, nu, N) + term(U, nu, N)


@pytest.mark.parametrize(
    "which, expected",
    [
        (body(), OUT),
        (body(apart), [2]),
        (body(potential=lambda u, nu: 0.2 * ufl.inner(u, u)), OUT),
        # Almost: a coupling far below round-off of the results is one; so is prestress.
        (body(with_term(lambda U, nu, N: 1e-25 * U[0, 0] * U[2, 1])), [*range(6)]),
        (body(potential=lambda u, nu: 1e-9 * (u[2] + u[0]) ** 2), [*range(6)]),
        (body(potential=lambda u, nu: 1e-9 * nu[2]), [*range(6)]),
        (body(with_term(lambda U, nu, N: 1e-9 * U[0, 0])), [*range(6)]),
        (body(apart, viscosity=np.eye(3) + 0.1), [2]),
        (body(inertia=np.eye(3) + 0.1), [*range(6)]),
        (body(viscosity=np.diag([1.0, 0, 0])), OUT),
    ],
)
def test_couplings(comm, which, expected):
    scene = plane(comm, which, initial=cb.Initial(u=bump(3, 2)))
    assert components(scene) == sorted(expected)


def test_gradients_that_exist(comm):
    """∂₃ couples what the plane does not: in space nothing falls apart."""
    mesh = meshes.box(comm, (0, 0, 0), (1, 1, 1), (2, 2, 2))
    scene = cb.Scene(mesh, body(), initial=cb.Initial(u=bump(3, 2)))
    assert components(scene) == [*range(6)]


def finite(U, nu, N):
    """St Venant and Kirchhoff's energy of F = I + U, and ν apart."""
    F = ufl.Identity(3) + U
    E = 0.5 * (F.T * F - ufl.Identity(3))
    return 0.5 * ufl.tr(E) ** 2 + ufl.inner(E, E) + 0.5 * ufl.inner(N, N) + nu[1] ** 2 * nu[0] ** 2


def test_densities_that_are_not_quadratic(comm):
    """In the plane a motion stays there; out of it, it drives the plane by its square."""
    for source, expected in ((0, [0, 1]), (2, [0, 1, 2]), (3, [3]), (4, [4])):
        part = {"u": bump(3, source)} if source < 3 else {"nu": bump(3, source - 3)}
        scene = plane(comm, body(finite, viscosity=1.0), initial=cb.Initial(**part))
        assert reached(scene) == expected, source
    # A force that exists only in large motions is one.
    beyond = with_term(
        lambda U, nu, N: ufl.conditional(ufl.gt(U[0, 0], 5.0), nu[0] * U[0, 0] ** 2, 0.0), finite
    )
    scene = plane(comm, body(beyond, viscosity=1.0), initial=cb.Initial(u=bump(3, 0)))
    assert reached(scene) == [0, 1, 3]


METHODS = {
    "synchronous": cb.Synchronous(),
    "global": cb.Synchronous(critical="global"),
    "balanced": cb.AVI(),
    "plain": cb.AVI(balanced=False),
    "real steps": cb.AVI(schedule="exact"),
    "local leapfrog": cb.LocalLeapfrog(),
    "implicit": cb.Implicit(),
}
CASES = {
    "out of plane": (body(viscosity=0.3), {"u": bump(3, 2)}),
    "u alone": (body(apart, viscosity=0.3), {"u": bump(3, 0, 1, 2)}),
    "nu alone": (body(apart, np.eye(3) + 0.1, np.eye(3) + 0.2), {"nu": bump(3, 0, 1, 2)}),
    "stiff": (body(with_term(lambda U, nu, N: 1e5 * ufl.inner(nu, nu), apart)), {"nu": bump(3, 1)}),
}


def same(one, other, comm, tolerance=1e-13):
    """Fields and books of two runs."""
    for name in ("u", "nu", "u_dot", "nu_dot"):
        a, b = getattr(one, name).x.array, getattr(other, name).x.array
        assert a.shape == b.shape
        assert largest(comm, a - b) <= tolerance * max(largest(comm, b), 1e-300), name
    assert len(one.ledger) == len(other.ledger) and one.ledger.columns == other.ledger.columns
    size = max(np.abs(other.ledger[c]).max() for c in ("kinetic_u", "kinetic_nu", "stored"))
    for column in ("kinetic_u", "kinetic_nu", "stored", "potential", "work", "dissipated"):
        assert np.abs(one.ledger[column] - other.ledger[column]).max() <= 1e-12 * size, column


PAIRS = [(name, "out of plane") for name in METHODS]
PAIRS += [("synchronous", case) for case in CASES if case != "out of plane"]
PAIRS += [("local leapfrog", "u alone"), ("balanced", "nu alone"), ("real steps", "stiff")]


@pytest.mark.parametrize("name, case", PAIRS)
def test_results_are_those_of_all_components(comm, name, case):
    which, initial = CASES[case]
    action = "implicit" if case == "stiff" else "consistent"
    scene = plane(comm, which, initial=cb.Initial(**initial), self_action=action)
    less, every = (cb.simulate(scene, METHODS[name], until=0.3, plan=p) for p in (True, False))
    assert less.stats.bytes_per_cell < every.stats.bytes_per_cell
    assert (less.stats.step, less.stats.critical, less.stats.updates) == (
        every.stats.step, every.stats.critical, every.stats.updates,
    )  # fmt: skip
    same(less, every, comm)


def test_everything_at_once(comm):
    """Moving supports, loads, regions, potential: what falls apart runs as a whole does."""
    mesh = meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 1), (9, 8)), 0.2, 3)
    bodies = {1: body(viscosity=0.2, potential=lambda u, nu: 0.3 * u[2] ** 2), 2: body(apart)}
    scene = cb.Scene(
        mesh, bodies, cell_tags=halves(mesh),
        supports=[cb.Fix("u", LEFT, (0, 0, 0.1), history=cb.sine(1.0)), cb.Fix("nu", LEFT)],
        loads=[cb.BodyForce((0, 0, -1.0)), cb.BodyForce((0, 0.4, 0), cb.ramp(0.2), field="nu")],
        initial=cb.Initial(u_dot=bump(3, 2)),
    )  # fmt: skip
    assert components(scene) == OUT
    less, every = (cb.simulate(scene, until=0.5, plan=p) for p in (True, False))
    same(less, every, comm)


def test_files_have_all_components(comm, shared_path):
    """Fields, derived ones, probes and books on disk are those of the whole."""
    scene = plane(comm, initial=cb.Initial(u=bump(3, 2)))
    found = {}
    for plan in (True, False):
        folder = shared_path / str(plan)
        output = cb.Output(folder, every=0.1, fields=("u", "nu", "stress"),
                           probes={"here": (0.3, 0.3)})  # fmt: skip
        result = cb.simulate(scene, until=0.2, output=output, plan=plan)
        found[plan] = result
        if comm.rank == 0:
            assert result.probes["here"]["u"].shape[1] == 3
    same(*found.values(), comm)
    if comm.rank == 0:
        for name in ("u", "nu", "stress"):
            sets = []
            for plan in (True, False):
                with h5py.File(shared_path / str(plan) / f"{name}.h5") as file:
                    parts = []
                    file.visititems(
                        lambda _, d, parts=parts: parts.append(d[()])
                        if isinstance(d, h5py.Dataset) else None
                    )  # fmt: skip
                sets.append(parts)
            assert len(sets[0]) == len(sets[1]) >= 3
            for a, b in zip(*sets, strict=True):
                np.testing.assert_allclose(a, b, rtol=0, atol=1e-13 * max(np.abs(b).max(), 1e-300))


@pytest.mark.serial
def test_what_is_left_out_is_checked_all_the_same():
    """An energy that is not coercive is refused although no source reaches where."""
    bad = with_term(lambda U, nu, N: -3.0 * U[0, 0] ** 2)
    scene = plane(MPI.COMM_SELF, body(bad), initial=cb.Initial(u=bump(3, 2)))
    with pytest.raises(CoercivityError):
        cb.simulate(scene, until=0.1)
