# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a run would do, without running it: is the energy coercive, what limits the step, how long.

For ``complexbody check``. Everything is measured on the scene itself: the cells' own critical steps
and a few timed steps.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat, coercivity
from complexbody.integrators.entries import Run
from complexbody.integrators.synchronous import Synchronous
from complexbody.ledger import Bookkeeper
from complexbody.problem import Problem
from complexbody.timesets import cell_steps

if TYPE_CHECKING:
    from complexbody.result import Result

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """The cells' own critical steps [s], of all ranks.

    Attributes:
        smallest, median, largest: Of the cells that have a finite one.
        slow: Number of cells whose step is below half the median.
        worst: Midpoint of the cell with the smallest [m].
        uniform, local: Cell updates per second of simulated time with one step for all cells, and
            if each cell took its own.
    """

    smallest: float
    median: float
    largest: float
    slow: int
    worst: tuple[float, ...]
    uniform: float
    local: float


def limits(problem: Problem, dissipation: str) -> Limits:
    """What limits the step of a scene; collective.

    Raises:
        StepError: if a cell's stiffness is not finite.
    """
    disc, comm = problem.disc, problem.comm
    steps = cell_steps(problem, dissipation)
    finite = np.isfinite(steps)
    mine = steps[finite]
    parts = comm.gather(mine)
    least, where = np.inf, (0.0,) * disc.dim
    if mine.size:
        block, lane = np.unravel_index(np.argmin(np.where(finite, steps, np.inf)), steps.shape)
        mesh = problem.scene.mesh
        nodes = _compat.cell_nodes(mesh)[disc.source_cell[block, lane]]
        middle = np.asarray(mesh.geometry.x)[nodes, : disc.dim].mean(axis=0)
        least, where = float(steps[block, lane]), tuple(middle.tolist())
    least, where = min(comm.allgather((least, where)))
    found: Limits | None = None
    if parts is not None:
        every = np.concatenate(parts)
        if every.size:
            median = float(np.median(every))
            slow = int(np.sum(every < 0.5 * median))
            sums = len(every) / least, float(np.sum(1.0 / every))
            found = Limits(least, median, float(every.max()), slow, where, *sums)
        else:
            found = Limits(np.inf, np.inf, np.inf, 0, where, 0.0, 0.0)
    return comm.bcast(found)


def smallest_eigenvalue(problem: Problem, number: int) -> float | None:
    """Smallest relative eigenvalue of region ``number``'s Hessian but for rotations; collective.

    Relative: every row and column is scaled by the root of its diagonal, as A1 is checked.

    Returns:
        The eigenvalue, or None for an energy that is not quadratic.
    """
    scene = problem.scene
    least = coercivity.least_eigenvalue(
        problem.hessian_samples(number), scene.displacement, scene.descriptor, problem.disc.dim
    )
    least = problem.comm.allreduce(least, op=MPI.MIN)
    return least if np.isfinite(least) else None


def seconds_per_step(run: Run, comm: Any, budget: float = 0.3) -> float:
    """Wall time of one step of the slowest rank [s], by timing some; collective."""
    run.advance(2)
    count = 1
    while True:
        comm.Barrier()
        begun = time.perf_counter()
        run.advance(count)
        spent = comm.allreduce(time.perf_counter() - begun, op=MPI.MAX)
        if spent > budget / 3 or count >= 100_000:
            return float(spent / count)
        count *= 4


def realised_speed_up(result: Result) -> float:
    """Speed-up of a finished run over one step for all, in wall time of stepping; collective.

    A run of the same scene by ``Synchronous`` is prepared, with its default step and the same
    dissipation scheme, and some of its steps are timed here and now: on a machine that others use
    the ratio is no better than the two times.

    Returns:
        Seconds of stepping per simulated second, of the synchronous run over those of this one.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the run has told them
        problem = Problem(result.scene)
    dissipation = getattr(result.integrator, "dissipation", "exact")
    rate = synchronous_rate(problem, dissipation, result.time)
    problem.close()
    return rate * result.time / max(result.stats.stepping, 1e-12)


def synchronous_rate(problem: Problem, dissipation: str, until: float) -> float:
    """Wall time that ``Synchronous`` would take per simulated second, by timing some steps.

    Collective. The problem is laid out anew: runs that were made from it are of no more use.
    """
    problem.arrange()
    run = Synchronous(dissipation=dissipation).prepare(problem, until)
    return seconds_per_step(run, problem.comm) / run.step


def seconds_per_row(books: Bookkeeper, comm: Any) -> float:
    """Wall time of one ledger row of the slowest rank [s]; collective.

    Raises:
        DivergenceError: if the energy is not finite.
    """
    books.row()
    begun = time.perf_counter()
    books.row()
    return float(comm.allreduce(time.perf_counter() - begun, op=MPI.MAX))
