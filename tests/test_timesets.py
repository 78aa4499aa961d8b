# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stable steps of cells against dense pencils: 4M̂(h) − h²K ≻ 0, by bisection in plain numpy."""

import math

import dolfinx
import numpy as np
import pytest
import scipy.linalg
import ufl
from dolfinx import fem
from harness import bent, everywhere, largest, refused
from mpi4py import MPI

import complexbody as cb
from complexbody import _compat
from complexbody.errors import IntegratorError, StepError
from complexbody.problem import Problem
from complexbody.timesets import cell_steps, critical_step

N_U, K = 2, 2
N = N_U + K
OMEGA = np.array([[2.0, 0.6], [0.6, 0.5]])
ETA = np.array([[30.0, -4.0], [-4.0, 2.0]])  # not diagonal in the same basis as OMEGA
RHO = 1.7


def random_hessian(seed, dim):
    """H on (∂_j q_i at i·dim + j, ν), positive definite and dense."""
    rng, m = np.random.default_rng(seed), N * dim + K
    a = rng.normal(size=(m, m))
    return a @ a.T / m + 0.3 * np.eye(m)


def density(H, dim, factor=1.0):
    """½ g·Hg times a factor, in UFL."""

    def energy(U, nu, N_):
        g = [U[i, j] for i in range(N_U) for j in range(dim)]
        g += [N_[i, j] for i in range(K) for j in range(dim)] + [nu[i] for i in range(K)]
        rows = [sum(float(H[i, j]) * g[j] for j in range(len(g))) for i in range(len(g))]
        return factor * 0.5 * sum(g[i] * row for i, row in enumerate(rows))

    return energy


def element_matrices(corners, H, lumped=False):
    """K_K / |K| of P1 cells, corners (cells, d+1, d), H (m, m) or one per cell; and |K|."""
    cells, m, d = corners.shape
    edges = corners[:, 1:] - corners[:, :1]
    inner = np.linalg.inv(edges).transpose(0, 2, 1)
    B = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    H = np.broadcast_to(H, (cells, *np.shape(H)[-2:]))
    v = slice(N * d, None)
    G = np.zeros((cells, N * d + K, m, N))
    for i in range(N):
        G[:, i * d : (i + 1) * d, :, i] = B.transpose(0, 2, 1)
    for i in range(K):
        G[:, N * d + i, :, N_U + i] = 1 / m
    G = G.reshape(cells, N * d + K, m * N)
    rest = H.copy()
    rest[:, v, v] = 0.0
    stiffness = np.einsum("cgx,cgh,chy->cxy", G, rest, G)
    pairs = np.eye(m) / m if lumped else (np.eye(m) + 1) / (m * (m + 1))
    own = np.zeros((cells, N, N))
    own[:, N_U:, N_U:] = H[:, v, v]
    own = np.einsum("ab,cij->caibj", pairs, own).reshape(stiffness.shape)
    return stiffness + own, np.abs(np.linalg.det(edges)) / math.factorial(d)


def mean_mass(rho, omega, eta, h, scheme):
    """M̂(h) of a node per unit volume, from the definition of each scheme."""
    out = np.zeros((N, N))
    out[:N_U, :N_U] = rho * np.eye(N_U)
    omega, eta = (np.asarray(a) * (np.eye(K) if np.ndim(a) == 0 else 1.0) for a in (omega, eta))
    if scheme == "symmetric":
        nu = omega
    elif scheme == "forward" or not omega.any():
        nu = omega + h / 2 * eta
    else:  # (hD/2) coth(hD/2M) = L s coth(s) Lᵀ with M = LLᵀ, s = L⁻¹(hD/2)L⁻ᵀ
        L = np.linalg.cholesky(omega)
        s = np.linalg.solve(L, np.linalg.solve(L, h / 2 * eta).T)
        values, vectors = np.linalg.eigh(0.5 * (s + s.T))
        tiny = np.abs(values) < 1e-8
        safe = np.where(tiny, 1.0, values)
        middle = np.where(tiny, 1.0, safe / np.tanh(safe))
        nu = L @ vectors @ np.diag(middle) @ vectors.T @ L.T
    out[N_U:, N_U:] = nu
    return out


