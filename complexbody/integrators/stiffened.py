# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Stiff self-action where every cell has its own step: how far each node's inertia must grow.

With the inertia Ω + H_a²S/4 at node a (:mod:`complexbody.stiffness`) the forces stay those of the
cells' potentials, so that any asynchronous integrator takes it as it takes any other Ω: the scheme
stays variational. A cell K whose own pencil has 4(M_K + H_K²S/4) ⪰ H_K²K_K is stable up to H_K at
nodes with H_a ≥ H_K. It runs at a fraction α of that step, as cells without self-action do, so that
resonances between optical modes and other cells' steps are no nearer than between waves.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat
from complexbody.integrators.octaves import largest
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]

#: H_a is rounded up to so many steps per octave: few classes of nodes, at most a fifth too much.
PER_OCTAVE = 4


def reach(critical: Array, steps: Array | float, safety: float) -> Array:
    """H_K of cells that will make steps h_K: h_K/α, at most the critical step; any shape [s].

    Args:
        critical: Critical steps of cells, each with the self-action at its own step.
        steps: h_K, at most.
        safety: α that the integrator is safe with.
    """
    return np.minimum(critical, np.asarray(steps) / safety)


def stiffen(problem: Problem, reached: Array) -> None:
    """Give every node the inertia for the largest H_K of its cells; collective.

    Does nothing unless the scene says ``self_action="implicit"``.

    Args:
        problem: The scene, made ready.
        reached: H_K of this rank's cells, in dolfinx's order (cells,), finite [s].
    """
    if not np.any(problem.self_stiffness):
        return
    disc = problem.disc
    real, values = disc.source_cell >= 0, np.zeros(disc.source_cell.shape)
    values[real] = reached[disc.source_cell[real]]
    most = np.zeros(disc.nodes + 1)
    np.maximum.at(most, disc.cells, values[:, None, :])
    most = largest(problem, most[:-1])
    least = float(np.min(reached, initial=np.inf))
    least = float(problem.comm.allreduce(least, op=MPI.MIN))
    # Round-off must not decide on a node's class, nor who else is on this rank.
    octaves = np.ceil(PER_OCTAVE * np.log2(np.maximum(most / least, 1.0)) - 1e-6) / PER_OCTAVE
    out = np.zeros(_compat.node_count(problem.scene.mesh))
    out[disc.dof] = least * 2.0**octaves
    problem.stiffen(out)
