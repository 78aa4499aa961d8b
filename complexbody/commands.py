# SPDX-License-Identifier: LGPL-3.0-or-later
"""What the commands of the command line do: run, check, info.

Each takes the parsed arguments and a communicator of all ranks for :func:`together` alone. All are
collective; every stage ends on all ranks together, so that none goes on without the others.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import shlex
import sys
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from mpi4py import MPI

from complexbody import machine, precheck, report, statefile
from complexbody.accuracy import Accurate
from complexbody.checkpoint import Checkpoint
from complexbody.errors import CheckpointError, CommandError, MissingPackage
from complexbody.files import on_first_rank
from complexbody.given import is_positive, is_whole, short
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.implicit import Implicit
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.peers import AssembledLeapfrog, Newmark, PetscTS
from complexbody.integrators.synchronous import Synchronous
from complexbody.ledger import Bookkeeper
from complexbody.output import NODE_FIELDS, Output, Probes
from complexbody.precheck import realised_speed_up
from complexbody.problem import Problem
from complexbody.rendering import require_vtk
from complexbody.result import Result
from complexbody.runfolder import recorded_words
from complexbody.scene import Scene
from complexbody.scenefile import CheckFailed, SceneFile, assignments, points
from complexbody.simulation import Simulation
from complexbody.stepping import default_ledger_steps
from complexbody.together import Interrupted, say, together

#: Integrators by the name that --integrator takes; the first is the default.
INTEGRATORS = {
    "synchronous": Synchronous, "avi": AVI, "local-leapfrog": LocalLeapfrog, "implicit": Implicit,
    "assembled-leapfrog": AssembledLeapfrog, "newmark": Newmark, "petsc-ts": PetscTS,
}  # fmt: skip
_OPTIONS = (
    "step", "safety", "dissipation", "start", "critical", "unstable_ok", "schedule", "balanced",
    "corrected", "stabilisation", "levels", "order", "quadrature", "tolerance", "iterations",
    "monitor", "options", "force", "kind", "forces",
)  # fmt: skip


@dataclass(frozen=True)
class Job:
    """What the command line and the scene file's DEFAULTS ask for together."""

    file: SceneFile
    scene: Scene
    parameters: Mapping[str, Any]
    settings: Mapping[str, Any]
    name: str
    method: Any

    @property
    def until(self) -> float | None:
        """End of the run [s], if anything gives it."""
        return self.settings.get("until")

    @property
    def ledger_steps(self) -> int | None:
        """Steps between ledger rows."""
        return self.settings.get("ledger_steps")

    @property
    def accuracy(self) -> float | None:
        """Relative error to meet, if asked for."""
        return self.settings.get("accuracy")

    def output(self) -> Output:
        """What to write, and where.

        Raises:
            OutputError, SceneError: for what makes no sense.
        """
        s = self.settings
        return Output(
            s.get("out", Path("results") / self.file.path.stem),
            every=s.get("every"),
            times=s.get("times", ()),
            fields=s.get("fields", NODE_FIELDS),
            probes=s.get("probes", {}),
            probe_steps=s.get("probe_steps", 10),
        )


def job_of(a: argparse.Namespace, ranks: Any) -> Job:
    """Read the scene file, make its scene and the integrator; collective."""
    with together(ranks):
        file = SceneFile(a.file)
        parameters = file.complete(assignments(a.set))
        settings = _settings(a, file)
        name, method = _method(settings)
    with together(ranks):
        # Scenes may change what they are given.
        scene = file.scene(MPI.COMM_WORLD, dict(parameters))
    return Job(file, scene, parameters, settings, name, method)


