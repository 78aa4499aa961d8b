# SPDX-License-Identifier: LGPL-3.0-or-later
"""One simulation, from scene to result: steps, output at chosen times, ledger, probes, progress.

The run never changes its step to meet an output time: what is written at t between two steps is
the cubic Hermite interpolant of fields and rates, whose error is of higher order than the scheme's.
"""

from __future__ import annotations

import time as clock
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import planning
from complexbody.amplitudes import try_histories
from complexbody.checkpoint import Checkpoint
from complexbody.continuation import Continuation
from complexbody.errors import (
    ComplexBodyError,
    DivergenceError,
    SolverError,
    agree,
)
from complexbody.instabilities import warn_of
from complexbody.integrators.entries import Run
from complexbody.keeper import Description
from complexbody.ledger import Bookkeeper
from complexbody.outfiles import Outfiles
from complexbody.output import Output
from complexbody.problem import Problem
from complexbody.progress import Progress
from complexbody.result import Result, Statistics
from complexbody.runoptions import Integrator, check_options, chosen
from complexbody.scene import Scene
from complexbody.stepping import default_ledger_steps, hermite, steps_until

Array = npt.NDArray[np.float64]


class Watch(Protocol):
    """Who looks at a run as it goes; may raise to end it.

    Attributes:
        looks: How often, about.
    """

    looks: int

    def look(self, run: Run, problem: Problem) -> None:
        """Look at a run between two steps; collective."""


