# SPDX-License-Identifier: LGPL-3.0-or-later
"""First-order fields: ``inertia=0`` with η > 0, explicit, and ``Implicit(forces="implicit")``."""

import dolfinx
import numpy as np
import pytest
import scipy.linalg
import ufl
from dense import Dense, halves, quadratic, random_hessian, slopes, values
from harness import bent, largest, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat
from complexbody.errors import IntegratorError, SolverError, StepError
from complexbody.integrators.nu_stiffness import NuStiffness
from complexbody.problem import Problem
from complexbody.timesets import HELD, critical_step

A, K, R, K0 = 1.0, 0.8, 0.5, 0.6  # moduli of the scalar pair


def pair(comm, cells, rho=0.0, eta=1.0, u=1.0, nu=0.5, q=np.pi, stiff=K, **more):
    """½A u'² + R u'ν' + ½K ν'² + ½k0 ν² on a unit interval, free at its ends, from cos qx."""
    body = cb.Body(
        1, lambda U, nu, N: 0.5 * A * ufl.inner(U, U) + 0.5 * stiff * ufl.inner(N, N)
        + R * U[0, 0] * N[0, 0] + 0.5 * K0 * nu[0] ** 2, 1.0, rho, eta, displacement=1,
    )  # fmt: skip
    mesh = dolfinx.mesh.create_interval(comm, cells, [0.0, 1.0])
    start = cb.Initial(u=lambda x: u * np.cos(q * x[0]), nu=lambda x: nu * np.cos(q * x[0]))
    return cb.Scene(mesh, body, initial=start, self_action="lumped", **more)


def amplitudes(t, cells, rho=0.0, eta=1.0, u=1.0, nu=0.5, q=np.pi, stiff=K):
    """(u, ν, u̇, ν̇) of the semi-discrete pair at t: cos qx is its eigenvector on this mesh."""
    square = (2 * cells * np.sin(q / cells / 2)) ** 2
    k = np.array([[A * square, R * square], [R * square, stiff * square + K0]])
    if rho > 0:
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [-k / [[1.0], [rho]], np.zeros((2, 2))]])
        matrix[3, 3] = -eta / rho
        return scipy.linalg.expm(matrix * t) @ [u, nu, 0.0, 0.0]
    matrix = np.array([[0, 0, 1.0], [-k[1, 0] / eta, -k[1, 1] / eta, 0], [-k[0, 0], -k[0, 1], 0]])
    x = scipy.linalg.expm(matrix * t) @ [u, nu, 0.0]
    return np.array([*x, -(k[1] @ x[:2]) / eta])


def errors(result, exact, q=np.pi):
    """Largest errors of u, ν and both rates."""
    wave = np.cos(q * result.scene.mesh.geometry.x[:, 0])
    fields = (result.u, result.nu, result.u_dot, result.nu_dot)
    comm = result.scene.mesh.comm
    return [largest(comm, f.x.array - a * wave) for f, a in zip(fields, exact, strict=True)]


@pytest.mark.parametrize("rho, eta", ((0.0, 1.0), (0.4, 0.3), (0.4, 0.0)))
@pytest.mark.parametrize("order", (1, 2))
def test_orders(comm, rho, eta, order):
    """Fields and rates against the matrix exponential, with inertia and without; books."""
    exact, found, books = amplitudes(1.0, 16, rho, eta), [], []
    steps = np.array([1 / 40, 1 / 80])
    for h in steps:
        method = cb.Implicit(h, order=order, forces="implicit")
        result = cb.simulate(pair(comm, 16, rho, eta), method, until=1.0, ledger_steps=1)
        found.append(errors(result, exact))
        books.append(np.abs(result.ledger["balance"]).max())
        if order == 2:
            assert 0 < np.abs(result.ledger["identity"]).max() < 1e-12
    found = np.array(found)
    slack = 0.12 if order == 2 else 0.35
    assert np.all(np.abs(slopes(steps, found) - order) < slack), slopes(steps, found)
    assert found[1, :2].max() < (2e-3 if order == 2 else 0.1)
    assert np.all(slopes(steps, books) > order - 0.25), books