def _settings(a: argparse.Namespace, file: SceneFile) -> dict[str, Any]:
    """DEFAULTS, overridden by the options that are given."""
    settings = dict(file.defaults)
    given = vars(a)
    names = ("until", "every", "fields", "probe_steps", "ledger_steps", "out", "integrator")
    for name in (*names, *_OPTIONS):
        if given.get(name) is not None:
            settings[name] = given[name]
    if given.get("every") is not None:
        settings.pop("times", None)
    if isinstance(settings.get("fields"), str):
        listed = [name.strip() for name in settings["fields"].split(",") if name.strip()]
        settings["fields"] = () if listed == ["none"] else tuple(listed)
    rows, until = settings.get("ledger_steps", 1), settings.get("until", 1.0)
    if not (is_whole(rows) and rows >= 1):
        raise CommandError(f"ledger_steps is {short(rows)}. Give a whole number from 1.")
    if not is_positive(until):
        raise CommandError(f"until is {short(until)}. Give the end of the run in seconds, > 0.")
    if given.get("petsc"):
        given_options = assignments(given["petsc"])
        settings["options"] = {name: str(value) for name, value in given_options.items()}
    if given.get("probe"):
        settings["probes"] = {**settings.get("probes", {}), **points(given["probe"])}
    if given.get("accuracy") is not None:
        chosen = ("integrator", *_OPTIONS)
        both = [name for name in chosen if given.get(name) is not None]
        if both:
            raise CommandError(
                f"--accuracy chooses integrator and step, and --{both[0].replace('_', '-')} is "
                "given as well. Give one of them."
            )
        settings = {name: value for name, value in settings.items() if name not in chosen}
        settings["accuracy"] = given["accuracy"]
    return settings


def _method(settings: Mapping[str, Any]) -> tuple[str, Any]:
    """The integrator with its options.

    Raises:
        CommandError: for a name or an option it does not have.
        IntegratorError: for values it does not take.
    """
    name = settings.get("integrator", next(iter(INTEGRATORS)))
    if not isinstance(name, str) or name not in INTEGRATORS:
        raise CommandError(f"No integrator {short(name)}. Give one of {', '.join(INTEGRATORS)}.")
    kind = INTEGRATORS[name]
    options = {option: settings[option] for option in _OPTIONS if option in settings}
    known = {field.name for field in fields(kind)}
    for option in options:
        if option not in known:
            raise CommandError(
                f"Integrator {name} has no option {option}. It has {', '.join(sorted(known))}."
            )
    return name, kind(**options)


def resume(a: argparse.Namespace, ranks: Any) -> None:
    """``complexbody resume``: go on with the run of a folder."""
    with together(ranks):
        words, path = recorded_words(Path(a.folder))
    if a.until is not None:
        words += ["--until", repr(a.until)]
    for option in ("quiet", "no_picture", "debug"):
        if getattr(a, option):
            words.append("--" + option.replace("_", "-"))
    again = a.parse(words)
    again.words, again.file, again.out, again.resume = words, path, a.folder, True
    run(again, ranks)


def run(a: argparse.Namespace, ranks: Any) -> None:
    """``complexbody run``: simulate, check, draw, and write down what was done."""
    job = job_of(a, ranks)
    resumes = bool(getattr(a, "resume", False))
    until = job.until
    if until is None:
        raise CommandError(
            f"Nothing says when to stop. Give --until T, or DEFAULTS = dict(until=…) in {a.file}."
        )
    if not a.quiet:
        say(ranks, report.heading(job.file.path, job.scene, job.parameters))
    with together(ranks):
        output = job.output()
        growth = None if job.settings.get("unstable_ok") else 10.0
        progress = False if a.quiet else None
        options: dict[str, Any] = {
            "until": until, "output": output, "ledger_steps": job.ledger_steps, "growth": growth,
            "progress": progress, "plan": not a.no_plan, "checkpoint": _checkpoint(a, job),
        }  # fmt: skip
        if job.accuracy is None or resumes:
            # What an accuracy has chosen goes on, without being looked at again.
            name, method = job.name, job.method
            if job.accuracy is not None:
                name, method = _chosen(output)
            runner: Any = Simulation(job.scene, method, **options, resume=resumes)
            simulation = runner
        else:
            runner = Accurate(job.scene, job.accuracy, **options)
            simulation = runner.simulation
            name = next(n for n, kind in INTEGRATORS.items() if kind is type(simulation.method))
    if not a.quiet:
        say(ranks, *report.before(simulation, name, simulation.method, output, until))
        say(ranks, *report.resumed(simulation))
    with _recorded(a, job, output, ranks) as done:
        with together(ranks):
            result = runner.run()
        done.update(report.results(result))
        if not a.quiet:
            say(ranks, *report.after(result))
            if a.speed_up and result.time_sets is not None:
                with together(ranks):
                    realised = realised_speed_up(result)
                say(ranks, report.speed_up(result.time_sets, realised))
        failure = _checked(job.file, result, done, ranks)
        if failure is None and "check" in done and not a.quiet:
            say(ranks, report.entry("check", done["check"]))
        if not a.no_picture and job.file.has("picture"):
            with together(ranks):
                _draw(job.file, result, output, done, ranks)
        if failure is not None:
            raise failure
    if not a.quiet:
        say(ranks, report.entry("files", str(output.folder)))


