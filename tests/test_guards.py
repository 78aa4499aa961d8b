"""A run that goes wrong stops on all ranks, and says where, when and what to do."""

import re

import numpy as np
import pytest
import ufl
from harness import bent, everywhere, refused

import complexbody as cb
from complexbody import _compat, guards, hessian, meshes
from complexbody.errors import DivergenceError, SceneError, SolverError, StepError
from complexbody.ledger import Bookkeeper
from complexbody.problem import Problem


def square(comm, cells=6):
    return meshes.rectangle(comm, (0.0, 0.0), (1.0, 1.0), (cells, cells))


def linear(U, nu, N):
    return 0.5 * (ufl.inner(U, U) + ufl.inner(N, N) + 2 * ufl.inner(nu, nu))


def hyperelastic(U, nu, N):
    """Neo-Hooke: log det F has no value where a cell is inside out."""
    F = ufl.Identity(3) + U
    J = ufl.det(F)
    return 0.5 * (ufl.inner(F, F) - 3 - 2 * ufl.ln(J) + ufl.ln(J) ** 2) + ufl.inner(N, N)


def body(energy=linear, **more):
    return cb.Body(
        **{"descriptor": 1, "energy": energy, "density": 1.0, "inertia": 1.0, "displacement": 2}
        | more
    )


def quartic(U, nu, N):
    return linear(U, nu, N) + ufl.inner(U, U) ** 2


def original(mesh, values, number):
    """Of the node with that number in the mesh's input, on the ranks that have it; else None."""
    at = np.flatnonzero(np.asarray(mesh.geometry.input_global_indices) == number)
    return values[at[0]] if len(at) else None


@pytest.mark.parametrize(
    ("energy", "is_quadratic"),
    [
        (linear, True),
        (lambda U, nu, N: linear(U, nu, N) + nu[0] ** 4 + ufl.exp(nu[0]) * U[0, 0], True),
        (lambda U, nu, N: (1 + ufl.inner(N, N)) * ufl.inner(U, U), True),
        (quartic, False),
        (lambda U, nu, N: ufl.inner(N, N) + nu[0] * U[0, 0] ** 3, False),
        (lambda U, nu, N: ufl.cos(U[1, 0]) + ufl.inner(N, N), False),
    ],
)
def test_which_energies_are_watched(comm, energy, is_quadratic):
    """Those that are of degree two in U are linear elasticity, whatever they are in ν."""
    mesh = square(comm, 2)
    assert hessian.quadratic_in_gradient(energy, mesh, 2, 1) is is_quadratic
    problem = Problem(cb.Scene(mesh, body(energy)))
    assert guards.Orientation(problem).watched is not is_quadratic
    problem.close()


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_determinants(comm, dim):
    """Those of the cells' edges, moved and not, by numpy; u has three components."""
    mesh = bent(comm, (3,) * dim)
    problem = Problem(cb.Scene(mesh, body(quartic, displacement=3)))
    disc, orientation = problem.disc, guards.Orientation(problem)
    x = np.zeros((disc.nodes + 1, disc.record))
    x[:-1, :dim] = 0.6 * np.sin(5 * disc.position[:-1, :dim] @ np.ones((dim, dim)) + range(dim))
    mine = []
    for block, lane in zip(*np.nonzero(disc.source_cell >= 0), strict=True):
        corners = disc.cells[block, :, lane]
        before = disc.position[corners, :dim]
        after = before + x[corners, :dim]
        known = np.linalg.det(after[1:] - after[0]) / np.linalg.det(before[1:] - before[0])
        found = orientation._det(np.array([block]), x)[0, lane]
        assert found == pytest.approx(known, rel=1e-12, abs=1e-12)
        mine.append((known, _compat.original_cells(mesh)[disc.source_cell[block, lane]]))
    least, number = min(part for rank in comm.allgather(mine) for part in rank)
    place = orientation.worst(x)
    assert least < 0 and place.kind == "cell"
    assert place.value == pytest.approx(least) and place.number == number
    assert comm.allgather(str(place)) == [str(place)] * comm.size
    assert orientation.worst(0.01 * x) is None
    problem.close()


