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

import hashlib
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from complexbody import fronts, machine
from complexbody.chartfile import ChartFile, write_csv
from complexbody.contenders import Contender, chosen
from complexbody.errors import ChartError
from complexbody.files import on_first_rank
from complexbody.measuring import Point, told
from complexbody.references import Exact, Finer, Reference, Semidiscrete
from complexbody.scene import Scene
from complexbody.scenefile import accepted

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
        scene: A scene, or a function (comm, **parameters) that makes it.
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
            and says so.
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
    plan = _Plan(scene, until, meshes, exact, parameters or {}, comm, steps, repeats, norm)
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


class _Plan:
    """What is asked for, checked."""

    def __init__(
        self, scene: Any, until: float, meshes: Any, exact: Any, parameters: Mapping[str, Any],
        comm: Any, steps: Any, repeats: int, norm: str,
    ) -> None:  # fmt: skip
        self.scene_, self.until, self.comm, self.exact = scene, float(until), comm, exact
        self.parameters, self.steps = dict(parameters), steps
        self.title, self.dimension = "", 0
        factory = not isinstance(scene, Scene)
        wrong = ""
        if not (np.isfinite(until) and until > 0):
            wrong = f"until is {until}. Give the end of the runs in seconds, > 0"
        elif meshes is not None and not factory:
            wrong = "meshes need a function that makes the scene. Give that, not a scene"
        elif meshes is not None and (len(meshes) != 1 or not all(len(v) for v in meshes.values())):
            wrong = f"meshes are {dict(meshes)!r}. Give one parameter and its values"
        elif not _sensible(steps):
            wrong = f"steps are {steps!r}. Give how many, or positive factors"
        elif repeats < 1:
            wrong = f"repeats is {repeats}. Give 1 or more"
        elif norm not in fronts.NORMS:
            wrong = f"norm is {norm!r}. Give one of {', '.join(fronts.NORMS)}"
        elif meshes is not None and exact is None and comm.size > 1:
            wrong = (
                "total errors against a finer mesh need one process. Run it without mpirun, give "
                "an exact solution, or a single mesh"
            )
        if wrong:
            raise ChartError(f"chart: {wrong}.")
        self.meshes: dict[str, list[Any]] = {k: list(v) for k, v in (meshes or {}).items()}

    def each(self) -> list[dict[str, Any]]:
        """Parameters of each mesh, coarse to fine."""
        return [{k: v} for k, values in self.meshes.items() for v in values] or [{}]

    def scene(self, mesh: Mapping[str, Any]) -> Scene:
        """The scene on a mesh."""
        if isinstance(self.scene_, Scene):
            made = self.scene_
        else:
            made = self.scene_(self.comm, **{**self.parameters, **mesh})
        self.title, self.dimension = made.name, made.mesh.geometry.dim
        return made

    def digest(self, source: str | bytes | None) -> str:
        """What knows the scene again."""
        if source is None:
            thing = self.scene_
            try:
                source = repr(thing) if isinstance(thing, Scene) else inspect.getsource(thing)
            except (OSError, TypeError):
                source = getattr(thing, "__qualname__", type(thing).__name__)
        data = source.encode() if isinstance(source, str) else source
        return hashlib.sha256(data).hexdigest()

    def total(self, scene: Scene, level: int) -> Reference | None:
        """What total errors are measured against, if anything."""
        if self.exact is not None:
            given = accepted(self.exact, {**self.parameters, **self.each()[0]})
            return Exact(lambda t: self.exact(t, **given), self.until, scene)
        if not self.meshes:
            return None
        (name, values), *_ = self.meshes.items()
        finer = {name: 2 * values[-1]}
        return Finer(self.scene(finer), self.until, level, label(finer))


def _sensible(steps: Any) -> bool:
    if isinstance(steps, int | None):
        return steps is None or steps > 0
    return len(steps) > 0 and all(np.isfinite(s) and s > 0 for s in steps)


def label(mesh: Mapping[str, Any]) -> str:
    """A mesh in words."""
    return ", ".join(f"{k}={v}" for k, v in mesh.items()) or "the scene's"


class _Runner:
    """Runs the points that are not there yet."""

    def __init__(
        self, plan: _Plan, file: ChartFile, repeats: int, budget: float, tell: Callable[[str], None]
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
                    if key not in self.file.rows:
                        todo.append((key, contender, float(factor)))
            if todo:
                self._mesh(mesh, scene, todo)
        if self.total is not None:
            self.total.close()
        return keys

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
                **found.measure(),
            }  # fmt: skip
            self.file.references[name] = reference.about()
            if self.total is not None:
                self.file.references["total"] = self.total.about()
            self.file.put(row)
            if self.comm.rank == 0:
                self.tell(told(self.file.rows[key]))
        reference.close()