def bisected(stiffness, mass, vertices):
    """Largest h with 4M̂(h)/(d+1) − h²K ⪰ 0: one cell, per unit volume."""

    def stable(h):
        M = np.kron(np.eye(vertices), mass(h)) / vertices
        return scipy.linalg.eigh(stiffness, M, eigvals_only=True)[-1] * h * h <= 4

    low, high = 1e-9, 1e9
    while high / low > 1 + 1e-11:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def corners(problem):
    """Vertices of this rank's cells, in dolfinx's order."""
    mesh = problem.scene.mesh
    nodes = _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
    return mesh.geometry.x[nodes, : mesh.geometry.dim]


def by_cell(problem, blocks):
    """Values (blocks, W) in dolfinx's order of cells."""
    real = problem.disc.source_cell >= 0
    assert np.all(np.isinf(blocks[~real]))
    out = np.zeros(real.sum())
    out[problem.disc.source_cell[real]] = blocks[real]
    return out


def check(problem, scheme, mass, H, lumped=False, some=slice(None, None, 7)):
    """Steps of some of this rank's cells; ``mass(h, cell)`` is M̂, H one or one per cell."""
    comm, x = problem.comm, corners(problem)
    found = by_cell(problem, cell_steps(problem, scheme))
    stiffness, _ = element_matrices(x, H, lumped)
    chosen = np.arange(len(x))[some]
    expected = np.array(
        [bisected(stiffness[c], lambda h, c=c: mass(h, c), x.shape[1]) for c in chosen]
    )
    ratio = found[chosen] / expected
    assert largest(comm, ratio - 1.0) < 2e-6
    assert everywhere(comm, np.all(ratio < 1 + 1e-9))  # never beyond the limit
    step = comm.allreduce(found.min(initial=np.inf), MPI.MIN)
    assert critical_step(problem, scheme) == step


CASES = [
    # cells, Ω, η, scheme, self-action
    ((19,), OMEGA, ETA, "exact", "consistent"),
    ((5, 4), OMEGA, ETA, "exact", "lumped"),
    ((5, 4), OMEGA, ETA, "symmetric", "consistent"),
    ((5, 4), OMEGA, ETA, "forward", "consistent"),
    ((2, 3, 2), OMEGA, ETA, "forward", "lumped"),
    ((2, 3, 2), 0.8, 0.0, "exact", "consistent"),
    ((5, 4), 0.8, 3.0, "exact", "consistent"),
    ((5, 4), 0.0, ETA, "exact", "consistent"),
    ((5, 4), 0.0, 3.0, "forward", "consistent"),
    ((5, 4), 1e-7, 1e4, "exact", "consistent"),  # overdamped by eleven orders
    ((5, 4), OMEGA, 1e-9, "exact", "consistent"),
]


@pytest.mark.parametrize("cells, omega, eta, scheme, self_action", CASES)
def test_against_bisection(comm, cells, omega, eta, scheme, self_action):
    """Block inertia, block viscosity, none of either; every cell of 1D, 2D and 3D meshes."""
    dim = len(cells)
    H = random_hessian(dim, dim)
    body = cb.Body(K, density(H, dim), RHO, omega, viscosity=eta, displacement=N_U)
    problem = Problem(cb.Scene(bent(comm, cells), body, self_action=self_action))
    check(
        problem, scheme, lambda h, c: mean_mass(RHO, omega, eta, h, scheme), H,
        self_action == "lumped",
    )  # fmt: skip
    problem.close()


def test_schemes_differ(comm):
    """Damping lengthens the step of "forward" and "exact", and leaves "symmetric" alone."""
    H = random_hessian(2, 2)
    make = lambda eta: Problem(  # noqa: E731
        cb.Scene(
            bent(comm, (5, 4)),
            cb.Body(K, density(H, 2), RHO, 0.05, viscosity=eta, displacement=N_U),
        )
    )
    free, damped = make(0.0), make(3.0)
    undamped = critical_step(free)
    steps = {scheme: critical_step(damped, scheme) for scheme in ("forward", "exact", "symmetric")}
    assert steps["symmetric"] == pytest.approx(undamped, rel=1e-12)
    assert steps["forward"] > 1.05 * steps["exact"] > 1.05 * 1.01 * undamped
    for scheme in steps:
        assert critical_step(free, scheme) == pytest.approx(undamped, rel=1e-7)
    free.close()
    damped.close()


