# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where a scene's runs are stable: critical steps, and growth over safety factor and schedule.

Everything is measured on the runs that a simulation would make, of the scene's homogeneous part:
without loads, supports at zero, from rough data. Critical steps stand beside the bounds by which
steps are chosen; growth is per coarse step (the synchronous step, the window, the largest h_K).
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import machine
from complexbody.criticalsteps import (
    DENSE,
    CriticalStep,
    affordable,
    critical_steps,
    problem_cells,
)
from complexbody.disturbed import Disturbed
from complexbody.errors import IntegratorError
from complexbody.growth import RunMap, long_run, resolution
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.synchronous import Synchronous
from complexbody.masses import SCHEMES
from complexbody.progress import Progress
from complexbody.resonances import TOLERANCE
from complexbody.scene import Scene
from complexbody.timesets import require_constant_inertia

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Schedule:
    """A way to step that the map has a row for.

    Attributes:
        make: Integrator of a safety factor and a dissipation scheme.
        default: Its default safety factor.
    """

    make: Callable[[float, str], Any]
    default: float


#: Rows of the growth map by name.
SCHEDULES: Mapping[str, Schedule] = {
    "synchronous": Schedule(
        lambda a, d: Synchronous(safety=a, dissipation=d, unstable_ok=True), Synchronous.safety
    ),
    "published AVI": Schedule(lambda a, d: AVI.as_published(a), AVI.safety),
    "corrected real steps": Schedule(lambda a, d: AVI(a, "exact", dissipation=d), AVI.safety),
    "plain windows": Schedule(lambda a, d: AVI(a, balanced=False, dissipation=d), AVI.safety),
    "balanced windows": Schedule(lambda a, d: AVI(a, dissipation=d), AVI.safety),
    "local leapfrog": Schedule(lambda a, d: LocalLeapfrog(a, dissipation=d), LocalLeapfrog.safety),
}


@dataclass(frozen=True)
class Point:
    """Growth of one schedule at one safety factor.

    Attributes:
        schedule, safety: Where.
        growth: Factor of the state per coarse step, minus 1.
        step: That coarse step [s].
        how: "map" (spectral radius) or "long run".
        resolution: Growth below which a long run shows nothing.
        refused: Why there is no such run, or "".
    """

    schedule: str
    safety: float
    growth: float
    step: float
    how: str
    resolution: float = 0.0
    refused: str = ""

    @property
    def unstable(self) -> bool:
        """Whether it grows by more than 1e-3 per coarse step, and shows it."""
        return self.growth > max(TOLERANCE, self.resolution)


@dataclass
class Stability:
    """What :func:`stability` found.

    Attributes:
        name: The scene's name; cells: its number of cells.
        critical: A row per dissipation scheme.
        points: The growth map, schedule by schedule.
        origin: Machine, versions and commit, and the time taken [s].
    """

    name: str
    cells: int
    critical: list[CriticalStep] = field(default_factory=list)
    points: list[Point] = field(default_factory=list)
    origin: dict[str, Any] = field(default_factory=lambda: origin())

    def growth(self, schedule: str) -> tuple[Array, Array]:
        """Safety factors and growth of a schedule, both (points,)."""
        mine = [p for p in self.points if p.schedule == schedule and not p.refused]
        return np.array([p.safety for p in mine]), np.array([p.growth for p in mine])


def origin() -> dict[str, Any]:
    """Machine, versions and commit, for the files."""
    return {
        "machine": machine.machine(), "versions": machine.versions(), "commit": machine.commit(),
    }  # fmt: skip


