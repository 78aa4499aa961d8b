# SPDX-License-Identifier: LGPL-3.0-or-later
"""Windows as the paper and DESIGN §5 say them: slow, one cell and one node at a time, in numpy.

A heap of events (t, K); at each, the nodes of K drift to t, the force is taken there, and kicks
them with the length of K's interval: (Discr-dAL1), (Discr-dAL2) with −η_a(ν^{i+1} − ν^i), the sign
corrected. Shares nothing with the package: dense element matrices, nodal clocks, times within a
window as fractions, each dissipation scheme as its own recursion on momenta.
"""

import heapq
import itertools
import math
from fractions import Fraction

import numpy as np
import scipy.linalg

# --- potentials of one cell ----------------------------------------------------------------------


def shape_gradients(corners):
    """Gradients of the d+1 shape functions, shape (d+1, d), and the volume."""
    edges = corners[1:] - corners[:1]
    inner = np.linalg.inv(edges).T
    B = np.concatenate([-inner.sum(axis=0, keepdims=True), inner])
    return B, abs(np.linalg.det(edges)) / math.factorial(len(edges))


class Quadratic:
    """½ g·Hg + l·g of one cell, g = (∂_j q_i row by row, q_i), q = (u, ν).

    Args:
        corners: (d+1, d).
        H: Hessian; l: linear part (a constant force, which belongs to the loads).
        n: Components.
        lumped: Integrate the q-q part by the vertex rule, else exactly.
    """

    def __init__(self, corners, H, l=None, n=2, lumped=False):  # noqa: E741
        self.B, self.volume = shape_gradients(corners)
        self.H, self.n = H, n
        (m, d), nd = self.B.shape, n * self.B.shape[1]
        # g at a point from the cell's (d+1)·n values, with q at its mean: exact but for q-q.
        self.G = np.zeros((nd + n, m * n))
        for a, i in itertools.product(range(m), range(n)):
            self.G[i * d : (i + 1) * d, a * n + i] = self.B[a]
            self.G[nd + i, a * n + i] = 1 / m
        rest, own = H.copy(), H[nd:, nd:]
        rest[nd:, nd:] = 0.0
        mass = np.eye(m) / m if lumped else (np.eye(m) + 1) / (m * (m + 1))
        self.K = self.volume * (self.G.T @ rest @ self.G + np.kron(mass, own))
        self.constant = np.zeros((m, n))
        if l is not None:
            self.constant = -self.volume * (self.G.T @ l).reshape(m, n)

    def force(self, q):
        """−∂V_K of its quadratic part at the nodal values q, shape (d+1, n)."""
        return -(self.K @ q.ravel()).reshape(q.shape)


class Quartic(Quadratic):
    """½ g·Hg + ¼ b ν₀⁴ + c ν₀² U₀₀ + ¼ s U₀₀⁴: everything by hand, integrated exactly.

    Args:
        corners, H, n: As before.
        n_u: Index of ν₀.
        numbers: (b, c, s).
    """

    def __init__(self, corners, H, n, n_u, numbers):
        super().__init__(corners, H, None, n)
        self.at, self.numbers = n_u, numbers

    def moment(self, *fields):
        """Mean over the cell of a product of P1 fields given by their nodal values."""
        m, d = self.B.shape
        total = 0.0
        for which in itertools.product(range(m), repeat=len(fields)):
            powers = [math.factorial(which.count(a)) for a in range(m)]
            weight = math.factorial(d) * math.prod(powers) / math.factorial(d + len(fields))
            total += weight * math.prod(f[a] for f, a in zip(fields, which, strict=True))
        return total

    def force(self, q):
        """Quadratic part and quartic one."""
        (b, c, s), nu, out = self.numbers, q[:, self.at], super().force(q)
        U = float(self.B[:, 0] @ q[:, 0])
        P = c * self.moment(nu, nu) + s * U**3
        out[:, 0] -= self.volume * P * self.B[:, 0]
        for a, shape in enumerate(np.eye(len(q))):
            z = b * self.moment(nu, nu, nu, shape) + 2 * c * U * self.moment(nu, shape)
            out[a, self.at] -= self.volume * z
        return out


# --- one node between kicks ----------------------------------------------------------------------


def common_basis(M, D):
    """V, m, d with VᵀMV = diag(m), VᵀDV = diag(d); m is zero where there is no inertia."""
    scale = np.trace(M) + np.trace(D)
    _, V = scipy.linalg.eigh(M, M + D)
    m, d = np.diag(V.T @ M @ V).copy(), np.diag(V.T @ D @ V)
    m[m < 1e-13 * scale / max(scale, 1)] = 0.0
    return V, m, d


