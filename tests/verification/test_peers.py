# SPDX-License-Identifier: LGPL-3.0-or-later
"""``AssembledLeapfrog``, ``Newmark`` and ``PetscTS``: what one would take in the place of ours."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import ufl
from busy import busy, waves
from dense import Dense, halves, prepared, quadratic, random_hessian, slopes, state, values
from harness import largest, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes
from complexbody.errors import DivergenceError, IntegratorError, SolverError, StepError
from complexbody.problem import Problem

OMEGA, ETA = np.array([[1.3, 0.4], [0.4, 0.7]]), np.array([[0.5, -0.3], [-0.3, 2.0]])
FIELDS = ("u", "nu", "u_dot", "nu_dot")


def held(scene):
    """The scene with its supports where they are at factor 1."""
    return replace(scene, supports=[replace(s, history=cb.constant()) for s in scene.supports])


@pytest.mark.parametrize(
    ("dim", "kind", "quartic", "force", "dissipation"),
    [
        (2, "numbers", 0.0, "matrix", "exact"),
        (2, "blocks", 0.5, "assembly", "exact"),
        (2, "numbers", 0.0, "assembly", "symmetric"),
        (1, "no inertia", 0.0, "matrix", "forward"),
    ],
)
def test_assembled_leapfrog_is_synchronous(comm, dim, kind, quartic, force, dissipation):
    """Fields, rates and books, with moving supports, loads, prestress, two regions; one count."""
    scene = busy(comm, dim, kind, quartic)
    until = 30 * prepared(scene, cb.Synchronous(dissipation=dissipation)).step
    ours = cb.simulate(
        scene, cb.Synchronous(dissipation=dissipation), until=until, ledger_steps=4
    )
    theirs = cb.simulate(
        scene, cb.AssembledLeapfrog(force, dissipation=dissipation), until=until, ledger_steps=4
    )
    for name in FIELDS:
        x, y = (getattr(r, name).x.array for r in (ours, theirs))
        assert largest(comm, x - y) < 1e-11 * largest(comm, x), name
    for name in ours.ledger.columns:
        if not name.startswith("variation"):
            x, y = ours.ledger[name], theirs.ledger[name]
            assert np.abs(x - y).max() < 1e-11 * max(np.abs(x).max(), 1.0), name
    assert np.abs(theirs.ledger["support_work"]).max() > 1e-6
    assert (theirs.stats.steps, theirs.stats.updates) == (ours.stats.steps, ours.stats.updates)


def damped(comm, viscosity=ETA):
    """Two regions with block inertia, fixed supports, no loads; and the same as matrices."""
    mesh, H = (
        meshes.jiggled(meshes.rectangle(comm, (0, 0), (1, 0.8), (4, 3)), 0.2),
        [random_hessian(seed, 2, 2, 2) for seed in (1, 2)],
    )
    bodies = [
        cb.Body(2, quadratic(H[0], 2), 1.4, OMEGA, viscosity, displacement=2),
        cb.Body(2, quadratic(H[1], 2), 0.9, 1.2, viscosity, displacement=2),
    ]
    supports = [cb.Fix("u", lambda x: x[0] < 1e-9), cb.Fix("nu", lambda x: x[0] > 1 - 1e-9)]
    initial = cb.Initial(waves(2, 2), waves(2, 3), waves(2, 4), waves(2, 5))
    scene = cb.Scene(mesh, dict(enumerate(bodies, 1)), supports, initial=initial,
                     cell_tags=halves(mesh))  # fmt: skip
    return scene, Dense(mesh, bodies, hessians=H)


def exact(dense, x, v, until):
    """The matrix exponential of the semi-discrete equations, from the nodes' (x, v)."""
    fixed = np.zeros_like(x, bool)
    fixed[dense.points[:, 0] < 1e-9, :2] = True
    fixed[dense.points[:, 0] > 1 - 1e-9, 2:] = True
    ix, held = dense.free(fixed), np.flatnonzero(fixed.ravel())
    M, D, K = (m[np.ix_(ix, ix)] for m in (dense.full(dense.M), dense.full(dense.D), dense.K))
    # Prescribed values stay, and pull at the others.
    rest = np.linalg.solve(K, -dense.K[np.ix_(ix, held)] @ x.ravel()[held])
    zero, eye = np.zeros_like(M), np.eye(len(M))
    system = np.block([[zero, eye], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
    y = scipy.linalg.expm(until * system) @ np.r_[x.ravel()[ix] - rest, v.ravel()[ix]]
    out = x.ravel().copy(), v.ravel().copy()
    out[0][ix], out[1][ix] = y[: len(ix)] + rest, y[len(ix) :]
    return np.array(out)


METHODS = {
    "leapfrog": (lambda h: cb.AssembledLeapfrog("matrix", step=h), 1e-2),
    "newmark": (lambda h: cb.Newmark(h), 1e-2),
    "dissipative newmark": (lambda h: cb.Newmark(h, beta=0.4, gamma=0.7), 4e-3),
    "alpha2": (lambda h: cb.PetscTS("alpha2", h), 1e-2),
    "rk4": (lambda h: cb.PetscTS("rk4", h), 1e-2),
    "cn": (lambda h: cb.PetscTS("cn", h), 1e-2),
    "theta": (lambda h: cb.PetscTS("theta", h), 1e-2),
}


def test_orders_on_the_exact_solution(comm):
    """Slopes of fields and rates together are those the traits claim."""
    scene, dense = damped(comm)
    problem, until = Problem(scene), 0.2
    for name, (make, h) in METHODS.items():
        errors, steps = [], []
        for n in (1, 2, 4):
            run = make(h / n).prepare(problem, until)
            if name == "leapfrog" and n == 1:
                expected = exact(dense, *state(run), until)
            run.advance(round(until / run.step))
            found = np.reshape(state(run), expected.shape)
            errors.append(np.abs(found - expected).max())
            steps.append(run.step)
            run.close()
        order = make(h).order
        assert np.all(abs(slopes(steps, errors) - order) < 0.15), (name, errors)
        assert errors[-1] < 5e-2, name


@pytest.mark.serial
@pytest.mark.parametrize("quartic", [0.0, 0.5])
def test_loads_and_nonlinear_energies(comm, quartic):
    """Loads with histories, prestress, potential, a quartic energy, against small steps of RK4."""
    problem, until = Problem(held(busy(comm, 1, "numbers", quartic))), 0.2

    def ends(method):
        run = method.prepare(problem, until)
        run.advance(round(until / run.step))
        fields = state(run)[0]
        run.close()
        return fields

    reference = ends(cb.PetscTS("rk4", 5e-4))
    for name, (make, _) in METHODS.items():
        if name in ("rk4", "dissipative newmark") or (quartic and name == "leapfrog"):
            continue
        errors = [np.abs(ends(make(h)) - reference).max() for h in (2e-3, 1e-3)]
        assert 1.7 < np.log2(errors[0] / errors[1]) < 2.3, (name, errors)
        assert errors[1] < 5e-3, name


@pytest.mark.serial
def test_energy_of_newmark_stays(comm):
    """Without viscosity, at five times the critical step; with γ > ½ it falls."""
    scene, _ = damped(comm, viscosity=0.0)
    step = 5 * prepared(scene, cb.Synchronous()).critical
    for gamma, beta in ((0.5, 0.25), (0.6, 0.4)):
        ledger = cb.simulate(
            scene, cb.Newmark(step, beta, gamma), until=150 * step, ledger_steps=10
        ).ledger
        balance = np.abs(ledger["balance"]) / (ledger["kinetic_u"] + ledger["stored"])[0]
        if gamma == 0.5:
            assert balance.max() < 1e-8
        else:
            assert balance[-1] > 0.1


@pytest.mark.serial
def test_books_close(comm):
    """The trapezoidal rule balances work and dissipation of its steps, RK4 to its own order."""
    scene = held(busy(comm, 2, "blocks"))
    for method, most in (
        (cb.Newmark(0.01), 1e-8), (cb.PetscTS("cn", 0.01), 1e-8),
        (cb.PetscTS("rk4", 0.01), 1e-5), (cb.PetscTS("alpha2", 0.01), 1e-3),
    ):  # fmt: skip
        ledger = cb.simulate(scene, method, until=0.5, ledger_steps=1).ledger
        assert np.abs(ledger["balance"]).max() < most, method
        assert ledger["dissipated"][-1] > 0.05 and abs(ledger["work"][-1]) > 1e-3


@pytest.mark.serial
def test_rk4_is_stable_up_to_its_limit(comm):
    """And not much above it."""
    for viscosity in (0.0, 40.0):
        scene, _ = damped(comm, viscosity=viscosity)
        critical = prepared(scene, cb.PetscTS("rk4")).critical
        ledger = cb.simulate(scene, cb.PetscTS("rk4", critical), until=200 * critical).ledger
        energies = ledger["kinetic_u"] + ledger["kinetic_nu"] + ledger["stored"]
        assert energies[-1] < 1.1 * energies[0]
        with refused(DivergenceError):
            # Cells bound the critical step from below.
            method = cb.PetscTS("rk4", 1.7 * critical, unstable_ok=True)
            cb.simulate(scene, method, until=200 * critical)


@pytest.mark.parametrize(
    ("method", "most", "quartic"),
    [
        (cb.AssembledLeapfrog("matrix"), 1e-11, 0.0),
        (cb.PetscTS("rk4"), 1e-11, 0.5),
        (cb.Newmark(0.02), 1e-9, 0.0),
        (cb.Newmark(0.02), 1e-9, 0.5),
        (cb.PetscTS("alpha2", 0.02), 1e-9, 0.0),
        (cb.PetscTS("cn", 0.02), 1e-9, 0.5),
    ],
    ids=["leapfrog", "rk4", "newmark", "nonlinear newmark", "alpha2", "cn"],
)
def test_ranks_agree(comm, method, most, quartic):
    """With one rank that has it all; books too."""
    results = []
    for here in (MPI.COMM_SELF, comm):
        scene = held(busy(here, 2, "blocks", quartic))
        results.append(cb.simulate(scene, method, until=0.2, ledger_steps=2))
    found = []
    for result in results:
        mesh = result.u.function_space.mesh
        points = np.concatenate(mesh.comm.allgather(_owned_points(mesh)))
        order = np.lexsort(np.round(points, 9).T)
        found.append(values(*(getattr(result, name) for name in FIELDS))[order])
    assert np.abs(found[0] - found[1]).max() < most * np.abs(found[0]).max()
    for name in ("kinetic_nu", "stored", "work", "dissipated"):
        alone, shared = (r.ledger[name] for r in results)
        assert np.abs(alone - shared).max() < most * max(1.0, np.abs(alone).max()), name


def _owned_points(mesh):
    return mesh.geometry.x[: mesh.geometry.index_map().size_local]


def test_steps_end_at_the_end(comm):
    """Given steps are shortened: no interpolation at the end."""
    scene, _ = damped(comm)
    for method in (cb.AssembledLeapfrog(step=0.0173), cb.Newmark(0.0173), cb.PetscTS("cn", 0.0173)):
        result = cb.simulate(scene, method, until=0.05)
        assert (result.stats.steps, result.time) == (3, 0.05)
        assert result.stats.step == 0.05 / 3


@pytest.mark.parametrize(
    ("quartic", "stop", "words"),
    [
        (0.5, {"snes_max_it": "1", "ksp_rtol": "0.5"}, "SNES: Newton does not converge"),
        (0.0, {"ksp_max_it": "1", "pc_type": "none"}, "the linear solve"),
    ],
)
def test_a_step_without_a_solution_keeps_the_last_state(comm, quartic, stop, words):
    """Solvers that may not iterate: told by the reason, fields as they were."""
    scene = held(busy(comm, 1, "numbers", quartic))
    for method in (
        cb.Newmark(0.05, options=stop), cb.PetscTS("alpha2", 0.05, options=stop),
        cb.PetscTS("cn", 0.05, options=stop),
    ):  # fmt: skip
        seen = []

        def run(method=method, seen=seen):
            try:
                cb.simulate(scene, method, until=1.0)
            except SolverError as error:
                seen.append(error)
                raise

        with refused(SolverError, "t = 0", words):
            run()
        start = cb.simulate(scene, cb.AssembledLeapfrog(), until=1e-9)
        assert seen[0].result.time == 0.0
        assert largest(comm, seen[0].result.nu.x.array - start.nu.x.array) < 1e-7


def test_refusals(comm):
    """What a peer cannot take, by name and with what can."""
    peers = (cb.AssembledLeapfrog(), cb.Newmark(0.01), cb.PetscTS("cn", 0.01), cb.PetscTS("rk4"))
    mesh = meshes.interval(comm, 0, 1, 4)

    def bar(inertia=1.0, viscosity=0.0, **more):
        def energy(U, nu, N):
            return 0.5 * (ufl.inner(U, U) + ufl.inner(N, N) + nu[0] ** 2)

        return cb.Scene(mesh, cb.Body(1, energy, 1.0, inertia, viscosity, displacement=1), **more)

    general = bar(lambda nu, v: 0.5 * (1 + nu[0] ** 2) * v[0] ** 2)
    for peer in peers:
        name = type(peer).__name__
        with refused(IntegratorError, name, "Implicit()"):
            cb.simulate(general, peer, until=0.1)
        for self_action in ("lumped", "implicit"):
            with refused(IntegratorError, name, "self_action"):
                cb.simulate(bar(self_action=self_action), peer, until=0.1)
        if isinstance(peer, cb.AssembledLeapfrog):
            continue
        with refused(IntegratorError, name, "inertia", "AssembledLeapfrog()"):
            cb.simulate(bar(0.0, 1.0), peer, until=0.1)
        moving = bar(supports=[cb.Fix("u", lambda x: x[0] < 1e-9, 0.1, history=cb.sine(1.0))])
        with refused(IntegratorError, name, "support", "AssembledLeapfrog()"):
            cb.simulate(moving, peer, until=0.1)
    with refused(IntegratorError, "force='matrix'", "force='assembly'"):
        cb.simulate(held(busy(comm, 1, "numbers", 0.5)), cb.AssembledLeapfrog("matrix"), until=0.1)
    for peer in (cb.AssembledLeapfrog(step=1.0), cb.PetscTS("rk4", 1.0)):
        with refused(StepError, "critical", "unstable_ok=True"):
            cb.simulate(bar(), peer, until=2.0)
    for peer in (cb.Newmark(), cb.PetscTS()):
        with refused(StepError, type(peer).__name__, "step="):
            cb.simulate(bar(), peer, until=2.0)
    for make in (cb.Newmark, lambda h, options: cb.PetscTS("alpha2", h, options=options),
                 lambda h, options: cb.PetscTS("theta", h, options=options)):  # fmt: skip
        with refused(IntegratorError, "PETSc", "bogus"):
            cb.simulate(bar(), make(0.1, options={"pc_type": "bogus"}), until=2.0)


def test_options_that_do_not_exist():
    for make, name in (
        (lambda: cb.AssembledLeapfrog("magic"), "force"),
        (lambda: cb.AssembledLeapfrog(dissipation="none"), "dissipation"),
        (lambda: cb.PetscTS("euler", 0.1), "kind"),
        (lambda: cb.PetscTS("alpha2", 0.1, radius=1.5), "radius"),
        (lambda: cb.Newmark(0.1, beta=0.1), "beta"),
        (lambda: cb.Newmark(0.1, gamma=0.4), "gamma"),
    ):
        with refused(IntegratorError, name):
            make()
    for make in (cb.Newmark, lambda h: cb.PetscTS("cn", h), lambda h: cb.AssembledLeapfrog(step=h)):
        with refused(StepError, "step"):
            make(-1.0)


def test_traits():
    """What charts and tables read."""
    for method, order, explicit, symplectic in (
        (cb.AssembledLeapfrog(), 2, True, True),
        (cb.AssembledLeapfrog(dissipation="forward"), 1, True, True),
        (cb.Newmark(0.1), 2, False, True),
        (cb.Newmark(0.1, 0.4, 0.7), 1, False, False),
        (cb.PetscTS("alpha2", 0.1), 2, False, False),
        (cb.PetscTS("alpha2", 0.1, radius=0.8), 1, False, False),
        (cb.PetscTS("rk4"), 4, True, False),
        (cb.PetscTS("cn", 0.1), 2, False, False),
        (cb.PetscTS("theta", 0.1), 2, False, True),
    ):
        assert (method.order, method.explicit, method.symplectic) == (order, explicit, symplectic)
        assert not method.asynchronous and "k×k" in method.inertia