@pytest.mark.parametrize("stiff, ratio", ((0.4, 300), (40.0, 3e4)))
def test_stiff_diffusion_takes_the_waves_step(comm, stiff, ratio):
    """Far beyond the explicit limit of ν, which ``Synchronous`` names: waves of u within 1 %."""
    cells, eta, until = 40, 0.05, 2.0
    limit = eta / cells**2 / (2 * stiff)
    scene = pair(comm, cells, 0.0, eta, stiff=stiff)
    step = 0.5 / cells
    assert step > ratio * limit
    with refused(StepError, "critical step", f"{critical_step(Problem(scene)):.6g}"):
        cb.simulate(scene, cb.Synchronous(step), until=until)
    exact = amplitudes(until, cells, 0.0, eta, stiff=stiff)
    for order, bound in ((2, 0.01), (1, 0.02)):
        method = cb.Implicit(step, order=order, forces="implicit")
        result = cb.simulate(scene, method, until=until)
        found = errors(result, exact)
        assert max(found[:2]) < bound and found[2] < np.pi * bound, found
        assert "1.00 Newton iterations per step" in result.solving
        if order == 2:
            assert np.abs(result.ledger["identity"]).max() < 1e-11
    # The step that it would choose is that of u.
    assert abs(result.stats.critical - 1 / cells) < 1e-6 / cells


def test_explicit_limit_is_the_formula(comm):
    """ηL²/(2K) of diffusion alone (R = k0 = 0) on cells of length L, beside L/c of waves."""
    for eta, stiff in ((1.0, 1.0), (0.01, 3.0), (50.0, 0.1)):
        body = cb.Body(1, lambda U, nu, N, s=stiff: 0.5 * ufl.inner(U, U) + 0.5 * s *
                       ufl.inner(N, N), 1.0, 0.0, eta, displacement=1)  # fmt: skip
        problem = Problem(cb.Scene(dolfinx.mesh.create_interval(comm, 20, [0.0, 1.0]), body))
        limit = eta / 20**2 / (2 * stiff)
        assert abs(critical_step(problem) / min(limit, 1 / 20) - 1) < 1e-6
        assert abs(critical_step(problem, HELD) * 20 - 1) < 1e-9


@pytest.mark.parametrize("order", (1, 2))
def test_without_forces_implicit_it_is_the_explicit_scheme(comm, order):
    """``Implicit()`` takes inertia=0 as ``Synchronous`` does, and is it."""
    scheme, start = ("exact", "trapezoidal") if order == 2 else ("forward", "one-sided")
    one = cb.simulate(pair(comm, 16), cb.Synchronous(dissipation=scheme, start=start), until=0.5)
    two = cb.simulate(pair(comm, 16), cb.Implicit(order=order), until=0.5)
    for name in ("u", "nu", "u_dot", "nu_dot"):
        assert largest(comm, getattr(one, name).x.array - getattr(two, name).x.array) < 1e-11
    # Its limit is that of the implicit scheme as well.
    fine = cb.simulate(pair(comm, 16), cb.Implicit(0.01, forces="implicit"), until=0.5)
    assert largest(comm, one.nu.x.array - fine.nu.x.array) < 0.02


def one_step(run):
    """The linear map of one step of a run on (u, ν, u̇, w), columns by unit vectors."""
    kernels, n, n_u, size = run.problem.kernels, run.n, run.n_u, run.start.size
    full = 2 * size if np.any(run.inertia) else size + run.rate[:, :n_u].size
    columns = []
    for unit in np.eye(full):
        kernels.x[:-1, :n] = unit[:size].reshape(-1, n)
        run.rate[:] = 0.0
        rates = unit[size:].reshape(len(run.rate), -1)
        run.rate[:, : rates.shape[1]] = rates
        run.momentum[:] = np.einsum("aij,aj->ai", run.inertia, run.rate[:, n_u:])
        run.ahead = False
        run.advance(1)
        rates = run.rate[:, : rates.shape[1]]
        columns.append(np.concatenate([kernels.x[:-1, :n].ravel(), rates.ravel()]))
    return np.array(columns).T


