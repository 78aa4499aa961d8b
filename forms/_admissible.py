# SPDX-License-Identifier: LGPL-3.0-or-later
"""Refusal of constants no stable body can have: the checks every family of bodies shares.

A family states its coercivity conditions (A1) as inequalities ``left > right`` between its own
constants. This file turns a broken one into a :class:`~complexbody.errors.CoercivityError` with the
inequality, both numbers and a remedy; it knows no family and evaluates no energy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from numbers import Real
from typing import Any, TypeAlias

from complexbody.errors import BodyError, CoercivityError

#: ``f(U, nu, N)``, as :class:`~complexbody.body.Body` takes it
Energy: TypeAlias = Callable[[Any, Any, Any], Any]


def finite(family: str, constants: Mapping[str, Any]) -> dict[str, float]:
    """The constants as floats.

    Args:
        family: The function the user called, for the message.
        constants: Parameter names and what was given for them.

    Returns:
        The same constants, each a float.

    Raises:
        BodyError: if one is not a finite real number.
    """
    for name, value in constants.items():
        if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
            raise BodyError(
                f"{family}: {name} is {value!r}, not a finite number. Give a real number for it."
            )
    return {name: float(value) for name, value in constants.items()}


def require(
    family: str, inequality: str, left: float, right: float, remedy: str, *, strict: bool = True
) -> None:
    """Refuse the body unless ``left > right``.

    Args:
        family: The function the user called.
        inequality: The condition in the names of the parameters, such as ``"mu*k5 > 3*R**2"``.
        left: Value of its left side.
        right: Value of its right side.
        remedy: One sentence that says what to change.
        strict: Whether equality is refused as well.

    Raises:
        CoercivityError: if the inequality does not hold.
    """
    if not (left > right or (left == right and not strict)):
        raise CoercivityError(
            f"{family}: the stored energy is not coercive, because {inequality} does not hold "
            f"({left:.9g} against {right:.9g}). {remedy}"
        )


def require_positive(family: str, constants: Mapping[str, float], names: Iterable[str]) -> None:
    """Refuse the body unless each of the named constants is positive.

    Raises:
        CoercivityError: naming the first one that is not.
    """
    for name in names:
        require(family, f"{name} > 0", constants[name], 0.0, f"Give {name} a positive value.")
