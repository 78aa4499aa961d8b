# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Speed against accuracy on one scene: every method at several steps, on several meshes.

*Cost* is processor time of stepping, the least of some whole runs after one that is discarded, and
the number of element updates (forces of one cell). Processor time, because other processes stretch
wall time, which the rows have as well; all methods use one thread per rank. With several ranks it
is the largest of any rank. Setting up, sampling and books are not in it.

*Errors* are those at the end of the run: of u, ν and their rates in L2 (lumped), in the energy norm
and of the energy, over the largest norm that the reference has in the run
(:mod:`complexbody.norms`). The *time error* is against the same mesh's equations solved exactly,
the *total error* against the scene's exact solution or a finer mesh
(:mod:`complexbody.references`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

from complexbody import fronts, machine
from complexbody.chartfile import ChartFile, write_csv
from complexbody.chartplan import Plan, label
from complexbody.contenders import Contender, chosen
from complexbody.files import on_first_rank
from complexbody.measuring import Point, told
from complexbody.references import Reference, Semidiscrete
from complexbody.scene import Scene

Factory = Callable[..., Scene]


@dataclass(frozen=True)
class Chart:
    """Points of speed and accuracy.

    Attributes:
        rows: One dict per method, step and mesh: ``status`` is "done", "unstable" (it blew up),
            "refused" (by the method, with its ``message``) or "too long" (for the budget).
        head: Title, machine, versions, commit, settings; references: by mesh.
        norm: Which error is drawn and judged.
        path: The file, if there is one.
    """

    rows: list[dict[str, Any]]
    head: dict[str, Any]
    references: dict[str, Any]
    norm: str = "fields"
    path: Path | None = None

    @property
    def error(self) -> str:
        """"total" if any total error is known, else "time"."""
        return "total" if self.knows("total") else "time"

    def knows(self, error: str) -> bool:
        """Whether any point has this error, "total" or "time"."""
        return bool(fronts.points(self.of(error), "seconds", error, self.norm))

    def winners(
        self, cost: str = "seconds", error: str | None = None, norm: str | None = None
    ) -> list[dict[str, Any]]:
        """The cheapest method for each decade of error: see :func:`complexbody.fronts.winners`.

        Time errors are those of the finest mesh alone.
        """
        kind = error or self.error
        return fronts.winners(self.of(kind), cost, kind, norm or self.norm)

    def of(self, error: str) -> list[dict[str, Any]]:
        """Rows that are compared in an error: for that of time, those of one mesh, the finest."""
        last = self.rows[-1]["mesh"] if self.rows else None
        return [row for row in self.rows if error == "total" or row["mesh"] == last]

    def table(self, cost: str = "seconds", error: str | None = None) -> str:
        """Winners as text."""
        return fronts.table(self.winners(cost, error), "s" if cost == "seconds" else cost)

    def save(self, folder: str | Path) -> None:
        """Write ``chart.csv`` and ``chart.png``; on one rank."""
        from complexbody.charting import draw

        out = Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        write_csv(out / "chart.csv", self.rows)
        draw(self, out / "chart.png")


def chart(
    scene: Scene | Factory,
    until: float,
    methods: Sequence[str | Contender] | None = None,
    steps: int | Sequence[float] | None = None,
    meshes: Mapping[str, Sequence[Any]] | None = None,
    exact: Callable[..., Any] | None = None,
    out: str | Path | None = None,
    repeats: int = 3,
    budget: float = 60.0,
    *,
    parameters: Mapping[str, Any] | None = None,
    comm: Any = MPI.COMM_WORLD,
    norm: str = "fields",
    fresh: bool = False,
    source: str | bytes | None = None,
    tell: Callable[[str], None] | None = None,
) -> Chart:
    """Measure cost and errors of methods on a scene; collective.

    Args:
        scene: A scene, or a function ``(comm, **parameters)`` that makes it.
        until: End of the runs [s].
        methods: Keys of :func:`complexbody.contenders.contenders`, or contenders; all by default.
        steps: How many steps each method makes, from its stable limit down (4), or the factors of
            the critical step themselves, for all methods.
        meshes: One parameter of the function and its values, from coarse to fine.
        exact: ``exact(t, **parameters)`` gives the exact solution: see
            :class:`complexbody.references.Exact`; it gets those of the parameters that it takes.
            Without it total errors are against the finest of several meshes made twice as fine (one
            process only), and unknown for a single mesh.
        out: Folder of chart.json, .csv and .png. Points that are there already are not run again.
        repeats: Runs of each point, the fastest of which counts.
        budget: Seconds after which a point is not repeated; one that would take longer is left out
            and says so, until a chart with a larger budget.
        parameters: More parameters of the function.
        comm: Ranks.
        norm: The error that is judged and drawn, one of :data:`complexbody.fronts.NORMS`.
        fresh: Begin anew.
        source: What the scene is made from, to know it again; by default the function's source.
        tell: Called on rank 0 with a line per point.

    Returns:
        The chart, on all ranks.

    Raises:
        ChartError: for requests that make no sense together, or a file of another chart.
        ComplexBodyError: if the scene cannot be run by the reference.
    """
    plan = Plan(scene, until, meshes, exact, parameters or {}, comm, steps, repeats, norm)
    identity = {
        "source": plan.digest(source), "until": float(until), "parameters": plan.parameters,
        "ranks": comm.size,
    }  # fmt: skip
    file = ChartFile(comm, None if out is None else Path(out), identity, fresh)
    file.write(
        until=float(until), machine=machine.machine(), versions=machine.versions(),
        commit=machine.commit(),
        settings={
            "methods": None if methods is None else [getattr(m, "key", m) for m in methods],
            "steps": steps, "meshes": plan.meshes, "repeats": repeats, "budget": budget,
            "norm": norm, "cost": "processor time of stepping, the largest of any rank",
        },
    )  # fmt: skip
    keys = _Runner(plan, file, repeats, budget, tell or (lambda line: None)).run(methods)
    made = Chart([file.rows[k] for k in keys], file.head, file.references, norm, file.path)
    wins = {kind: made.winners(error=kind) for kind in fronts.ERRORS}
    file.write(title=plan.title, dimension=plan.dimension, winners=wins)
    if file.path is not None:
        on_first_rank(comm, file.path, lambda: made.save(file.path.parent))  # type: ignore[union-attr]
    return made


class _Runner:
    """Runs the points that are not there yet."""

    def __init__(
        self, plan: Plan, file: ChartFile, repeats: int, budget: float, tell: Callable[[str], None]
    ) -> None:
        self.plan, self.file, self.repeats, self.budget = plan, file, repeats, budget
        self.tell, self.comm = tell, plan.comm
        self.total: Reference | None = None
        self.commit = file.head["commit"]

    def run(self, methods: Any) -> list[str]:
        """All points, mesh by mesh; their keys."""
        keys: list[str] = []
        for mesh in self.plan.each():
            scene = self.plan.scene(mesh)
            general = any(callable(body.inertia) for body in scene.bodies)
            todo = []
            for contender in chosen(methods, general):
                for factor in self._factors(contender):
                    key = json.dumps([contender.key, float(factor), mesh], default=repr)
                    keys.append(key)
                    if self._missing(key):
                        todo.append((key, contender, float(factor)))
            if todo:
                self._mesh(mesh, scene, todo)
        if self.total is not None:
            self.total.close()
        return keys

    def _missing(self, key: str) -> bool:
        """Whether a point is to be run: also one that was too long for a smaller budget."""
        row = self.file.rows.get(key)
        return row is None or (row["status"] == "too long" and row["budget"] < self.budget)

    def _factors(self, contender: Contender) -> Sequence[float]:
        steps = 4 if self.plan.steps is None else self.plan.steps
        return contender.factors(steps) if isinstance(steps, int) else steps

    def _known(self, name: str) -> int:
        return int(self.file.references.get(name, {}).get("level", 1))

    def _mesh(self, mesh: Any, scene: Scene, todo: Sequence[tuple[str, Contender, float]]) -> None:
        name = label(mesh)
        # As far as an earlier run has refined it, so that what is left sees the same.
        reference = Semidiscrete(scene, self.plan.until, self._known(name))
        if self.total is None:
            self.total = self.plan.total(scene, self._known("total"))
        for key, contender, factor in todo:
            found = Point(contender, factor, reference, self.total, self.repeats, self.budget)
            row = {
                "key": key, "method": contender.name, "peer": contender.peer, "mesh": dict(mesh),
                "factor": factor, "ranks": self.comm.size, "commit": self.commit,
                "budget": self.budget,
                **found.measure(),
            }  # fmt: skip
            self.file.references[name] = reference.about()
            if self.total is not None:
                self.file.references["total"] = self.total.about()
            self.file.put(row)
            if self.comm.rank == 0:
                self.tell(told(self.file.rows[key]))
        reference.close()
