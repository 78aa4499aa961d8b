# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Largest eigenvalue of every cell's lumped pencil, W cells at a time.

The stable step of a cell follows from the largest λ of K_K x = λ M_K x with its stiffness K_K and
lumped mass M_K = |K|/(d+1) diag(μ): the largest eigenvalue of S K_K S, S = M_K^{-1/2}. It is never
estimated from below (power iterations would give an unstable step): a Householder reduction, then
an enclosure of the largest root of the characteristic polynomial, returned by its upper end.

For a quadratic density the matrix is built in modes between the vertices, orthogonal to each other,
in which the mean value of each component separates from its d gradient modes,

    A_gg = P H_GG Pᵀ + w I⊗H_vv,  A_gv = P H_Gv,  A_vv = H_vv,

with P_c = √(d+1) (B_c + τ Σ_a B_a), τ = (√(d+1) − 1)/d, w = 1/(d+2) or 1 if lumped. Translations
and components that H does not couple fall apart into matrices of their own. Knows H and d, no mesh.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from ctypes import CDLL, c_double, c_int64
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import native

Array = npt.NDArray[np.float64]


@functools.cache
def _library(lanes: int, dim: int) -> CDLL:
    if lanes not in (4, 8):
        raise ValueError(f"Cells are worked on 4 or 8 at a time, not {lanes}.")
    folder = Path(__file__).parent
    source = [f"#define W {lanes}", f"#define NR {lanes}", f"#define DIM {dim}"]
    source += [(folder / name).read_text() for name in ("vectors.h", "pencil.c")]
    return native.load("\n".join(source), native.FULL)