def stability(
    scene: Scene,
    *,
    safeties: Sequence[float] | None = None,
    schedules: Sequence[str] | None = None,
    dissipation: str = "exact",
    critical: bool = True,
    steps: int | None = None,
    dense: int = DENSE,
    progress: bool | None = None,
) -> Stability:
    """Critical steps of a scene, and the growth of its runs; collective.

    Args:
        scene: What to look at. Its loads are left out, its supports held at zero; a scene that is
            not linear is disturbed slightly about its initial fields.
        safeties: Safety factors α; by default 0.3 to 1 by 0.05, by 0.1 above 2000 cells, and the
            defaults.
        schedules: Of :data:`SCHEDULES`; all by default.
        dissipation: Scheme of the map (the published AVI has its own).
        critical: Measure critical steps as well.
        steps: Coarse steps of a long run, which tells growth above some 8/steps; by default 8000,
            or what 2·10⁷ cell updates are enough for, but 500 at least.
        dense: Largest state whose map is made (on one rank); larger ones, real steps and scenes
            that are not linear take long runs.
        progress: Show progress on rank 0; by default where standard error is a terminal.

    Raises:
        IntegratorError: for an unknown schedule or scheme, or a body without constant inertia.
        StepError: for a body without stiffness.
    """
    names = list(SCHEDULES) if schedules is None else list(schedules)
    for name in names:
        if name not in SCHEDULES:
            raise IntegratorError(
                f"stability: no schedule {name!r}. Give some of {', '.join(SCHEDULES)}."
            )
    if dissipation not in SCHEMES:
        raise IntegratorError(
            f"stability: dissipation is {dissipation!r}. Give one of {', '.join(SCHEMES)}."
        )
    problems = Disturbed.pair(scene)
    problem = problems[0]
    require_constant_inertia(problem, "stability")
    cells = problem_cells(problems)
    found = Stability(scene.name, cells)
    if safeties is None:
        defaults, apart = {SCHEDULES[name].default for name in names}, 0.1 if cells > 2000 else 0.05
        safeties = sorted({*np.round(np.arange(0.3, 1.001, apart), 3).tolist(), *defaults})
    total = (len(SCHEMES) if critical else 0) + len(names) * len(safeties)
    bar, begun = Progress(problem.comm, float(total), progress), clock.perf_counter()
    if critical:
        for scheme in SCHEMES:
            found.critical.append(critical_steps(problems, scheme, steps, dense))
            bar.update(float(len(found.critical)), len(found.critical))
    for name in names:
        for safety in safeties:
            method = SCHEDULES[name].make(float(safety), dissipation)
            found.points.append(point(problems, name, float(safety), method, steps, dense))
            count = len(found.critical) + len(found.points)
            bar.update(float(count), count)
    bar.close()
    found.origin["seconds"] = clock.perf_counter() - begun
    for each in problems:
        each.close()
    return found


def point(
    problems: Sequence[Disturbed], name: str, safety: float, method: Any,
    steps: int | None = None, dense: int = DENSE,
) -> Point:  # fmt: skip
    """Growth of one integrator's runs; collective."""
    runs: list[Any] = []
    try:
        for problem in problems:
            problem.anew()
            # So long that no step is shortened to fit.
            runs.append(method.prepare(problem, 1e9 * problem.unit))
        sets = runs[0].time_sets
        real = getattr(method, "schedule", "") == "exact"
        coarse = sets.largest_step if real else runs[0].step
        if runs[0].problem.mappable and not real:
            states = RunMap(runs[0])
            if states.size <= dense:
                return Point(name, safety, states.radius() - 1.0, coarse, "map")
        updates = (
            sets.updates / sets.window * coarse if sets is not None else problem_cells(problems)
        )
        # An event at real steps costs as much as four others.
        steps = steps or affordable(updates * (4 if real else 1) * len(runs))
        count = int(np.ceil(steps * coarse / runs[0].step))
        slope = long_run(runs, count, problems[0].enough) * coarse / runs[0].step
        growth = float(np.expm1(min(slope, 500.0)))
        return Point(name, safety, growth, coarse, "long run", resolution(steps))
    except IntegratorError as error:
        return Point(name, safety, np.nan, np.nan, "", refused=str(error))
    finally:
        for run in runs:
            run.close()
