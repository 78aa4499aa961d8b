# SPDX-License-Identifier: LGPL-3.0-or-later
"""Maps of one step or window as matrices, by running it from unit states, and their growth."""

import itertools

import numpy as np
from dense import halves, prepared
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes, native
from complexbody.integrators.balance import BEGIN

EVERYWHERE = lambda x: x[0] > -1  # noqa: E731


def stiffness(problem):
    """K of linear forces by those of unit fields, shape (nodes · n, nodes · n); on one rank."""
    kernels, disc = problem.kernels, problem.disc
    K = np.zeros((disc.nodes * disc.n,) * 2)
    for j in range(len(K)):
        kernels.x[:] = 0.0
        kernels.x[j // disc.n, j % disc.n] = 1.0
        kernels.forces()
        K[:, j] = -kernels.f[:-1, : disc.n].ravel()
    return K


def frequencies(problem, modes=False):
    """ω² of the free components, rising, masses lumped; with their modes (free, free) if asked."""
    disc, masses = problem.disc, problem.masses
    free = ~masses.fixed[masses.classes[:-1]]
    rho = np.full((disc.nodes, disc.n), problem.scene.bodies[0].density)
    rho[:, problem.scene.displacement :] = np.diag(problem.scene.bodies[0].inertia_matrix)
    root = np.sqrt(rho * disc.volume[:, None])[free]
    K = stiffness(problem)[np.ix_(free.ravel(), free.ravel())] / np.outer(root, root)
    if not modes:
        return np.linalg.eigvalsh(K)
    values, vectors = np.linalg.eigh(K)
    return values, vectors / root[:, None]


def window_map(run):
    """The matrix of one window on (q, q̇) of the free components and, balanced, the held forces.

    A cell's forces are those of some displacement of its nodes: of all others it never holds any.
    """
    problem, balance = run.problem, run.balance
    disc, n, record = problem.disc, problem.disc.n, problem.disc.record
    rows, columns = np.nonzero(~problem.masses.fixed[problem.masses.classes[:-1]])
    size, held = len(rows), []
    if balance is not None:
        for block, lane in np.argwhere(disc.source_cell >= 0):
            held += [(block, lane, basis) for basis in force_basis(run, block, lane)]

    def put(q, v, F):
        run.record[:-1, :n] = run.record[:-1, record : record + n] = 0.0
        run.record[rows, columns], run.record[rows, record + columns] = q, v
        run.record[:, run._time] = run.time
        if balance is not None:
            balance.held[:], total = 0.0, np.zeros((disc.nodes + 1, record))
            run.record[:-1, 2 * record : 2 * record + n] = 0.0
            for (block, lane, basis), part in zip(held, F, strict=True):
                if part:
                    balance.held[block, :, lane] += part * basis
                    np.add.at(total[:, :n], disc.cells[block, :, lane], part * basis.reshape(-1, n))
            run.c.cb_accelerate(run._world, native.pointer(total))

    out = np.zeros((2 * size + len(held),) * 2)
    for j, unit in enumerate(np.eye(len(out))):
        run.steps = 1
        put(unit[:size], unit[size : 2 * size], unit[2 * size :])
        run.advance(1)
        out[:size, j] = run.record[rows, columns]
        out[size : 2 * size, j] = run.record[rows, record + columns]
        out[2 * size :, j] = [balance.held[m, :, lane] @ basis for m, lane, basis in held]
    return out


def force_basis(run, block, lane):
    """Orthonormal forces that a cell can hold, shape (rank, (d+1)·n)."""
    disc, balance, rows = run.problem.disc, run.balance, []
    nodes, n = disc.cells[block, :, lane], disc.n
    group = next(i for i in range(run.plan.count) if block < run.plan.groups[i].last)
    for a, i in itertools.product(nodes, range(n)):
        run.record[:-1, :n] = 0.0
        run.record[a, i] = 1.0
        run.record[:, run._time] = run.time
        run._together(run.time, BEGIN, first=group, last=group + 1)
        rows.append(balance.held[block, :, lane].copy())
    values, basis = np.linalg.svd(rows)[1:]
    return basis[: np.count_nonzero(values > 1e-10 * values[0])]


def radius(run):
    """Spectral radius of the window map."""
    return abs(np.linalg.eigvals(window_map(run))).max()


def spectral_radius(scene, method):
    """Of the undamped step map, from the forces that the run itself gives for unit fields."""
    run = prepared(scene, method)
    disc, kernels = run.problem.disc, run.problem.kernels
    fixed = run.problem.masses.fixed[run.problem.masses.classes[:-1]]
    columns = []
    free = list(zip(*np.nonzero(~fixed), strict=True))
    for node, component in free:
        kernels.x[:] = 0.0
        kernels.x[node, component] = 1.0
        kernels.reset_forces()
        run.ready = False
        run.forces()
        columns.append([kernels.f[a, c] for a, c in free])
    stiff = -np.array(columns)
    assert abs(stiff - stiff.T).max() < 1e-12 * abs(stiff).max()
    root = np.array([np.sqrt(disc.volume[a]) for a, _ in free])
    s = run.step**2 / 2 * np.linalg.eigvalsh(stiff / np.outer(root, root))
    roots = [np.roots([1.0, -2.0 + 2.0 * value, 1.0]) for value in (s[0], s[-1])]
    return max(abs(r).max() for r in roots), run


def string(lengths, moduli=(1.0,), where="boundary", viscosity=0.0, initial=None):
    """ν alone on an interval, ρ̄ = 1, stiffness per half; u is held."""

    def body(a):
        def energy(U, nu, N):
            return 1e-4 * U[0, 0] ** 2 + 0.5 * a * N[0, 0] ** 2

        return cb.Body(1, energy, 1.0, 1.0, viscosity, displacement=1)

    mesh = meshes.graded_interval(MPI.COMM_SELF, lengths)
    supports = [cb.Fix("nu", where), cb.Fix("u", EVERYWHERE)]
    given = {"supports": supports, "initial": initial or cb.Initial()}
    if len(moduli) == 1:
        return cb.Scene(mesh, body(moduli[0]), **given)
    bodies = {tag: body(a) for tag, a in zip((1, 2), moduli, strict=True)}
    return cb.Scene(mesh, bodies, cell_tags=halves(mesh, 0.5 * sum(lengths)), **given)
