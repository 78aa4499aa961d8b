# SPDX-License-Identifier: LGPL-3.0-or-later
"""A density and its first and second derivatives at one state (U, ν, N), by UFL, as numbers.

UFL differentiates by variables that stand for the state, and what comes out is read as
:mod:`complexbody.hessian` reads densities, with numbers in the variables' places.
Where a density has coefficients that vary, such as DG0 Functions, so have the results: they stay
UFL scalars. Knows no mesh.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.classes import Variable

from complexbody.densities import scalar
from complexbody.errors import BodyError
from complexbody.hessian import NotQuadratic, Poly, Reader

Array = npt.NDArray[np.float64]
#: A number, or a UFL scalar where a coefficient varies.
Scalar = Any


class Expansion:
    """A density with its derivatives, differentiated once, to be evaluated at any state.

    Args:
        what: What the density is, for messages.
        density: A function of UFL tensors, such as ``energy(U, nu, N)``.
        shapes: Their shapes.
        order: 0, 1 or 2: derivatives above it are left out.

    Raises:
        BodyError: if the density cannot be evaluated or is no scalar.
    """

    def __init__(
        self, what: str, density: Callable[..., Any], shapes: Sequence[tuple[int, ...]], order: int
    ) -> None:
        # What is inside a variable does not matter: UFL does not look there.
        variables = [ufl.variable(ufl.zero(shape)) for shape in shapes]
        self._what, self._labels = what, [v.label() for v in variables]
        value = scalar(what, density, *variables)
        self._sizes = [math.prod(shape) for shape in shapes]
        slopes = [ufl.diff(value, v) for v in variables] if order > 0 else []
        pairs = [(a, b) for a in range(len(slopes)) for b in range(a, len(slopes))]
        self._value, self._slopes = _lowered(value), [_lowered(slope) for slope in slopes]
        self._second = {
            (a, b): _lowered(ufl.diff(slopes[a], variables[b]))
            for a, b in (pairs if order > 1 else [])
        }

    def at(
        self, state: Sequence[Array]
    ) -> tuple[Scalar, list[Scalar], dict[tuple[int, int], Scalar]]:
        """Value, gradient and Hessian at a state.

        Returns:
            The value; the gradient, entry by entry of all tensors row by row; the Hessian's entries
            that are not zero by (row, column), both triangles.

        Raises:
            BodyError: if the density is not finite, or not (twice) differentiable there.
        """
        arrays = [np.asarray(part, dtype=np.float64) for part in state]
        reader = _AtState(dict(zip(self._labels, arrays, strict=True)))
        starts = [0, *itertools.accumulate(self._sizes)]
        hessian: dict[tuple[int, int], Scalar] = {}
        try:
            number = reader.entries(self._value)[0]
            gradient = [entry for slope in self._slopes for entry in reader.entries(slope)]
            for (a, b), second in self._second.items():
                block = np.ndindex(self._sizes[a], self._sizes[b])
                for (i, j), entry in zip(block, reader.entries(second), strict=True):
                    if not (isinstance(entry, float) and entry == 0.0):
                        row, column = starts[a] + i, starts[b] + j
                        hessian[row, column] = hessian[column, row] = entry
        except (NotQuadratic, ArithmeticError, ValueError) as error:
            raise self._singular(arrays) from error
        found = [number, *gradient, *hessian.values()]
        if not all(math.isfinite(f) for f in found if isinstance(f, float)):
            raise self._singular(arrays)
        return number, gradient, hessian

    def _singular(self, state: Sequence[Array]) -> BodyError:
        at = "; ".join(np.array2string(part, precision=4) for part in state).replace("\n", "")
        return BodyError(
            f"The {self._what} has no finite value, or is not differentiable, at ({at}). Give a "
            "state inside its domain, or another energy."
        )


def _lowered(expression: Any) -> Any:
    return apply_derivatives(apply_algebra_lowering(expression))


class _AtState(Reader):
    """Reads expressions whose variables have values, by label."""

    def __init__(self, values: dict[Any, Array]) -> None:
        super().__init__(lambda terminal, component: None)
        self._values = values

    def _read(self, e: Any, c: tuple[int, ...], at: dict[Any, int]) -> Poly:
        if isinstance(e, Variable) and e.label() in self._values:
            value = float(self._values[e.label()][c])
            return {(): value} if value != 0.0 else {}
        return super()._read(e, c, at)

    def entries(self, expression: Any) -> list[Scalar]:
        """All entries of an expression, row by row."""
        shape = expression.ufl_shape
        return [self.visit(expression, c, {}).get((), 0.0) for c in np.ndindex(shape)]