def stripes(mesh):
    """Tags 1 and 2 in turn along x, of all local cells."""
    cells = np.arange(_compat.cell_count(mesh)[1], dtype=np.int32)
    middle = mesh.geometry.x[_compat.cell_nodes(mesh)].mean(axis=1)[:, 0]
    values = 1 + (np.floor(4 * middle).astype(np.int32) % 2)
    return dolfinx.mesh.meshtags(mesh, mesh.topology.dim, cells, values.astype(np.int32))


def test_bodies_by_region(comm):
    """Each cell with its own body's mass and stiffness."""
    mesh, hessians = bent(comm, (8, 5)), [random_hessian(s, 2) for s in (5, 6)]
    inertias, densities = (OMEGA, np.diag([0.1, 3.0])), (RHO, 0.2)
    bodies = {
        1 + r: cb.Body(K, density(hessians[r], 2), densities[r], inertias[r], displacement=N_U)
        for r in range(2)
    }
    problem = Problem(cb.Scene(mesh, bodies, cell_tags=stripes(mesh)))
    region = problem.scene.regions()
    check(
        problem, "exact",
        lambda h, c: mean_mass(densities[region[c]], inertias[region[c]], 0.0, h, "exact"),
        np.array(hessians)[region],
    )  # fmt: skip
    problem.close()


@pytest.mark.parametrize("inertia", ["diagonal", "block"])
def test_coefficients_by_cell(comm, inertia):
    """A stiffness and a mass that vary from cell to cell: by the generated pencil, or by FFCx."""
    mesh = bent(comm, (5, 4))
    omega = OMEGA if inertia == "block" else np.diag([0.7, 0.2])
    lam, rho = (fem.Function(_compat.cell_space(mesh)) for _ in range(2))
    lam.interpolate(lambda x: 2 + np.sin(7 * x[0]))
    rho.interpolate(lambda x: 1.5 + np.cos(5 * x[1]))
    H = random_hessian(2, 2)
    body = cb.Body(K, density(H, 2, lam), rho, omega, displacement=N_U)
    problem = Problem(cb.Scene(mesh, body))
    owned = _compat.cell_count(mesh)[0]
    dofs = _compat.cell_dofs(lam.function_space)[:owned, 0]
    check(
        problem, "exact", lambda h, c: mean_mass(rho.x.array[dofs[c]], omega, 0.0, h, "exact"),
        lam.x.array[dofs][:, None, None] * H,
    )  # fmt: skip
    problem.close()


def test_tangent_at_the_initial_state(comm):
    """A density that is not quadratic, by FFCx: H at the initial gradient of each cell."""
    mesh, dim = bent(comm, (5, 4)), 2
    H = random_hessian(2, dim)

    def energy(U, nu, N_):
        square = sum(U[i, j] ** 2 for i in range(N_U) for j in range(dim))
        return density(H, dim)(U, nu, N_) + 0.25 * 3.0 * square**2

    body = cb.Body(K, energy, RHO, OMEGA, viscosity=ETA, displacement=N_U)
    initial = cb.Initial(u=lambda x: np.stack([np.sin(3 * x[0]), x[0] * x[1]]))
    problem = Problem(cb.Scene(mesh, body, initial=initial))
    assert not problem.kernels.densities.linear
    x = corners(problem)
    edges = x[:, 1:] - x[:, :1]
    u = np.stack([np.sin(3 * x[..., 0]), x[..., 0] * x[..., 1]], axis=-1)
    U = np.linalg.solve(edges, u[:, 1:] - u[:, :1]).transpose(0, 2, 1).reshape(-1, N_U * dim)
    tangent = np.repeat(H[None], len(x), axis=0)
    m = N_U * dim
    square = (U**2).sum(axis=1)[:, None, None]
    tangent[:, :m, :m] += 3.0 * (square * np.eye(m) + 2 * U[:, :, None] * U[:, None, :])
    check(
        problem, "exact", lambda h, c: mean_mass(RHO, OMEGA, ETA, h, "exact"), tangent,
    )  # fmt: skip
    problem.close()


