# SPDX-License-Identifier: LGPL-3.0-or-later
"""Asynchronous variational integrators: every cell has its own time step (paper §4).

At an event of cell K its nodes drift to t, the force is taken there, and each node is kicked by
h_K times it: (Discr-dAL1), (Discr-dAL2) with the dissipation's sign corrected. What differs is
when: at the multiples of any h_K ("exact"), or in windows whose order of events repeats. Windows
may be ``balanced``: a cell's force then acts all through its steps instead of in kicks, so that
neighbours, who nearly cancel each other, do so at any time (balance.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from complexbody.errors import IntegratorError, StepError, agree
from complexbody.given import is_positive, short
from complexbody.integrators.exact_run import ExactRun
from complexbody.integrators.exact_schedule import alike, span_length
from complexbody.integrators.options import flags, one_of
from complexbody.integrators.stiffened import reach, stiffen
from complexbody.integrators.window_run import WindowRun
from complexbody.integrators.windows import apart, divisions, graded, window_length
from complexbody.masses import SCHEMES
from complexbody.problem import Problem
from complexbody.timesets import cell_steps, require_constant_inertia

Array = npt.NDArray[np.float64]
SCHEDULES = ("windows", "exact", "octaves")
STARTS = ("trapezoidal", "one-sided")
#: α, below the resonances of two-rate bars, which begin at 0.47 of the critical step.
SAFETY = 0.45


@dataclass(frozen=True)
class AVI:
    """Asynchronous variational integrator: every cell its own step.

    Attributes:
        safety: α, the fraction of each cell's critical step it may use. Resonances start near
            0.47 of it on bars of two rates, hence 0.45.
        schedule: "octaves" (N_K = ⌈W/h_K⌉ equal steps per window rounded up to a power of two, and
            until neighbours differ by two at most; the default), "windows" (N_K as it is; the
            default if not balanced) or "exact" (any real h_K, events at its multiples; those not
            given have 26 binary digits, so that cells alike but for round-off act together).
        balanced: Forces act through the cells' steps, which removes the error floor of asynchronous
            stepping; the default on octaves, and only there. False gives an AVI of the paper with
            rational time sets, symplectic, with the floor. An exact schedule is plain.
        dissipation: "exact", "symmetric" or "forward", as for Synchronous.
        start: "trapezoidal" (a cell's first kick is a half, order 2) or "one-sided" (the paper's,
            order 1; not balanced).
        corrected: Give each cell the softer potential V_K − θ_K (h_K²/24) ∇V_K·M⁻¹∇V_K, which
            cures most of what a cell that acts alone sees of its own ripple, θ_K being the share
            of its neighbours with other steps than its own; "exact" only, where it is the default.
            Still a potential per cell: symplectic, momentum kept.
        steps: h_K of this rank's cells [s], in the order of dolfinx's owned cells; "exact" only.
        unstable_ok: Run even with ``steps`` above the cells' critical ones.

    Raises:
        IntegratorError, StepError: for options that make no sense, or not together.
    """

    safety: float = SAFETY
    schedule: str | None = None
    balanced: bool | None = None
    dissipation: str = "exact"
    start: str = "trapezoidal"
    corrected: bool | None = None
    steps: Array | None = field(default=None, compare=False)
    unstable_ok: bool = False

    explicit: ClassVar[bool] = True
    asynchronous: ClassVar[bool] = True
    inertia: ClassVar[str] = "number or k×k matrix; 0 where viscosity is positive"

    def __post_init__(self) -> None:
        if not is_positive(self.safety):
            raise StepError(
                f"AVI: safety is {short(self.safety)}. Give a positive number, 0.45 or less."
            )
        if self.schedule is None:
            plain = self.balanced is False or self.start == "one-sided"
            object.__setattr__(self, "schedule", "windows" if plain else "octaves")
        for name, allowed in (
            ("dissipation", SCHEMES),
            ("schedule", SCHEDULES),
            ("start", STARTS),
        ):
            one_of(self, name, allowed)
        flags(self, "unstable_ok", *(n for n in ("balanced", "corrected")
                                     if getattr(self, n) is not None))  # fmt: skip
        exact, whole = self.schedule == "exact", self.start == "one-sided"
        octaves = self.schedule == "octaves"
        if self.balanced is None:
            object.__setattr__(self, "balanced", octaves and not whole)
        if self.corrected is None:
            object.__setattr__(self, "corrected", exact)
        for wrong, advice in (
            (
                exact and self.balanced,
                "schedule='exact' has no windows to balance. Use balanced=False",
            ),
            (
                not octaves and self.balanced,
                "balanced windows are stable only where neighbours' steps differ by two at most. "
                "Use schedule='octaves'",
            ),
            (
                whole and self.balanced,
                "balanced windows start from the force half a step on. Use balanced=False, or "
                "start='trapezoidal'",
            ),
            (
                not exact and self.corrected,
                "corrected is for cells that act alone. Use schedule='exact'",
            ),
            (
                not exact and self.steps is not None,
                "steps are for schedule='exact'. Use that, or safety",
            ),
        ):
            if wrong:
                raise IntegratorError(f"AVI: {advice}.")

    @classmethod
    def as_published(cls, safety: float = SAFETY, steps: Array | None = None) -> AVI:
        """The paper's scheme: real steps, one-sided start, (dissdiscr) with its sign corrected."""
        return cls(
            safety, "exact", dissipation="forward", start="one-sided", corrected=False, steps=steps
        )

    @property
    def order(self) -> int:
        """Order of convergence in the steps."""
        return 1 if self.dissipation == "forward" or self.start == "one-sided" else 2

    @property
    def fraction(self) -> float:
        """Of the critical step, to which an implicit self-action grows a node's inertia."""
        return max(self.safety, SAFETY)

    @property
    def symplectic(self) -> bool:
        """Balanced windows are reversible, but forces that cells hold are states of their own."""
        return not self.balanced

    def prepare(self, problem: Problem, until: float) -> WindowRun | ExactRun:
        """Choose steps, regroup the cells for windows, and set up the run; collective.

        Raises:
            IntegratorError: for bodies this integrator cannot take.
            StepError: for ``steps`` that are not one per cell, positive, and stable.
        """
        require_constant_inertia(problem, "AVI")
        critical = cell_steps(problem, self.dissipation)
        disc = problem.disc
        real = disc.source_cell >= 0
        own = np.full(disc.count, np.inf)
        own[disc.source_cell[real]] = critical[real]
        steps = self.safety * own
        if self.schedule == "exact":
            steps = alike(steps)
        if self.steps is not None:
            steps = self._given(problem, own)
        window = window_length(steps, until, problem.comm)
        stiffen(problem, reach(np.where(np.isfinite(own), own, window / SAFETY), steps, SAFETY))
        if self.schedule == "exact":
            # A cell without stiffness of its own acts once per span.
            blocks = np.full(critical.shape, np.inf)
            blocks[real] = np.where(np.isfinite(steps), steps, window)[disc.source_cell[real]]
            return ExactRun(problem, self, span_length(blocks, until, problem.comm), blocks, own)
        octaves = self.schedule == "octaves"
        counts = divisions(steps, window, octaves)
        counts = graded(problem, counts) if octaves else counts
        problem.arrange(apart(problem, counts) if self.balanced else counts)
        return WindowRun(problem, self, window, own)

    def _given(self, problem: Problem, critical: Array) -> Array:
        """``steps``, if they are fit to run with."""
        steps, error = np.asarray(self.steps, dtype=np.float64), None
        if steps.shape != critical.shape:
            error = StepError(
                f"AVI: steps has shape {steps.shape}, but this rank owns {len(critical)} cells. "
                "Give one step for each of them."
            )
        elif not (np.isfinite(steps).all() and np.all(steps > 0)):
            error = StepError("AVI: steps are not all positive and finite. Give seconds, > 0.")
        elif np.any(steps > critical * (1 + 1e-9)) and not self.unstable_ok:
            worst = int(np.argmax(steps / critical))
            error = StepError(
                f"AVI: the step {steps[worst]:.6g} s of cell {worst} is larger than its critical "
                f"step {critical[worst]:.6g} s. Give smaller steps (resonances start near 0.47 of "
                "it), or unstable_ok=True to see what happens."
            )
        agree(problem.comm, error)
        return steps
