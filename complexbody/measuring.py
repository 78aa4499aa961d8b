# SPDX-License-Identifier: LGPL-3.0-or-later
"""One point of a chart: a method with one step on one mesh, run whole, its cost and its errors.

What happens to a point is its ``status``, never its absence: "done", "unstable" (it blew up or
found no solution), "refused" (by the method) or "too long" (for the budget).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI

from complexbody.contenders import Contender
from complexbody.errors import ComplexBodyError, DivergenceError, SolverError
from complexbody.integrators.entries import Run
from complexbody.norms import State, state_of
from complexbody.problem import Problem
from complexbody.references import Reference, Semidiscrete, quietly

#: A run has blown up if its fields exceed the reference's largest entry so many times, or if its
#: error in the energy norm is so many times the reference's norm.
HUGE, LOST = 1e3, 10.0
#: A run is looked at after so many steps, or at so many times; steps of the run that is discarded.
STRIDE, PIECES, WARM = 64, 16, 3
#: Runs are repeated beyond what is asked for until all took so many seconds, up to so many times.
SHORT, MORE = 0.1, 5
#: A run is left out as too long after this share of the budget.
SURE = 0.02


class _BlownUp(Exception):
    """A run whose fields left all bounds."""


@dataclass
class _Cost:
    """Of one whole run, the largest of any rank [s]; processor time and wall time."""

    seconds: float = 0.0
    wall: float = 0.0
    done: int = 0


class Point:
    """A point to be measured; collective.

    Args:
        contender: The method.
        factor: Of its stable limit.
        reference: Of the mesh; its scene is what runs.
        total: What total errors are against, if anything.
        repeats: Runs, the fastest of which counts.
        budget: Seconds after which it is not repeated.
    """

    def __init__(
        self, contender: Contender, factor: float, reference: Semidiscrete,
        total: Reference | None, repeats: int, budget: float,
    ) -> None:  # fmt: skip
        self.contender, self.factor, self.reference = contender, factor, reference
        self.total, self.repeats, self.budget = total, repeats, budget
        self.until, self.comm = reference.until, reference.scene.mesh.comm
        self.problem: Problem = quietly(reference.scene)

    def measure(self) -> dict[str, Any]:
        """Status, cost and errors."""
        row: dict[str, Any] = {
            "cells": self.comm.allreduce(self.problem.disc.count), "status": "done",
            "message": None, "integrator": None, "step": None, "steps": None, "seconds": None,
            "wall": None, "updates": None, "runs": 0, "time_error": None, "total_error": None,
        }  # fmt: skip
        try:
            with np.errstate(all="ignore"):
                self._measure(row)
        except (_BlownUp, DivergenceError, SolverError) as error:
            row.update(status="unstable", message=str(error))
        except ComplexBodyError as error:
            row.update(status="refused", message=str(error))
        finally:
            self.problem.close()
        return row

    def _prepared(self, row: dict[str, Any]) -> Run:
        wanted = self.factor * self.reference.critical
        step = self.until / np.ceil(self.until / min(wanted, self.until) * (1 - 1e-12))
        method = self.contender.make(self.factor, float(step))
        run: Run = method.prepare(self.problem, self.until)
        sets = run.time_sets
        row.update(
            integrator=repr(method), steps=round(self.until / run.step),
            step=float(run.step if sets is None else sets.largest_step),
        )  # fmt: skip
        return run

    def _measure(self, row: dict[str, Any]) -> None:
        run = self._prepared(row)
        if not self._warm(run, row):
            return
        spent = 0.0
        while True:
            run, cost = self._prepared(row), _Cost()
            try:
                self._whole(run, row["steps"], cost)
            finally:
                # Also of a run that blew up: what the rest would have cost at this rate.
                share = row["steps"] / max(cost.done, 1)
                row["runs"] += 1
                row["seconds"] = min(row["seconds"] or np.inf, cost.seconds * share)
                row["wall"] = min(row["wall"] or np.inf, cost.wall * share)
                row["updates"] = round(self.comm.allreduce(int(run.updates)) * share)
            if row["runs"] == 1:
                self._judge(row, state_of(run, self.problem)[0])
            run.close()
            spent += self.comm.bcast(cost.wall)
            if spent > self.budget or self._enough(row["runs"], spent):
                return

    def _enough(self, runs: int, spent: float) -> bool:
        """Whether to stop repeating: short runs go on, for a clock has its grain."""
        return runs >= self.repeats and (
            self.repeats == 1 or spent > SHORT or runs >= MORE * self.repeats
        )

    def _warm(self, run: Run, row: dict[str, Any]) -> bool:
        """A run that is discarded; False if a whole one would take longer than the budget."""
        cost, steps = _Cost(), row["steps"]
        self._advance(run, 1, _Cost())
        few, whole = min(WARM, steps) - 1, 0.0
        while few > 0:
            self._advance(run, few, cost)
            cost.done = run.steps - 1
            wall = self.comm.bcast(cost.wall)
            whole = wall / cost.done * steps
            if whole <= self.budget or wall > SURE * self.budget:
                break
            few = min(2 * few, steps - run.steps)  # a few steps alone may mislead
        run.close()
        if whole > self.budget:
            row.update(
                status="too long", seconds=cost.seconds / cost.done * steps,
                message=f"about {whole:.0f} s, more than the budget of {self.budget:g} s",
            )  # fmt: skip
        return whole <= self.budget

    def _whole(self, run: Run, steps: int, cost: _Cost) -> None:
        """All steps in some pieces, so that a run which blows up does not go on."""
        bound, n = HUGE * self.reference.norms.largest, self.problem.disc.n
        piece = max(STRIDE, -(-steps // PIECES))
        while run.steps < steps:
            self._advance(run, min(piece, steps - run.steps), cost)
            cost.done = run.steps
            top = float(np.abs(run.positions()[:-1, :n]).max(initial=0.0))
            top = self.comm.allreduce(top if np.isfinite(top) else np.inf, op=MPI.MAX)
            if top > bound:
                raise _BlownUp(f"blew up by t = {run.time:.3g} s")

    def _advance(self, run: Run, steps: int, cost: _Cost) -> None:
        self.comm.Barrier()
        wall, begun = time.perf_counter(), time.process_time()
        run.advance(steps)
        spent = np.array([time.process_time() - begun, time.perf_counter() - wall])
        self.comm.Allreduce(MPI.IN_PLACE, spent, op=MPI.MAX)
        cost.seconds, cost.wall = cost.seconds + float(spent[0]), cost.wall + float(spent[1])

    def _judge(self, row: dict[str, Any], state: State) -> None:
        """Errors, by references refined until they can tell them.

        Raises:
            _BlownUp: if the state has nothing to do with the reference.
        """
        norms, mesh = self.reference.norms, self.reference.scene.mesh
        errors = norms.errors(state, self.reference.state(mesh))
        lost = errors["energy_norm"]
        if lost is not None and lost > LOST:
            raise _BlownUp(f"its error in the energy norm is {lost:.1e}")
        for kind, against in (("time", self.reference), ("total", self.total)):
            if against is None:
                continue
            known = against.good_for(norms.errors(state, against.state(mesh)))
            row[f"{kind}_error"] = norms.errors(state, against.state(mesh))
            if not known:
                row["message"] = f"the reference's own error may be over a tenth of the {kind} one"


def told(row: dict[str, Any]) -> str:
    """A point in one line."""
    place = ", ".join(f"{k}={v}" for k, v in row["mesh"].items())
    head = f"{place:12s} {row['method']:26s} ×{row['factor']:<8.4g}"
    if row["status"] != "done":
        return f"{head} {row['status']}: {row['message'].split('. ')[0]}"
    parts = [f"{row['seconds']:9.3g} s {row['updates']:10.3g} updates"]
    for kind in ("total", "time"):
        error = (row[f"{kind}_error"] or {}).get("fields")
        parts.append(f"{kind} error " + ("unknown" if error is None else f"{error:.2e}"))
    return f"{head} {', '.join(parts)}"
