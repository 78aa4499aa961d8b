# SPDX-License-Identifier: LGPL-3.0-or-later
"""Options of integrators, all of which are refused in the same words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

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