def _checkpoint(a: argparse.Namespace, job: Job) -> Checkpoint | None:
    """When to make checkpoints, by the options."""
    given = a.checkpoint_every, a.checkpoint_steps, a.checkpoint_keep
    if a.checkpoint_every == 0 and a.checkpoint_steps is None:
        return None
    if job.name == "petsc-ts" and given == (None, None, None):
        return None  # it can make none
    every = 600.0 if a.checkpoint_every is None else a.checkpoint_every or None
    return Checkpoint(every, a.checkpoint_steps, 2 if given[2] is None else given[2])


def _chosen(output: Output) -> tuple[str, Any]:
    """The integrator of a folder's newest checkpoint, by name and made; rank 0's word counts.

    Raises:
        CheckpointError: if there is none.
    """
    told: tuple[str, Any] | CheckpointError = CheckpointError("No checkpoint. Run it anew.")
    if MPI.COMM_WORLD.rank == 0:
        for path in statefile.listed(Checkpoint().place(output)):
            try:
                kind = statefile.read(path)[0]["integrator"]
            except CheckpointError as error:
                told = error
                continue
            name = next(n for n, k in INTEGRATORS.items() if k.__name__ == kind["class"])
            told = name, INTEGRATORS[name](**kind["options"])
            break
    told = MPI.COMM_WORLD.bcast(told)
    if isinstance(told, CheckpointError):
        raise told
    return told


def _checked(
    file: SceneFile, result: Result, done: dict[str, Any], ranks: Any
) -> CheckFailed | None:
    """Call the file's check; a failure is kept until the picture is drawn. Collective."""
    if not file.has("check"):
        return None
    try:
        with together(ranks):
            done["check"] = file.check(result)
    except CheckFailed as failure:
        done["check"] = str(failure)
        return failure
    return None


def _draw(
    file: SceneFile, result: Result, output: Output, done: dict[str, Any], ranks: Any
) -> None:
    """Call the file's picture(); what is not installed for it is a warning. Collective."""
    path = Path(output.folder) / "picture.png"
    missing = ""
    try:
        if file.draws_with_vtk:
            on_first_rank(ranks, path, require_vtk)
        file.picture(result, path)
        done["picture"] = path.name
        return
    except MissingPackage as error:
        missing = str(error)
    except CommandError as error:
        if not isinstance(error.__cause__, ImportError):
            raise
        missing = str(error)
    done["picture"] = f"not drawn: {missing}"
    say(ranks, f"complexbody: warning: no picture: {missing}", stream=sys.stderr)


