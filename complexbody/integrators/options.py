# SPDX-License-Identifier: LGPL-3.0-or-later
"""Options of integrators, all of which are refused in the same words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from complexbody.errors import IntegratorError, StepError
from complexbody.given import is_flag, is_positive, is_whole, short


def positive(method: Any, *names: str) -> None:
    """Refuse options that are not positive numbers; ``step`` may be None.

    Raises:
        StepError: naming the first.
    """
    for name in names:
        value = getattr(method, name)
        if not (is_positive(value) or (value is None and name == "step")):
            raise StepError(
                f"{type(method).__name__}: {name} is {short(value)}. Give a positive number."
            )


def one_of(method: Any, name: str, allowed: tuple[Any, ...]) -> None:
    """Refuse an option that is none of those allowed.

    Raises:
        IntegratorError: naming those that are.
    """
    value = getattr(method, name)
    known = is_whole(value) if isinstance(allowed[0], int) else isinstance(value, str)
    if not known or value not in allowed:
        raise IntegratorError(
            f"{type(method).__name__}: {name}={short(value)} is not known. Give one of "
            f"{', '.join(map(str, allowed))}."
        )


def divided(step: float, until: float) -> float:
    """The step, shortened so that the end of the run falls on one [s]."""
    return float(until / np.ceil(until / min(step, until) * (1 - 1e-12)))


def chosen_step(
    method: Any, critical: float, until: float, which: str = "critical step", divide: bool = False
) -> float:
    """The step of an explicit integrator [s]: its own, or its safety times the critical one.

    Args:
        method: The integrator.
        critical: The critical step [s].
        until: End of the run, which falls on a step if the integrator has none of its own [s].
        which: What is critical, in words.
        divide: The end falls on a step in any case.

    Raises:
        StepError: if it is above the critical one and ``unstable_ok`` is False.
    """
    step = method.safety * critical if method.step is None else float(method.step)
    step = divided(step, until) if divide or method.step is None else step
    if step > critical * (1 + 1e-9) and not method.unstable_ok:
        raise StepError(
            f"The step {step:.6g} s is larger than the {which} {critical:.6g} s, so the run would "
            "be unstable. Give a smaller step, or unstable_ok=True to see it happen."
        )
    return step


def flags(method: Any, *names: str) -> None:
    """Refuse options that are neither True nor False.

    Raises:
        IntegratorError: naming the first.
    """
    for name in names:
        if not is_flag(getattr(method, name)):
            raise IntegratorError(
                f"{type(method).__name__}: {name} is {short(getattr(method, name))}. Give True or "
                "False."
            )


def petsc_options(method: Any) -> None:
    """Refuse ``options`` that are no mapping of texts.

    Raises:
        IntegratorError: for them.
    """
    given = method.options
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise IntegratorError(
            f"{type(method).__name__}: options are {short(given)}. Give a dict of PETSc's options, "
            "for instance {'ksp_type': 'cg'}."
        )
