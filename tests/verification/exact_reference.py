# SPDX-License-Identifier: LGPL-3.0-or-later
"""Exact schedules as the paper says them: a heap of events (t, K), one cell and node at a time.

At t = j h_K cell K's nodes drift to t, the force is taken there and kicks them with the length of
K's next interval: (Discr-dAL1), (Discr-dAL2) with −η_a(ν^{i+1} − ν^i), the sign corrected. In all
but the schedule it is windows_reference.py; what a user sees is made on copies.
"""

import heapq

import numpy as np
from verification.windows_reference import Windows


class Exact(Windows):
    """Cells act at the multiples of their own steps.

    Args:
        steps: h_K of every cell.
        start: "trapezoidal": first kicks are halves, "one-sided": whole.
        corrected: Forces at q + (θh²/12) M⁻¹f(q), θ the share of neighbours with other steps.
        acted: Nodes (mask) that loads or supports act on at the ends of beats of length ``window``.
        The rest as for :class:`Windows`.
    """

    def __init__(self, steps, start, corrected, acted, **rest):
        super().__init__(divisions=np.ones(len(steps), int), balanced=False, **rest)
        self.steps, self.corrected, self.acted = steps, corrected, acted
        self.trapezoidal = start == "trapezoidal"
        self.heap = [(0.0, K, 0) for K in range(len(steps))]
        self.done = np.zeros(len(steps), int)
        self.alone = np.zeros(len(steps))
        for K, cell in enumerate(self.cells):
            around = [np.flatnonzero((self.cells == a).any(axis=1)) for a in cell]
            others = [j for found in around for j in found if j != K]
            apart = [abs(steps[j] - steps[K]) > 1e-9 * steps[K] for j in others]
            self.alone[K] = np.float32(np.mean(apart)) if others else 1.0
        self.clock = np.zeros(self.size)

    def _drift(self, a, t):
        dt = t - self.clock[a]
        if dt == 0:
            return
        before, ix = self.q[a].copy(), self.free[a]
        self.q[a] += dt * self.speed[a]
        self.q[a, ix], self.p[a, ix] = self.nodes[a].drift(
            self.q[a, ix], self.p[a, ix], self.F[a, ix], dt
        )
        if self.log is not None:
            self.log.append((a, self.clock[a], t, self.q[a].copy(), (self.q[a] - before) / dt))
        self.clock[a] = t

    def _force(self, K):
        nodes = self.cells[K]
        q = self.q[nodes]
        force = self.potentials[K].force(q)
        if not self.corrected:
            return force
        soft = q.copy()
        for i, a in enumerate(nodes):
            ix = self.free[a]
            amount = self.alone[K] * self.steps[K] ** 2 / 12
            soft[i, ix] += amount * self.nodes[a].rate(force[i, ix])
        return self.potentials[K].force(soft)

    def _do_window(self):
        start, end = self.time, (self.count + 1) * self.window
        self._touch(start)
        self.speed = np.where(
            self.fixed & self.acted[:, None], (self.targets(end) - self.q) / self.window, 0.0
        )
        self._kick_nodes((0.5 if self.trapezoidal else 1.0) * self.window * self.load(start))
        while self.heap[0][0] < end:
            t, K, j = heapq.heappop(self.heap)
            for a in self.cells[K]:
                self._drift(a, t)
            h = self.steps[K] * (0.5 if self.trapezoidal and j == 0 else 1.0)
            for a, part in zip(self.cells[K], h * self._force(K), strict=True):
                self.p[a] += np.where(self.fixed[a], 0.0, part)
            self.done[K] = j + 1
            heapq.heappush(self.heap, ((j + 1) * self.steps[K], K, j + 1))
        self._touch(end)
        if self.trapezoidal:
            self._kick_nodes(0.5 * self.window * self.load(end))
        self.count += 1

    def _touch(self, t):
        for a in np.flatnonzero(self.acted):
            self._drift(a, t)

    def see(self):
        """(q, q̇) now: drifted, impulses completed to this time; the run itself is not touched."""
        kept = [x.copy() for x in (self.q, self.p, self.clock)]
        log, self.log = self.log, None
        for a in range(self.size):
            self._drift(a, self.time)
        for K, j in enumerate(self.done):
            given = (j - 0.5 if self.trapezoidal else j) * self.steps[K]
            force = self.potentials[K].force(self.q[self.cells[K]])
            for a, part in zip(self.cells[K], force, strict=True):
                self.p[a] += np.where(self.fixed[a], 0.0, (self.time - given) * part)
        out = self.q.copy(), self.rates()
        (self.q, self.p, self.clock), self.log = kept, log
        return out
