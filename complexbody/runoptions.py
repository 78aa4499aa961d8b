# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a simulation is asked for besides its scene: integrators, and options that make sense."""

from __future__ import annotations

from typing import Any

from complexbody.checkpoint import Checkpoint
from complexbody.errors import CheckpointError, IntegratorError, SceneError
from complexbody.given import is_flag, is_path, is_positive, is_whole, short
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.implicit import Implicit
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.peers import AssembledLeapfrog, Newmark, PetscTS
from complexbody.integrators.synchronous import Synchronous
from complexbody.output import Output

Integrator = (
    Synchronous | AVI | LocalLeapfrog | Implicit | AssembledLeapfrog | Newmark | PetscTS
)  # fmt: skip

#: Options of a simulation that are True or False.
FLAGS = ("progress", "plan", "quiet")


def check_options(
    *,
    until: Any,
    output: Any = None,
    ledger_steps: Any = None,
    growth: Any = None,
    checkpoint: Any = None,
    resume: Any = False,
    **flags: Any,
) -> None:
    """Refuse options of :func:`simulate` that make no sense.

    Raises:
        SceneError: for the first of them.
        CheckpointError: for what is no checkpoint's.
    """
    if not is_positive(until):
        raise SceneError(
            f"simulate: until is {short(until)}. Give the end of the run in seconds, > 0."
        )
    if output is not None and not isinstance(output, Output):
        raise SceneError(f"simulate: output is {short(output)}. Give cb.Output(folder, …).")
    if ledger_steps is not None and not (is_whole(ledger_steps) and ledger_steps > 0):
        raise SceneError(
            f"simulate: ledger_steps is {short(ledger_steps)}. Give a whole number, 1 or more."
        )
    if growth is not None and not is_positive(growth):
        raise SceneError(f"simulate: growth is {short(growth)}. Give a number > 0, or None.")
    if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
        raise CheckpointError(
            f"simulate: checkpoint is {short(checkpoint)}. Give cb.Checkpoint(…), or None."
        )
    if not is_flag(resume) and not is_path(resume):
        raise CheckpointError(
            f"simulate: resume is {short(resume)}. Give True, a run's folder, or a checkpoint."
        )
    for name, value in flags.items():
        if name in FLAGS and not (is_flag(value) or (value is None and name != "plan")):
            raise SceneError(f"simulate: {name} is {short(value)}. Give True or False.")


def chosen(integrator: Integrator | None) -> Integrator:
    """The integrator, Synchronous() if there is none.

    Raises:
        IntegratorError: for what is none.
    """
    integrator = Synchronous() if integrator is None else integrator
    if not isinstance(integrator, Integrator):
        raise IntegratorError(
            f"simulate: integrator is {short(integrator)}. Give one, such as cb.AVI()."
        )
    return integrator
