# SPDX-License-Identifier: LGPL-3.0-or-later
"""A body as dense matrices, and the schemes as the discrete principle says them, in plain numpy.

Shares nothing with the package but the mesh and its numbering: element matrices are written from
the Hessian cell by cell, masses are lumped by the vertex rule, and every dissipation scheme is its
own recursion (paper (Discr-dAL2s), the sign of the dissipation corrected), without the effective
mass that the package makes of all three.
"""

import math

import numpy as np
import scipy.linalg
import ufl
from dolfinx import mesh as dmesh

from complexbody import _compat
from complexbody.problem import Problem


def whole(mesh):
    """Points (nodes, d) and cells (cells, d+1) of the whole mesh, on all ranks, global numbers."""
    index, dim = _compat.node_map(mesh), mesh.geometry.dim
    nodes = _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
    numbers = np.asarray(index.local_to_global(nodes.ravel().astype(np.int32)))
    points = mesh.comm.allgather(mesh.geometry.x[: index.size_local, :dim])
    return np.concatenate(points), np.concatenate(mesh.comm.allgather(numbers.reshape(nodes.shape)))


def values(*functions):
    """Nodal values of P1 Functions side by side, on all ranks, rows as in :func:`whole`."""
    mesh = functions[0].function_space.mesh
    index, rows = _compat.node_map(mesh), _compat.node_count(mesh)
    mine = np.concatenate([f.x.array.reshape(rows, -1) for f in functions], axis=1)
    return np.concatenate(mesh.comm.allgather(mine[: index.size_local]))


def state(run):
    """(q, q̇) of a run in progress at its own time, shapes (nodes, n), rows as in :func:`whole`."""
    disc = run.problem.disc
    index = _compat.node_map(run.problem.scene.mesh)
    numbers = np.asarray(index.local_to_global(disc.dof.astype(np.int32)))
    out = []
    for record in run.sample():
        parts = disc.comm.allgather((numbers, record[:-1, : disc.n].copy()))
        whole = np.full((index.size_global, disc.n), np.nan)
        for rows, mine in parts:
            whole[rows] = mine
        out.append(whole)
    return tuple(out)


def prepared(scene, method, until=1.0):
    """A run of the scene that stands at t = 0."""
    return method.prepare(Problem(scene), until)


def halves(mesh, middle=0.5):
    """Cell tags: 1 where x < middle, else 2 (cells that cross it: 2)."""
    dim = mesh.topology.dim
    left = dmesh.locate_entities(mesh, dim, lambda x: x[0] < middle + 1e-9)
    count = _compat.cell_count(mesh)[1]
    tags = np.where(np.isin(np.arange(count), left), 1, 2).astype(np.int32)
    return dmesh.meshtags(mesh, dim, np.arange(count, dtype=np.int32), tags)


# --- energies ------------------------------------------------------------------------------------


def unknowns(U, nu, N, dim):
    """The list g = (∂_j u_i, ∂_j ν_i, ν_i), j < dim, in this order."""
    g = [U[i, j] for i in range(U.ufl_shape[0]) for j in range(dim)]
    g += [N[i, j] for i in range(N.ufl_shape[0]) for j in range(dim)]
    return g + [nu[i] for i in range(nu.ufl_shape[0])]


def quadratic(H, dim):
    """The density ½ g·Hg as ``f(U, nu, N)``."""

    def energy(U, nu, N):
        g = unknowns(U, nu, N, dim)
        pairs = zip(*np.nonzero(H), strict=True)
        return sum(0.5 * float(H[a, b]) * g[a] * g[b] for a, b in pairs)

    return energy


def random_hessian(seed, n_u, k, dim):
    """A dense H with eigenvalues between 0.3 and about 3, in the order of :func:`unknowns`."""
    rng, m = np.random.default_rng(seed), (n_u + k) * dim + k
    basis, _ = np.linalg.qr(rng.normal(size=(m, m)))
    return (basis * rng.uniform(0.3, 3.0, m)) @ basis.T


def hessian_of(body, dim):
    """H of a body's quadratic density by polarisation, in the order of :func:`unknowns`.

    A potential counts with its ν alone.
    """
    n_u, k = body.displacement, body.descriptor
    n = n_u + k

    def value(g):
        gradient = np.zeros((n, 3))
        gradient[:, :dim] = g[: n * dim].reshape(n, dim)
        parts = gradient[:n_u], g[n * dim :], gradient[n_u:]
        outer = 0.0
        if body.potential is not None:
            still = ufl.as_tensor(np.zeros(n_u).tolist())
            outer = float(body.potential(still, ufl.as_tensor(parts[1].tolist())))
        return outer + float(body.energy(*(ufl.as_tensor(part.tolist()) for part in parts)))

    unit = np.eye(n * dim + k)
    H = np.diag([2 * value(e) for e in unit])
    for a in range(len(unit)):
        for b in range(a):
            together = value(unit[a] + unit[b])
            H[a, b] = H[b, a] = together - 0.5 * (H[a, a] + H[b, b])
    return H