@pytest.mark.serial
@pytest.mark.parametrize("order", (1, 2))
@pytest.mark.parametrize("rho, eta", ((0.0, 0.02), (1e-3, 0.1), (0.5, 0.0)))
def test_stable_up_to_the_step_of_u_alone(comm, rho, eta, order):
    """Spectral radius of the step, random coercive energies that couple all of u, ν and gradients.

    For order 2 that of the assembled K_uu is sharp: above it the map has an eigenvalue beyond 1.
    """
    for seed in range(3):
        body = cb.Body(2, quadratic(random_hessian(seed, 1, 2, 1), 1), 1.0, rho, eta,
                       displacement=1)  # fmt: skip
        mesh = bent(comm, (5,))
        supports = [cb.Fix(name, lambda x: x[0] < 0.1) for name in ("u", "nu")]

        def radius(step, ok=False, body=body, mesh=mesh, supports=supports):
            method = cb.Implicit(step, order=order, forces="implicit", unstable_ok=ok)
            run = method.prepare(Problem(cb.Scene(mesh, body, supports=supports)), 1.0)
            found = np.abs(np.linalg.eigvals(one_step(run)))
            run.close()
            return found.max()

        bound = critical_step(Problem(cb.Scene(mesh, body, supports=supports)), HELD)
        dense = Dense(mesh, body)
        held = np.flatnonzero(dense.points[:, 0] > 0.1) * dense.n
        mass = dense.volume[held // dense.n]
        top = scipy.linalg.eigh(dense.K[np.ix_(held, held)], np.diag(mass), eigvals_only=True)[-1]
        exact = 2 / np.sqrt(top)
        assert bound <= exact
        for step in (0.3 * bound, bound, 0.999 * exact):
            assert radius(step, ok=step > bound) < 1 + 1e-9, (seed, step)
        # At λ = −1 midpoint's ν stands still: sharp. Backward Euler's still gives way.
        assert radius((1.02 if order == 2 else 1.5) * exact, ok=True) > 1.0005


def test_energy_without_drift(comm):
    """ρ̄ > 0, η = 0, at a step 20 times that of ν: bounded balance over 300 steps, identity."""
    scene = pair(comm, 20, 1e-4, 0.0, q=2 * np.pi)
    method = cb.Implicit(0.04, forces="implicit")
    assert 0.04 > 20 * critical_step(Problem(scene))
    ledger = cb.simulate(scene, method, until=12.0, ledger_steps=1).ledger
    balance, half = ledger["balance"], len(ledger["balance"]) // 2
    assert abs(balance[:half].mean() - balance[half:].mean()) < 0.02 * np.ptp(balance)
    assert np.ptp(balance) < 0.15 * ledger["stored"].max()
    assert np.abs(ledger["identity"]).max() < 1e-10


@pytest.mark.filterwarnings("ignore:The energy of body does not see")
def test_nematic_relaxation(comm):
    """K|∇θ|²/2 with η = γ1 and no inertia, numbers like 5CB's: θ decays at the rate Kq²/γ1."""
    k, gamma, length, cells = 6e-12, 0.08, 1e-5, 40
    body = cb.Body(1, lambda U, nu, N: 0.5 * k * ufl.inner(N, N), 1000.0, 0.0, gamma,
                   displacement=1)  # fmt: skip
    mesh = dolfinx.mesh.create_interval(comm, cells, [0.0, length])
    q = np.pi / length
    scene = cb.Scene(mesh, body, supports=[cb.Fix("nu", "boundary")],
                     initial=cb.Initial(nu=lambda x: 0.1 * np.sin(q * x[0])))  # fmt: skip
    time = gamma / (k * q**2)
    limit = gamma * (length / cells) ** 2 / (2 * k)
    step, steps = time / 20, 40
    assert step > 5 * limit
    result = cb.simulate(scene, cb.Implicit(step, forces="implicit"), until=steps * step)
    shape = np.sin(q * mesh.geometry.x[:, 0])
    assert largest(comm, result.nu.x.array - 0.1 * np.exp(-2.0) * shape) < 1e-3 * 0.1 * np.exp(-2)
    # To round-off it is the midpoint rule on the discrete mode.
    z = step * k * (2 * cells / length * np.sin(q * length / cells / 2)) ** 2 / gamma
    factor = ((1 - z / 2) / (1 + z / 2)) ** steps
    assert largest(comm, result.nu.x.array - 0.1 * factor * shape) < 1e-11
    with refused(StepError, "critical"):
        cb.simulate(scene, cb.Implicit(forces="implicit"), until=1.0)


def wells(comm, start=0.4, **more):
    """½|∇u|² + ½·0.02|∇ν|² + ¼(ν² − 1)² + 0.2 ν² u': phases that separate while waves pass."""
    body = cb.Body(
        1, lambda U, nu, N: 0.5 * ufl.inner(U, U) + 0.01 * ufl.inner(N, N)
        + 0.25 * (nu[0] ** 2 - 1) ** 2 + 0.2 * nu[0] ** 2 * U[0, 0],
        1.0, displacement=1, **({"inertia": 0.0, "viscosity": 0.5} | more),
    )  # fmt: skip
    return cb.Scene(
        dolfinx.mesh.create_interval(comm, 16, [0.0, 1.0]), body,
        supports=[cb.Fix("u", "boundary")],
        initial=cb.Initial(u=lambda x: 0.1 * np.sin(np.pi * x[0]),
                           nu=lambda x: start * np.cos(np.pi * x[0])),
    )  # fmt: skip


@pytest.mark.parametrize("order", (1, 2))
def test_double_well_converges(comm, order):
    """Newton in every step; the field against a run with steps 8 times smaller, its balance."""
    def run(steps, order):
        method = cb.Implicit(1 / steps, order=order, forces="implicit")
        return cb.simulate(wells(comm), method, until=1.0, ledger_steps=1)

    fine, coarse = run(240, 2), [run(n, order) for n in (20, 40)]
    found = [largest(comm, r.nu.x.array - fine.nu.x.array) for r in coarse]
    assert abs(np.log2(found[0] / found[1]) - order) < 0.2, found
    books = [np.abs(r.ledger["balance"]).max() for r in coarse]
    assert np.log2(books[0] / books[1]) > order - 0.3, books
    assert "2." in coarse[1].solving.split()[0] and not np.any(coarse[1].ledger["identity"])


def busy(comm, cells=6):
    """Two regions, one without inertia, full matrices; moving supports and loads of u and ν."""
    mesh = bent(comm, (cells, cells))
    omega = np.array([[1.0, 0.2], [0.2, 0.7]])

    def body(hessian, inertia, eta):
        return cb.Body(2, quadratic(hessian, 2), 1.3, inertia, eta, displacement=2)

    return cb.Scene(
        mesh, {1: body(random_hessian(3, 2, 2, 2), 0.0, 0.4 * omega),
               2: body(2 * random_hessian(4, 2, 2, 2), omega, 0.0)}, cell_tags=halves(mesh),
        supports=[cb.Fix("u", lambda x: x[0] < 0.06, (0.1, 0.0), history=cb.sine(0.6)),
                  cb.Fix("nu", lambda x: x[1] < 0.06, (0.05, -0.1), history=cb.sine(0.4)),
                  cb.Fix("nu", lambda x: (x[0] > 0.94) & (x[1] > 0.06), (0.0, 0.0))],
        loads=[cb.BodyForce((1.0, 0.3), history=cb.sine(0.9)),
               cb.BodyForce((0.5, 0.2), history=cb.sine(0.3), field="nu")],
        initial=cb.Initial(nu=lambda x: np.stack([np.sin(3 * x[0]), x[0] * x[1]])),
    )  # fmt: skip


def test_busy_scene_books(comm):
    """Works of loads and moving supports: balance of order 2, discrete identity to round-off."""
    balance = []
    for n in (60, 120):
        method = cb.Implicit(1 / n, forces="implicit")
        ledger = cb.simulate(busy(comm), method, until=1.0, ledger_steps=1).ledger
        balance.append(np.abs(ledger["balance"]).max())
        assert 0 < np.abs(ledger["identity"]).max() < 1e-11
    assert np.abs(ledger["support_work"]).max() > 1e-2 and np.abs(ledger["work"]).max() > 1e-2
    assert 1.6 < np.log2(balance[0] / balance[1]) < 2.4, balance


def test_ranks_agree(comm):
    """With one rank that has it all: linear with all the trimmings, and by Newton."""
    for make, method in ((busy, cb.Implicit(0.01, forces="implicit")),
                         (wells, cb.Implicit(0.02, forces="implicit"))):  # fmt: skip
        alone = cb.simulate(make(MPI.COMM_SELF), method, until=0.3)
        shared = cb.simulate(make(comm), method, until=0.3)
        tables = [
            values(*(fem_points(r), r.u, r.nu, r.u_dot, r.nu_dot)) for r in (alone, shared)
        ]  # fmt: skip
        tables = [t[np.lexsort(np.round(t[:, :2], 6).T)] for t in tables]
        assert np.abs(tables[0] - tables[1]).max() < 1e-9
        for column in ("kinetic_nu", "dissipated", "work", "support_work"):
            difference = alone.ledger[column][-1] - shared.ledger[column][-1]
            assert abs(difference) < 1e-9, column


def fem_points(result):
    """Coordinates as a Function, to be gathered with fields."""
    mesh, dim = result.scene.mesh, 2
    function = dolfinx.fem.Function(_compat.vector_space(mesh, dim))
    function.x.array[:] = mesh.geometry.x[:, :dim].ravel()
    return function


@pytest.mark.serial
@pytest.mark.parametrize("make", (busy, wells))
def test_stiffness_is_the_derivative_of_the_forces(comm, make):
    """∂²V/∂ν∂ν against differences of the kernels' forces, supports left out."""
    problem = Problem(make(comm))
    disc, kernels, k = problem.disc, problem.kernels, problem.scene.descriptor
    stiffness, tiny = NuStiffness(problem), 1e-5
    kernels.x[:-1, : disc.n] = problem.initial_fields
    stiffness.assemble(2.0, np.zeros((disc.nodes, k, k)), kernels.x)
    dense = stiffness.matrix.convert("dense").getDenseArray().copy()
    size = disc.nodes * k
    for j in np.flatnonzero(stiffness.free)[:: max(size // 12, 1)]:
        sides = []
        for sign in (1, -1):
            kernels.x[j // k, disc.n - k + j % k] += sign * tiny
            kernels.forces()
            sides.append(kernels.f[:-1, disc.n - k : disc.n].ravel().copy())
            kernels.x[j // k, disc.n - k + j % k] -= sign * tiny
        column = np.where(stiffness.free, (sides[1] - sides[0]) / tiny, 0.0)
        assert np.abs(dense[:, j] - column).max() < 1e-6 * np.abs(column).max()
    stiffness.close()
    problem.close()


def test_refusals(comm):
    """Steps above u's, general inertia, options that exclude each other, steps without solution."""
    with refused(StepError, "critical step of u", "0.0625"):
        cb.simulate(pair(comm, 16), cb.Implicit(0.07, forces="implicit"), until=1.0)
    bubble = cb.Body(1, lambda U, nu, N: ufl.inner(U, U) + ufl.inner(N, N), 1.0,
                     lambda nu, v: (2 + nu[0]) * v[0] ** 2, displacement=1)  # fmt: skip
    mesh = dolfinx.mesh.create_interval(comm, 8, [0.0, 1.0])
    with refused(IntegratorError, "constant inertia", "forces='implicit'", "Implicit()"):
        cb.simulate(cb.Scene(mesh, bubble), cb.Implicit(forces="implicit"), until=1.0)
    with refused(IntegratorError, "lumped"):
        cb.Implicit(forces="implicit", quadrature="consistent")
    with refused(IntegratorError, "forces"):
        cb.Implicit(forces="both")
    with refused(IntegratorError, "without inertia", "forces='implicit'"):
        cb.simulate(pair(comm, 16), cb.Implicit(solve="always"), until=1.0)
    with refused(SolverError, "t = 0", "smaller step"):
        method = cb.Implicit(0.05, forces="implicit", iterations=1)
        cb.simulate(wells(comm, start=3.0), method, until=1.0)


def test_kinetic_energy_of_two_densities(comm):
    """A node's own mass counts in the books of all runs with one step."""
    mesh = bent(comm, (8,))
    bodies = [cb.Body(1, lambda U, nu, N: ufl.inner(U, U) + ufl.inner(N, N), rho, 1.0, 0.2,
                      displacement=1) for rho in (1.0, 5.0)]  # fmt: skip
    scene = cb.Scene(mesh, {1: bodies[0], 2: bodies[1]}, cell_tags=halves(mesh),
                     initial=cb.Initial(u_dot=lambda x: x[0]))  # fmt: skip
    dense = Dense(mesh, bodies)
    mass = np.array([m[0, 0] for m in dense.M])
    expected = 0.5 * mass @ dense.points[:, 0] ** 2
    for method in (cb.Synchronous(), cb.Implicit(solve="always"), cb.Implicit(forces="implicit")):
        ledger = cb.simulate(scene, method, until=0.01).ledger
        assert abs(ledger["kinetic_u"][0] - expected) < 1e-12
