# SPDX-License-Identifier: LGPL-3.0-or-later
"""What the command line says about a run before and after it, and DIR/run.json.

Words and numbers only: computes nothing, and prints nothing itself.
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from complexbody import __version__, ledger, machine
from complexbody.body import Body
from complexbody.integrators.timetable import TimeSets
from complexbody.output import Output
from complexbody.planning import Plan
from complexbody.precheck import Limits
from complexbody.result import Result, Statistics
from complexbody.scene import Scene


def entry(name: str, text: str) -> str:
    """A line "  name   text", wrapped to 100 columns."""
    return textwrap.fill(
        f"  {name:<12s}{text}", 100, subsequent_indent=" " * 14, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip


def seconds(value: float) -> str:
    """A wall time in words: 0.031 s, 12.3 s, 4 min 10 s, 2 h 5 min."""
    if value < 99.5:
        return f"{value:.3g} s"
    minutes = round(value / 60)
    if value < 5400:
        return f"{int(value) // 60} min {int(value) % 60} s"
    return f"{minutes // 60} h {minutes % 60} min"


def heading(path: Path, scene: Scene, parameters: Mapping[str, Any]) -> str:
    """What is run: version, scene, file, parameters."""
    values = ", ".join(f"{name}={_short(value)}" for name, value in parameters.items())
    name = path.stem if scene.name == "scene" else scene.name
    text = f"complexbody {__version__}: {name} ({path})" + (f", {values}" if values else "")
    return textwrap.fill(text, 100, subsequent_indent="  ", break_on_hyphens=False)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "…"


def mesh(scene: Scene, cells: int, nodes: int, ranks: int) -> str:
    """Dimension and sizes."""
    where = f"{ranks} ranks" if ranks > 1 else "1 rank"
    return entry("mesh", f"{scene.mesh.geometry.dim}D, {cells} cells, {nodes} nodes, on {where}")


def bodies(scene: Scene) -> list[str]:
    """Each body with its masses and constants."""
    tags = [None] if isinstance(scene.body, Body) else sorted(scene.body)
    lines = []
    for tag, body in zip(tags, scene.bodies, strict=True):
        where = "" if tag is None else f" (cell tag {tag})"
        values = [
            f"n_u={body.displacement}, k={body.descriptor}",
            f"density {_value(body.density)}",
            f"inertia {_value(body.inertia)}",
            f"viscosity {_value(body.viscosity)}",
            *(f"{name}={_value(value)}" for name, value in body.constants.items()),
        ]
        lines.append(entry("body", f"{body.name}{where}: {', '.join(values)}"))
    return lines


def _value(value: Any) -> str:
    if callable(value) or hasattr(value, "function_space"):
        return "a function"
    array = np.asarray(value)
    return f"{float(array):.6g}" if array.ndim == 0 else str(array.tolist())


def step(run: Any, method: Any, until: float | None) -> str:
    """Step of a run, critical step and number of steps; for local steps the longest one."""
    step, critical = run.step, run.critical
    count = "" if until is None else f"; {steps(step, until)} of them to t = {until:g} s"
    if method.asynchronous:
        name = "coarse step" if hasattr(method, "levels") else "window"
        text = f"{name} {step:.6g} s, {step / critical:.3g} times the smallest cell's critical step"
        return entry("step", f"{text} of {critical:.6g} s{count}")
    if not np.isfinite(critical):
        return entry("step", f"{step:.6g} s, which stability does not limit{count}")
    share = step / critical
    text = f"{step:.6g} s, {share:.3g} of the critical {critical:.6g} s{count}"
    return entry("step", text + (" (UNSTABLE)" if share > 1 + 1e-9 else ""))


def time_sets(sets: TimeSets | None) -> list[str]:
    """Time sets of an integrator with local steps, and what they should save; else nothing."""
    if sets is None:
        return []
    first, *others = str(sets).splitlines()
    return [entry("time sets", first), *(entry("", line) for line in others)]


def speed_up(sets: TimeSets, realised: float) -> str:
    """What local steps save in updates, and in time."""
    return entry(
        "speed-up",
        f"over one step for all: {sets.ideal:.3g} ideal and {sets.scheduled:.3g} scheduled in cell "
        f"updates, {realised:.3g} realised in time (some synchronous steps were timed)",
    )


def steps(step: float, until: float) -> int:
    """How many steps a run takes."""
    return int(np.ceil(until / step - 1e-9))


def integrator(name: str, method: Any) -> str:
    """The integrator and its options."""
    given = {k: v for k, v in asdict(method).items() if v is not None and v is not False}
    options = ", ".join(f"{name}={value}" for name, value in given.items())
    return entry("integrator", f"{name} (order {method.order}): {options}")


def output(plan: Output, until: float, ledger_steps: int, resumed: bool = False) -> str:
    """What is written, where and when."""
    count = len(plan.schedule(until))
    parts = [f"ledger every {ledger_steps} step{'s' if ledger_steps > 1 else ''}"]
    if plan.fields:
        parts.insert(0, f"{', '.join(plan.fields)} at {count} times")
    if plan.probes:
        parts.append(f"probes {', '.join(plan.probes)} every {plan.probe_steps} steps")
    again = " (replaces an earlier run)" if (Path(plan.folder) / "run.json").exists() else ""
    again = "" if resumed else again
    return entry("output", f"{plan.folder}{again}: {'; '.join(parts)}")


def planned(plan: Plan | None) -> list[str]:
    """Components that stay zero and are left out, if any."""
    if plan is None or not plan.left_out:
        return []
    live, left = ", ".join(plan.components), ", ".join(plan.left_out)
    return [entry("plan", f"{live} are computed; {left} stay zero (--no-plan computes them, too)")]


def memory(bytes_per_cell: float, cells: int) -> str:
    """Memory of the arrays beside dolfinx's mesh."""
    total = bytes_per_cell * cells / 1e6
    return entry("memory", f"{bytes_per_cell:.0f} bytes per cell, {total:.3g} MB in all")