def element_matrices(corners, H, n, k, lumped=False):
    """K_K of ½ g·Hg for P1 cells, shape (cells, (d+1)n, (d+1)n); corners (cells, d+1, d).

    Rows are vertex by vertex, each with its n components.
    """
    cells, m, d = corners.shape
    edges = corners[:, 1:] - corners[:, :1]
    inner = np.linalg.inv(edges).transpose(0, 2, 1)
    B = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    volume = np.abs(np.linalg.det(edges)) / math.factorial(d)
    # g of a cell with ν at its mean value: right for all but the ν-ν part.
    G = np.zeros((cells, n * d + k, m * n))
    own = np.zeros((n, n))
    own[n - k :, n - k :] = H[n * d :, n * d :]
    for a in range(m):
        for i in range(n):
            G[:, i * d : (i + 1) * d, a * n + i] = B[:, a, :]
        for i in range(k):
            G[:, n * d + i, a * n + n - k + i] = 1 / m
    rest = H.copy()
    rest[n * d :, n * d :] = 0.0
    mass = np.eye(m) / m if lumped else (np.eye(m) + 1) / (m * (m + 1))
    K = np.einsum("cgx,gh,chy->cxy", G, rest, G) + np.kron(mass, own)
    return volume[:, None, None] * K


def square(given, k):
    """A number or a matrix as a k×k matrix."""
    return given * np.eye(k) if np.ndim(given) == 0 else np.asarray(given)


class Dense:
    """A body of one or two regions (as :func:`halves` tags them) as matrices.

    Attributes:
        points: (nodes, d).
        K: Stiffness (nodes·n, nodes·n), rows node by node.
        M, D: Masses and viscosities of nodes (nodes, n, n).
        volume: Lumped volumes (nodes,).
    """

    def __init__(self, mesh, bodies, lumped=False, middle=0.5, hessians=None):
        bodies = bodies if isinstance(bodies, list | tuple) else [bodies]
        self.points, self.cells = whole(mesh)
        d, n_u = mesh.geometry.dim, bodies[0].displacement
        k = bodies[0].descriptor
        n = self.n = n_u + k
        size = len(self.points)
        self.n_u, self.dim = n_u, d
        self.K = np.zeros((size * n, size * n))
        self.M, self.D = np.zeros((size, n, n)), np.zeros((size, n, n))
        self.volume = np.zeros(size)
        corners = self.points[self.cells]
        first = (corners[:, :, 0] < middle + 1e-9).all(axis=1)
        region = np.where(first, 0, 1) if len(bodies) > 1 else np.zeros(len(corners), int)
        hessians = hessians or [hessian_of(body, d) for body in bodies]
        for r, body in enumerate(bodies):
            mine = self.cells[region == r]
            local = element_matrices(corners[region == r], hessians[r], n, k, lumped)
            dofs = (mine[:, :, None] * n + np.arange(n)).reshape(len(mine), -1)
            np.add.at(self.K, (dofs[:, :, None], dofs[:, None, :]), local)
            edges = corners[region == r][:, 1:] - corners[region == r][:, :1]
            share = np.abs(np.linalg.det(edges)) / math.factorial(d + 1)
            mass, eta = np.zeros((n, n)), np.zeros((n, n))
            mass[:n_u, :n_u] = body.density * np.eye(n_u)
            mass[n_u:, n_u:] = square(body.inertia, k)
            eta[n_u:, n_u:] = square(body.viscosity, k)
            for a in range(d + 1):
                np.add.at(self.volume, mine[:, a], share)
                np.add.at(self.M, mine[:, a], share[:, None, None] * mass)
                np.add.at(self.D, mine[:, a], share[:, None, None] * eta)

    def full(self, blocks):
        """Block diagonal matrix of nodal blocks (nodes, n, n)."""
        return scipy.linalg.block_diag(*blocks)

    def free(self, fixed=None):
        """Flat numbers of the free components; ``fixed`` is a mask (nodes, n) or None."""
        mask = np.zeros((len(self.points), self.n), bool) if fixed is None else fixed
        return np.flatnonzero(~mask.ravel())

    def frequencies(self, fixed=None):
        """Angular frequencies without dissipation, sorted, and the modes in columns."""
        ix = self.free(fixed)
        square, modes = scipy.linalg.eigh(
            self.K[np.ix_(ix, ix)], self.full(self.M)[np.ix_(ix, ix)]
        )
        return np.sqrt(np.maximum(square, 0.0)), modes


