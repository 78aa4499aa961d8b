# SPDX-License-Identifier: LGPL-3.0-or-later
r"""The stiffness of ν at frozen u, ∂²V/∂ν∂ν, as a PETSc matrix over this run's own nodes.

Element matrices come from what the forces come from (the Hessian's entries, or FFCx's second
derivative), so that matrix and forces fit to round-off, a lumped self-action included.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from complexbody import native
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]

#: Blocks of cells tabulated at a time: bounds the memory of whole element matrices.
PIECE = 512


class NuStiffness:
    """c·∂²V/∂ν∂ν + nodal k×k matrices, rows of prescribed components those of the identity.

    Args:
        problem: The scene, made ready.

    Attributes:
        owned: This rank's counted nodes; their unknowns, node by node, are the local rows.
        free: True for free local rows.
        matrix: The matrix, symmetric (AIJ).
        constant: Whether it is the same for all states.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, disc = problem, problem.disc
        self.k = k = problem.scene.descriptor
        self.owned = np.flatnonzero(disc.owned)
        self.size = len(self.owned) * k
        first = problem.comm.exscan(len(self.owned)) or 0
        number = np.zeros((disc.nodes, 1))
        number[self.owned, 0] = first + np.arange(len(self.owned))
        disc.sum_shared(number)  # copies elsewhere are zero: this spreads the owner's number
        fixed = problem.masses.fixed[problem.masses.classes[:-1], disc.n - k :]
        self.free = ~fixed[self.owned].ravel()
        rows = number.astype(np.int64) * k + np.arange(k)
        # PETSc leaves negative rows and columns out: those of supports, and of padding cells.
        rows = np.concatenate([np.where(fixed, -1, rows), np.full((1, k), -1)])
        self._nodal = rows[self.owned].astype(PETSc.IntType)
        self._cell = np.ascontiguousarray(
            rows[disc.cells.transpose(0, 2, 1)].reshape(-1, (disc.dim + 1) * k), PETSc.IntType
        )
        self.constant = problem.kernels.densities.linear
        self.matrix = self._create(first)

    def _create(self, first: int) -> Any:
        """An empty matrix with room for all neighbours of a node."""
        disc, k = self.problem.disc, self.k
        corners = disc.cells.transpose(0, 2, 1).reshape(-1, disc.dim + 1)
        m, pair = corners.shape[1], np.int64(disc.nodes + 1)
        links = np.repeat(corners, m, axis=1).astype(np.int64) * pair + np.tile(corners, (1, m))
        links = np.unique(links)
        near = np.bincount(links // pair, minlength=disc.nodes + 1)[:-1, None]
        room = near.astype(np.float64)
        disc.sum_shared(room)  # at least as many as there are
        # Neighbours that others own: of shared nodes perhaps all.
        elsewhere = np.append(~disc.owned, False)[links % pair]
        apart = np.bincount(links[elsewhere] // pair, minlength=disc.nodes + 1)[:-1]
        apart[disc.late : disc.late + disc.shared] = room[disc.late : disc.late + disc.shared, 0]
        wanted, beyond = (
            np.repeat(count[self.owned] * k, k).astype(PETSc.IntType)
            for count in (room[:, 0], apart)
        )  # fmt: skip
        matrix = PETSc.Mat().create(self.problem.comm)
        matrix.setSizes(((self.size, None), (self.size, None)))
        matrix.setBlockSize(k)
        matrix.setType("aij")
        matrix.setPreallocationNNZ((np.minimum(wanted, max(self.size, 1)), beyond))
        matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._diagonal = (first * k + np.arange(self.size))[~self.free].astype(PETSc.IntType)
        return matrix

    def assemble(self, factor: float, nodal: Array, x: Array) -> None:
        """Matrix = factor ∂²V/∂ν∂ν at x (node records) + ``nodal`` (nodes, k, k); collective."""
        disc, A = self.problem.disc, self.matrix
        A.zeroEntries()
        add = PETSc.InsertMode.ADD_VALUES
        lanes = disc.lanes
        for r in range(len(self.problem.scene.bodies)):
            mine = np.flatnonzero(disc.region == r)
            for run in np.split(mine, np.flatnonzero(np.diff(mine) > 1) + 1):
                for at in range(0, len(run), PIECE):
                    blocks = run[at : at + PIECE]
                    cells = slice(int(blocks[0]) * lanes, (int(blocks[-1]) + 1) * lanes)
                    values = factor * self._elements(r, blocks, x)
                    A.setValuesRCV(self._cell[cells], self._cell[cells], values, add)
        A.setValuesRCV(self._nodal, self._nodal, np.ascontiguousarray(nodal[self.owned]), add)
        for row in self._diagonal:
            A.setValue(row, row, 1.0, add)
        A.assemble()

    def _elements(self, number: int, blocks: Any, x: Array) -> Array:
        """∂²V_K/∂ν∂ν of neighbouring blocks of one region, (cells, (d+1)k, (d+1)k)."""
        if self.problem.kernels.densities.generated[number]:
            return self._quadratic(number, blocks)
        return self._tabulated(number, blocks, x)

    def _quadratic(self, number: int, blocks: Any) -> Array:
        """From the Hessian's entries and the cells' shape gradients."""
        problem, disc, k = self.problem, self.problem.disc, self.k
        n, n_u, d, W = disc.n, problem.scene.displacement, disc.dim, disc.lanes
        known = problem.kernels.densities.coefficients
        given = problem.kernels.coefficients[blocks] if known else np.zeros(0)
        B = np.empty((len(blocks), d + 1, d, W))  # B_a √|K|
        B[:, 1:] = disc.geometry[blocks, :-1].reshape(-1, d, d, W)
        B[:, 0] = -B[:, 1:].sum(axis=1)
        root = disc.geometry[blocks, -1]
        weights = (np.eye(d + 1) + 1) / ((d + 1) * (d + 2))
        if problem.scene.lumped:
            weights = np.eye(d + 1) / (d + 1)
        mass = weights[None, :, :, None] * root[:, None, None] ** 2
        out = np.zeros((len(blocks), W, d + 1, k, d + 1, k))
        for (i, j), parts in problem.kernels.densities.total(number).items():
            (a, p), (b, q) = (self._place(m, n, n_u) for m in (i, j))
            if min(a, b) < 0 or max(p, q) >= d:
                continue
            entry = sum(
                v if isinstance(v, float) else given[:, known.index(v), None, None] for v in parts
            )
            if p < 0 and q < 0:
                product = mass
            else:
                mean = np.broadcast_to(root[:, None] / (d + 1), B[:, :, 0].shape)
                left, right = (B[:, :, m] if m >= 0 else mean for m in (p, q))
                product = left[:, :, None] * right[:, None, :]
            out[:, :, :, a, :, b] += (entry * product).transpose(0, 3, 1, 2)
        return out.reshape(len(blocks) * W, (d + 1) * k, (d + 1) * k)

    @staticmethod
    def _place(index: int, n: int, n_u: int) -> tuple[int, int]:
        """(component of ν, direction) of an entry of g; direction −1: the value; (−1, 0): of u."""
        if index >= 3 * n:
            return max(index - 3 * n - n_u, -1), -1
        return max(index // 3 - n_u, -1), index % 3

    def _tabulated(self, number: int, blocks: Any, x: Array) -> Array:
        """By FFCx's second derivative, at the state x."""
        disc, kernels = self.problem.disc, self.problem.kernels
        m, n, k = disc.dim + 1, disc.n, self.k
        if not hasattr(self, "_forms"):
            self._forms: dict[int, Any] = {}
        if number not in self._forms:
            self._forms[number] = kernels.second_derivative(number)
        cells = np.ascontiguousarray(disc.cells[blocks])
        part = np.zeros((len(blocks) * disc.lanes, m * n, m * n))
        kernels.c.cb_tabulated_matrices(
            ctypes.byref(self._forms[number].record), ctypes.c_int64(disc.nodes),
            ctypes.c_int64(len(blocks)), ctypes.c_int64(int(blocks[0])), native.pointer(cells),
            native.pointer(x), native.pointer(disc.position), native.pointer(part),
        )  # fmt: skip
        own = part.reshape(-1, m, n, m, n)[:, :, n - k :, :, n - k :]
        return own.reshape(len(part), m * k, m * k)

    # --- vectors -------------------------------------------------------------------------------

    def local(self, values: Array) -> Array:
        """Nodal values (nodes, k) as local unknowns."""
        return values[self.owned].ravel()

    def spread(self, local: Array) -> Array:
        """Local unknowns as values of all of this rank's nodes (nodes, k); collective."""
        out = np.zeros((self.problem.disc.nodes, self.k))
        out[self.owned] = local.reshape(-1, self.k)
        self.problem.disc.sum_shared(out)
        return out

    def close(self) -> None:
        """Free the matrix."""
        self.matrix.destroy()
