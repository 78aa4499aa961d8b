# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The semi-discrete equations on dolfinx's own vectors, as one would write them by hand:

.. math:: M\ddot q + D\dot q + r(q) = F(t),

q = (u, ν) at the nodes, r by ``ufl.derivative`` of the scene's action, M and D the lumped masses
and viscosities of this package, F the loads with their histories. Vectors are this rank's owned
unknowns, node by node. Peers of our integrators step these equations; it knows no time step.
"""  # noqa: D415

from __future__ import annotations

from typing import Any

import dolfinx.fem.petsc  # noqa: F401  (0.9 does not load it with dolfinx.fem)
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from complexbody import _compat
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


class Blocks:
    """One n×n matrix per owned node, or its diagonal where no component couples.

    Attributes:
        values: Diagonals (owned unknowns,), or blocks (owned nodes, n, n).
    """

    def __init__(self, values: Array) -> None:
        self.values, self.n = values, values.shape[-1]
        self.diagonal = values.ndim == 1
        self._one = self.diagonal and bool(np.all(values == 1.0))

    def times(self, x: Array, out: Array) -> Array:
        """Out = B x, both (owned unknowns,)."""
        if not self.diagonal:
            shape = (-1, self.n)
            np.einsum("aij,aj->ai", self.values, x.reshape(shape), out=out.reshape(shape))
        elif self._one:
            out[:] = x
        else:
            np.multiply(self.values, x, out=out)
        return out

    def add_to(self, matrix: Any, factor: float) -> None:
        """Matrix += factor · B, by owned nodes; collective."""
        if self.diagonal:
            vector = matrix.createVecLeft()
            vector.array[:] = factor * self.values
            matrix.setDiagonal(vector, addv=True)
            vector.destroy()
            return
        rows = np.arange(len(self.values) + 1, dtype=np.int32)
        block = factor * self.values.ravel()
        matrix.setValuesBlockedLocalIJV(rows, rows[:-1], block, addv=True)
        matrix.assemble()


class SemiDiscrete:
    """M, D, r, F and supports of a problem; collective.

    Args:
        problem: The scene made ready.
        matrix: PETSc type of the stiffness, assembled once and then multiplied with; "" to
            assemble the residual at each evaluation.

    Attributes:
        n: Components per node; size: owned unknowns of this rank.
        q: (u, ν), a Function; x: its owned values, a view.
        r: Result of :meth:`residual`, a view of owned values.
        fixed: Flat numbers of owned prescribed unknowns.
        linear: Whether r is affine in q.
        evaluations: Residuals, matrices and products since setting up, each a pass over all cells.
    """

    def __init__(self, problem: Problem, matrix: str = "") -> None:
        self.problem = problem
        action, scene = problem.action, problem.scene
        self.n, self.linear = scene.components, problem.kernels.densities.linear
        self.nodes = int(_compat.node_map(scene.mesh).size_local)
        self.size = self.nodes * self.n
        self.q, self._r, self._buffer = (fem.Function(action.space) for _ in range(3))
        self.x, self.r = (f.x.array[: self.size] for f in (self.q, self._r))
        self._residual = _compat.form(ufl.replace(action.residual(), {action.q: self.q}))
        self._tangent: Any = None
        self.evaluations = 0
        self.fixed = np.flatnonzero(problem.supports.fixed[: self.nodes].ravel()).astype(np.int32)
        self._load()
        self.matrix: Any = None
        self.affine: Array | None = None
        if self.linear:
            self.q.x.array[:] = 0.0
            self.residual()
            self.affine = self.r.copy() if np.any(self.r) else None
        if matrix:
            self.matrix = self.tangent(matrix if self.n > 1 else "aij")
            self._vectors = _compat.petsc_vector(self.q), _compat.petsc_vector(self._r)
        self.set(problem.initial_fields)
        self.evaluations = 0

    def _load(self) -> None:
        """One vector of owned forces per history."""
        loads, out = self.problem.loads, []
        for group in range(len(loads.histories)):
            mine, values = loads.group == group, self._buffer.x.array
            values[:] = 0.0
            at = loads.node[mine] * self.n + loads.component[mine]
            np.add.at(values, at, loads.value[mine])
            _compat.accumulate(self._buffer)
            out.append(values[: self.size].copy())
        self._loads = np.array(out).reshape(len(out), self.size)
        self._force = np.zeros(self.size)

    @property
    def loaded(self) -> bool:
        """Whether there are any loads."""
        return len(self._loads) > 0

    def force(self, t: float) -> Array:
        """F(t), t in s; valid until the next call."""
        if self.loaded:
            amplitude = self.problem.loads.amplitudes(np.array([t]))[0]
            np.dot(amplitude, self._loads, out=self._force)
        return self._force

    def residual(self) -> Array:
        """r(q) into ``r``, ghosts of q being up to date; collective."""
        self.evaluations += 1
        if self.matrix is not None:
            self.matrix.mult(*self._vectors)
            if self.affine is not None:
                self.r += self.affine
            return self.r
        self._r.x.array[:] = 0.0
        fem.assemble_vector(self._r.x.array, self._residual)
        _compat.add_ghosts(self._r)
        return self.r

    def tangent(self, kind: str | None = None, out: Any = None) -> Any:
        """∂r/∂q at q as a PETSc matrix, a new one (of a kind) or into ``out``; collective."""
        self.evaluations += 1
        if self._tangent is None:
            jacobian = self.problem.action.jacobian()
            self._tangent = _compat.form(ufl.replace(jacobian, {self.problem.action.q: self.q}))
        matrix = fem.petsc.create_matrix(self._tangent, kind) if out is None else out
        matrix.zeroEntries()
        fem.petsc.assemble_matrix(matrix, self._tangent)
        matrix.assemble()
        return matrix

    # --- between node records and owned unknowns -------------------------------------------------

    def set(self, records: Array) -> None:
        """Set q, ghosts included, from node records (nodes, n); collective."""
        self.x[:] = self.owned(records)
        self.q.x.scatter_forward()

    def owned(self, records: Array) -> Array:
        """Owned unknowns of node records (nodes, n); collective."""
        disc = self.problem.disc
        values = self._buffer.x.array
        values[:] = 0.0
        values.reshape(-1, self.n)[disc.dof[disc.owned]] = records[disc.owned]
        _compat.accumulate(self._buffer)
        return values[: self.size].copy()

    def blocks(self, records: Array) -> Blocks:
        """Matrices of owned nodes from those of node records (nodes, n, n); collective."""
        if self.problem.masses.diagonal:
            return Blocks(self.owned(np.einsum("aii->ai", records)))
        rows = [self.owned(records[:, i]).reshape(-1, self.n) for i in range(self.n)]
        return Blocks(np.stack(rows, axis=1))

    def write(self, values: Array, records: Array) -> None:
        """Node records (nodes + 1, NR) of owned unknowns; collective."""
        self._buffer.x.array[: self.size] = values
        self._buffer.x.scatter_forward()
        self.read(self._buffer, records)

    def read(self, function: Any, records: Array) -> None:
        """Node records of a Function whose ghosts are up to date."""
        values = function.x.array.reshape(-1, self.n)
        records[:-1, : self.n] = values[self.problem.disc.dof]

    def close(self) -> None:
        """Free PETSc's objects."""
        if self.matrix is not None:
            self.matrix.destroy()
        for function in (self.q, self._r, self._buffer):
            _compat.free_vector(function)