def before(job: Any, name: str, method: Any, plan: Output, until: float) -> list[str]:
    """What is printed between set-up and first step."""
    s: Statistics = job.stats
    return [
        mesh(job.scene, s.cells, s.nodes, s.ranks),
        *bodies(job.scene),
        integrator(name, method),
        step(job.run_, method, until),
        *time_sets(job.run_.time_sets),
        *planned(job.plan),
        memory(s.bytes_per_cell, s.cells),
        output(plan, until, job.every, job.resumed is not None),
    ]


def resumed(job: Any) -> list[str]:
    """Where a run goes on, and how well; nothing if it begins."""
    if job.resumed is None:
        return []
    path, about, same = job.resumed.path, job.resumed.about, job.resumed.same
    how = "to the bit" if same else f"to round-off: the cells of its {about['ranks']} ranks differ"
    return [entry("resumed", f"at t = {about['time']:.6g} s, from {path.name}, {how}")]


def after(result: Result) -> list[str]:
    """Wall time by part, rate, and whether the books balance."""
    s = result.stats
    parts = {"set-up": s.set_up, "steps": s.stepping, "ledger": s.booking, "writing": s.writing}
    if s.saving > 0:
        parts["checkpoints"] = s.saving
    times = ", ".join(f"{name} {seconds(value)}" for name, value in parts.items())
    return [
        entry("time", times),
        entry("rate", f"{s.rate / s.ranks / 1e6:.3g} million cell updates per second and core"),
        *([entry("solving", result.solving)] if result.solving else []),
        *([entry("accuracy", str(result.accuracy))] if result.accuracy else []),
        entry("ledger", ledger.summary(result.ledger)),
    ]


def energy(problem: Any, number: int, least: float | None) -> str:
    """A1 of one region, whether its forces are linear, and what computes them."""
    body, densities = problem.scene.bodies[number], problem.kernels.densities
    kernel = "generated kernel" if densities.generated[number] else "FFCx kernel"
    if least is None:
        text = f"{body.name}: not quadratic, so A1 depends on the state and is not checked"
    else:
        about = f"The energy of {body.name} "
        notes = " ".join(note for note in problem.warnings if note.startswith(about))
        kind = "semidefinite (A1)"
        if least > 1e-11:
            kind = f"coercive (A1), smallest relative eigenvalue {least:.3g}"
        text = f"{body.name}: {kind}. {notes}".rstrip(" .")
    return entry("energy", f"{text}; {kernel}")


def quality(found: Limits) -> list[str]:
    """Which cells limit the step, and what that costs."""
    where = ", ".join(f"{x:.4g}" for x in found.worst)
    ratio, gain = found.median / found.smallest, found.uniform / max(found.local, 1e-300)
    slow = "1 cell is" if found.slow == 1 else f"{found.slow} cells are"
    steps = (
        f"critical steps {found.smallest:.4g} s (the worst cell, at {where}), "
        f"{found.median:.4g} s (median), {found.largest:.4g} s (largest)"
    )
    cost = (
        f"the worst cell makes the run {ratio:.3g} times as long as the median one would; {slow} "
        f"below half the median; a step of its own for each cell would save cell updates by a "
        f"factor of {gain:.3g} at most"
    )
    return [entry("cells", steps), entry("", cost)]


class Record:
    """DIR/run.json: what was run on what, and how it ended; for one process.

    Args:
        path: The file.
        values: What is known before the run.

    Raises:
        OSError: if it cannot be written.
    """

    def __init__(self, path: Path, values: Mapping[str, Any]) -> None:
        self._path = path
        here = {"versions": machine.versions(), "commit": machine.commit()}
        self._values = {"state": "running", **values, **here, "machine": machine.machine()}
        self._save()

    def update(self, state: str, **values: Any) -> None:
        """Set the state ("finished", "failed: …", "stopped by …") and whatever else is known."""
        self._values.update(state=state, **values)
        self._save()

    def _save(self) -> None:
        text = json.dumps(self._values, indent=1, ensure_ascii=False, default=_plain)
        draft = self._path.with_name("run.json.part")
        draft.write_text(text + "\n", encoding="utf-8")
        draft.replace(self._path)


def _plain(value: Any) -> Any:
    return value.tolist() if hasattr(value, "tolist") else str(value)


def results(result: Result) -> dict[str, Any]:
    """What run.json keeps of a run: statistics, final ledger row, numbers of the time sets."""
    row = dict(zip(result.ledger.columns, result.ledger.rows[-1], strict=True))
    out = {"statistics": asdict(result.stats), "ledger": row}
    if result.accuracy is not None:
        out["accuracy"] = {**vars(result.accuracy), "method": repr(result.accuracy.method)}
    if result.time_sets is not None:
        out["time_sets"] = {
            name: value for name, value in vars(result.time_sets).items() if np.isscalar(value)
        }
    return out