def test_a_cell_inside_out_stops_the_run(comm):
    """Squeezed beyond nothing by a moving support; the same body may be told not to mind."""

    def run(**options):
        scene = cb.Scene(
            square(comm, 3), body(quartic, **options),
            supports=[
                cb.Fix("u", lambda x: x[0] < 1e-9),
                cb.Fix("u", lambda x: x[0] > 1 - 1e-9, value=(-3.0, 0.0), history=cb.ramp(1.0)),
            ],
        )  # fmt: skip
        return cb.simulate(scene, cb.Synchronous(5e-3), until=1.0, growth=None)

    words = "inside out", "det F = -", "cell ", "rank", "t = ", "Use a smaller step", "All was well"
    with refused(DivergenceError, *words) as told:
        run()
    well, stopped = (
        float(re.search(r"well at t = (\S+) s", told[0])[1]),
        re.search(r"By t = (\S+) s \(step (\d+)\)", told[0]),
    )
    assert 0 < well < float(stopped[1]) < 1
    assert run(orientation=False).time == 1.0


def test_linear_bodies_may_move_as_far_as_they_like(comm):
    initial = cb.Initial(u=lambda x: 100 * np.sin(9 * x[:2]))
    scene = cb.Scene(square(comm, 3), body(), initial=initial)
    assert cb.simulate(scene, until=0.05).time == 0.05


def test_energies_without_a_value_inside_out(comm):
    """Log det F of the initial data is not a number: found before the run, and in which cell."""

    def push(x):
        out = np.zeros((3, x.shape[1]))
        out[0, np.hypot(x[0] - 0.52, x[1] - 0.48) < 0.12] = 3.0
        return out

    scene = cb.Scene(square(comm), body(hyperelastic, displacement=3), initial=cb.Initial(u=push))
    with refused(StepError, "not finite at the initial state in cell ", "rank") as told:
        cb.simulate(scene, until=1e-2)
    at = re.search(r"at \((\S+), (\S+)\)", told[0]).groups()
    assert np.hypot(float(at[0]) - 0.52, float(at[1]) - 0.48) < 0.3


@pytest.mark.parametrize("kind", [cb.Synchronous, cb.AVI, cb.LocalLeapfrog])
def test_the_node_where_it_began(comm, kind):
    """A NaN planted at one node: found there after it has spread over several layers."""
    mesh = square(comm, 12)
    initial = cb.Initial(u=lambda x: 0.1 * np.sin(x[:2]))
    problem = Problem(cb.Scene(mesh, body(), initial=initial))
    problem.quiet = False
    run = kind().prepare(problem, 0.1)
    books = Bookkeeper(problem, run)
    books.row()
    numbers = np.asarray(mesh.geometry.input_global_indices)[problem.disc.dof]
    middle = np.linalg.norm(problem.disc.position[:-1, :2] - 0.5, axis=1)
    _, chosen = min(
        pair for rank in comm.allgather(list(zip(middle, numbers, strict=True))) for pair in rank
    )
    run.positions()[:-1][numbers == chosen, 1] = np.nan
    run.advance(2)
    with pytest.raises(DivergenceError, match="non-finite") as told:
        books.row()
    place = told.value.place
    assert place.kind == "node" and place.value > 5
    assert told.value.last_good == 0.0 and len(told.value.ledger) == 2
    # Rates and forces spread it by at most a cell per step in each direction, from there.
    assert np.linalg.norm(np.array(place.position) - 0.5) < 0.15
    assert comm.allgather(str(told.value)) == [str(told.value)] * comm.size
    run.close()
    problem.close()


