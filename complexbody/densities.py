# SPDX-License-Identifier: LGPL-3.0-or-later
"""Calling a user's density: a scalar UFL expression, or a clear error; and F for those in F."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import ufl
from ufl.algorithms.analysis import extract_arguments
from ufl.classes import (
    Condition,
    Constant,
    Curl,
    Div,
    FormArgument,
    Grad,
    NablaDiv,
    NablaGrad,
    ScalarValue,
)
from ufl.corealg.traversal import unique_pre_traversal

from complexbody.errors import BodyError
from complexbody.given import short

#: Derivatives in space.
GRADIENTS = (Grad, Div, NablaGrad, NablaDiv, Curl)


def scalar(what: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a user's density and insist on a scalar UFL expression.

    Raises:
        BodyError: if it fails or returns something else.
    """
    try:
        value = ufl.as_ufl(function(*arguments))
    except BodyError:
        raise
    except Exception as error:
        raise BodyError(
            f"The {what} cannot be evaluated: {type(error).__name__}: {error}. Write it in UFL for "
            "U of shape (n_u, 3), nu of shape (k,) and N of shape (k, 3)."
        ) from error
    if value.ufl_shape != () or value.ufl_free_indices:
        free = ", with free indices" if value.ufl_free_indices else ""
        raise BodyError(
            f"The {what} has shape {value.ufl_shape}{free}, but a density is a scalar. Contract "
            "its indices, for instance with ufl.inner."
        )
    if isinstance(value, Condition) or extract_arguments(value):
        raise BodyError(
            f"The {what} is no number: {short(value)}. Return a scalar expression of its "
            "arguments, for instance with ufl.conditional."
        )
    given = {part for a in arguments if a is not None for part in unique_pre_traversal(a)}
    for part in unique_pre_traversal(value):
        if isinstance(part, ScalarValue) and not _is_finite(part):
            raise BodyError(f"The {what} has the constant {short(part)}. Give finite real numbers.")
        if isinstance(part, GRADIENTS) and part not in given and _has_field(part, given):
            raise BodyError(
                f"The {what} takes {type(part).__name__.lower()} of its arguments. Use U for ∇u "
                "and N for ∇ν, of three columns: gradients have no other place in it."
            )
    return value


def _has_field(expression: Any, fields: set[Any]) -> bool:
    """Whether a field or constant among ``fields`` stands in an expression."""
    inside = unique_pre_traversal(expression)
    return any(isinstance(part, FormArgument | Constant) and part in fields for part in inside)


def deformation(U: Any) -> Any:
    """F = I + ∇u of U = ∇u, shape (n_u, 3), as a 3×3 UFL tensor for energies e(F, ν, N).

    Where u has less than three components the missing ones are zero (plane strain).

    Raises:
        BodyError: for more than three rows.
    """
    rows = U.ufl_shape[0]
    if rows > 3:
        raise BodyError(f"deformation: U has {rows} rows, but space has three. Give n_u ≤ 3.")
    return ufl.as_tensor(
        [
            [(U[i, j] if i < rows else ufl.as_ufl(0.0)) + (1.0 if i == j else 0.0)
             for j in range(3)]
            for i in range(3)
        ]
    )  # fmt: skip


def _is_finite(constant: Any) -> bool:
    try:
        return math.isfinite(float(constant))
    except (TypeError, OverflowError):  # complex, or hundreds of digits
        return False
