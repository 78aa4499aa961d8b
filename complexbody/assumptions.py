# SPDX-License-Identifier: LGPL-3.0-or-later
"""A1 of a scene made ready: is its energy coercive, what does it leave free, will cells lock?

Densities that are not quadratic are not looked at: their Hessian depends on the state.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.algorithms import expand_derivatives
from ufl.classes import Zero

from complexbody import _compat, coercivity
from complexbody.errors import CoercivityError, agree

if TYPE_CHECKING:
    from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


def hessian_samples(problem: Problem, number: int) -> Array:
    """H of ρe of region ``number`` at its distinct coefficients, shape (samples, 4n, 4n).

    A density that is not quadratic gives no sample: its Hessian depends on the state.
    """
    n = problem.disc.n
    stored, d = problem.kernels.densities.stored[number], problem.kernels.densities
    if stored is None or not (d.generated[number] or not stored.expressions()):
        return np.zeros((0, 4 * n, 4 * n))
    samples = np.zeros((1, len(d.coefficients)))
    if stored.expressions():
        blocks = problem.kernels.coefficients[problem.disc.region == number]
        real = problem.disc.source_cell[problem.disc.region == number] >= 0
        samples = np.unique(blocks.transpose(0, 2, 1)[real], axis=0)
    out = np.zeros((len(samples), 4 * n, 4 * n))
    for (i, j), value in stored.hessian.items():
        if isinstance(value, float):
            out[:, i, j] = value
        else:
            out[:, i, j] = samples[:, d.coefficients.index(value)]
    return out


def _outer_samples(problem: Problem, number: int) -> Array | None:
    """∂²(ρw)/∂ν∂ν of region ``number``, shape (samples, k, k); None without a potential.

    Where it depends on the state or on the place: at the initial one, at the cells' vertices.
    """
    scene, w = problem.scene, problem.kernels.densities.potential[number]
    k = scene.descriptor
    body, first = scene.bodies[number], 3 * problem.disc.n + scene.displacement
    if body.potential is None:
        return None
    if w is not None and not w.expressions():
        own = np.zeros((1, k, k))
        for (i, j), value in w.hessian.items():
            if min(i, j) >= first:
                own[0, i - first, j - first] = value
        return own
    q = fem.Function(problem.action.space)
    problem.disc.scatter(problem.initial_fields, q)
    u, nu = problem.action.fields(q)[:2]
    nu = ufl.variable(nu)
    second = expand_derivatives(ufl.diff(ufl.diff(body.potential(u, nu), nu), nu))
    if isinstance(second, Zero):  # which FFCx does not compile
        return None
    entries = ufl.as_vector([second[i, j] for i in range(k) for j in range(k)])
    compiled = _compat.expression(entries, _compat.vertex_space(scene.mesh))
    cells = np.flatnonzero(scene.regions() == number).astype(np.int32)
    return _compat.evaluate(compiled, scene.mesh, cells).reshape(-1, k, k)


def check_energy(problem: Problem) -> list[str]:
    """A1 and locking of every quadratic region; what is found is told on rank 0."""
    notes: list[str] = []
    for r, body in enumerate(problem.scene.bodies):
        samples, shape = hessian_samples(problem, r), (problem.scene.displacement, problem.disc.dim)
        ratio = coercivity.locking_ratio(samples, *shape)
        ratio = problem.comm.allreduce(ratio, op=MPI.MAX)
        # Coefficients differ between ranks, and so may what they leave free.
        modes = _null_modes(problem, r, samples)
        if any(problem.comm.allgather(bool(modes))):
            modes = _null_modes(problem, r, samples, _outer_samples(problem, r))
        every = [mode for part in problem.comm.allgather(modes) for mode in part]
        notes += [
            f"The energy of {body.name} does not see the mode {mode}: only inertia, supports "
            "or loads hold it."
            for mode in dict.fromkeys(every)
        ]
        if ratio >= coercivity.LOCKING:
            notes.append(
                f"The energy of {body.name} is nearly incompressible: volume changes cost as "
                f"much as with λ/μ = {ratio:.3g}, and P1 cells lock from about "
                f"{coercivity.LOCKING:g} on: shear and bending come out too stiff. Use a "
                "smaller bulk modulus, or refine until results stay."
            )
    if problem.comm.rank == 0:
        for note in notes:
            warnings.warn(note, UserWarning, stacklevel=2)
    return notes


def _null_modes(
    problem: Problem, number: int, samples: Array, outer: Array | None = None
) -> list[str]:
    """Null modes of a region on this rank, in words; collective.

    Raises:
        CoercivityError: on all ranks if it is not coercive on one.
    """
    scene, error, modes = problem.scene, None, []
    name = scene.bodies[number].name
    try:
        if len(samples):
            modes = coercivity.check_coercive(
                samples, scene.displacement, scene.descriptor, problem.disc.dim, name, outer
            )
    except CoercivityError as found:
        error = found
    agree(problem.comm, error)
    return modes
