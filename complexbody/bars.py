# SPDX-License-Identifier: LGPL-3.0-or-later
"""Resonances predicted and measured: two springs on one mass, and bars of two cell sizes.

What :mod:`complexbody.resonances` predicts is met here by runs of the package: of scenes that are
those models, by the integrators as a user has them. Scenes are of one rank each.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import mesh as dmesh
from mpi4py import MPI

from complexbody import _compat, meshes, resonances
from complexbody.body import Body
from complexbody.disturbed import Disturbed
from complexbody.growth import RunMap, long_run, resolution
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.progress import Progress
from complexbody.scene import Fix, Scene
from complexbody.stability import origin

Array = npt.NDArray[np.float64]

#: Size ratios of the bars: as real steps have a common period.
RATIOS = tuple(map(Fraction, "1 5/4 4/3 3/2 5/3 7/4 2 9/4 7/3 5/2 8/3 3 7/2 4 9/2 5 6 7 8".split()))
#: Safety factors of the predicted maps and of those made of runs.
FINE, COARSE = np.arange(300, 1001) / 1e3, np.arange(300, 1001, 5) / 1e3


def string(
    lengths: Sequence[float], stiffness: Sequence[float], viscosity: float = 0.0, free: bool = False
) -> Scene:
    """ν alone on an interval of cells of the given lengths and stiffness, ρ̄ = 1; u is held.

    Args:
        lengths: Of the cells, from the left.
        stiffness: a of ½a|∇ν|², cell by cell.
        viscosity: η.
        free: Leave the right end free; both are held otherwise.
    """

    def body(a: float) -> Body:
        def energy(U: Any, nu: Any, N: Any) -> Any:
            return 1e-4 * U[0, 0] ** 2 + 0.5 * a * N[0, 0] ** 2

        return Body(1, energy, 1.0, 1.0, viscosity, displacement=1)

    mesh = meshes.graded_interval(MPI.COMM_SELF, lengths)
    ends = (lambda x: x[0] < 1e-9 * sum(lengths)) if free else "boundary"
    supports = [Fix("nu", ends), Fix("u", lambda x: x[0] > -1.0)]
    values = sorted(set(stiffness))
    if len(values) == 1:
        return Scene(mesh, body(values[0]), supports)
    cells = np.arange(len(lengths), dtype=np.int32)
    tags = np.array([values.index(stiffness[k]) for k in _from_left(mesh)], np.int32)
    bodies = {tag: body(a) for tag, a in enumerate(values)}
    return Scene(mesh, bodies, supports, cell_tags=dmesh.meshtags(mesh, 1, cells, tags))


def _from_left(mesh: Any) -> npt.NDArray[np.int64]:
    """Place from the left of each of dolfinx's cells of an interval."""
    middle = mesh.geometry.x[_compat.cell_nodes(mesh), 0].mean(axis=1)
    place = np.empty(len(middle), np.int64)
    place[np.argsort(middle)] = np.arange(len(middle))
    return place


# --- two springs ----------------------------------------------------------------------------------


class Springs:
    """A mass 1 between springs k₁ = 1/n² (left) and k₂ = 1, ends held: critical steps n and 1.

    Args:
        ratio: n; the left cell's step is n times the right one's.
        windows: Run in plain windows instead of real steps.
    """

    def __init__(self, ratio: int, windows: bool = False) -> None:
        self.ratio, self.windows = ratio, windows
        self.scene = string([1.0, 1.0], [1.0 / ratio**2, 1.0])
        self.problem = Disturbed(self.scene)
        self._left = _from_left(self.scene.mesh) == 0

    def growth(self, omega: float, steps: int = 2000) -> float:
        """Growth per step h₁ of a long run at Ω = h₂, minus 1."""
        self.problem.anew()
        given = np.where(self._left, self.ratio * omega, omega)
        method = AVI(schedule="exact", corrected=False, steps=given, unstable_ok=True)
        if self.windows:
            method = AVI(safety=omega, balanced=False)
        run = method.prepare(self.problem, 1e9)
        count = int(np.ceil(steps * self.ratio * omega / run.step))
        slope = long_run([run], count) * self.ratio * omega / run.step
        run.close()
        return float(np.expm1(slope))

    def edge(self, inside: float, outside: float) -> float:
        """Ω of the end of a band between two points in and out of it, to 2e-4."""
        while abs(inside - outside) > 4e-4:
            middle = 0.5 * (inside + outside)
            unstable = self.growth(middle, 600) > resolution(600)
            inside, outside = (middle, outside) if unstable else (inside, middle)
        return 0.5 * (inside + outside)


def two_springs(ratio: int, windows: bool = False) -> list[dict[str, Any]]:
    """Bands of two springs: edges and peak growth, predicted and measured, a row per band."""
    springs, rows = Springs(ratio, windows), []
    bands = resonances.two_spring_bands(ratio)
    for i, band in enumerate(bands):
        below = bands[i - 1].high if i else 0.3
        above = bands[i + 1].low if i + 1 < len(bands) else 1.95
        rows.append(
            {
                "ratio": ratio, "schedule": "plain windows" if windows else "real steps",
                "low": band.low, "high": band.high, "omega": band.peak, "predicted": band.growth,
                "low_measured": springs.edge(band.peak, 0.5 * (below + band.low)),
                "high_measured": springs.edge(band.peak, 0.5 * (band.high + above)),
                "measured": springs.growth(band.peak),
            }
        )  # fmt: skip
    springs.problem.close()
    return rows


# --- bars of two rates ----------------------------------------------------------------------------

