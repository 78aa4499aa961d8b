# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Which components of (u, ν) can move at all: those that a source reaches through couplings.

Sources are initial data, loads, supports that prescribe something, and linear terms of the
energies (prestress, constant external actions). Two components are coupled where ∂²(ρe), ∂²(ρw), Ω
or η has an entry for them, in the gradients that exist on this mesh. A density that is not
quadratic couples a component to those in motion unless the force on it is the expression zero when
it vanishes itself. What no source reaches stays zero: leaving it out changes no result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from ufl.algorithms import expand_indices, strip_variables
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.algorithms.map_integrands import map_expr_dag
from ufl.classes import Zero
from ufl.corealg.multifunction import MultiFunction

from complexbody.kernels.library import Densities
from complexbody.scene import Scene

Array = npt.NDArray[np.float64]
Density = Callable[..., Any]


@dataclass(frozen=True)
class Live:
    """Components in the order of records: u first, then ν.

    Attributes:
        components: Those that may move, sorted; all of them if nothing moves any.
        sources: What sets a component in motion, by component, in words.
        total: n_u + k.
    """

    components: tuple[int, ...]
    sources: dict[int, str]
    total: int

    @property
    def all(self) -> bool:
        """Whether nothing can be left out."""
        return len(self.components) == self.total


def live(
    scene: Scene, densities: Densities, supports: Any, loads: Any, start: tuple[Array, Array]
) -> Live:
    """The components that a source reaches; collective, the same on all ranks.

    Args:
        scene: The scene.
        densities: What reading its energies found.
        supports: Its :class:`complexbody.boundary.Supports`.
        loads: Its :class:`complexbody.loading.Loads`.
        start: Initial fields and rates (geometry nodes, n).
    """
    n = scene.components
    sources = _from_data(scene, supports, loads, start)
    links, nonlinear = _couplings(scene, densities, sources)
    reached = _closure(set(sources), links)
    while reached and len(reached) < n:
        driven = set().union(*(_driven(d, values, scene, reached) for d, values in nonlinear))
        if driven <= reached:
            break
        reached = _closure(reached | driven, links)
    return Live(tuple(sorted(reached or range(n))), sources, n)


def _from_data(
    scene: Scene, supports: Any, loads: Any, start: tuple[Array, Array]
) -> dict[int, str]:
    """Components that data move; collective."""
    n, out = scene.components, {}
    given = np.zeros((4, n), dtype=np.int64)
    free = ~supports.fixed
    for row, values in enumerate(start):
        given[row] = np.any((values != 0) & free, axis=0)
    given[2] = np.any(supports.fixed & (supports.value != 0), axis=0)
    given[3, loads.component[loads.value != 0]] = 1
    given = scene.mesh.comm.allreduce(given)
    words = ("initial data", "initial rates", "a support", "a load")
    for row, word in reversed(list(enumerate(words))):
        out.update(dict.fromkeys(np.flatnonzero(given[row]).tolist(), word))
    return out


def _couplings(
    scene: Scene, densities: Densities, sources: dict[int, str]
) -> tuple[list[set[int]], list[tuple[Density, str]]]:
    """Sets of coupled components, and densities to be looked at by :func:`_driven`.

    Adds to ``sources`` what linear terms move.
    """
    n_u, k, n = scene.displacement, scene.descriptor, scene.components
    links: list[set[int]] = []
    nonlinear: list[tuple[Density, str]] = []

    def component(i: int) -> int:
        return i // 3 if i < 3 * n else i - 3 * n

    for body, stored, outer in zip(
        scene.bodies, densities.stored, densities.potential, strict=True
    ):
        parts = [(body.energy, "gradients", stored), (body.potential, "fields", outer)]
        for density, values, found in parts:
            if density is None:
                continue
            if found is None:
                nonlinear.append((density, values))
                for i in _driven(density, values, scene, set()):
                    sources.setdefault(i, f"a force of {body.name} at rest")
                continue
            links += [{component(i), component(j)} for i, j in found.hessian]
            for i in found.linear:
                sources.setdefault(component(i), f"a linear term of {body.name}")
        matrices = [body.viscosity_matrix]
        if callable(body.inertia):
            # Rates enter χ in any way: ν is kept as a whole.
            sources.update({n_u + i: f"the inertia of {body.name}" for i in range(k)})
        else:
            matrices.append(body.inertia_matrix)
        links += [{n_u + int(i), n_u + int(j)} for m in matrices for i, j in np.argwhere(m)]
    return links, nonlinear


def _closure(reached: set[int], links: Iterable[set[int]]) -> set[int]:
    """All components linked to those reached, directly or not."""
    links = list(links)
    while True:
        more = set().union(reached, *(link for link in links if link & reached))
        if more == reached:
            return reached
        reached = more


class _Conditionals(MultiFunction):  # type: ignore[misc]
    """Conditionals between two zeros are zero, which UFL leaves open."""

    expr = MultiFunction.reuse_if_untouched

    def conditional(self, o: Any, condition: Any, yes: Any, no: Any) -> Any:
        """Zero if both values are."""
        if isinstance(yes, Zero) and isinstance(no, Zero):
            return yes
        return self.reuse_if_untouched(o, condition, yes, no)


def _driven(density: Density, values: str, scene: Scene, moving: set[int]) -> set[int]:
    """Components at rest on which a density acts by a force that is not the expression zero.

    Args:
        density: ρe(U, ν, N) or ρw(u, ν).
        values: "gradients" for the first, "fields" for the second.
        scene: The scene.
        moving: Components that may be anything; all others are zero.
    """
    mesh = scene.mesh
    domain, dim = mesh.ufl_domain(), mesh.geometry.dim
    n_u, n = scene.displacement, scene.components
    q = [ufl.Constant(domain) for _ in range(n)]
    gradient = [[ufl.Constant(domain) for _ in range(dim)] for _ in range(n)]
    blank = [ufl.as_ufl(0.0)] * (3 - dim)
    u, nu = ufl.as_vector(q[:n_u]), ufl.as_vector(q[n_u:])
    U, N = (ufl.as_tensor([[*row, *blank] for row in part])
            for part in (gradient[:n_u], gradient[n_u:]))  # fmt: skip
    expression = ufl.as_ufl(density(U, nu, N) if values == "gradients" else density(u, nu))
    rest = [i for i in range(n) if i not in moving]
    zero = {c: ufl.as_ufl(0.0) for i in rest for c in (q[i], *gradient[i])}
    out = set()
    for i in rest:
        for unknown in (q[i], *gradient[i]):
            held = ufl.variable(unknown)
            force = ufl.diff(ufl.replace(expression, {unknown: held}), held)
            force = expand_indices(apply_derivatives(apply_algebra_lowering(force)))
            force = map_expr_dag(_Conditionals(), ufl.replace(strip_variables(force), zero))
            if not isinstance(force, Zero):
                out.add(i)
                break
    return out
