# SPDX-License-Identifier: LGPL-3.0-or-later
"""What users call: one scene, from here to its result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from complexbody.accuracy import Accurate
from complexbody.checkpoint import Checkpoint
from complexbody.errors import AccuracyError, SceneError
from complexbody.given import short
from complexbody.output import Output
from complexbody.result import Result
from complexbody.runoptions import Integrator
from complexbody.scene import Scene
from complexbody.simulation import Simulation


def simulate(
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
    accuracy: float | None = None,
    checkpoint: Checkpoint | None = None,
    resume: bool | str | Path = False,
) -> Result:
    """Run a scene from t = 0 to ``until``; collective.

    Args:
        scene: What to simulate.
        integrator: How; ``Synchronous()`` by default, or ``AVI`` or ``LocalLeapfrog`` where a few
            small cells would dictate the step of all others.
        until: End of the run [s].
        output: What to write and where; nothing by default.
        ledger_steps: Steps between two ledger rows; by default so many that the books cost some
            per cent of the run, but at least a hundred rows.
        growth: Stop when energy from nowhere exceeds this multiple of what was put in; None: never.
        progress: Show progress on rank 0; by default where standard error is a terminal.
        plan: Leave out what changes no result (:func:`complexbody.planning.plan`); False: nothing.
        quiet: Skip cells at rest that nothing has reached yet: the same results to the bit
            (``Synchronous``, ``LocalLeapfrog``, ``AVI``, and ``Implicit`` with the vertex rule and
            explicit forces; the others act on all cells).
        accuracy: Relative error to meet at the end, in place of an integrator: the larger one of u
            and ν (L2), over their largest norms (:mod:`complexbody.accuracy`).
        checkpoint: When to make checkpoints; none by default.
        resume: Go on from the newest good checkpoint of this scene: True for that of ``checkpoint``
            and ``output``, or a folder of a run, or a file. The step stays that of its run,
            whatever ``until`` is; files go on where they were then.

    Returns:
        Fields at the final time, ledger, probes and statistics.

    Raises:
        ComplexBodyError: of a kind that says what is wrong, on all ranks.
    """
    options: dict[str, Any] = {
        "until": until, "output": output, "ledger_steps": ledger_steps, "growth": growth,
        "progress": progress, "plan": plan, "quiet": quiet, "checkpoint": checkpoint,
    }  # fmt: skip
    if not isinstance(scene, Scene):
        raise SceneError(f"simulate: the scene is {short(scene)}. Give a cb.Scene.")
    if accuracy is None:
        return Simulation(scene, integrator, **options, resume=resume).run()
    if resume:
        raise AccuracyError(
            "simulate: accuracy= chooses the integrator, and resume= has one. Give one of them."
        )
    return Accurate(scene, accuracy, integrator, **options).run()