class Node:
    """The free components of one node: position q, momentum p, under a constant force F.

    DESIGN §2's table, all by the nodal interval Δ, carried lazily:

    * "forward" keeps w = p + ηq (kicks change p, hence w). At a touch, with the impulse ΔF:
      (M + ηΔ) v = w + ΔF − ηq, q += Δv.
    * "symmetric" takes half of ηΔv, and half of ΔF, on each side of the drift with v.
    * "exact" is the flow of M q̈ + η q̇ = F. Directions without inertia: q += (p + ΔF)/η, p = 0.
    """

    def __init__(self, M, D, scheme):
        self.M, self.D, self.scheme = M, D, scheme
        self.singular = np.linalg.matrix_rank(M) < len(M)
        # What has no dissipation and is not coupled to what has moves along parabolas.
        self.plain = ~(np.abs(D).max(axis=1, initial=0) > 0)
        assert not np.any(M[np.ix_(self.plain, ~self.plain)])
        self.flows = {}

    def drift(self, q, p, F, dt):
        """(q, p) after dt."""
        q, p = q.copy(), p.copy()
        for ix in (np.flatnonzero(self.plain), np.flatnonzero(~self.plain)):
            if len(ix):
                M, D = (A[np.ix_(ix, ix)] for A in (self.M, self.D))
                flow = self._parabola if self.plain[ix[0]] else getattr(self, "_" + self.scheme)
                q[ix], p[ix] = flow(q[ix], p[ix], F[ix], M, D, dt)
        return q, p

    @staticmethod
    def _parabola(q, p, F, M, D, dt):
        return q + np.linalg.solve(M, dt * p + 0.5 * dt**2 * F), p + dt * F

    @staticmethod
    def _forward(q, p, F, M, D, dt):
        w = p + D @ q + dt * F
        v = np.linalg.solve(M + dt * D, w - D @ q)
        q = q + dt * v
        return q, w - D @ q

    @staticmethod
    def _symmetric(q, p, F, M, D, dt):
        v = np.linalg.solve(M + 0.5 * dt * D, p + 0.5 * dt * F)
        return q + dt * v, M @ v + 0.5 * dt * (F - D @ v)

    def _exact(self, q, p, F, M, D, dt):
        if self.singular:
            V, m, d = common_basis(M, D)
            heavy, light = m > 0, m == 0
            # In the basis every component has its own m y'' + d y' = Vᵀ F.
            P, f = V.T @ p, V.T @ F
            y = np.zeros(len(m))
            y[light] = (P[light] + dt * f[light]) / d[light]
            P[light] = 0.0
            if heavy.any():
                y[heavy], P[heavy] = self._flow(
                    0 * y[heavy], P[heavy], f[heavy], np.diag(m[heavy]), np.diag(d[heavy]), dt
                )
            return q + V @ y, np.linalg.solve(V.T, P)
        return self._flow(q, p, F, M, D, dt)

    def _flow(self, q, p, F, M, D, dt):
        if dt not in self.flows:
            n, inverse = len(M), np.linalg.inv(M)
            rates = np.zeros((3 * n, 3 * n))  # of (q, p, F)
            rates[:n, n : 2 * n] = inverse
            rates[n : 2 * n, n : 2 * n] = -D @ inverse
            rates[n : 2 * n, 2 * n :] = np.eye(n)
            self.flows[dt] = scipy.linalg.expm(dt * rates)[: 2 * n]
        return np.split(self.flows[dt] @ np.concatenate([q, p, F]), 2)

    def rate(self, p):
        """M⁻¹p; of p the part that has inertia."""
        if not self.singular:
            return np.linalg.solve(self.M, p)
        V, m, _ = common_basis(self.M, self.D)
        return V @ (np.where(m > 0, 1 / np.where(m > 0, m, 1), 0) * (V.T @ p))

    def mobility(self):
        """The map from forces to rates of directions without inertia, D q̇ = f."""
        if not self.singular:
            return np.zeros_like(self.M)
        V, m, d = common_basis(self.M, self.D)
        return V @ np.diag(np.where(m > 0, 0, 1 / np.where(m > 0, 1, d))) @ V.T


# --- windows -------------------------------------------------------------------------------------


