# SPDX-License-Identifier: LGPL-3.0-or-later
"""Reading a density symbolically: is it quadratic, and what is its Hessian?

A UFL density is evaluated over polynomials in the unknowns (∇u, ∇ν, u, ν) instead of numbers.
What remains of degree two or less is the density exactly: no differentiation, no sampling.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl import classes as uc
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives

from complexbody import _compat

Array = npt.NDArray[np.float64]
#: Monomial (sorted indices of unknowns, at most two) -> coefficient (float or UFL scalar).
Poly = dict[tuple[int, ...], Any]


_COMPARED = {
    uc.EQ: operator.eq, uc.NE: operator.ne, uc.LT: operator.lt, uc.LE: operator.le,
    uc.GT: operator.gt, uc.GE: operator.ge,
}  # fmt: skip


class NotQuadratic(Exception):
    """The density is not a polynomial of degree two in the unknowns."""


@dataclass(frozen=True)
class Quadratic:
    """c + l·g + ½ g·Hg with g = (∂_j q_i at 3i + j, then q_i at 3n + i), q = (u, ν).

    Attributes:
        constant: c.
        linear: l by index.
        hessian: H by (row, column), both triangles; entries are floats or UFL scalars.
        cellwise: True if every entry is constant on each cell, so that a kernel can be generated.
    """

    constant: Any
    linear: dict[int, Any]
    hessian: dict[tuple[int, int], Any]
    cellwise: bool

    def expressions(self) -> list[Any]:
        """The distinct coefficients that vary between cells, as UFL scalars."""
        found: list[Any] = []
        for value in (self.constant, *self.linear.values(), *self.hessian.values()):
            if not isinstance(value, float) and value not in found:
                found.append(value)
        return found


def read(density: Callable[..., Any], mesh: Any, n_u: int, k: int, values: str) -> Quadratic | None:
    """Read a density off as a quadratic polynomial, or return None if it is not one.

    Args:
        density: ``e(U, nu, N)`` if ``values`` is "gradients", ``w(u, nu)`` if it is "fields".
        mesh: The dolfinx mesh, whose dimension says which columns of U and N exist; None for
            space, where all do.
        n_u: Components of u.
        k: Components of ν.
        values: Which of the two it is.
    """
    n, dim = n_u + k, 3 if mesh is None else mesh.geometry.dim
    domain = _compat.space() if mesh is None else mesh.ufl_domain()
    # A reduced scene may have no component of one of them.
    u, nu = (ufl.Constant(domain, shape=(m,)) if m else None for m in (n_u, k))
    U, N = (ufl.Constant(domain, shape=(m, 3)) if m else None for m in (n_u, k))

    def unknown(terminal: Any, component: tuple[int, ...]) -> Poly | None:
        if terminal is U or terminal is N:
            i, j = component
            return {(3 * (i + (n_u if terminal is N else 0)) + j,): 1.0} if j < dim else {}
        if terminal is u or terminal is nu:
            return {(3 * n + component[0] + (n_u if terminal is nu else 0),): 1.0}
        return None

    expression = density(U, nu, N) if values == "gradients" else density(u, nu)
    reader = Reader(unknown)
    try:
        return _read(reader, expression)
    except NotQuadratic:
        return None


def read_at(
    density: Callable[..., Any], n_u: int, k: int, values: str, state: Sequence[Array]
) -> Quadratic:
    """The Taylor polynomial of degree two of any density at a state, in space.

    Args:
        density: As for :func:`read`.
        n_u: Components of u.
        k: Components of ν.
        values: As for :func:`read`.
        state: Numbers in place of the arguments of ``density``.

    Raises:
        NotQuadratic: if it has no second derivative there that can be read.
    """
    n, domain = n_u + k, _compat.space()
    shapes = [np.shape(value) for value in state]
    at, change = ([ufl.Constant(domain, shape=shape) for shape in shapes] for _ in range(2))
    own = 3 * n + n_u  # where ν stands; before it u, before that N and U
    first = (0, own, 3 * n_u) if values == "gradients" else (3 * n, own)

    def unknown(terminal: Any, component: tuple[int, ...]) -> Poly | None:
        for x, value in zip(at, state, strict=True):
            if terminal is x:
                return _constant(float(value[component]))
        for x, start, shape in zip(change, first, shapes, strict=True):
            if terminal is x:
                return {(start + int(np.ravel_multi_index(component, shape)),): 1.0}
        return None

    variables = [ufl.variable(x) for x in at]

    def varied(e: Any) -> Any:
        pairs = zip(variables, change, strict=True)
        return sum(ufl.inner(ufl.diff(e, x), y) for x, y in pairs)

    expression = ufl.as_ufl(density(*variables))
    slope = varied(expression)
    try:
        return _read(Reader(unknown), expression + slope + 0.5 * varied(slope))
    except (ZeroDivisionError, ValueError, OverflowError):
        raise NotQuadratic from None  # a function at the edge of where it is defined


def _read(reader: Reader, expression: Any) -> Quadratic:
    lowered = apply_derivatives(apply_algebra_lowering(ufl.as_ufl(expression)))
    poly = reader.visit(lowered, (), {})
    hessian: dict[tuple[int, int], Any] = {}
    for monomial, value in poly.items():
        if len(monomial) == 2:
            a, b = monomial
            hessian[a, b] = hessian[b, a] = _times(value, 2.0) if a == b else value
    linear = {m[0]: value for m, value in poly.items() if len(m) == 1}
    return Quadratic(poly.get((), 0.0), linear, hessian, reader.cellwise)


def quadratic_in_gradient(density: Callable[..., Any], mesh: Any, n_u: int, k: int) -> bool:
    """Whether ``e(U, nu, N)`` is a polynomial of degree two in U alone, whatever it is in ν and N.

    Args:
        density: The stored energy density.
        mesh: The dolfinx mesh, whose dimension says which columns of U exist.
        n_u: Components of u.
        k: Components of ν.
    """
    domain = mesh.ufl_domain()
    U, nu, N = (ufl.Constant(domain, shape=s) for s in ((n_u, 3), (k,), (k, 3)))

    def unknown(terminal: Any, component: tuple[int, ...]) -> Poly | None:
        if terminal is not U:
            return None
        i, j = component
        return {(3 * i + j,): 1.0} if j < mesh.geometry.dim else {}

    try:
        lowered = apply_derivatives(apply_algebra_lowering(ufl.as_ufl(density(U, nu, N))))
        Reader(unknown).visit(lowered, (), {})
    except NotQuadratic:
        return False
    return True


class Reader:
    """Evaluates lowered UFL over polynomials; ``cellwise`` turns False at a varying coefficient."""

    def __init__(self, unknown: Callable[[Any, tuple[int, ...]], Poly | None]) -> None:
        self.unknown = unknown
        self.cellwise = True
        self._known: dict[tuple[Any, ...], tuple[Any, Poly]] = {}

    def visit(self, e: Any, c: tuple[int, ...], at: dict[Any, int]) -> Poly:
        """Polynomial of component ``c`` of ``e`` with free indices bound by ``at``."""
        # Derivatives share most of their parts: each is to be read once.
        key = (id(e), c, *(at[i] for i in e.ufl_free_indices))
        if key not in self._known:
            self._known[key] = e, self._read(e, c, at)  # e too: its id must not be given away
        return self._known[key][1]

    def _read(self, e: Any, c: tuple[int, ...], at: dict[Any, int]) -> Poly:
        ops = e.ufl_operands
        if isinstance(e, uc.Zero):
            return {}
        if isinstance(e, uc.ScalarValue):
            return _constant(float(e))
        if isinstance(e, uc.Identity):
            return _constant(1.0 if c[0] == c[1] else 0.0)
        if isinstance(e, uc.PermutationSymbol):
            return _constant(float(_permutation_sign(c)))
        if isinstance(e, uc.Indexed):
            return self.visit(ops[0], self._fixed(ops[1], at), at)
        if isinstance(e, uc.ComponentTensor):
            bound = dict(at)
            bound.update(zip((i.count() for i in ops[1]), c, strict=True))
            return self.visit(ops[0], (), bound)
        if isinstance(e, uc.ListTensor):
            return self.visit(ops[c[0]], c[1:], at)
        if isinstance(e, uc.IndexSum):
            index = ops[1][0].count()
            return _sum(self.visit(ops[0], c, {**at, index: i}) for i in range(e.dimension()))
        if isinstance(e, uc.Variable | uc.Conj | uc.Real):  # everything here is real
            return self.visit(ops[0], c, at)
        if isinstance(e, uc.Sum):
            return _sum(self.visit(o, c, at) for o in _terms(e))
        if isinstance(e, uc.Product):
            return _product(self.visit(ops[0], (), at), self.visit(ops[1], (), at))
        if isinstance(e, uc.Division):
            return self._over(self.visit(ops[0], c, at), self.visit(ops[1], (), at))
        if isinstance(e, uc.Power):
            return self._power(self.visit(ops[0], (), at), self.visit(ops[1], (), at))
        if isinstance(e, uc.Conditional):
            return self.visit(ops[1] if self._holds(ops[0], at) else ops[2], c, at)
        if not ops or isinstance(e, uc.Derivative):  # gradients of coefficients are left, no others
            known = self.unknown(e, c)
            return self._coefficient(e, c) if known is None else known
        return self._function(e, [self.visit(o, (), at) for o in ops])

    def _fixed(self, multi: Any, at: dict[Any, int]) -> tuple[int, ...]:
        return tuple(int(i) if isinstance(i, uc.FixedIndex) else at[i.count()] for i in multi)

    def _coefficient(self, e: Any, c: tuple[int, ...]) -> Poly:
        if isinstance(e, fem.Constant):
            return _constant(float(np.asarray(e.value)[c]))
        if not (isinstance(e, fem.Function) and _compat.is_cellwise(e)):
            self.cellwise = False
        return {(): e[c] if c else e}

    def _over(self, a: Poly, b: Poly) -> Poly:
        if any(b) or () not in b:  # division by an unknown, or by zero
            raise NotQuadratic
        return {m: v / b[()] for m, v in a.items()}

    def _power(self, base: Poly, exponent: Poly) -> Poly:
        if any(exponent):
            raise NotQuadratic
        p = exponent.get((), 0.0)
        if not any(base):
            return {(): base.get((), 0.0) ** p}
        if not isinstance(p, float) or p not in (0.0, 1.0, 2.0):
            raise NotQuadratic
        if p == 0.0:
            return {(): 1.0}
        return base if p == 1.0 else _product(base, base)

    def _holds(self, e: Any, at: dict[Any, int]) -> bool:
        """Whether a condition on numbers holds; of anything else it says nothing."""
        if isinstance(e, uc.NotCondition):
            return not self._holds(e.ufl_operands[0], at)
        if isinstance(e, uc.AndCondition | uc.OrCondition):
            both = [self._holds(o, at) for o in e.ufl_operands]
            return all(both) if isinstance(e, uc.AndCondition) else any(both)
        sides = [self.visit(o, (), at) for o in e.ufl_operands]
        values = [side.get((), 0.0) for side in sides]
        if any(any(side) for side in sides) or not all(isinstance(v, float) for v in values):
            raise NotQuadratic
        return bool(_COMPARED[type(e)](*values))

    def _function(self, e: Any, arguments: list[Poly]) -> Poly:
        # A function of coefficients alone is a coefficient; of an unknown, no polynomial.
        if any(any(a) for a in arguments):
            raise NotQuadratic
        operands = [ufl.as_ufl(a.get((), 0.0)) for a in arguments]
        value = e._ufl_expr_reconstruct_(*operands)
        if isinstance(value, uc.Zero):  # as ln 1: no ScalarValue
            return {}
        return _constant(float(value)) if isinstance(value, uc.ScalarValue) else {(): value}


def _constant(value: float) -> Poly:
    return {(): value} if value != 0.0 else {}


def _terms(e: Any) -> list[Any]:
    """Terms of nested sums: a long sum is as deep as it is long, too deep for recursion."""
    terms, stack = [], [e]
    while stack:
        top = stack.pop()
        if isinstance(top, uc.Sum):
            stack.extend(reversed(top.ufl_operands))
        else:
            terms.append(top)
    return terms


def _times(a: Any, b: Any) -> Any:
    return a * b


def _sum(terms: Any) -> Poly:
    total: Poly = {}
    for term in terms:
        for monomial, value in term.items():
            total[monomial] = total[monomial] + value if monomial in total else value
    return {m: v for m, v in total.items() if not (isinstance(v, float) and v == 0.0)}


def _product(a: Poly, b: Poly) -> Poly:
    terms = []
    for (m, x), (n, y) in itertools.product(a.items(), b.items()):
        if len(m) + len(n) > 2:
            raise NotQuadratic
        terms.append({tuple(sorted(m + n)): _times(x, y)})
    return _sum(terms)


def _permutation_sign(c: tuple[int, ...]) -> int:
    if len(set(c)) < len(c):
        return 0
    return int(
        math.prod(1 if c[i] < c[j] else -1 for i, j in itertools.combinations(range(len(c)), 2))
    )


def names(n_u: int, k: int) -> list[str]:
    """Names of the unknowns g: U11 … , N11 … , u1 …, nu1 …, in the order of :class:`Quadratic`."""
    gradients = [f"U{i + 1}{j + 1}" for i in range(n_u) for j in range(3)]
    gradients += [f"N{i + 1}{j + 1}" for i in range(k) for j in range(3)]
    return gradients + [f"u{i + 1}" for i in range(n_u)] + [f"nu{i + 1}" for i in range(k)]