# --- schemes -------------------------------------------------------------------------------------


class Plain:
    """One dissipation scheme as the discrete principle says it, for matrices M, D and a force.

    A step is a kick by f at the step's own time, then a drift. With p the momentum M·rate:

    * "forward": M(v⁻ − v⁺) − hD v⁺ = −h f
    * "symmetric": M(v⁻ − v⁺) − (h/2) D (v⁺ + v⁻) = −h f
    * "exact": M w⁺ = M w⁻ + h f, then the flow of M ẅ + D ẇ = 0 over h

    Rows of M that vanish have D q̇ = f: x⁺ = x + h D⁻¹ f.

    Args:
        M: Masses, symmetric, block structure as of the nodes; rows may vanish.
        D: Viscosities.
        h: Step.
        scheme: One of the three.
    """

    def __init__(self, M, D, h, scheme, start="trapezoidal"):
        self.M, self.D, self.h, self.scheme, self.start = M, D, h, scheme, start
        self.heavy = np.flatnonzero(np.abs(M).max(axis=1) > 0)
        self.light = np.setdiff1d(np.arange(len(M)), self.heavy)
        assert not np.any(D[np.ix_(self.heavy, self.light)])
        ix = np.ix_(self.heavy, self.heavy)
        self.m, self.d = M[ix], D[ix]
        self.inverse = np.linalg.inv(self.m)
        self.mobility = np.linalg.inv(D[np.ix_(self.light, self.light)])
        if scheme == "exact":
            size = len(self.m)
            zero, eye = np.zeros((size, size)), np.eye(size)
            flow = scipy.linalg.expm(h * np.block([[-self.inverse @ self.d, zero], [eye, zero]]))
            self.decay, self.drift = flow[:size, :size], flow[size:, :size]

    def begin(self, x, rate, f):
        """The first step, from (x, rate) with force f at t = 0: x at t = h."""
        weight = 0.5 if self.start == "trapezoidal" else 1.0
        return self._step(x, rate[self.heavy], f, weight, first=True)

    def step(self, x, f):
        """One more step with the force f at the step's own time."""
        return self._step(x, self.v, f, 1.0)

    def _step(self, x, v, f, weight, first=False):
        h, m, d, f = self.h, self.m, self.d, weight * f
        heavy = f[self.heavy]
        new = x.copy()
        if self.scheme == "forward":
            self.v = np.linalg.solve(m + h * d, m @ v + h * heavy)
            new[self.heavy] += h * self.v
        elif self.scheme == "symmetric":
            before = m @ v if first else m @ v - 0.5 * h * d @ v
            self.v = np.linalg.solve(m + 0.5 * h * d, before + h * heavy)
            new[self.heavy] += h * self.v
        else:
            after = v + h * self.inverse @ heavy
            new[self.heavy] += self.drift @ after
            self.v = self.decay @ after
        new[self.light] += h * self.mobility @ f[self.light]
        return new

    def rate(self, f):
        """q̇ at the step's own time: half the kick is done ("trapezoidal"), or nothing of it."""
        out = np.zeros(len(self.M), np.asarray(f).dtype)
        half = 0.5 * self.h * self.inverse @ f[self.heavy] * (self.start == "trapezoidal")
        lost = 0.5 * self.h * self.inverse @ self.d @ self.v if self.scheme == "symmetric" else 0.0
        out[self.heavy] = self.v - lost + half
        out[self.light] = self.mobility @ f[self.light]
        return out


def amplification(M, D, K, h, scheme):
    """The matrix of one step of (x, momentum state), whose spectral radius decides on stability."""
    size, columns, plain = len(M), [], Plain(M, D, h, scheme)
    for unit in np.eye(2 * size):
        x, plain.v = unit[:size], unit[size:][plain.heavy]
        new = plain.step(x, -K @ x)
        v = np.zeros(size)
        v[plain.heavy] = plain.v
        columns.append(np.concatenate([new, v]))
    return np.array(columns).T


def slopes(steps, errors):
    """Observed orders between neighbouring steps."""
    steps, errors = np.asarray(steps, float), np.asarray(errors, float)
    return np.log(errors[:-1] / errors[1:]) / np.log(steps[:-1] / steps[1:])
