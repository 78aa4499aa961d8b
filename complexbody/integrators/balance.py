# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Balanced windows: a cell's force acts through its steps, not at their ends (DESIGN §5).

The forces of neighbouring cells nearly cancel at a node; kicks at different times do not. So cell K
pulls at its nodes all the time, with a force F that changes at its own times t_j only, such that
the mean of F before and behind is the force there:

.. math:: F_{j+1/2} + F_{j-1/2} = 2 f_j, \qquad f_j = -\partial V_K(q(t_j)).

F is the force half a step on, to second order, of any smooth motion; impulses over whole steps are
those of the kicks it replaces. The rule is the same forwards and backwards in time, and starts from
F_{1/2} = −∂V_K(q_0 + (h_K/2) q̇_0).

An error ±δ that alternates from step to step neither grows nor decays. Viscosity would make it
grow, by ω²h²·hη/(12ρ̄) per step for a cell of frequency ω (the mean of the displacement that it
causes no longer is zero), so that there it must decay, which a kick makes up for:

.. math:: F_{j+1/2} = (2-k) f_j - (1-k) F_{j-1/2}, \qquad
   \text{kick}\; h \big(f_j - \tfrac12 (F_{j+1/2} + F_{j-1/2})\big).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import native
from complexbody.integrators.snapshot import Snapshot, to_blocks, to_cells
from complexbody.integrators.windows import WindowPlan
from complexbody.masses import pencil_basis
from complexbody.problem import Problem
from complexbody.timesets import initial_matrices

if TYPE_CHECKING:
    from complexbody.integrators.window_run import WindowRun

Array = npt.NDArray[np.float64]
BEGIN = 1
#: k of cells at absorbing boundaries, whose dampers have hD/M of about one whatever the mesh. With
#: k = 0 random states grew by some per cent a window, with 1/2 on none of the meshes tried.
BESIDE_DAMPERS = 0.5


def blending(rates: Array, coupled: Array, step: float) -> Array:
    """k of each component for steps h: min(1, z_i), or what coupling to others needs if larger.

    With z = hη/ρ̄ component i feels component j by C_ij² z_j/(1 + z_j²): a descriptor that viscosity
    holds fast (z ≫ 1) hardly moves, and nothing comes of it. Where k > 0 a wave without viscosity
    of its own would grow, by k times a high power of ωh; hence no more than needed.

    Args:
        rates: η/ρ̄ of the components [1/s], infinite without inertia.
        coupled: C_ij², coupling of components by the energy, between 0 and 1.
        step: h [s].
    """
    with np.errstate(invalid="ignore"):
        z = rates * step
        felt = np.where(z < 1e100, z / (1.0 + z * z), 0.0)
    return np.minimum(np.maximum(z, (coupled * felt).max(axis=1)), 1.0)


def component_rates(problem: Problem, number: int, step: float = 0.0) -> Array:
    """η/ρ̄ of a region's components [1/s]; of several modes the fastest that they are in.

    With an implicit self-action the inertia is at least Ω + h²S/4, h ``step`` [s].
    """
    body, n_u = problem.scene.bodies[number], problem.scene.displacement
    inertia = body.inertia_matrix + 0.25 * step**2 * problem.self_stiffness[number]
    basis, mass, viscosity = pencil_basis(inertia, body.viscosity_matrix)
    with np.errstate(divide="ignore"):
        rate = np.where(viscosity > 0, viscosity / np.where(mass > 0, mass, 0.0), 0.0)
    part = np.abs(basis) > 1e-12 * np.abs(basis).max()
    return np.concatenate([np.zeros(n_u), np.where(part, rate, 0.0).max(axis=1)])


