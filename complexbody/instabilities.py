# SPDX-License-Identifier: LGPL-3.0-or-later
"""Known instabilities: where the chosen integrator lies in a band that has been measured.

Each rule was read off ``complexbody stability`` (docs/stability.md); growth of bars is computed. No
rule proves a scene unstable: it says what models with such steps do, if a run of that length would
see it. Defaults lie outside every rule but that of viscosity in 3D.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from mpi4py import MPI

from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.octaves import largest
from complexbody.problem import Problem
from complexbody.resonances import first_unstable, resonance_free
from complexbody.timesets import cell_steps

#: Step ratios above this are taken for it: bars of more than 16 to 1 are no worse.
MOST_RATIO = 16
#: Balanced windows: bands above this α (5 of 56 bars up to 0.7, none below), and growth there.
BALANCED, BALANCED_GROWTH = 0.5, 6e-3
#: Steps that differ by so much and more; balanced windows with viscosity in 3D there, α = 0.45.
GRADED, VISCOUS_GROWTH = 16.0, 6e-6
#: Plain windows and real steps on meshes graded by so much and more, at α = 0.45.
PLAIN_GROWTH = 1e-3
#: Growth over a whole run that is worth a word: e-fold.
WORTH = 1.0
_ADVICE = (
    "Use balanced windows, AVI(), or LocalLeapfrog(); or see by `complexbody stability` whether "
    "this mesh does."
)


def known_instabilities(problem: Problem, integrator: Any, until: float | None = None) -> list[str]:
    """What is known to grow, a sentence each; the same on all ranks, collective.

    Args:
        problem: The scene, made ready.
        integrator: What is to step it.
        until: End of the run [s]; growth that this run would not see is then left out, and slow
            growth is told only if it is given.
    """
    if isinstance(integrator, LocalLeapfrog):
        return _local_leapfrog(problem, integrator)
    if isinstance(integrator, AVI):
        if integrator.balanced:
            return _balanced(problem, integrator, until)
        return _plain(problem, integrator, until)
    return []


def warn_of(problem: Problem, integrator: Any, until: float) -> None:
    """Tell of known instabilities on rank 0, unless ``unstable_ok`` asks for them; collective."""
    if getattr(integrator, "unstable_ok", False):
        return
    for note in known_instabilities(problem, integrator, until):
        if problem.comm.rank == 0:
            warnings.warn(note, UserWarning, stacklevel=4)


class _Steps:
    """Critical steps of the whole body: ``most`` and ``least`` [s], and the ratio at any node."""

    def __init__(self, problem: Problem, integrator: Any) -> None:
        disc, comm = problem.disc, problem.comm
        steps = cell_steps(problem, integrator.dissipation)
        given = getattr(integrator, "steps", None)
        real = np.isfinite(steps)
        self.fraction = getattr(integrator, "safety", 1.0)
        if given is not None:
            mine = np.asarray(given, dtype=np.float64)[np.maximum(disc.source_cell, 0)]
            share = float(np.max(mine / steps, initial=0.0, where=real))
            self.fraction = float(comm.allreduce(share, op=MPI.MAX))
            steps = np.where(real, mine, np.inf)
        longest, rate = (np.zeros(disc.nodes + 1) for _ in range(2))
        np.maximum.at(longest, disc.cells, np.where(real, steps, 0.0)[:, None, :])
        np.maximum.at(rate, disc.cells, np.where(real, 1.0 / steps, 0.0)[:, None, :])
        at = largest(problem, longest[:-1]) * largest(problem, rate[:-1])
        self.ratio = float(comm.allreduce(float(at.max(initial=1.0)), op=MPI.MAX))
        mine_most = float(np.max(steps, initial=0.0, where=real))
        self.most = float(comm.allreduce(mine_most, op=MPI.MAX))
        self.least = float(comm.allreduce(float(steps.min(initial=np.inf)), op=MPI.MIN))

    def windows(self, until: float | None) -> float:
        """Coarse steps until then; infinitely many by default."""
        return np.inf if until is None else until / max(self.fraction * self.most, 1e-300)


def _plain(problem: Problem, method: AVI, until: float | None) -> list[str]:
    steps = _Steps(problem, method)
    windows, octaves = steps.windows(until), method.schedule == "octaves"
    if octaves:  # neighbours differ by two at most, by which they do not grow on graded meshes
        steps.ratio = min(steps.ratio, 2.0)
    what = "real steps" if method.schedule == "exact" else "plain windows"
    first, growth = _bands(steps)
    if growth * windows > WORTH:
        return [
            f"AVI with {what}: the steps of neighbouring cells differ by up to {steps.ratio:.3g}. "
            f"Bars of such cells grow from α = {first:.2f} on, by up to {growth:.1g} per window at "
            f"or below the chosen {steps.fraction:.3g}. {_ADVICE}"
        ]
    graded = steps.most >= GRADED * steps.least and not octaves
    if graded and PLAIN_GROWTH * windows > WORTH:
        return [
            f"AVI with {what}: the steps of cells differ by up to {steps.most / steps.least:.3g}. "
            f"Of 16 scenes on meshes graded by {GRADED:g} or more seven grew at α = 0.45, by 1e-3 "
            f"to 7e-2 per window. {_ADVICE}"
        ]
    return []


def _bands(steps: _Steps) -> tuple[float, float]:
    """First α at which bars of the neighbours' ratio grow, and the most up to the chosen one.

    Corrected cells' bars begin to grow within 8 % of the same α, later or earlier.
    """
    alpha, ratio = min(steps.fraction, 1.0), min(steps.ratio, MOST_RATIO)
    whole = {int(np.floor(ratio + 1e-6)), int(np.ceil(ratio - 1e-6))} - {1}
    found = [first_unstable(n, alpha) for n in whole if alpha > resonance_free(n)]
    return (
        min((first for first, _ in found), default=np.inf),
        max((growth for _, growth in found), default=0.0),
    )


def _balanced(problem: Problem, method: AVI, until: float | None) -> list[str]:
    alpha = method.safety
    told: list[str] = []
    viscous = problem.masses.damped and problem.disc.dim == 3 and until is not None
    if alpha <= BALANCED and not viscous:
        return told
    steps = _Steps(problem, method)
    windows = steps.windows(until)
    if alpha > BALANCED and steps.ratio > 1.0 + 1e-6 and BALANCED_GROWTH * windows > WORTH:
        told.append(
            f"AVI with balanced windows at α = {alpha:.3g}: some bars of two cell sizes grow "
            f"there, by up to {BALANCED_GROWTH:.0e} per window, and fast above 0.7; none at 0.45. "
            "Use the default, or measure it by `complexbody stability`."
        )
    growth = VISCOUS_GROWTH * (alpha / 0.45) ** 5
    if viscous and steps.most >= GRADED * steps.least and growth * windows > WORTH:
        told.append(
            f"AVI with balanced windows, viscosity and steps that differ by up to "
            f"{steps.most / steps.least:.3g} in 3D: small meshes like it grew by {growth:.0e} per "
            f"window, by e^{growth * windows:.0f} in so long a run. Use a smaller safety, or "
            "LocalLeapfrog()."
        )
    return told


def _local_leapfrog(problem: Problem, method: LocalLeapfrog) -> list[str]:
    needed = method.safety**4 / 6
    if method.stabilisation >= needed * (1 - 1e-9) or method.levels == 0:
        return []
    steps = _Steps(problem, method)
    if steps.most < 2 * steps.least:  # one octave at most, of no use
        return []
    return [
        f"LocalLeapfrog with stabilisation={method.stabilisation:.3g} at α = {method.safety:.3g}: "
        "without enough of it the step map grows on scattered meshes and bars, by up to 0.2 per "
        f"step. Use {needed:.2g} or more (the default is {LocalLeapfrog.stabilisation})."
    ]