class Windows:
    """Plain or balanced windows.

    Args:
        cells: Node numbers (cells, d+1).
        potentials: One per cell.
        divisions: N_K of every cell.
        window: W [s].
        masses, viscosities: Per cell and unit volume, shape (cells, n, n).
        q, rates: Initial values (nodes, n).
        fixed: Prescribed components (nodes, n).
        targets: Prescribed values (nodes, n) as a function of t; by default they stay.
        loads: Pairs of nodal forces (nodes, n) and a factor as a function of t.
        balanced, scheme, start: As for cb.AVI.
        blend: k of each cell and component (cells, n), if balanced.
    """

    def __init__(
        self, cells, potentials, divisions, window, masses, viscosities, q, rates, fixed=None,
        targets=None, loads=(), balanced=True, blend=None, scheme="exact",
        start="trapezoidal",
    ):  # fmt: skip
        self.cells, self.potentials, self.divisions = cells, potentials, divisions
        self.window, self.balanced, self.blend = window, balanced, blend
        # One-sided: what acts at a window's start acts with its whole step, nothing at its end.
        self.first = 1.0 if start == "one-sided" else 0.5
        self.size, self.n = q.shape
        self.fixed = np.zeros(q.shape, bool) if fixed is None else fixed
        self.loads = [*loads, (self._assemble([p.constant for p in potentials]), lambda t: 1.0)]
        self.q, self.count, self.held, self.log = q.copy(), 0, None, None
        start = self.q.copy()
        self.targets = (lambda t: start) if targets is None else targets
        self.q[self.fixed] = self.targets(0.0)[self.fixed]
        self.speed = np.zeros(q.shape)  # of prescribed components
        self.F, self.p = np.zeros(q.shape), np.zeros(q.shape)
        share = [p.volume / cells.shape[1] for p in potentials]
        self.volume = np.zeros(self.size)
        M, D = np.zeros((2, self.size, self.n, self.n))
        for c, s, m, d in zip(cells, share, masses, viscosities, strict=True):
            for a in c:
                self.volume[a] += s
                M[a] += s * m
                D[a] += s * d
        self.nodes, self.free = [], [np.flatnonzero(~f) for f in self.fixed]
        for a, ix in enumerate(self.free):
            self.nodes.append(Node(M[a][np.ix_(ix, ix)], D[a][np.ix_(ix, ix)], scheme))
            self.p[a, ix] = self.nodes[a].M @ rates[a, ix]

    def _assemble(self, parts):
        out = np.zeros((self.size, self.n))
        for c, part in zip(self.cells, parts, strict=True):
            for a, f in zip(c, part, strict=True):
                out[a] += f
        return out

    @property
    def time(self):
        """End of the last window."""
        return self.count * self.window

    def load(self, t):
        """Nodal forces of all loads at t."""
        return sum((factor(t) * vector for vector, factor in self.loads), np.zeros(self.q.shape))

    def advance(self, windows):
        """Do so many windows."""
        for _ in range(windows):
            self._do_window()

    def _do_window(self):
        W, start = self.window, self.time
        self.clock = [Fraction(0)] * self.size  # in windows
        self.speed = np.where(self.fixed, (self.targets(start + W) - self.q) / W, 0.0)
        if self.balanced:
            if self.count == 0:
                self._begin()
            self.F = self._assemble(self.held) + self.load(start + W / 2)
        else:
            self._kick_nodes(self.first * W * self.load(start))
            for K, N in enumerate(self.divisions):
                self._act(K, Fraction(0), self.first * W / N)
        heap = [(Fraction(1, int(N)), K, 1) for K, N in enumerate(self.divisions) if N > 1]
        heapq.heapify(heap)
        while heap:
            t, K, j = heapq.heappop(heap)
            N = int(self.divisions[K])
            self._act(K, t, W / N)
            if j + 1 < N:
                heapq.heappush(heap, (Fraction(j + 1, N), K, j + 1))
        for K, N in enumerate(self.divisions):
            if self.balanced or self.first == 0.5:
                self._act(K, Fraction(1), W / N if self.balanced else W / N / 2)
        for a in range(self.size):
            self._drift(a, Fraction(1))  # nodes of no cell would be left behind
        self.count += 1
        if not self.balanced:
            self._kick_nodes((1 - self.first) * W * self.load(self.time))

    def _begin(self):
        """Forces of the first steps: half a step on, moving evenly."""
        rates = self.moving_rates()
        self.held = [
            p.force(self.q[c] + self.window / N / 2 * rates[c])
            for c, p, N in zip(self.cells, self.potentials, self.divisions, strict=True)
        ]

    def _drift(self, a, t):
        dt = float(t - self.clock[a]) * self.window
        if dt == 0:
            return
        before, ix = self.q[a].copy(), self.free[a]
        self.q[a] += dt * self.speed[a]
        self.q[a, ix], self.p[a, ix] = self.nodes[a].drift(
            self.q[a, ix], self.p[a, ix], self.F[a, ix], dt
        )
        if self.log is not None:
            began = self.time + float(self.clock[a]) * self.window
            self.log.append((a, began, began + dt, self.q[a].copy(), (self.q[a] - before) / dt))
        self.clock[a] = t

    def _act(self, K, t, h):
        nodes = self.cells[K]
        for a in nodes:
            self._drift(a, t)
        force = self.potentials[K].force(self.q[nodes])
        kick = h * force
        if self.balanced:
            before, k = self.held[K], self.blend[K]
            self.held[K] = (2 - k) * force - (1 - k) * before
            kick = h * (force - (self.held[K] + before) / 2)
            for a, part in zip(nodes, self.held[K] - before, strict=True):
                self.F[a] += part
        for a, part in zip(nodes, kick, strict=True):
            self.p[a] += np.where(self.fixed[a], 0.0, part)

    def _kick_nodes(self, impulse):
        self.p += np.where(self.fixed, 0.0, impulse)

    def moving_rates(self):
        """q̇ of what has inertia, or is prescribed, at the last window's end."""
        out = self.speed.copy()
        for a, ix in enumerate(self.free):
            out[a, ix] = self.nodes[a].rate(self.p[a, ix])
        return out

    def rates(self):
        """q̇ at the last window's end: what has no inertia follows the forces at that time."""
        out = self.moving_rates()
        forces = self.load(self.time) + self._assemble(
            [p.force(self.q[c]) for c, p in zip(self.cells, self.potentials, strict=True)]
        )
        for a, ix in enumerate(self.free):
            out[a, ix] += self.nodes[a].mobility() @ forces[a, ix]
        return out
