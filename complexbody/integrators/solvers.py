# SPDX-License-Identifier: LGPL-3.0-or-later
"""What implicit peers solve with: the matrix mM + dD + k ∂r/∂q, and PETSc options of their own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc

from complexbody.errors import IntegratorError

if TYPE_CHECKING:
    from complexbody.integrators.peer_run import PeerRun

#: Linear solvers of implicit peers, by default.
KRYLOV = {
    "ksp_type": "cg", "ksp_norm_type": "unpreconditioned", "ksp_max_it": "10000",
    "pc_type": "bjacobi", "sub_pc_type": "icc",
}  # fmt: skip


#: KSPConvergedReason below zero, in words.
LINEAR = {
    -3: "it does not converge within the allowed iterations", -4: "it diverges",
    -5: "it broke down", -8: "the preconditioner is not positive definite",
    -9: "values are not finite", -10: "the matrix is not positive definite",
    -11: "the preconditioner failed",
}  # fmt: skip


def unsolved(reason: int) -> str:
    """Why a linear solver failed, in words."""
    return f"the linear solver failed: {LINEAR.get(int(reason), f'reason {reason}')}"


def last_line(error: Any) -> str:
    """What PETSc says of an error, without where it happened."""
    return str(error).strip().splitlines()[-1].split("] ")[-1].rstrip(".")


@contextmanager
def options(prefix: str, defaults: Mapping[str, str], given: Mapping[str, str]) -> Iterator[None]:
    """PETSc options for a ``setFromOptions`` inside: what is given, else PETSc's, else defaults.

    Raises:
        IntegratorError: for options that PETSc does not take.
    """
    database = PETSc.Options(prefix)
    mine = {name: value for name, value in defaults.items() if not database.hasName(name)}
    mine |= dict(given)
    for name, value in mine.items():
        database.setValue(name, value)
    try:
        yield
    except PETSc.Error as error:
        raise IntegratorError(
            f"PETSc does not take its options: {last_line(error)}. Change options={dict(given)} or "
            f"those on its command line that begin with {prefix}."
        ) from error
    finally:
        for name in mine:
            database.delValue(name)


class Operator:
    """The matrix mM + dD + k ∂r/∂q of a run, prescribed rows and columns taken out; collective.

    Attributes:
        matrix: PETSc's, of type AIJ.
        diagonal: What stands on the diagonal of prescribed rows, of the size of the masses.
    """

    def __init__(self, run: PeerRun) -> None:
        self.run, system = run, run.system
        self.matrix = system.tangent("aij")
        masses = run.mass.values
        own = masses if run.mass.diagonal else np.einsum("aii->ai", masses)
        comm = run.problem.comm
        count = comm.allreduce(system.size)
        self.diagonal = comm.allreduce(float(own.sum())) / max(count, 1)
        self._factors: tuple[float, float, float] | None = None

    def build(self, m: float, d: float, k: float) -> None:
        """Make the matrix at the system's q, unless it is there already."""
        run, system = self.run, self.run.system
        if system.linear and self._factors == (m, d, k):
            return
        self._factors = (m, d, k)
        if system.matrix is not None:
            system.matrix.copy(self.matrix, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        else:
            system.tangent(out=self.matrix)
        self.matrix.scale(k)
        run.mass.add_to(self.matrix, m)
        if run.damping is not None:
            run.damping.add_to(self.matrix, d)
        self.matrix.zeroRowsColumnsLocal(system.fixed, self.diagonal)

    def close(self) -> None:
        """Free the matrix."""
        self.matrix.destroy()