def scenes(mesh):
    """Scenes of all kinds on a mesh: one body, two damped ones, cell-wise, not quadratic."""
    H = random_hessian(2, 2)
    one = cb.Body(K, density(H, 2), RHO, OMEGA, viscosity=ETA, displacement=N_U)
    other = cb.Body(K, density(random_hessian(7, 2), 2), 0.3, 0.4, viscosity=9.0, displacement=N_U)
    lam = fem.Function(_compat.cell_space(mesh))
    lam.interpolate(lambda x: 2 + np.sin(7 * x[0]))
    cellwise = cb.Body(K, density(H, 2, lam), lam, 1.0, displacement=N_U)
    quartic = cb.Body(
        K, lambda U, nu, N_: density(H, 2)(U, nu, N_) + nu[0] ** 4, 1.0, 1.0, displacement=N_U
    )
    initial = cb.Initial(nu=lambda x: np.stack([x[0], x[1]]))
    return {
        "one": cb.Scene(mesh, one),
        "two": cb.Scene(mesh, {1: one, 2: other}, cell_tags=stripes(mesh)),
        "cellwise": cb.Scene(mesh, cellwise),
        "quartic": cb.Scene(mesh, quartic, initial=initial),
    }


@pytest.mark.parametrize("name", ["one", "two", "cellwise", "quartic"])
def test_the_same_for_every_number_of_ranks(comm, name):
    found = []
    for which in (comm, MPI.COMM_SELF):
        problem = Problem(scenes(bent(which, (8, 5)))[name])
        found.append(critical_step(problem, "exact"))
        problem.close()
    assert found[0] == pytest.approx(found[1], rel=1e-9)
    assert len(set(comm.allgather(found[0]))) == 1


@pytest.mark.parametrize("scheme", ["exact", "forward", "symmetric"])
def test_safe_for_the_body(scheme):
    """4M̂ − h²K ≻ 0 for the whole mesh, also where bodies of different damping share nodes."""
    problem = Problem(scenes(bent(MPI.COMM_SELF, (8, 5)))["two"])
    disc, h = problem.disc, critical_step(problem, scheme)
    mass = problem.masses.effective(h, scheme)[problem.masses.classes[:-1]]
    size = disc.nodes * N
    M, stiffness = np.zeros((size, size)), np.zeros((size, size))
    for a in range(disc.nodes):
        part = slice(a * N, (a + 1) * N)
        M[part, part] = disc.volume[a] * mass[a]
    hessians = np.array([random_hessian(2, 2), random_hessian(7, 2)])[problem.scene.regions()]
    matrices, volumes = element_matrices(corners(problem), hessians)
    nodes = disc.number[_compat.cell_nodes(problem.scene.mesh)]
    for cell, row in enumerate(nodes):
        at = (row[:, None] * N + np.arange(N)).ravel()
        stiffness[np.ix_(at, at)] += volumes[cell] * matrices[cell]
    top = scipy.linalg.eigh(stiffness, M, eigvals_only=True)[-1]
    assert 0.2 < h * h * top / 4 <= 1
    problem.close()


