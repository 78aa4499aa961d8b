# SPDX-License-Identifier: LGPL-3.0-or-later
"""Densities that are not quadratic: FFCx's kernels and what they read.

A density's energy, first and second derivative are compiled by dolfinx; their ``tabulate_tensor``
is called by our own loop (``tabulated.h``). The unknowns (u, ν) of a cell come from the node
records; every other coefficient is packed once.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import cffi
import numpy as np

from complexbody import _compat, native
from complexbody.action import Action
from complexbody.discretisation import Discretisation
from complexbody.errors import BodyError


class TabulatedRecord(ctypes.Structure):
    """Mirror of ``tabulated`` in tabulated.h."""

    _fields_ = (
        ("function", ctypes.c_void_p),
        ("before", ctypes.c_int64),
        ("after", ctypes.c_int64),
        ("unknowns", ctypes.c_int64),
        ("pack", ctypes.c_void_p),
        ("corners", ctypes.c_void_p),
        ("constants", ctypes.c_void_p),
    )


class Tabulated:
    """One compiled form (rank 0, 1 or 2) of a density, ready for the loops.

    Args:
        action: The scene's action, whose function ``q`` stands for the unknowns.
        disc: Its arrays.
        density: UFL density of the mixed function q.
        degree: Quadrature degree, or None for UFL's estimate.
        rank: 0 energy, 1 first derivative, 2 second derivative.
        form: A UFL form to use instead of those of a density.

    Raises:
        BodyError: if the density reads a Function the packing does not know.
    """

    def __init__(
        self,
        action: Action,
        disc: Discretisation,
        density: Callable[[Any], Any] | None = None,
        degree: int | None = None,
        rank: int = 0,
        form: Any = None,
    ) -> None:
        if form is None:
            assert density is not None
            form = action.kernel_form(density, degree, rank)
        self.record = TabulatedRecord()
        self._keep: list[Any] = []
        # A derivative that vanishes identically has no integral at all.
        compiled = _compat.form(form) if not form.empty() else None
        found = _compat.integrals(compiled, 0) if compiled is not None else []
        if not found:
            return
        integral = found[0][1]
        address = integral.tabulate_tensor_float64
        self.record.function = int(cffi.FFI().cast("uintptr_t", address))
        before: list[Any] = []
        after: list[Any] = []
        target = before
        coefficients = form.coefficients()
        for position in _compat.coefficient_positions(compiled):
            if coefficients[position] is action.q:
                self.record.unknowns = 1
                target = after
            else:
                target.append(self._pack(coefficients[position], disc))
        self.record.before = sum(p.shape[1] for p in before)
        self.record.after = sum(p.shape[1] for p in after)
        packs = np.concatenate(
            [*before, *after, np.zeros((len(disc.source_cell) * disc.lanes, 0))], 1
        )
        constants = [np.ravel(np.asarray(c.value, dtype=np.float64)) for c in form.constants()]
        # FFCx never reads past what it needs, but the pointers must be valid.
        self._keep = [
            np.ascontiguousarray(packs),
            np.concatenate([*constants, np.zeros(1)]),
            compiled,
        ]
        self.record.pack = self._keep[0].ctypes.data if packs.size else self._keep[1].ctypes.data
        if disc.corners is not None:
            self._keep.append(disc.corners)
            self.record.corners = disc.corners.ctypes.data
        self.record.constants = self._keep[1].ctypes.data

    @staticmethod
    def _pack(function: Any, disc: Discretisation) -> Any:
        if not hasattr(function, "x") or getattr(
            function.function_space.element, "needs_dof_transformations", False
        ):
            raise BodyError(
                f"The energy reads {function}, which cannot be packed cell by cell. Interpolate it "
                "into a Lagrange or DG space."
            )
        dofs = _compat.cell_dofs(function.function_space)
        lanes = np.where(disc.source_cell < 0, 0, disc.source_cell).ravel()
        size = function.function_space.dofmap.index_map_bs
        values = function.x.array.reshape(-1, size)[dofs[lanes]]
        return values.reshape(len(lanes), dofs.shape[1] * size)  # also of no cells


def header() -> str:
    """Source of the loops over tabulated cells."""
    return native.template("tabulated.h")
