# SPDX-License-Identifier: LGPL-3.0-or-later
r"""A4 and A5 at the states a run visits: convexity γ and bounds Ξ of a general χ(ν, ν̇), and T₀.

Lemma "invertib" of the paper bounds the step by T₀ = 2γ/(2Ξ+γ), a number that depends on the unit
of time. Its proof only needs γ/h to exceed the Lipschitz constant of ∂χ/∂ν in ν̇, that is Ξ of the
mixed derivative ∂²χ/∂ν∂ν̇; the best of the paper's bounds over all units of time is T₀ = γ/Ξ. In the
midpoint scheme the mixed part enters only by its skew part, which does no harm; what is left is
4γ > h²Ξ with Ξ of ∂²χ/∂ν∂ν, so T₀ = 2√(γ/Ξ). Both are taken point by point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI

from complexbody import _compat
from complexbody.errors import BodyError, agree
from complexbody.kinetics import derivatives
from complexbody.scene import Scene

Array = npt.NDArray[np.float64]


@dataclass
class Range:
    """What χ was over the states seen so far, over all ranks.

    Attributes:
        gamma: Smallest eigenvalue γ of ∂²χ/∂ν̇∂ν̇ (A5).
        mixed, second: Ξ, largest norms of ∂²χ/∂ν∂ν̇ and ∂²χ/∂ν∂ν (A4).
        first_limit, second_limit: T₀ of the first- and the second-order scheme [s].
        first_place, second_place: Where they were found, in words.
    """

    gamma: float = np.inf
    mixed: float = 0.0
    second: float = 0.0
    first_limit: float = np.inf
    second_limit: float = np.inf
    first_place: str = ""
    second_place: str = ""

    def widen(self, other: Range) -> None:
        """Take in another range."""
        if other.first_limit < self.first_limit:
            self.first_place = other.first_place
        if other.second_limit < self.second_limit:
            self.second_place = other.second_place
        self.gamma = min(self.gamma, other.gamma)
        self.mixed, self.second = max(self.mixed, other.mixed), max(self.second, other.second)
        self.first_limit = min(self.first_limit, other.first_limit)
        self.second_limit = min(self.second_limit, other.second_limit)

    def limit(self, order: int) -> float:
        """T₀ of the scheme of this order [s]."""
        return self.first_limit if order == 1 else self.second_limit

    def place(self, order: int) -> str:
        """Where T₀ of the scheme of this order was found, in words."""
        return self.first_place if order == 1 else self.second_place


class Convexity:
    """Second derivatives of the general χ of a scene at the vertices of its cells; collective.

    Args:
        scene: A scene some of whose bodies have an inertia that is a function.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.comm = scene, scene.mesh.comm
        self.k, mesh = scene.descriptor, scene.mesh
        space = _compat.vector_space(mesh, self.k)
        self.nu, self.rate = fem.Function(space), fem.Function(space)
        regions, self._parts = scene.regions(), {}
        for r, body in enumerate(scene.bodies):
            if callable(body.inertia):
                second = derivatives(body, self.nu, self.rate)[3:]
                entries = [m[i, j] for m in second for i in range(self.k) for j in range(self.k)]
                # The interpolation points of P1 are the vertices.
                compiled = _compat.expression(ufl.as_vector(entries), _compat.vertex_space(mesh))
                self._parts[r] = compiled, np.flatnonzero(regions == r).astype(np.int32)

    def measure(self, nu: Array, rate: Array) -> dict[int, Range]:
        """Range of each general region at nodal values (geometry nodes, k); collective.

        Raises:
            BodyError: where χ is not uniformly convex (A5) or has no finite Hessian (A4), on all
                ranks, naming the place, ν and ν̇.
        """
        self.nu.x.array[:], self.rate.x.array[:] = nu.ravel(), rate.ravel()
        out, error, k = {}, None, self.k
        for r, (compiled, cells) in self._parts.items():
            values = _compat.evaluate(compiled, self.scene.mesh, cells)
            blocks = values.reshape(-1, 3, k, k)
            nodes = _compat.cell_nodes(self.scene.mesh)[cells].ravel()
            error = error or self._broken(r, blocks, nodes, nu, rate)
            if error is None:
                out[r], least = _range(blocks)
                for name, at in least.items():
                    setattr(out[r], name, self._place(nodes[at]))
        agree(self.comm, error)
        for found in out.values():
            for order in ("first", "second"):
                limit, place = f"{order}_limit", f"{order}_place"
                mine = getattr(found, limit), self.comm.rank, getattr(found, place)
                smallest = min(self.comm.allgather(mine))
                setattr(found, limit, smallest[0])
                setattr(found, place, smallest[2])
            found.gamma = self.comm.allreduce(found.gamma, op=MPI.MIN)
            for name in ("mixed", "second"):
                setattr(found, name, self.comm.allreduce(getattr(found, name), op=MPI.MAX))
        return out

    def _place(self, node: int) -> str:
        """A geometry node of this rank in words."""
        geometry = self.scene.mesh.geometry
        number = int(np.asarray(geometry.input_global_indices)[node])
        where = np.round(geometry.x[node, : geometry.dim], 9).tolist()
        return f"node {number} at {where}, rank {self.comm.rank}"

    def _broken(self, r: int, blocks: Array, nodes: Any, nu: Array, rate: Array) -> Any:
        finite = np.isfinite(blocks).all(axis=(1, 2, 3))
        least = np.linalg.eigvalsh(np.where(finite[:, None, None], blocks[:, 0], 0.0))[:, 0]
        bad = np.flatnonzero(~finite | (least <= 0))
        if not bad.size:
            return None
        at, node = bad[0], nodes[bad[0]]
        what = f"is not convex in ν̇ (A5: γ = {least[at]:.3g})" if finite[at] else (
            "has no finite second derivatives (A4)"
        )  # fmt: skip
        return BodyError(
            f"The kinetic co-energy of {self.scene.bodies[r].name} {what} in {self._place(node)}, "
            f"ν = {nu[node].tolist()}, ν̇ = {rate[node].tolist()}. Change the inertia, or keep the "
            "descriptor away from there."
        )


def _range(blocks: Array) -> tuple[Range, dict[str, int]]:
    """γ, Ξ and T₀ of second derivatives (points, 3, k, k), and the points where T₀ is smallest."""
    if not len(blocks):
        return Range(), {}
    gamma = np.linalg.eigvalsh(blocks[:, 0])[:, 0]
    mixed, second = (np.linalg.norm(blocks[:, i], axis=(1, 2)) for i in (1, 2))
    with np.errstate(divide="ignore"):
        first, midpoint = gamma / mixed, 2 * np.sqrt(gamma / second)
    found = Range(
        float(gamma.min()), float(mixed.max()), float(second.max()),
        float(first.min()), float(midpoint.min()),
    )  # fmt: skip
    return found, {"first_place": int(first.argmin()), "second_place": int(midpoint.argmin())}
