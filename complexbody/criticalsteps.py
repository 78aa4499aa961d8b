# SPDX-License-Identifier: LGPL-3.0-or-later
"""Critical synchronous steps of a scene: bound by its cells, of its body, and measured by runs.

The first two are what integrators choose their steps by; the last says how far they are from where
runs begin to grow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from complexbody.disturbed import Disturbed
from complexbody.errors import ComplexBodyError, IntegratorError, MissingPackage
from complexbody.growth import RunMap, long_run, resolution
from complexbody.integrators.synchronous import Synchronous
from complexbody.integrators.synchronous_run import SynchronousRun
from complexbody.timesets import critical_step

#: Growth per coarse step below which a spectral radius counts as 1: a double eigenvalue 1 (a body
#: without supports) comes out with the root of round-off.
ROUND_OFF = 1e-6
#: States up to this size have their map made and its eigenvalues computed.
DENSE = 600
#: Coarse steps of a long run, fewer where they would take more than so many cell updates.
STEPS, WORK, LEAST_STEPS = 8000, 2e7, 500
#: Accuracy of the measured critical step.
BRACKET = 1e-3


@dataclass(frozen=True)
class CriticalStep:
    """Critical synchronous steps of one dissipation scheme [s]; None where one is not to be had.

    Attributes:
        scheme: Dissipation scheme.
        elemental: Bound by the cells' own pencils.
        overall: The body's own by SLEPc; linear forces only.
        measured: By bisection of runs, to 1e-3.
        how: How the runs were judged, or why there are none.
    """

    scheme: str
    elemental: float | None
    overall: float | None
    measured: float | None
    how: str


def affordable(updates: float) -> int:
    """Coarse steps of a long run of so many cell updates each."""
    return int(np.clip(WORK / updates, LEAST_STEPS, STEPS))


def problem_cells(problems: Sequence[Disturbed]) -> int:
    """Cells of the whole body; collective."""
    return int(problems[0].comm.allreduce(int(np.sum(problems[0].disc.source_cell >= 0))))


def critical_steps(
    problems: Sequence[Disturbed], scheme: str, steps: int | None = None, dense: int = DENSE
) -> CriticalStep:
    """Elemental, global and measured critical step of a dissipation scheme; collective."""
    problem = problems[0]
    for each in problems:
        each.anew()
    try:
        elemental = critical_step(problem, scheme)
    except IntegratorError as error:
        return CriticalStep(scheme, None, None, None, str(error))
    overall: float | None = None
    why = ""
    try:
        if problem.scene.self_action != "implicit":
            overall = critical_step(problem, scheme, "global")
    except MissingPackage as error:
        why = f"; {error}"
    except IntegratorError:
        why = "; forces are not linear"
    steps = steps or affordable(problem_cells(problems) * len(problems))
    size = 2 * int(np.sum(~problem.masses.fixed[problem.masses.classes[:-1]]))
    mapped = problem.mappable and size <= dense
    how = "spectral radius" if mapped else f"runs of {steps} steps"

    def unstable(h: float) -> bool:
        runs = []
        for each in problems:
            each.anew()
            each.stiffen(h)
            method = Synchronous(h, dissipation=scheme, unstable_ok=True)
            runs.append(SynchronousRun(each, method, h, elemental))
        if mapped:
            return RunMap(runs[0]).radius() > 1 + ROUND_OFF
        return long_run(runs, steps, problem.enough) > resolution(steps)

    low, high = elemental, elemental if overall is None else overall
    try:
        while unstable(low):
            low, high = 0.9 * low, low
        high *= 1 + 0.5 * BRACKET
        while not unstable(high):
            low, high = high, high * (1 + BRACKET if high == low else 1.05)
            if high > 1e3 * elemental:
                return CriticalStep(scheme, elemental, overall, None, f"no growth found{why}")
        while high / low > 1 + BRACKET:
            middle = float(np.sqrt(low * high))
            low, high = (low, middle) if unstable(middle) else (middle, high)
    except ComplexBodyError as error:
        return CriticalStep(scheme, elemental, overall, None, str(error))
    return CriticalStep(scheme, elemental, overall, float(np.sqrt(low * high)), how + why)