class Simulation:
    """A simulation that is ready to run: what :func:`simulate` makes and runs; same arguments.

    Beside those, ``watch`` looks at the run.

    Attributes:
        problem, run_: The scene made ready, and the integrator's run.
        every: Steps between two ledger rows.
        stats: Filled in as far as known before the run.
        resumed: The checkpoint that it goes on from, or None.
    """

    stats: Statistics

    def __init__(
        self,
        scene: Scene,
        integrator: Integrator | None = None,
        *,
        until: float,
        output: Output | None = None,
        ledger_steps: int | None = None,
        growth: float | None = 10.0,
        progress: bool | None = None,
        plan: bool = True,
        quiet: bool | None = None,
        watch: Watch | None = None,
        checkpoint: Checkpoint | None = None,
        resume: bool | str | Path = False,
    ) -> None:
        begun = clock.perf_counter()
        check_options(
            until=until, output=output, ledger_steps=ledger_steps, growth=growth,
            progress=progress, plan=plan, quiet=quiet, checkpoint=checkpoint, resume=resume,
        )  # fmt: skip
        self.method = chosen(integrator)
        self.watch = watch
        self.scene, self.until, self.output, self.comm = scene, until, output, scene.mesh.comm
        self.problem = Problem(scene, reduce=plan)
        try:
            self._make_ready(plan, quiet, ledger_steps, growth, progress, checkpoint, resume)
        except ComplexBodyError:  # which all ranks have: closing is collective
            self.problem.close()
            raise
        self.stats.set_up += clock.perf_counter() - begun

    def _make_ready(
        self,
        plan: bool,
        quiet: bool | None,
        ledger_steps: int | None,
        growth: float | None,
        progress: bool | None,
        checkpoint: Checkpoint | None,
        resume: bool | str | Path,
    ) -> None:
        """All but the problem itself."""
        until, output = self.until, self.output
        for data in (self.problem.loads, self.problem.supports):
            try_histories(self.comm, data.histories, until)
        warn_of(self.problem, self.method, until)
        self.problem.quiet = plan if quiet is None else quiet
        going_on = Continuation(self.problem, self.method, output, checkpoint, resume)
        self.resumed = going_on.found
        self.run_: Run = self.method.prepare(self.problem, going_on.begun_for(until))
        self.problem.release()
        self.books = Bookkeeper(self.problem, self.run_, growth)
        rows = None
        if self.resumed is not None:
            rows = going_on.restore(self.run_, until, len(self.books.ledger.columns))
        self.plan = planning.of_run(self.problem, self.method) if plan else None
        self.last = steps_until(until, self.run_.step)
        self.files = Outfiles(self.problem, output)
        self.times = self.files.times(until)
        # Now that nothing refuses the run: it replaces what an earlier one wrote.
        self.keeper = going_on.keeper(self.run_, until, self._describe, self.files.sync)
        self.files.open(self.books.ledger, self._steps(), going_on.since)
        self._noted, self._before = -1, (np.zeros(0), np.zeros(0))
        self.progress = Progress(self.comm, until, progress)
        self._statistics()
        self.every = ledger_steps or default_ledger_steps(
            self.stats.cells, self.comm.size, self.last
        )
        if self.resumed is not None and rows is not None:
            self._resume(self.resumed.about, rows)

    def _describe(self) -> Description:
        """What a checkpoint keeps of the simulation around the run."""
        rows = len(self.books.ledger)
        about = {
            "books": self.books.state(), "written": self.files.written, "every": self.every,
            "noted": self._noted == self.run_.steps, "statistics": asdict(self.stats),
        }  # fmt: skip
        return about, {"ledger": lambda: np.array(self.books.ledger.rows[:rows])}

    def _resume(self, about: Mapping[str, Any], rows: Array) -> None:
        """Take from a checkpoint what was around its run."""
        self.books.restore(about["books"], rows)
        self.every = int(about["every"])
        self._noted = self.run_.steps if about["noted"] else -1
        for name in ("set_up", "stepping", "booking", "writing", "saving"):
            setattr(self.stats, name, float(about["statistics"][name]))

    def _steps(self) -> dict[str, Array]:
        """Step and level of each of this rank's cells."""
        sets, count = self.run_.time_sets, self.problem.disc.count
        if sets is None:
            return {"steps": np.full(count, self.run_.step), "levels": np.zeros(count)}
        return {"steps": sets.steps, "levels": sets.levels.astype(np.float64)}

    def _statistics(self) -> None:
        disc = self.problem.disc
        self.stats = Statistics(self.run_.step, self.run_.critical, ranks=self.comm.size)
        self.stats.cells = self.comm.allreduce(int(np.sum(disc.source_cell >= 0)))
        self.stats.nodes = self.comm.allreduce(int(disc.owned.sum()))
        self.stats.bytes_per_cell = self.problem.kernels.bytes_per_cell()

    def run(self) -> Result:
        """Run it; collective, once.

        Raises:
            DivergenceError: if the run blew up.
            SceneError: if a history of the scene failed on the way.
            SolverError: if an implicit step has no solution; the last state is written as output,
                and is ``result`` of the error.
            OutputError: if results cannot be written any more.
        """
        listening = nullcontext() if self.keeper is None else self.keeper.listening()
        try:
            with listening:
                self._loop()
                result = self._result()
                if self.keeper is not None and not self._overshoots:
                    self.keeper.save()
                return self._counted(result)
        except (DivergenceError, SolverError) as error:
            # A history that failed on some rank since the last row gave it NaN.
            for data in (self.problem.loads, self.problem.supports):
                agree(self.comm, data.failure)
            if isinstance(error, SolverError):
                if self.keeper is not None:
                    self.keeper.save()
                error.result = self._keep()
            elif self.keeper is not None:
                self.keeper.fall_back()
            raise
        finally:
            self._close()

    # --- the loop ------------------------------------------------------------------------------

    def _loop(self) -> None:
        run = self.run_
        tiny = 1e-9 * run.step
        pending = [t for t in self.times if self.files.written < t < self.until - tiny]
        if self._noted != run.steps:
            self._note()
        while pending and pending[0] <= tiny:
            self._write(pending.pop(0), *run.sample())
        while run.steps < self.last:
            if self.keeper is not None:
                self.keeper.look()
            stop = min(self.last, *((run.steps // n + 1) * n for n in self._strides()))
            if pending:
                stop = min(stop, int(np.floor(pending[0] / run.step + 1e-9)))
            if self.keeper is not None:
                stop = min(stop, self.keeper.pause(run.steps))
            if self._overshoots:
                stop = self._ending(stop)
            if stop > run.steps:
                self._advance(stop - run.steps)
                self._note()
            if pending and pending[0] < (run.steps + 1) * run.step - tiny:
                if self.keeper is not None:
                    self.keeper.look()
                pending = self._between(pending, tiny)
        self.progress.update(self.until, run.steps)

    def _advance(self, steps: int) -> None:
        begun = clock.perf_counter()
        # In pieces of about a second, so that progress and signals are seen in long stretches.
        sets = self.run_.time_sets
        updates = self.stats.cells if sets is None else sets.updates
        piece = max(1, 50_000_000 // max(updates // self.comm.size, 1))
        while steps > 0:
            if self.keeper is not None:
                piece = min(piece, self.keeper.stride)
            self.run_.advance(min(piece, steps))
            steps -= piece
            if self.keeper is not None and steps > 0:
                self.stats.stepping += clock.perf_counter() - begun
                self.keeper.look()
                begun = clock.perf_counter()
        self.stats.stepping += clock.perf_counter() - begun
        self.progress.update(self.run_.time, self.run_.steps)

    def _note(self) -> None:
        """Ledger and probes, where the run's step is due for them."""
        run = self.run_
        receivers = self.files.receivers
        if receivers is not None and run.steps % receivers.stride == 0:
            receivers.record(run.time, run.positions())
        if run.steps % self.every == 0 and run.steps < self.last:
            self._book()
        self._noted = run.steps
        if self.watch is not None and (run.steps % self._looks() == 0 or run.steps == self.last):
            self.watch.look(run, self.problem)

    def _strides(self) -> list[int]:
        """Numbers of steps after which someone wants to see the run."""
        out = [self.every]
        if self.files.receivers is not None:
            out.append(self.files.receivers.stride)
        return out if self.watch is None else [*out, self._looks()]

    def _looks(self) -> int:
        """Steps between two looks of whoever watches."""
        assert self.watch is not None
        return max(1, self.last // self.watch.looks)

    def _between(self, pending: list[float], tiny: float) -> list[float]:
        """Write all times due before the next step's end, by Hermite interpolation."""
        run = self.run_
        x, rates = run.sample()
        self._before = x0, v0 = x.copy(), rates.copy()
        t0 = run.time
        while pending and pending[0] <= t0 + tiny:
            self._write(pending.pop(0), x0, v0)
        if not pending or pending[0] >= t0 + run.step - tiny:
            return pending
        self._advance(1)
        x1, v1 = run.sample()
        while pending and pending[0] < run.time - tiny:
            t = pending.pop(0)
            self._write(t, *hermite((t - t0) / run.step, run.step, x0, v0, x1, v1))
        self._note()
        return pending

    @property
    def _overshoots(self) -> bool:
        """Whether a given step does not divide the time to ``until``."""
        return abs(self.last * self.run_.step - self.until) > 1e-9 * self.run_.step

    def _ending(self, stop: int) -> int:
        """Where to stop next: before the last step, whose ends make what is at ``until``."""
        if self.run_.steps < self.last - 1:
            return min(stop, self.last - 1)
        x, rates = self.run_.sample()
        self._before = x.copy(), rates.copy()
        if self.keeper is not None:
            self.keeper.save()
        return stop

    def _final(self) -> tuple[Array, Array]:
        """Fields and rates at ``until``; interpolated if a given step does not divide it."""
        run = self.run_
        x1, v1 = run.sample()
        if not self._overshoots:
            return x1, v1
        part = (self.until - run.time + run.step) / run.step
        return hermite(part, run.step, *self._before, x1, v1)

    def _keep(self) -> Result:
        """The state before the step that failed, written and returned."""
        # Rates at its own time may have no solution either: those of the last drift do.
        return self._made(self.run_.time, self.run_.positions(), self.problem.kernels.v)

    def _result(self) -> Result:
        rows = self.books.ledger.rows
        if not rows or rows[-1][0] != self.run_.time:  # there already if it was killed at the end
            self._book()
        return self._made(self.until, *self._final())

    def _made(self, t: float, x: Array, rates: Array) -> Result:
        self._write(t, x, rates)
        self.files.fill(x, rates)
        f, s = self.files.functions, self.stats
        s.steps = self.run_.steps
        s.updates = self.comm.allreduce(int(self.run_.updates))
        skipped = self.comm.allreduce(int(self.run_.skipped))
        s.quiet = skipped / max(s.updates + skipped, 1)
        for name in ("set_up", "stepping", "booking", "writing"):
            setattr(s, name, self.comm.allreduce(getattr(s, name), op=MPI.MAX))
        s.rate = s.updates / max(s.stepping, 1e-12)
        fields = (f["u"], f["nu"], f["u_dot"], f["nu_dot"])
        return Result(
            *fields, t, self.books.ledger, s, self.scene, self.files.probes(),
            self.files.folder, self.method,
            self.run_.time_sets, getattr(self.run_, "summary", str)(), self.plan,
        )  # fmt: skip

    def _counted(self, result: Result) -> Result:
        """The result, with the time that checkpoints took."""
        if self.keeper is not None:
            mine = self.stats.saving + self.keeper.seconds
            self.stats.saving = self.comm.allreduce(mine, op=MPI.MAX)
        return result

    # --- what leaves the run -------------------------------------------------------------------

    def _write(self, t: float, x: Array, rates: Array) -> None:
        begun = clock.perf_counter()
        self.files.write(t, x, rates)
        self.stats.writing += clock.perf_counter() - begun

    def _book(self) -> None:
        # The forces at this time are the next step's as well: they are no cost of the books.
        begun = clock.perf_counter()
        self.run_.sample()
        self.stats.stepping += clock.perf_counter() - begun
        begun = clock.perf_counter()
        rows = len(self.books.ledger)
        try:
            self.books.row()
        finally:
            # The row that stops a run is the one a user wants to see.
            self.files.rows(self.books.ledger.rows[rows:])
        if self.keeper is not None:
            self.keeper.note()
        self.stats.booking += clock.perf_counter() - begun

    def _close(self) -> None:
        self.progress.close()
        self.files.close()
        self.run_.close()
        self.problem.close()