@contextmanager
def _recorded(
    a: argparse.Namespace, job: Job, output: Output, ranks: Any
) -> Iterator[dict[str, Any]]:
    """Keep run.json: at first what is to be run, in the end what came of it; collective."""
    begun = time.perf_counter()
    path = Path(output.folder) / "run.json"
    kept: list[report.Record] = []
    values = {
        "command": shlex.join(["complexbody", *a.words]),
        "words": list(a.words),
        "scene": job.scene.name,
        "file": str(job.file.path.resolve()),
        "sha256": hashlib.sha256(job.file.path.read_bytes()).hexdigest(),
        "parameters": dict(job.parameters),
        "settings": {k: v for k, v in job.settings.items() if k != "out"},
        "bodies": {body.name: dict(body.constants) for body in job.scene.bodies},
        "ranks": ranks.size,
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }
    on_first_rank(ranks, path, lambda: kept.append(report.Record(path, values)))
    done: dict[str, Any] = {}
    state = "finished"
    try:
        yield done
    except BaseException as error:
        told = error if isinstance(error, Exception) else f"{type(error).__name__}: {error}"
        state = str(error) if isinstance(error, Interrupted) else f"failed: {told}"
        if isinstance(error, Interrupted):
            told = f"{error}; what was written until then is in {output.folder}"
            if statefile.listed(Checkpoint().place(output)):
                told += f", and complexbody resume {output.folder} goes on"
            error.args = (told,)
        raise
    finally:
        # Not collective: after a signal the ranks need not meet again.
        for record in kept:
            with suppress(OSError):
                record.update(state, seconds=time.perf_counter() - begun, **done)


def check(a: argparse.Namespace, ranks: Any) -> None:
    """``complexbody check``: build everything, and say what run would do."""
    job = job_of(a, ranks)
    with together(ranks), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # null modes are part of the report
        problem = Problem(job.scene)
        if job.settings.get("probes"):
            Probes(job.scene, job.output().probes)
        job.output()
    say(ranks, report.heading(job.file.path, job.scene, job.parameters))
    disc, comm = problem.disc, problem.comm
    cells = comm.allreduce(int((disc.source_cell >= 0).sum()))
    nodes = comm.allreduce(int(disc.owned.sum()))
    say(ranks, report.mesh(job.scene, cells, nodes, comm.size), *report.bodies(job.scene))
    for number in range(len(job.scene.bodies)):
        with together(ranks):
            least = precheck.smallest_eigenvalue(problem, number)
        say(ranks, report.energy(problem, number, least))
    linear = "linear in (u, ν)" if problem.kernels.densities.linear else "nonlinear"
    say(ranks, report.entry("forces", linear))
    with together(ranks):
        found = precheck.limits(problem, getattr(job.method, "dissipation", "exact"))
    if math.isfinite(found.smallest):
        say(ranks, *report.quality(found))
    say(ranks, report.integrator(job.name, job.method))
    with together(ranks):
        until = job.until if job.until is not None else 100 * found.smallest
        prepared = job.method.prepare(problem, until)
        per_row = precheck.seconds_per_row(Bookkeeper(problem, prepared), comm)
        per_step, sets = precheck.seconds_per_step(prepared, comm), prepared.time_sets
        told = [report.step(prepared, job.method, job.until), *report.time_sets(sets)]
        prepared.close()
        if sets is not None:
            scheme = job.method.dissipation
            alone = precheck.synchronous_rate(problem, scheme, until) * prepared.step
            told.append(report.speed_up(sets, alone / per_step))
        problem.close()
    say(ranks, report.memory(problem.kernels.bytes_per_cell(), cells))
    say(ranks, *told)
    updates = cells if sets is None else sets.updates * prepared.step / sets.window
    rate = updates / per_step / comm.size
    say(ranks, report.entry("rate", f"{rate / 1e6:.3g} million cell updates per second and core"))
    if job.until is None:
        say(ranks, report.entry("time", "give --until T for an estimate"))
        return
    steps = report.steps(prepared.step, until)
    every = job.ledger_steps or default_ledger_steps(cells, comm.size, steps)
    whole = steps * per_step + (steps / every + 2) * per_row
    say(ranks, report.entry("time", f"about {report.seconds(whole)}, without writing fields"))


def info(a: argparse.Namespace, ranks: Any) -> None:
    """``complexbody info``: what this installation is made of."""
    if ranks.rank == 0:
        say(ranks, *machine.description())
