# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Axes along which nothing varies: a scene on the cross-section gives the same fields.

Fields that do not vary along an axis e stay so if the body is a prism along e, its data do not vary
along e, and at the two ends, for the live components that are free there (o) and held at zero (c),
forces do not bend them: H has no entry between ∂_e o and anything of o but its ∂_e (so that natural
conditions hold), and none between c, but for its ∂_e, and o (so that c stays zero). Data are looked
at as the user gave them: callables at points moved along e. What cannot be looked at (tags, data
given as Functions, densities that are not quadratic), absorbing boundaries and mirrors leave the
question open.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat
from complexbody.body import Body
from complexbody.problem import Problem
from complexbody.scene import BodyForce, Fix, PointSource, Pressure

Array = npt.NDArray[np.float64]
AXES = "xyz"


def invariant_axes(problem: Problem) -> list[int]:
    """Axes (0, 1, 2) of the mesh along which no field of the scene varies; collective."""
    scene, dim = problem.whole, problem.disc.dim
    if scene.identified is not None and not scene.identified.boxed:
        return []  # a vector may lead out of the cross-section
    if dim == 1 or not isinstance(scene.body, Body) or not problem.kernels.densities.generated[0]:
        return []
    if problem.kernels.densities.coefficients or hasattr(scene.body.density, "function_space"):
        return []
    found = []
    for axis in range(dim):
        # Ranks see different nodes: each answer is made common before the next question.
        for question in (_prism, _data, _ends):
            if not problem.comm.allreduce(bool(question(problem, axis)), op=MPI.LAND):
                break
        else:
            found.append(axis)
    return found


def _over_ranks(comm: Any, values: Any, op: Any) -> npt.NDArray[np.bool_]:
    """True where all (MPI.MIN) or any (MPI.MAX) ranks have it."""
    out = np.array(values, dtype=np.int64)
    comm.Allreduce(MPI.IN_PLACE, out, op=op)
    return out > 0


def _range(problem: Problem, axis: int) -> tuple[float, float]:
    x = problem.whole.mesh.geometry.x[:, axis]
    low = problem.comm.allreduce(float(x.min(initial=np.inf)), op=MPI.MIN)
    return low, problem.comm.allreduce(float(x.max(initial=-np.inf)), op=MPI.MAX)


def _facets(problem: Problem) -> tuple[Array, Array]:
    """Corners of this rank's exterior facets (facets, d, 3), and their measures."""
    mesh, dim = problem.whole.mesh, problem.disc.dim
    facets = _compat.exterior_facets(mesh)
    nodes = _compat.facet_nodes(mesh, facets)
    corners = mesh.geometry.x[nodes].reshape(-1, dim, 3)
    edges = corners[:, 1:] - corners[:, :1]
    gram = np.einsum("fai,fbi->fab", edges, edges)
    return corners, np.sqrt(np.linalg.det(gram)) / (1.0 if dim == 2 else 2.0)


def _prism(problem: Problem, axis: int) -> bool:
    """Whether the volume is that of either end times the length."""
    disc, comm = problem.disc, problem.comm
    low, high = _range(problem, axis)
    corners, measure = _facets(problem)
    real = disc.source_cell >= 0
    volume = comm.allreduce(float(np.sum(disc.geometry[:, -1, :][real] ** 2)))
    for end in (low, high):
        there = np.all(np.abs(corners[:, :, axis] - end) < 1e-9 * (high - low), axis=1)
        area = comm.allreduce(float(measure[there].sum()))
        if abs(area * (high - low) - volume) > 1e-9 * volume:
            return False
    return True


def _same(function: Any, x: Array, axis: int, low: float, high: float) -> bool:
    """Whether a callable of x (3, npts) has the same values at points moved along the axis."""
    if not callable(function):
        return not hasattr(function, "function_space")
    here = np.asarray(function(x), dtype=np.float64)
    for fraction in (0.137, 0.5, 0.811):
        moved = x.copy()
        moved[axis] = low + fraction * (high - low)
        there = np.asarray(function(moved), dtype=np.float64)
        scale = np.abs(here).max(initial=0.0)
        if here.shape != there.shape or np.abs(here - there).max(initial=0.0) > 1e-14 * scale:
            return False
    return True