def test_nodes_between_different_dampings():
    """An average of M and D has less effective mass than the average of M̂: the cells' bound knows.

    Cells of equal critical step l in turn: one of mass 1, one of viscosity 2/l with hardly a mass.
    The zigzag mode is every cell's own worst, so that nothing else makes the bound cautious.
    """
    count = 12
    mesh = dolfinx.mesh.create_interval(MPI.COMM_SELF, count, [0.0, 1.0])
    cells = np.arange(count, dtype=np.int32)
    middle = mesh.geometry.x[_compat.cell_nodes(mesh)][..., 0].mean(axis=1)
    turn = np.floor(count * middle).astype(np.int32) % 2
    tags = dolfinx.mesh.meshtags(mesh, 1, cells, 1 + turn)

    def energy(U, nu, N_):
        return 0.5 * N_[0, 0] ** 2 + 1e-3 * U[0, 0] ** 2

    light, viscous = 1e-6, 2.0 * count
    bodies = {
        1: cb.Body(1, energy, 1.0, 1.0, displacement=1),
        2: cb.Body(1, energy, 1.0, light, viscosity=viscous, displacement=1),
    }
    problem = Problem(cb.Scene(mesh, bodies, cell_tags=tags))
    h = critical_step(problem, "exact")
    problem.close()

    m, d = np.full(count + 1, (1 + light) / 2), np.full(count + 1, viscous / 2)
    m[[0, -1]], d[[0, -1]] = (1.0, light), (0.0, viscous)
    s = h * d / (2 * m)
    volume = np.full(count + 1, 1 / count)
    volume[[0, -1]] /= 2
    M = np.diag(volume * np.where(s > 0, m * s / np.tanh(np.where(s > 0, s, 1.0)), m))
    beside = np.diag(np.full(count, 1.0 * count), 1)
    stiffness = np.diag(np.full(count + 1, 2.0 * count)) - beside - beside.T
    stiffness[[0, -1], [0, -1]] = count
    top = scipy.linalg.eigh(stiffness, M, eigvals_only=True)[-1]
    assert 0.7 < h * h * top / 4 <= 1
    assert h < 0.9 / count


@pytest.mark.filterwarnings("ignore:The energy of body does not see")
def test_a_body_without_stiffness(comm):
    """Nothing limits the step: all ranks say so."""
    body = cb.Body(1, lambda U, nu, N_: 0.0 * nu[0], 1.0, 1.0)
    problem = Problem(cb.Scene(bent(comm, (8, 5)), body))
    assert everywhere(comm, np.all(np.isinf(cell_steps(problem))))
    with refused(StepError, "no stiffness"):
        critical_step(problem)
    problem.close()


@pytest.mark.filterwarnings("ignore:The energy of body does not see")
def test_stiffness_on_one_rank_only(comm):
    """Other ranks take the step of the one that has a limit."""
    mesh = bent(comm, (8, 5))
    lam = fem.Function(_compat.cell_space(mesh))
    if comm.rank == comm.size - 1:
        lam.x.array[: _compat.cell_count(mesh)[0]] = 1.0
    body = cb.Body(
        1, lambda U, nu, N_: lam * (ufl.inner(U, U) + ufl.inner(N_, N_)), 1.0, 1.0, displacement=2
    )
    problem = Problem(cb.Scene(mesh, body))
    step = critical_step(problem)
    mine = np.isfinite(cell_steps(problem)).any()
    assert comm.allgather(bool(mine)) == [rank == comm.size - 1 for rank in range(comm.size)]
    assert len(set(comm.allgather(step))) == 1
    problem.close()


def test_symmetric_scheme_without_inertia(comm):
    """It has no limit there: refused by name, with what to use instead."""
    H = random_hessian(2, 2)
    mesh = bent(comm, (8, 5))
    for omega, eta in ((0.0, 1.0), (np.diag([1.0, 0.0]), np.eye(2))):
        body = cb.Body(K, density(H, 2), RHO, omega, viscosity=eta, displacement=N_U)
        problem = Problem(cb.Scene(mesh, body))
        with refused(IntegratorError, "symmetric", "without inertia", '"exact"'):
            critical_step(problem, "symmetric")
        assert critical_step(problem, "exact") > 0
        problem.close()


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_stiffness_that_is_not_finite(comm, eta):
    """At the initial state of one cell of one rank: all ranks hear of it."""
    mesh = bent(comm, (8, 5))
    bad = comm.size - 1

    def initial(x):
        return np.full((1, x.shape[1]), -1.0) if comm.rank == bad else np.ones((1, x.shape[1]))

    body = cb.Body(
        1,
        lambda U, nu, N_: ufl.inner(U, U) + ufl.inner(N_, N_) + nu[0] ** 2.5,
        1.0, 1.0, viscosity=eta,
    )  # fmt: skip
    problem = Problem(cb.Scene(mesh, body, initial=cb.Initial(nu=initial)))
    with refused(StepError, "not finite", "initial state"):
        critical_step(problem)
    problem.close()