def coupling(problem: Problem, number: int) -> Array:
    """C_ij² = |H_ij|²/(|H_ii| |H_jj|) of components i ≠ j of region ``number``, shape (n, n).

    Parts in gradients and in values apart, the largest of them and of up to a thousand cells; if
    the density is not quadratic, of the cells' stiffness at the initial state.
    """
    n, kernels = problem.disc.n, problem.kernels
    mine = problem.disc.region == number
    cells = np.argwhere(problem.disc.source_cell[mine] >= 0)
    cells = cells[:: len(cells) // 1000 + 1]
    if not kernels.densities.generated[number]:
        d = problem.disc.dim + 1  # a rank may have no cell of this region
        shape = *problem.disc.source_cell[mine].shape, d, n, d, n
        local = initial_matrices(problem, number).reshape(shape)[tuple(cells.T)]
        size = np.linalg.norm(local, axis=(1, 3))
        pairs = [(size, size, size)]
    else:
        H = np.zeros((len(cells), 4 * n, 4 * n))
        for (i, j), values in kernels.densities.total(number).items():
            for v in values:
                if not isinstance(v, float):
                    at = kernels.densities.coefficients.index(v)
                    v = kernels.coefficients[mine][cells[:, 0], at, cells[:, 1]]
                H[:, i, j] += v
        split = H[:, : 3 * n, : 3 * n].reshape(-1, n, 3, n, 3)
        waves, own = np.linalg.norm(split, axis=(2, 4)), np.abs(H[:, 3 * n :, 3 * n :])
        mixed = np.linalg.norm(H[:, : 3 * n, 3 * n :].reshape(-1, n, 3, n), axis=2)
        mixed = (mixed, waves, own), (mixed.transpose(0, 2, 1), own, waves)
        pairs = [(waves, waves, waves), (own, own, own), *mixed]
    out = np.zeros((n, n))
    for size, one, other in pairs:
        scale = np.einsum("cii,cjj->cij", one, other)
        ratio = np.where(size > 0, size**2 / np.where(scale > 0, scale, size**2 + 1e-300), 0.0)
        out = np.maximum(out, ratio.max(axis=0, initial=0.0))
    problem.comm.Allreduce(MPI.IN_PLACE, out, op=MPI.MAX)
    np.fill_diagonal(out, 0.0)
    return np.minimum(out, 1.0)


class Balance:
    """The forces that a run's cells hold.

    Args:
        run: The run.
        plan: Its groups.

    Attributes:
        held: F of cells (blocks, (d + 1)·n, W).
        blend: k of each group (groups, NR).
    """

    def __init__(self, run: WindowRun, plan: WindowPlan) -> None:
        self.run, self.plan, problem = run, plan, run.problem
        disc = problem.disc
        self.held = native.aligned((disc.blocks, (disc.dim + 1) * disc.n, disc.lanes))
        self.blend = native.aligned((max(plan.count, 1), disc.record))
        self._load = np.zeros((disc.nodes + 1, disc.record))
        if problem.masses.damped:
            numbers = range(len(problem.scene.bodies))
            coupled = [coupling(problem, r) for r in numbers]
            for i in range(plan.count):
                group = plan.groups[i]
                r = group.region
                rates = component_rates(problem, r, group.step / run.method.fraction)
                self.blend[i, : disc.n] = blending(rates, coupled[r], group.step)
                if disc.group[group.first] < 0:
                    k = np.maximum(self.blend[i, : disc.n], BESIDE_DAMPERS)
                    self.blend[i, : disc.n] = k

    def save(self, saved: Snapshot) -> None:
        """Add the forces held to a snapshot of the run."""
        disc = self.run.problem.disc
        held = to_cells(disc, self.held.transpose(0, 2, 1))
        saved.corners["held"] = held.reshape(disc.count, disc.dim + 1, disc.n)
        saved.nodes["load"] = self._load[:-1]

    def restore(self, saved: Snapshot) -> None:
        """Take them from one."""
        disc = self.run.problem.disc
        rows = saved.corners["held"].reshape(disc.count, -1)
        self.held[:] = to_blocks(disc, rows).transpose(0, 2, 1)
        self._load[:-1] = saved.nodes["load"]

    def begin(self, t: float) -> None:
        """Forces half a step behind t, from positions and rates there: those of the first steps."""
        run, disc = self.run, self.run.problem.disc
        run.c.cb_get_rates(run._world, native.pointer(run._rates), *run._all)
        q, rates = run.record[:, : disc.n].copy(), run._rates[:, : disc.n]
        run.record[:, 2 * disc.record : 3 * disc.record] = 0.0
        self._load[:] = 0.0
        for i in range(self.plan.count):
            run.record[:, : disc.n] = q + 0.5 * self.plan.groups[i].step * rates
            run._together(t, BEGIN, first=i, last=i + 1, exchange=False)
        run.record[:, : disc.n] = q
        run._exchange(t)
        run._count(disc.count)

    def load(self, t: float) -> None:
        """Loads at t act from now on, as a constant force."""
        run = self.run
        if not run._loaded:
            return
        run._load_forces(t)
        at = run.acted
        self._load[at] = run._force[at] - self._load[at]
        run.c.cb_accelerate(run._world, native.pointer(self._load), *run._some)
        self._load[at] = run._force[at]
