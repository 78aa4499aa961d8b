# SPDX-License-Identifier: LGPL-3.0-or-later
"""Asynchronous variational integrators: every cell has its own time step (paper §4).

At an event of cell K its nodes drift to t, the force is taken there, and each node is kicked by
h_K times it: (Discr-dAL1), (Discr-dAL2) with the dissipation's sign corrected. ``balanced`` windows
act against a smooth reference stress taken at the window's start, whose assembled force drives the
drifts: neighbouring cells need not cancel each other at different times (DESIGN §5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from complexbody.errors import IntegratorError, StepError
from complexbody.integrators.window_run import WindowRun
from complexbody.integrators.windows import divisions, window_length
from complexbody.masses import SCHEMES
from complexbody.problem import Problem
from complexbody.timesets import cell_steps


@dataclass(frozen=True)
class AVI:
    """Asynchronous variational integrator on windows: every cell its own step.

    Attributes:
        safety: α, the fraction of each cell's critical step it may use. Resonances start near
            0.47 of it on bars of two rates, hence 0.45.
        schedule: "windows" (N_K = ⌈W/h_K⌉ equal steps per window) or "octaves" (N_K rounded up to a
            power of two).
        balanced: Act against a smoothed reference stress, which removes the error floor of
            asynchronous stepping; False gives plain windows, an AVI of the paper with rational
            time sets, symplectic, with the floor.
        passes: Smoothing passes of the reference (cell → node → cell).
        filter: ε of the filter v −= ε(I − S)³v at window ends (balanced only); 0 is none.
        dissipation: "exact", "symmetric" or "forward", as for Synchronous.

    Raises:
        IntegratorError, StepError: for options that make no sense.
    """

    safety: float = 0.45
    schedule: str = "windows"
    balanced: bool = True
    passes: int = 2
    filter: float = 0.01
    dissipation: str = "exact"

    explicit: ClassVar[bool] = True
    asynchronous: ClassVar[bool] = True
    order: ClassVar[int] = 2
    inertia: ClassVar[str] = "number, or diagonal matrix; 0 where viscosity is positive"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.safety) and 0 < self.safety):
            raise StepError(f"AVI: safety is {self.safety}. Give a positive number, 0.45 or less.")
        if self.dissipation not in SCHEMES:
            raise IntegratorError(
                f"AVI: dissipation={self.dissipation!r} is not known. Give one of "
                f"{', '.join(SCHEMES)}."
            )
        if self.schedule not in ("windows", "octaves"):
            raise IntegratorError(
                f"AVI: schedule={self.schedule!r} is not known. Give 'windows' or 'octaves'."
            )
        if self.passes < 1 or self.filter < 0:
            raise IntegratorError("AVI: give passes ≥ 1 and filter ≥ 0.")

    @property
    def symplectic(self) -> bool:
        """Plain windows are; balanced ones only nearly: the reference depends on the state."""
        return not self.balanced

    def prepare(self, problem: Problem, until: float) -> WindowRun:
        """Choose windows and steps, regroup the cells, and set up the run; collective.

        Raises:
            IntegratorError: for bodies this integrator cannot take.
        """
        critical = cell_steps(problem, self.dissipation)
        disc = problem.disc
        real = disc.source_cell >= 0
        steps = np.full(int(real.sum()), np.inf)
        steps[disc.source_cell[real]] = self.safety * critical[real]
        window = window_length(steps, until, problem.comm)
        problem.arrange(divisions(steps, window, self.schedule == "octaves"))
        return WindowRun(problem, self, window, steps / self.safety)
