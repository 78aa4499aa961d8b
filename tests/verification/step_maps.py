# SPDX-License-Identifier: LGPL-3.0-or-later
"""Maps of one step or window as matrices, by running it from unit states, and their growth."""

import numpy as np
from dense import halves, prepared
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes
from complexbody.growth import RunMap

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
    """The matrix of one window on (q, q̇) of the free components and, balanced, the held forces."""
    return RunMap(run).matrix()


def radius(run):
    """Spectral radius of the window map."""
    return RunMap(run).radius()


def spectral_radius(scene, method):
    """Of the undamped step map, from the forces that the run itself gives for unit fields."""
    run = prepared(scene, method)
    run.wake()  # its state is set by hand
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