def test_the_cell_that_explodes(comm):
    """One cell much smaller than the others, the step above its critical one: named by growth."""
    mesh = meshes.graded_interval(comm, [1 / 16] * 8 + [1 / 512] + [1 / 16] * 8)
    initial = cb.Initial(u=lambda x: np.sin(np.pi * x[:1]))
    scene = cb.Scene(mesh, body(displacement=1), initial=initial)
    method = cb.Synchronous(safety=8.0, unstable_ok=True)
    with refused(DivergenceError, "nowhere", "cell ", "rank", "All was well", "smaller") as told:
        cb.simulate(scene, method, until=2.0)
    number, at = re.search(r"in cell (\d+) at \((\S+)\)", told[0]).groups()
    assert float(at) == pytest.approx(0.5 + 1 / 1024, abs=2e-3)
    middles = mesh.geometry.x[_compat.cell_nodes(mesh), 0].mean(axis=1)
    owned = _compat.cell_count(mesh)[0]
    cell = np.flatnonzero(_compat.original_cells(mesh)[:owned] == int(number))
    assert comm.allreduce(len(cell)) == 1
    assert everywhere(comm, all(abs(middles[c] - float(at)) < 1e-6 for c in cell))


@pytest.mark.parametrize("order", [1, 2])
def test_collapsed_inertia_names_its_node(comm, order):
    """χ = ½ν̇²e^{20ν}, whose T₀ shrinks as ν moves away from where the step was chosen."""

    def chi(nu, rate):
        return 0.5 * rate[0] ** 2 * ufl.exp(20 * nu[0])

    scene = cb.Scene(
        square(comm, 2), body(inertia=chi),
        initial=cb.Initial(nu_dot=lambda x: -0.9 - 0.1 * x[:1]),
    )  # fmt: skip
    with refused(SolverError, "t = ", "node", "rank", "smaller step"):
        cb.simulate(scene, cb.Implicit(order=order), until=20.0, ledger_steps=1)


# --- histories -----------------------------------------------------------------------------------

BAD = {
    "raises": lambda t: [][1],
    "is not finite": lambda t: np.full_like(np.asarray(t), np.nan),
    "returned shape": lambda t: np.ones(3),
    "no real numbers": lambda t: "loud",
}


def held(comm, history, support, on=None):
    """A scene with that history, on one rank alone if ``on`` says which."""
    mine = history if on is None or comm.rank == on else cb.constant()
    if support:
        parts = {"supports": [cb.Fix("u", "boundary", value=0.1, history=mine)]}
    else:
        parts = {"loads": [cb.BodyForce((1.0, 0.0), history=mine)]}
    return cb.Scene(square(comm, 2), body(), **parts)


@pytest.mark.parametrize("support", [False, True])
@pytest.mark.parametrize("what", BAD)
def test_histories_that_fail_on_any_rank(comm, what, support):
    """Found before the run, and by all ranks also if only the last one has it."""
    words = "history", "" if what == "raises" else what
    for on in (None, comm.size - 1):
        with refused(SceneError, *words):
            cb.simulate(held(comm, BAD[what], support, on), until=0.1)


@pytest.mark.parametrize("support", [False, True])
@pytest.mark.parametrize(
    "method",
    [cb.Synchronous(), cb.AVI(), cb.LocalLeapfrog(), cb.AssembledLeapfrog(), cb.Implicit()],
)
def test_histories_that_fail_on_the_way_on_any_rank(comm, method, support):
    """Between the times that were tried: all ranks stop at the next row."""
    calls = [0]

    def late(t):
        calls[0] += 1
        if calls[0] > 12:
            raise RuntimeError("the file is gone")
        return np.ones_like(np.asarray(t))

    scene = held(comm, late, support, comm.size - 1)
    with refused(SceneError, "history", "the file is gone"):
        cb.simulate(scene, method, until=5.0, ledger_steps=1)


def test_too_many_steps(comm):
    with refused(StepError, "1e+30 steps", "larger step"):
        cb.simulate(held(comm, cb.constant(), False), cb.Synchronous(1e-30), until=1.0)