#: Integrators of the maps by name, of α.
BARS: Mapping[str, Callable[[float], Any]] = {
    "real steps": lambda a: AVI(a, "exact", corrected=False),
    "plain windows": lambda a: AVI(a, balanced=False),
    "corrected real steps": lambda a: AVI(a, "exact"),
    "balanced windows": lambda a: AVI(a),
    "local leapfrog": lambda a: LocalLeapfrog(a),
    "local leapfrog, no filter": lambda a: LocalLeapfrog(a, stabilisation=0.0),
}


PREDICTED = ("real steps", "plain windows")


class Bar:
    """10 + 10 cells of lengths r to 1, c = 1, left end held."""

    def __init__(self, ratio: Fraction, viscosity: float = 0.0) -> None:
        self.ratio = ratio
        n = resonances.CELLS
        lengths = [float(ratio)] * n + [1.0] * n
        self.problem = Disturbed(string(lengths, [1.0] * 2 * n, viscosity, free=True))

    def _run(self, method: Any) -> tuple[Any, int, float]:
        """A run, steps of it in a period common to all cells, and the coarse step."""
        self.problem.anew()
        if getattr(method, "schedule", "") != "exact":
            run = method.prepare(self.problem, 1e9)
            return run, 1, run.step
        coarse = method.safety * float(self.ratio)
        period = coarse * self.ratio.denominator
        run = method.prepare(self.problem, period)
        return run, round(period / run.step), coarse

    def growth(self, method: Any) -> float:
        """Spectral radius of the run's map over a period, per coarse step, minus 1."""
        run, spans, coarse = self._run(method)
        radius = RunMap(run, spans).radius()
        run.close()
        return float(radius ** (coarse / (spans * run.step)) - 1.0)

    def long_growth(self, method: Any, steps: int) -> float:
        """The same from a long run of so many coarse steps."""
        run, _, coarse = self._run(method)
        slope = long_run([run], int(np.ceil(steps * coarse / run.step)))
        run.close()
        return float(np.expm1(slope * coarse / run.step))


def predicted(name: str, ratio: Fraction, alphas: Array) -> Array:
    """Growth of the two plain schedules by :mod:`complexbody.resonances`."""
    counts = resonances.real_counts(ratio)
    if name == "plain windows":
        counts = resonances.window_counts(float(ratio))
    return resonances.two_rate_growth(float(ratio), counts, alphas)


def check(name: str, bar: Bar, growth: Array, alphas: Array) -> list[dict[str, Any]]:
    """Predicted growth against a long run's, at the worst of α below and above 0.6."""
    rows = []
    for part in (alphas < 0.6, alphas >= 0.6):
        at = int(np.argmax(np.where(part, growth, -1.0)))
        if growth[at] < resonances.TOLERANCE:
            continue
        alpha = float(alphas[at])
        measured = bar.long_growth(BARS[name](alpha), int(np.clip(40 / growth[at], 400, 10_000)))
        rows.append(
            {
                "schedule": name, "ratio": str(bar.ratio), "alpha": alpha,
                "predicted": float(growth[at]), "measured": measured,
            }
        )  # fmt: skip
    return rows


@dataclass
class Bars:
    """What :func:`bars` found.

    Attributes:
        springs: Rows of :func:`two_springs`.
        checks: Rows of :func:`check`.
        maps: By schedule: "alpha" (a,), "ratio" (r,) as words, "growth" (r, a) per coarse step,
            predicted or of runs, and of the former "apart", by how much runs differ at most.
        origin: Machine, versions, commit.
    """

    springs: list[dict[str, Any]] = field(default_factory=list)
    checks: list[dict[str, Any]] = field(default_factory=list)
    maps: dict[str, dict[str, Any]] = field(default_factory=dict)
    origin: dict[str, Any] = field(default_factory=origin)


def bars(
    ratios: Sequence[Fraction] = RATIOS, fine: Array = FINE, coarse: Array = COARSE,
    springs: Sequence[int] = (2, 3), progress: bool | None = None,
) -> Bars:  # fmt: skip
    """Two springs and bars of two rates, predicted and measured.

    Args:
        ratios: Size ratios r of the bars.
        fine: Safety factors of predicted maps.
        coarse: Of maps made of runs.
        springs: Ratios n of the steps of two springs.
        progress: Show progress; by default where standard error is a terminal.
    """
    found = Bars()
    for n in springs:
        for windows in (False, True):
            found.springs += two_springs(n, windows)
    differences = dict.fromkeys(PREDICTED, 0.0)
    bar = Progress(MPI.COMM_WORLD, float(len(ratios)), progress)
    rows: dict[str, list[list[float]]] = {name: [] for name in BARS}
    for i, ratio in enumerate(ratios):
        body = Bar(ratio)
        for name, make in BARS.items():
            some = coarse[::10] if name in PREDICTED else coarse
            growth = np.array([body.growth(make(float(a))) for a in some])
            if name in PREDICTED:
                apart = np.abs(growth - predicted(name, ratio, some)).max()
                differences[name] = max(differences[name], float(apart))
                growth = predicted(name, ratio, fine)
                found.checks += check(name, body, growth, fine)
            rows[name].append(np.asarray(growth).tolist())
        body.problem.close()
        bar.update(float(i + 1), i + 1)
    bar.close()
    for name in BARS:
        alphas = fine if name in PREDICTED else coarse
        found.maps[name] = {
            "alpha": alphas.tolist(), "ratio": [str(r) for r in ratios], "growth": rows[name],
            "apart": differences.get(name),
        }  # fmt: skip
    return found