def quadratic_eigenvalues(
    geometry: Array,
    hessian: Mapping[tuple[int, int], float | int],
    n: int,
    dim: int,
    lumped: bool,
    scale: Array,
    coefficients: Array | None = None,
) -> Array:
    """Largest eigenvalue of S K_K S for P1 cells whose energy is ½ g·Hg with H constant on each.

    Args:
        geometry: Shape (blocks, rows, W): B_a √|K| at row (a−1)d + j for a = 1 … d, then √|K|.
            Cells of zeros (padding) get the eigenvalue 0.
        hessian: H by (row, column), both triangles: ∂_j q_i at 3i + j, q_i at 3n + i. An entry is
            a number, or an integer: its index in ``coefficients``.
        n: Components per node.
        dim: Dimension d of the mesh.
        lumped: Whether the value-value part of H is lumped at the vertices.
        scale: μ^(−1/2) by component, for all cells (n,) or cell by cell (blocks, n, W).
        coefficients: Entries that vary from cell to cell, shape (blocks, count, W).

    Returns:
        λ by cell, shape (blocks · W,); nan where the input is not finite.

    Raises:
        ValueError: if the geometry has no row √|K|, or arrays do not fit together.
    """
    blocks, rows, lanes = geometry.shape
    if rows <= dim * dim:
        raise ValueError(f"The geometry has {rows} rows, and the pencil needs √|K| at {dim * dim}.")
    given = np.zeros((blocks, 0, lanes)) if coefficients is None else coefficients
    count = given.shape[1]
    indices = [v for v in hessian.values() if isinstance(v, int | np.integer)]
    if given.shape != (blocks, count, lanes) or any(not 0 <= i < count for i in indices):
        raise ValueError(f"H names coefficients that the array {given.shape} does not have.")
    shared = scale.ndim == 1
    if scale.shape not in ((n,), (blocks, n, lanes)):
        raise ValueError(f"The scale has shape {scale.shape}, not {(n,)} or {(blocks, n, lanes)}.")
    each = np.ascontiguousarray(np.repeat(scale, lanes) if shared else scale, np.float64)
    given, shapes = (np.ascontiguousarray(a, np.float64) for a in (given, geometry))
    entries = {
        (int(row), int(column)): value
        for (row, column), value in hessian.items()
        if (isinstance(value, int | np.integer) or value != 0.0)
        and all(i >= 3 * n or i % 3 < dim for i in (row, column))
    }
    library = _library(lanes, dim)
    groups, idle = _groups(entries, n)
    # A mode without any energy has the eigenvalue 0.
    result = np.full(blocks * lanes, 0.0 if idle else -np.inf)
    for members in groups:
        table, direction, values, m = _tables(members, entries, n, dim)
        vary = [(i, v) for i, v in enumerate(values) if isinstance(v, int | np.integer)]
        slots = np.array(vary, np.int32).reshape(-1, 2)
        entry = native.aligned((len(values), lanes))
        entry[:] = np.array(values, np.float64)[:, None]
        scratch = native.aligned((m * (m + 1) // 2 + 5 * m, lanes))
        library.cb_quadratic_pencil(
            c_int64(blocks), c_int64(rows), native.pointer(shapes),
            c_int64(count), native.pointer(given),
            c_int64(0 if shared else n * lanes), native.pointer(each),
            c_int64(m), c_int64(len(table)), native.pointer(table), native.pointer(direction),
            native.pointer(entry), c_int64(len(slots)), native.pointer(slots),
            c_double(1.0 if lumped else 1.0 / (dim + 2)), native.pointer(scratch),
            native.pointer(result),
        )  # fmt: skip
    return result


def _groups(entries: Mapping[tuple[int, int], Any], n: int) -> tuple[list[list[int]], bool]:
    """Members that H couples: i stands for the gradient modes of q_i, n + i for its mean value.

    Returns:
        The groups, and whether some member has no energy at all.
    """
    links = []
    for key in entries:
        i, k = (x // 3 if x < 3 * n else x - 2 * n for x in key)
        links.append((i, k))
        if i >= n and k >= n:
            links.append((i - n, k - n))  # gradient modes are values, too
    group = list(range(2 * n))
    for i, k in links * (2 * n):  # labels spread over one link or more each time
        group[i] = group[k] = min(group[i], group[k])
    live = sorted({i for link in links for i in link})
    return [[i for i in live if group[i] == g] for g in live if group[g] == g], len(live) < 2 * n


def _tables(
    members: list[int], entries: Mapping[tuple[int, int], Any], n: int, dim: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32], list[Any], int]:
    """Parts of a group's matrix as pencil.c reads them, directions and values of their entries, m.

    Args:
        members: The group, gradients first.
        entries: Non-zeros of H.
        n: Components per node.
        dim: Dimension of the mesh.
    """
    at = np.cumsum([0] + [dim if i < n else 1 for i in members])
    table: list[list[int]] = []
    direction: list[int] = []
    values: list[Any] = []
    for x, i in enumerate(members):
        for y, k in enumerate(members[: x + 1]):
            left = range(3 * i, 3 * i + dim) if i < n else (2 * n + i,)
            start = [len(values)]
            for column in range(3 * k, 3 * k + dim):
                found = [j for j, row in enumerate(left) if k < n and (row, column) in entries]
                direction += found
                values += [entries[left[j], column] for j in found]
                start.append(len(values))
            kind, both, slot = (i >= n) + (k >= n), (3 * n + i % n, 3 * n + k % n), -1
            if kind != 1 and both in entries:
                slot = len(values)
                direction.append(0)
                values.append(entries[both])
            table.append([at[x], at[y], i % n, k % n, kind, slot, *start])
    return np.array(table, np.int32), np.array(direction, np.int32), values, int(at[-1])


def matrix_eigenvalues(matrices: Array, scale: Array, lanes: int | None = None) -> Array:
    """Largest eigenvalue of diag(s) A diag(s) for given symmetric matrices A.

    Args:
        matrices: Shape (cells, m, m).
        scale: s, the same for all cells (m,) or cell by cell (cells, m).
        lanes: Cells at a time; :func:`complexbody.native.lanes` if None.

    Returns:
        λ by cell, shape (cells,); nan where A or s is not finite.
    """
    lanes = lanes or native.lanes()
    matrices = np.ascontiguousarray(matrices, np.float64)
    scale = np.ascontiguousarray(scale, np.float64)
    cells, m = matrices.shape[:2]
    result = np.zeros(cells)
    scratch = native.aligned((m * (m + 1) // 2 + 7 * m, lanes))
    _library(lanes, 0).cb_matrix_pencil(
        c_int64(cells), c_int64(m), native.pointer(matrices), native.pointer(scale),
        c_int64(0 if scale.ndim == 1 else m), native.pointer(scratch), native.pointer(result),
    )  # fmt: skip
    return result
