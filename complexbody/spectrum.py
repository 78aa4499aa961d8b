# SPDX-License-Identifier: LGPL-3.0-or-later
"""The body's own critical step, by SLEPc: the largest eigenvalue of M̂(h)⁻¹K without any matrix.

Sharper than the cells' bound (5 to 30 % on ordinary meshes), at the cost of some hundred force
evaluations. Linear forces only: K is applied by the kernels themselves.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.errors import IntegratorError, MissingPackage, StepError
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


class _Operator:
    """Shell matrix w ↦ S K S w on this rank's counted nodes, S = M̂^(−1/2), fixed parts left out."""

    def __init__(self, problem: Problem, h: float, scheme: str) -> None:
        self.problem, disc, masses = problem, problem.disc, problem.masses
        self.owned = np.flatnonzero(disc.owned)
        values, vectors = np.linalg.eigh(masses.effective(h, scheme))
        root = np.einsum("cij,cj,ckj->cik", vectors, 1.0 / np.sqrt(values), vectors)
        fixed = masses.fixed
        if not masses.diagonal:
            # Only the free block of M̂ counts where some components are prescribed.
            for c in np.flatnonzero(fixed.any(axis=1) & ~fixed.all(axis=1)):
                free = np.flatnonzero(~fixed[c])
                block = masses.effective(h, scheme)[c][np.ix_(free, free)]
                s, v = np.linalg.eigh(block)
                root[c] = 0.0
                root[c][np.ix_(free, free)] = v @ np.diag(1 / np.sqrt(s)) @ v.T
        root = np.where(fixed[:, :, None] | fixed[:, None, :], 0.0, root)
        self.root = root[masses.classes[:-1]] / np.sqrt(disc.volume)[:, None, None]

    def mult(self, _matrix: Any, x: Any, y: Any) -> None:
        """y = S K S x (PETSc calls this)."""
        disc, kernels = self.problem.disc, self.problem.kernels
        full = np.zeros((disc.nodes, disc.n))
        full[self.owned] = x.getArray(readonly=True).reshape(-1, disc.n)
        disc.sum_shared(full)  # copies elsewhere are zero: this spreads the owner's value
        kernels.x[:-1, : disc.n] = np.einsum("aij,aj->ai", self.root, full)
        kernels.forces()
        if kernels.constant is not None:
            kernels.f -= kernels.constant
        force = -kernels.f[:-1, : disc.n]
        disc.sum_shared(force)
        result = np.einsum("aij,aj->ai", self.root, force)
        y.setArray(result[self.owned].ravel())


def largest_eigenvalue(problem: Problem, h: float, scheme: str, tolerance: float = 1e-6) -> float:
    """λ_max of M̂(h)⁻¹K [1/s²]; collective.

    Raises:
        MissingPackage: if slepc4py is not there.
        StepError: if SLEPc does not converge.
    """
    try:
        from petsc4py import PETSc
        from slepc4py import SLEPc
    except ImportError as error:
        raise MissingPackage(
            "critical='global' needs slepc4py. Install it: apt install python3-slepc4py."
        ) from error
    operator = _Operator(problem, h, scheme)
    local = len(operator.owned) * problem.disc.n
    matrix = PETSc.Mat().createPython(((local, None), (local, None)), operator, problem.comm)
    matrix.setUp()
    solver = SLEPc.EPS().create(problem.comm)
    solver.setOperators(matrix)
    solver.setProblemType(SLEPc.EPS.ProblemType.HEP)
    solver.setWhichEigenpairs(SLEPc.EPS.Which.LARGEST_REAL)
    solver.setDimensions(1, 24)
    solver.setTolerances(tolerance, 400)
    # The same start for every run: results must not depend on a random vector.
    start = matrix.createVecRight()
    x = problem.disc.position[operator.owned]
    wave = np.sin(1.0 + 12.9898 * x[:, :1] + 78.233 * x[:, 1:2] + 37.719 * x[:, 2:3])
    start.setArray(np.repeat(wave, problem.disc.n, axis=1).ravel())
    solver.setInitialSpace([start])
    solver.solve()
    converged = solver.getConverged()
    value = solver.getEigenvalue(0).real if converged else np.nan
    for thing in (solver, matrix, start):
        thing.destroy()
    if not converged:
        raise StepError(
            "SLEPc found no largest eigenvalue in 400 restarts. Use critical='cells', whose bound "
            "is always safe."
        )
    return float(value)


def global_step(problem: Problem, scheme: str, bound: float) -> float:
    """The body's own critical step [s], at least the cells' ``bound``; collective.

    With viscosity M̂ depends on h: h²λ(h) = 4 is then found by iteration from below.

    Raises:
        IntegratorError: for forces that are not linear.
    """
    if not problem.kernels.densities.linear:
        raise IntegratorError(
            "critical='global' needs linear forces, and this body's are not. Use critical='cells'."
        )
    h, tolerance = bound, 1e-6
    x = problem.kernels.x.copy()
    for _ in range(30):
        ratio = 4.0 / (h * h * largest_eigenvalue(problem, h, scheme, tolerance))
        # Lanczos approaches λ from below: leave a margin of its tolerance.
        ratio *= 1 - 10 * tolerance
        if not problem.masses.damped or scheme == "symmetric":
            h *= np.sqrt(ratio)
            break
        h *= np.sqrt(ratio) if ratio > 1 else ratio
        if abs(ratio - 1) < 20 * tolerance:
            break
    problem.kernels.x[:] = x
    return max(float(h), bound)