def _data(problem: Problem, axis: int) -> bool:
    """Whether initial data, loads and supports do not vary; ends may hold components at zero."""
    scene = problem.whole
    low, high = _range(problem, axis)
    x = np.array(scene.mesh.geometry.x).T
    tiny = 1e-9 * (high - low)
    inner = x[:, (x[axis] > low + tiny) & (x[axis] < high - tiny)]
    values = [scene.initial.u, scene.initial.nu, scene.initial.u_dot, scene.initial.nu_dot]
    if scene.absorbing:
        return False
    for load in scene.loads:
        if isinstance(load, PointSource):
            return False
        if isinstance(load, BodyForce):
            if load.where is not None:
                return False
        elif not callable(load.where) or not _same(load.where, x, axis, low, high):
            return False
        values.append(0.0 if isinstance(load, Pressure) else load.vector)
    for fix in scene.supports:
        if not isinstance(fix, Fix):
            return False
        if not callable(fix.where) or not _same(fix.value, x, axis, low, high):
            return False
        if not _at_ends(fix, x, axis, low, high) and not _same(fix.where, inner, axis, low, high):
            return False
    return all(value is None or _same(value, x, axis, low, high) for value in values)


def _at_ends(fix: Fix, x: Array, axis: int, low: float, high: float) -> bool:
    """Whether a support holds zero at ends only, all of them or none."""
    mask, tiny = np.asarray(fix.where(x)) != 0, 1e-9 * (high - low)  # type: ignore[operator]
    first, last = np.abs(x[axis] - low) < tiny, np.abs(x[axis] - high) < tiny
    zero = not callable(fix.value) and not np.any(fix.value)
    whole = all(mask[end].all() or not mask[end].any() for end in (first, last))
    return bool(zero and whole and not mask[~(first | last)].any())


def _ends(problem: Problem, axis: int) -> bool:
    """Whether H lets fields be even along the axis, with what is held at both ends at zero."""
    if problem.whole.identified is not None and axis in problem.whole.identified.axes:
        return True  # there are none
    low, high = _range(problem, axis)
    tiny, n, comm = 1e-9 * (high - low), problem.disc.n, problem.comm
    x, fixed = problem.whole.mesh.geometry.x[:, axis], problem.supports.fixed
    still = problem.supports.value == 0
    every, some = np.ones(n, bool), np.zeros(n, bool)
    for end in (low, high):
        there = np.abs(x - end) < tiny
        every &= np.all((fixed & still)[there], axis=0)
    held = _over_ranks(comm, every, MPI.MIN)
    for end in (low, high):
        # Held at an end where sides are not: that bends a free component.
        there = np.abs(x - end) < tiny
        at, off = (_over_ranks(comm, np.any(fixed[i], axis=0), MPI.MAX) for i in (there, ~there))
        some |= at & ~off
    if np.any(some & ~held):
        return False
    # What starts or is driven is no field that stays zero.
    moved = np.zeros(n, dtype=int)
    for values in problem.start:
        moved[np.any((values != 0) & ~fixed, axis=0)] = 1
    moved[problem.loads.component] = 1
    if np.any(held & _over_ranks(comm, moved, MPI.MAX)):
        return False

    def kind(i: int) -> tuple[int, bool, bool]:
        """Component, whether ∂_axis, whether held at both ends."""
        c = i // 3 if i < 3 * n else i - 3 * n
        return c, i < 3 * n and i % 3 == axis, bool(held[c])

    densities = problem.kernels.densities
    for part in (densities.stored[0], densities.potential[0]):
        for i in part.linear if part is not None else ():
            _, along, zero = kind(i)
            if along != zero:
                return False
    for i, j in densities.total(0):
        (_, along, zero), (_, other_along, other_zero) = kind(i), kind(j)
        if other_along or other_zero:
            continue  # that unknown vanishes
        if (along and not zero) or (zero and not along):
            return False
    return True
