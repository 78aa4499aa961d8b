# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The cheapest integrator and step that meet an accuracy, found by short runs on the scene itself.

The *norm* is that of the charts: the larger of the relative L2 errors of u and ν at the end, over
the largest norm of either in the run. At a few moments of the motion windows of about a hundredth
of it are run (:mod:`complexbody.pilots`): by each method that may be worth it, at its stable
limit, against Richardson's extrapolation of two steps of the first of them; and with the forces
that masses without the mesh's leading error would feel. The amplitudes a by which runs part in a
window grow as a power p of time, 0 ≤ p ≤ 1, seen from the windows' middles to their ends (1 where
phases drift apart, 0 for the ripple of cells that act alone), and as the square of the step. So

.. math:: e = \bar r\,(T/w)^p\,\langle\min(q, q_T)\rangle / q_{most},

r the mean of a/q over windows and q the amplitude of the motion itself: what moves later errs for a
shorter time, and what viscosity takes from the motion it takes from its errors, too.
This is what the error may be at any phase near the end. The first window decides, before the run
where something moves from the start. One or two more, at states of the run itself, verify it by
halving its steps: the run begins anew if the request would be missed.
"""

from __future__ import annotations

import time as clock
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody.asked import Accuracy, Parting
from complexbody.candidates import candidates, halved, name_of, scaled
from complexbody.corners import BEND, widest
from complexbody.errors import AccuracyError
from complexbody.given import is_positive, short
from complexbody.histories import Constant
from complexbody.integrators.entries import Run
from complexbody.pilots import Moment, Piece, Pilots, attempt, moment_of
from complexbody.precheck import limits
from complexbody.problem import Problem
from complexbody.result import Result
from complexbody.runoptions import check_options
from complexbody.scene import Scene
from complexbody.simulation import Simulation

Array = npt.NDArray[np.float64]

#: A window is this part of the motion, and at least so many of the largest cell's critical steps.
PART, STEPS = 120, 3.6
#: Where windows begin, as parts of the motion; the first one later if nothing moves at its start.
WINDOWS, LATE = (0.0, 0.4, 0.7), 0.15
#: Time may take this share of what the mesh leaves of the request, and at least that of all of it.
SHARE, LEAST = 0.6, 0.15
#: Processor time is believed where windows took so long [s]; else updates are counted.
GRAIN = 0.02
#: A run under way goes on with what would cost at most so many times the least.
KEEP = 1.5
#: By so much estimates may be too large at the first, second, … window: where something moves from
#: the start, and where motion sets in later, whose onset has the shortest waves.
DOUBT, DOUBT_LATE = (1.5, 1.0), (8.0, 2.0, 1.0)
#: Below this share of the request one window of the run is enough.
CLEAR = 0.5
#: At re-entrant corners the mesh's error is at most so many times its estimate (docs/plan.md).
CORNERS = 3.0
#: Share of the request that the advised mesh leaves to its own error.
ROOM = 0.7
#: Loads act from where they reach this part of their largest factor.
ONSET = 1e-2


class _Again(Exception):
    """The run would miss the request."""


class Accurate:
    """A simulation whose integrator and step are chosen; collective.

    Args:
        scene: What to simulate.
        asked: Relative error to meet.
        integrator: None: it is chosen.
        until: End of the run [s].
        options: As for :class:`complexbody.simulation.Simulation`.

    Attributes:
        simulation: The simulation, ready to run; looks: how often this looks at it.
        method: Its integrator.

    Raises:
        AccuracyError: for what is no accuracy, beside an integrator, or what the mesh cannot meet.
        ComplexBodyError: for a scene that cannot be run.
    """

    looks = 40

    def __init__(
        self, scene: Scene, asked: float, integrator: Any = None, *, until: float, **options: Any
    ) -> None:
        if integrator is not None:
            raise AccuracyError(
                "simulate: accuracy= chooses the integrator, and integrator= is given as well. "
                "Give one of them."
            )
        if not (is_positive(asked) and asked < 1):
            raise AccuracyError(
                f"simulate: accuracy is {short(asked)}. Give a relative error between 0 and 1."
            )
        check_options(until=until, **options)
        self.scene, self.asked, self.until, self.options = scene, asked, until, options
        begun = clock.process_time()
        self.pilots = Pilots(scene, options.get("plan", True))
        self.comm = self.pilots.comm
        try:
            self._prepare()
            self.spent, self._running = clock.process_time() - begun, True
            self.simulation = Simulation(scene, self.method, until=until, watch=self, **options)
        except BaseException:
            self.pilots.close()
            raise

    def _prepare(self) -> None:
        pilots, problem = self.pilots, self.pilots.problem
        self._own, self._reach = (np.zeros(2) for _ in range(2))
        self._history: list[tuple[float, Array]] = []
        self._time: list[Parting] = []
        self._space: list[Parting] = []
        self.work = 0
        self.factor, self.predicted, self.restarts = 1.0, np.nan, 0
        self.tried: dict[str, float] = {}
        self._chosen = self._running = False
        self.begin, moving = self._onset()
        self._late = not moving
        self.length = self.until - self.begin
        found = limits(problem, "exact")
        self.candidates = candidates(problem, found)
        self.method = self.candidates[0][0]
        longest = found.largest if self.method.asynchronous else found.smallest
        shortest = STEPS * longest if np.isfinite(longest) else 0.0
        self.window = min(max(self.length / PART, shortest), self.length / 4)
        self.pending = [self.begin + part * self.length for part in WINDOWS]
        if moving:
            self._decide(pilots.start)
        else:
            self.pending[0] = self.begin + LATE * self.length

    def _onset(self) -> tuple[float, bool]:
        """When something begins to move [s], and whether it moves from the start; collective."""
        problem, start = self.pilots.problem, self.pilots.start
        loads, supports = problem.loads.histories, problem.supports.histories[1:]
        moving = bool(np.any(start.fields) or np.any(start.rates))
        moving |= problem.kernels.constant is not None
        times = np.linspace(0.0, self.until, 2001)
        first = self.until
        for history, rest in [(h, 0.0) for h in loads] + [(h, None) for h in supports]:
            factor = np.asarray(history(times), dtype=np.float64)
            factor = np.abs(factor - (factor[0] if rest is None else rest))
            acts = np.flatnonzero(factor > ONSET * factor.max())
            if len(acts):
                first = min(first, float(times[max(acts[0] - 1, 0)]))
            moving |= isinstance(history, Constant)
        moving = bool(self.comm.allreduce(moving, op=MPI.LOR))
        first = float(self.comm.allreduce(first, op=MPI.MIN))
        return (0.0, True) if moving or first >= 0.9 * self.until else (first, False)

    # --- windows -------------------------------------------------------------------------------

    def _piece(self, method: Any, begin: Moment, extra: Array | None = None) -> Piece:
        made = self.pilots.run(method, begin, self.window, extra)
        self.work += made.work
        return made

    def _pair(self, method: Any, begin: Moment) -> tuple[Piece, list[Moment]]:
        """A run through a window, and its extrapolation with one of half the steps.

        Between them, how it would part from a motion with masses of no leading error.
        """
        coarse = self._piece(method, begin)
        self._see(coarse.ends[1])
        extra = self.pilots.defect(begin, coarse.ends[1])
        other = self._piece(method, begin, extra)
        self._space.append(self._parting(begin, coarse.ends, other.ends))
        fine = self._piece(halved(method, 0.5 * self.window / coarse.steps), begin)
        # Of second order in steps whose ratio is that of their numbers.
        share = 1.0 / ((fine.steps / coarse.steps) ** 2 - 1.0)
        ends = [f + (f - c) * share for f, c in zip(fine.ends, coarse.ends, strict=True)]
        return coarse, ends

    def _parting(self, begin: Moment, ends: Any, exact: Any) -> Parting:
        middle, end = (e - x for e, x in zip(ends, exact, strict=True))
        reach = self.pilots.reach(begin, end)
        parts = [self.pilots.amplitude(m, reach, 0.5) for m in (middle, end)]
        return Parting(parts[0], parts[1], self._own)

    def _see(self, moment: Moment, anew: bool = True) -> None:
        """Know the amplitudes of the motion itself; ``anew``: also how far its rates reach."""
        if anew:
            self._reach = self.pilots.reach(moment, moment)
        self._own = self.pilots.amplitude(moment, self._reach)
        self._history.append((moment.time, self._own))

    def _lasting(self) -> Array:
        """Mean of min(q, q_now) over the largest q, u and ν (2,); the future as it is now."""
        times = np.array([self.begin, *(t for t, _ in self._history)])
        least = np.array([np.minimum(q, self._own) for _, q in self._history])
        past = np.sum(np.diff(times)[:, None] * least, axis=0)
        mean = (past + (self.begin + self.length - times[-1]) * self._own) / self.length
        most = np.max([q for _, q in self._history], axis=0)
        return np.asarray(mean / self.pilots.floored(most))

    def _error(self, parts: list[Parting]) -> float:
        """Relative error at the end from windows."""
        if not parts:
            return 0.0
        with np.errstate(all="ignore"):
            # What viscosity takes from the motion it takes from its errors as well.
            left = [np.nan_to_num(np.minimum(1.0, self._own / p.own), nan=1.0) for p in parts]
            pairs = list(zip(parts, left, strict=True))
            middle = np.sum([p.middle * part for p, part in pairs], axis=0)
            end = np.sum([p.end * part for p, part in pairs], axis=0)
            own = np.sum([self.pilots.floored(p.own) * part for p, part in pairs], axis=0)
            power = np.clip(np.nan_to_num(np.log2(end / middle), nan=1.0), 0.0, 1.0)
            error = end / own * (self.length / self.window) ** power * self._lasting()
        return float(np.max(np.where(np.isnan(error), 0.0, error)))

    def _decide(self, begin: Moment) -> None:
        """Choose by the first window; collective.

        Raises:
            AccuracyError: if the mesh cannot meet the request.
        """
        self.pending.pop(0)
        first, price = self.candidates[0]
        piece, exact = self._pair(first, begin)
        budget = self._budget()
        pieces = [(first, price, piece)]
        for method, cost in self.candidates[1:]:
            made = attempt(lambda method=method: self._piece(method, begin))
            if made is not None and made.finite:
                pieces.append((method, cost, made))
        timed = all(made.measured > GRAIN for *_, made in pieces)
        rows = []
        for method, cost, made in pieces:
            parts = self._parting(begin, made.ends, exact)
            error = self._error([parts])
            factor = min(1.0, float(np.sqrt(budget / error))) if error > 0 else 1.0
            spent = (made.seconds if timed else made.updates * cost) / factor
            rows.append((spent, method, factor, 0.5 * self.window / made.steps, parts))
        best = min(rows, key=lambda row: row[0])
        self.tried = {name_of(row[1]): row[0] / best[0] for row in rows}
        self._chosen = True
        if self._running:
            # The run is under way with the first of them: what is good enough goes on.
            spent, method, factor, step, parts = rows[0]
            if factor**2 >= SHARE and factor * spent <= KEEP * best[0]:
                best = factor * spent, method, 1.0, step, parts
            else:
                self._take(*best[1:])
                raise _Again
        self._take(*best[1:])

    def _take(self, method: Any, factor: float, step: float, parts: Parting) -> None:
        """Use a method at this factor of its limit, where it makes ``step`` and parts so far."""
        self._limit, self._step, self._parts = method, step, parts
        self._set(factor)
        self.predicted = self._error(self._time)

    def _set(self, factor: float) -> None:
        self.factor = factor
        self._time = [self._parts * factor**2]
        self.method = scaled(self._limit, factor, self._step, self.until)

    def _budget(self) -> float:
        """What is left for time; collective.

        Raises:
            AccuracyError: if the mesh leaves nothing.
        """
        mesh = self._error(self._space)
        doubts = DOUBT_LATE if self._late else DOUBT
        doubt = doubts[min(len(self._space), len(doubts)) - 1]
        if mesh > doubt * self.asked and self.pending:
            size, part = self.pilots.cell_size(), float(np.sqrt(ROOM * self.asked / mesh))
            raise AccuracyError(
                f"A relative error of {self.asked:g} is asked for, but the mesh's own is about "
                f"{mesh:.2g}. Give cells {part:.2g} times as long (median {size * part:.3g} m in "
                f"place of {size:.3g} m), or ask for {1.3 * mesh:.1g}."
            )
        surely = mesh / doubt if self._late else mesh
        return max(SHARE * (self.asked - surely), LEAST * self.asked)

    def look(self, run: Run, problem: Problem) -> None:
        """Look at the run: norms, and windows where they are due; collective.

        Raises:
            AccuracyError: if the mesh cannot meet the request.
        """
        begun = clock.process_time()
        moment = moment_of(run, problem)
        try:
            if self.pending and run.time >= self.pending[0] * (1 - 1e-9):
                if self._chosen:
                    self._verify(moment)
                else:
                    self._decide(moment)
            elif run.time >= self.begin:
                self._see(moment, anew=run.time > self.until * (1 - 1e-9))
        finally:
            self.spent += clock.process_time() - begun

    def _verify(self, begin: Moment) -> None:
        """Halve the steps of the run's own method in a window; collective."""
        self.pending.pop(0)
        piece, exact = self._pair(self.method, begin)
        self._time.append(self._parting(begin, piece.ends, exact))
        budget, error = self._budget(), self._error(self._time)
        if error > budget / SHARE and self.pending and self.restarts == 0:
            self._set(0.9 * self.factor * float(np.sqrt(budget / error)))
            raise _Again
        if error + self._error(self._space) < CLEAR * self.asked:
            self.pending.clear()

    # --- the run -------------------------------------------------------------------------------

    def run(self) -> Result:
        """Run it, anew if need be; collective, once.

        Raises:
            AccuracyError: if the mesh cannot meet the request.
            ComplexBodyError: as for any simulation.
        """
        try:
            while True:
                try:
                    result = self.simulation.run()
                    break
                except _Again:
                    self.restarts += 1
                    self._history.clear()
                    self.pending = [self.begin + part * self.length for part in WINDOWS[1:]]
                    self.simulation = Simulation(
                        self.scene, self.method, until=self.until, watch=self, **self.options
                    )
            result.accuracy = self._record(result)
        finally:
            self.pilots.close()
        return result

    def _record(self, result: Result) -> Accuracy:
        verified, mesh = self._error(self._time), self._error(self._space)
        spent = float(self.comm.allreduce(self.spent, op=MPI.MAX))
        made = Accuracy(
            self.asked, "fields", self.method, self.factor, self.predicted, verified, mesh,
            verified + mesh <= self.asked, self.tried, self.work / max(result.stats.updates, 1),
            spent / max(result.stats.stepping, 1e-12), self.restarts,
        )  # fmt: skip
        angle = widest(self.pilots.problem)
        if made.met and angle > BEND and verified + CORNERS * mesh > self.asked:
            if self.comm.rank == 0:
                warnings.warn(
                    f"The body has a corner or edge whose interior angle is {angle:.2g} times a "
                    "flat one. Of the singular fields there the estimate of the mesh's error, "
                    f"{mesh:.2g}, sees a part: the run's error may be up to "
                    f"{verified + CORNERS * mesh:.2g}, more than the {self.asked:g} asked for. "
                    "Compare with a finer mesh.", UserWarning, stacklevel=3,
                )  # fmt: skip
        if not made.met and self.comm.rank == 0:
            warnings.warn(
                f"The run's error is about {verified + mesh:.2g} ({verified:.2g} in time, "
                f"{mesh:.2g} of the mesh), more than the {self.asked:g} asked for.",
                UserWarning, stacklevel=3,
            )  # fmt: skip
        return made
