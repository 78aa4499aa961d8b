# SPDX-License-Identifier: LGPL-3.0-or-later
"""Absorbing boundaries as damping matrices of nodes.

Each facet has the impedance of its cell's body along its own outward normal, and gives an equal
share of (area × impedance) to its vertices: the vertex rule, as for masses. Knows no time step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat, hessian
from complexbody.boundary import entities
from complexbody.errors import IntegratorError, SceneError, agree
from complexbody.facets import exterior
from complexbody.hessian import NotQuadratic
from complexbody.impedance import impedance

if TYPE_CHECKING:
    from complexbody.discretisation import Discretisation
    from complexbody.problem import Problem

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Damping per volume is rounded to this fraction of its largest entry: equal nodes are one class.
GRAIN = 2.0**-44


@dataclass
class Dampers:
    """Damping matrices of this rank's facets at their nodes, before the sum over ranks.

    Attributes:
        node: Geometry nodes (dolfinx's numbers), each once.
        matrix: ∫Z by the vertex rule, shape (len(node), n, n).
        coupled: Whether any of them, on any rank, couples two components.
    """

    node: Ints
    matrix: Array
    coupled: bool

    def reduced(self, components: Sequence[int]) -> Dampers:
        """Of some components alone."""
        rows = np.array(components, dtype=np.int64)
        return Dampers(self.node, self.matrix[:, rows[:, None], rows], self.coupled)

    def per_volume(self, disc: Discretisation) -> Array:
        """Damping per lumped volume of nodes in own numbering, (nodes, n, n); collective."""
        n = disc.n
        total = np.zeros((disc.nodes, n * n))
        # Copies of a periodic node map to one row.
        np.add.at(total, disc.number[self.node], self.matrix.reshape(-1, n * n))
        disc.sum_shared(total)
        total /= disc.volume[:, None]
        # Per entry: u and ν have units of their own.
        largest = np.abs(total).max(axis=0, initial=0.0)
        disc.comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
        grain = np.where(largest > 0, largest, 1.0) * GRAIN
        # Copies of a shared node are the same to the bit, so they round alike; no −0.0.
        return (np.rint(total / grain) * grain + 0.0).reshape(-1, n, n)


def dampers(problem: Problem) -> Dampers | None:
    """Resolve the absorbing boundaries of a scene; collective.

    Raises:
        SceneError: if one selects no facet, two select the same, or a body has no impedance (on all
            ranks).
    """
    scene = problem.scene
    if not scene.absorbing:
        return None
    mesh, n, dim = scene.mesh, scene.components, scene.mesh.geometry.dim
    x = np.asarray(mesh.geometry.x)
    total = np.zeros((len(x), n, n))
    seen = np.zeros(0, np.int32)
    materials = _Materials(problem)
    for absorb in scene.absorbing:
        facets = np.asarray(entities(scene, absorb), dtype=np.int32)
        counts = mesh.comm.allreduce(np.array([len(facets), np.isin(facets, seen).sum()]))
        if counts[0] == 0:
            raise SceneError(
                f"Absorb(where={absorb.where!r}) selects no boundary facet. Check the predicate's "
                "tolerance or the tag."
            )
        if counts[1]:
            raise SceneError(
                f"Absorb(where={absorb.where!r}) selects facets that another Absorb has. Let them "
                "not overlap."
            )
        seen = np.append(seen, facets)
        found = exterior(mesh, facets)
        error: Exception | None = None
        Z = np.zeros((len(facets), n, n))
        try:
            Z = materials.impedances(found.cells, found.normals, absorb.frequency, absorb.field)
        except SceneError as refusal:
            error = refusal
        agree(mesh.comm, error)
        share = found.areas[:, None, None] / dim * Z
        for vertex in range(dim):
            np.add.at(total, found.nodes[:, vertex], share)
    off = ~np.eye(n, dtype=bool)
    coupled = bool(mesh.comm.allreduce(bool(np.any(total[:, off])), op=MPI.LOR))
    used = np.flatnonzero(np.any(total, axis=(1, 2)))
    return Dampers(used.astype(np.int64), total[used], coupled)


def refuse_dampers(problem: Problem, what: str) -> None:
    """Refuse absorbing boundaries where rates of u are not damped.

    Raises:
        IntegratorError: naming the integrators that take them.
    """
    if problem.dampers is not None:
        raise IntegratorError(
            f"{what} takes no absorbing boundary: it damps ν alone. Use Synchronous(), AVI(), "
            "LocalLeapfrog(), or a peer such as Newmark()."
        )


class _Materials:
    """Impedances of the bodies in this rank's cells, each distinct one computed once."""

    def __init__(self, problem: Problem) -> None:
        self.problem, scene, disc = problem, problem.scene, problem.disc
        self.regions = scene.regions()
        self.place = np.zeros((len(self.regions), 2), dtype=np.int64)
        block, lane = np.nonzero(disc.source_cell >= 0)
        self.place[disc.source_cell[block, lane]] = np.stack([block, lane], axis=1)
        self.known: dict[tuple[object, ...], Array] = {}
        self._cells = _compat.cell_nodes(scene.mesh)
        self._fields = problem.start[0].copy()
        rows, columns = np.nonzero(problem.supports.fixed)
        self._fields[rows, columns] = problem.supports.targets(rows, columns, 0.0)

    def impedances(
        self, cells: Ints, normals: Array, frequency: float | None, field: str | None
    ) -> Array:
        """Z of facets by their cells and normals, shape (facets, n, n).

        Raises:
            SceneError: for bodies whose waves cannot be told, or without the limit asked for.
        """
        n, coefficients = self.problem.scene.components, self.problem.kernels.coefficients
        varying = bool(self.problem.kernels.densities.coefficients)
        out = np.zeros((len(cells), n, n))
        kept = np.zeros((n, n))
        rows = np.arange(n) if field is None else self.problem.scene.components_of(field)
        kept[np.ix_(rows, rows)] = 1.0
        for i, (cell, normal) in enumerate(zip(cells, normals, strict=True)):
            region, (block, lane) = int(self.regions[cell]), self.place[cell]
            rho, values = self._density(region, cell), coefficients[block * varying, :, lane]
            alike = tuple(np.round(normal, 14))
            state = self._state(region, cell)
            key = (region, rho, values.tobytes(), state.tobytes(), alike, frequency, field)
            if key not in self.known:
                H = self._hessian(region, values, state)
                self.known[key] = kept * self._impedance(region, rho, H, normal, frequency)
            out[i] = self.known[key]
        return out

    def _state(self, region: int, cell: int) -> Array:
        """(u, ν) and ∇(u, ν) of a cell at the start, rounded, (4n,); empty where H is constant."""
        densities = self.problem.kernels.densities
        if densities.linear or densities.generated[region]:
            return np.zeros(0)
        nodes, dim = self._cells[cell], self.problem.disc.dim
        x, q = np.asarray(self.problem.scene.mesh.geometry.x)[nodes, :dim], self._fields[nodes]
        gradient = np.zeros((q.shape[1], 3))
        gradient[:, :dim] = np.linalg.solve(x[1:] - x[0], q[1:] - q[0]).T
        out = np.concatenate([q.mean(axis=0), gradient.ravel()])
        # Cells that are alike but for round-off have one impedance.
        grain = GRAIN**0.75 * max(np.abs(out).max(), 1e-300)
        return np.asarray(np.rint(out / grain) * grain + 0.0)

    def _density(self, region: int, cell: int) -> float:
        rho = self.problem.scene.bodies[region].density
        if not hasattr(rho, "function_space"):
            return float(rho)
        return float(rho.x.array[_compat.cell_dofs(rho.function_space)[cell, 0]])

    def _hessian(self, region: int, values: Array, state: Array) -> Array:
        """H of ρe + ρw in a cell, (4n, 4n): of a density that is not quadratic at the start."""
        scene, d = self.problem.scene, self.problem.kernels.densities
        n, body = scene.components, scene.bodies[region]
        H = np.zeros((4 * n, 4 * n))
        if d.generated[region]:
            for (i, j), parts in d.total(region).items():
                H[i, j] += sum(
                    v if isinstance(v, float) else values[d.coefficients.index(v)] for v in parts
                )
            return H
        n_u, k = scene.displacement, scene.descriptor
        gradient = state[n:].reshape(n, 3) if len(state) else np.zeros((n, 3))
        q = state[:n] if len(state) else np.zeros(n)
        arguments = {
            "gradients": (body.energy, (gradient[:n_u], q[n_u:], gradient[n_u:])),
            "fields": (body.potential, (q[:n_u], q[n_u:])),
        }
        for what, (density, at) in arguments.items():
            if density is None:
                continue
            try:
                found = hessian.read_at(density, n_u, k, what, at)
            except NotQuadratic:
                raise _unknown(body.name) from None
            if found.expressions():
                raise _unknown(body.name)
            for (i, j), value in found.hessian.items():
                H[i, j] += value
        return H

    def _impedance(
        self, region: int, rho: float, H: Array, normal: Array, frequency: float | None
    ) -> Array:
        scene = self.problem.scene
        n, n_u, body = scene.components, scene.displacement, scene.bodies[region]
        M, D = np.zeros((n, n)), np.zeros((n, n))
        M[range(n_u), range(n_u)] = rho
        M[n_u:, n_u:], D[n_u:, n_u:] = body.inertia_matrix, body.viscosity_matrix
        return impedance(H, M, D, normal, frequency)


def _unknown(name: str) -> SceneError:
    return SceneError(
        f"Absorb: the second derivative of the energy of {name} at the start varies within cells "
        "or cannot be read, so that its waves are not known. Give that part of the body another "
        "energy, or leave it free."
    )
