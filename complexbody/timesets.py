# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stable steps: of every cell by its own pencil, and of the whole body.

For the recursion of :mod:`complexbody.masses` a step h is stable iff 4M̂(h) − h²K ≻ 0. If each cell
satisfies it with its share of the lumped masses, so does their sum: the smallest elemental step is
a bound. It is exact for a cell alone, and safe for the body.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from complexbody import _compat, native
from complexbody.errors import IntegratorError, StepError
from complexbody.guards import cell_place, lowest
from complexbody.kernels.ffcx import Tabulated
from complexbody.kernels.pencil import matrix_eigenvalues, quadratic_eigenvalues
from complexbody.masses import Masses, effective, pencil_basis
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]

#: In the place of a dissipation scheme: ν is held (an infinite inertia), the step is that of u.
HELD = "held"


def cell_densities(problem: Problem) -> Array:
    """ρ of every cell in blocks, shape (blocks, W); padding has 1."""
    disc, scene = problem.disc, problem.scene
    out = np.ones((disc.blocks, disc.lanes))
    for r, body in enumerate(scene.bodies):
        mine = disc.region == r
        if hasattr(body.density, "function_space"):
            owned = _compat.cell_count(scene.mesh)[0]
            dofs = _compat.cell_dofs(body.density.function_space)[:owned, 0]
            values = disc.cell_values(body.density.x.array[dofs][:, None])[:, 0, :]
            out[mine] = values[mine]
        else:
            out[mine] = float(body.density)
    return np.where(disc.source_cell < 0, 1.0, out)


class _Region:
    """λ_K(h) of one region's cells, for any h per cell."""

    def __init__(self, problem: Problem, number: int, rho: Array) -> None:
        disc, scene, kernels = problem.disc, problem.scene, problem.kernels
        self.n, self.n_u, self.dim = disc.n, scene.displacement, disc.dim
        self.rho = rho
        body = scene.bodies[number]
        self.basis, self.m, self.d = pencil_basis(body.inertia_matrix, body.viscosity_matrix)
        self.lumped = scene.lumped
        S = problem.self_stiffness[number]
        self.s = np.einsum("ji,jk,ki->i", self.basis, S, self.basis)
        blocks = disc.region == number
        self.geometry = np.ascontiguousarray(disc.geometry[blocks])
        identity = np.count_nonzero(self.basis - np.diag(np.diag(self.basis))) == 0
        generated = kernels.densities.generated[number]
        entries = kernels.densities.total(number) if generated else {}
        varying = any(not isinstance(v, float) for e in entries.values() for v in e)
        self.matrices: Array | None = None
        if generated and (identity or not varying):
            self._hessian(entries, problem, blocks)
        else:
            self._tabulate(problem, number, blocks)

    def _hessian(self, entries: dict[Any, Any], problem: Problem, blocks: Any) -> None:
        """H in the basis that makes inertia and viscosity diagonal."""
        coefficients, known = problem.kernels.coefficients, problem.kernels.densities.coefficients
        rows: list[Array] = []
        self.hessian: dict[tuple[int, int], Any] = {}
        n = self.n
        transform = np.eye(4 * n)
        full = np.eye(n)
        full[self.n_u :, self.n_u :] = self.basis
        for j in range(3):
            transform[j : 3 * n : 3, j : 3 * n : 3] = full
        transform[3 * n :, 3 * n :] = full
        dense = np.zeros((4 * n, 4 * n))
        scale = np.diag(transform)
        for (i, j), values in entries.items():
            if all(isinstance(v, float) for v in values):
                dense[i, j] = sum(values)
                continue
            # Entries that vary imply a diagonal basis here: it only scales them.
            row = sum(
                v if isinstance(v, float) else coefficients[blocks][:, known.index(v), :]
                for v in values
            )
            self.hessian[i, j] = len(rows)
            rows.append(scale[i] * scale[j] * np.asarray(row))
        dense = transform.T @ dense @ transform
        for i, j in zip(*np.nonzero(np.abs(dense) > 1e-15 * np.abs(dense).max()), strict=True):
            self.hessian[int(i), int(j)] = float(dense[i, j])
        self.coefficients = np.ascontiguousarray(np.stack(rows, axis=1)) if rows else None

    def _tabulate(self, problem: Problem, number: int, blocks: Any) -> None:
        """Element matrices at the initial state by FFCx, in the same basis."""
        disc, kernels, n = problem.disc, problem.kernels, self.n
        form: Tabulated = kernels.second_derivative(number)
        local, index = (self.dim + 1) * n, np.flatnonzero(blocks)
        x = native.aligned(kernels.x.shape)
        x[:-1, :n] = problem.initial_fields
        parts = [np.zeros((0, local, local))]
        # A region's blocks come in at most two runs (touching shared nodes, or not).
        for run in np.split(index, np.flatnonzero(np.diff(index) > 1) + 1):
            if not len(run):
                continue
            cells = np.ascontiguousarray(disc.cells[run])
            part = np.zeros((len(run) * disc.lanes, local, local))
            kernels.c.cb_tabulated_matrices(
                ctypes.byref(form.record), ctypes.c_int64(disc.nodes), ctypes.c_int64(len(run)),
                ctypes.c_int64(int(run[0])), native.pointer(cells), native.pointer(x),
                native.pointer(disc.position), native.pointer(part),
            )  # fmt: skip
            parts.append(part)
        out = np.concatenate(parts)
        full = np.eye(n)
        full[self.n_u :, self.n_u :] = self.basis
        each = np.kron(np.eye(self.dim + 1), full)
        self.matrices = each.T @ (0.5 * (out + out.transpose(0, 2, 1))) @ each

    def eigenvalues(self, h: Array, scheme: str) -> Array:
        """λ_max of M̂_K(h)⁻¹K_K for steps h of shape (blocks, W); zero for padding."""
        mu = np.empty((*h.shape, self.n))
        mu[..., : self.n_u] = self.rho[..., None]
        m = self.m + 0.25 * h[..., None] ** 2 * self.s
        held = scheme == HELD
        mu[..., self.n_u :] = np.inf if held else effective(m, self.d, h[..., None], scheme)
        scale = np.ascontiguousarray((1.0 / np.sqrt(mu)).transpose(0, 2, 1))
        if self.matrices is None:
            values = quadratic_eigenvalues(
                self.geometry, self.hessian, self.n, self.dim, self.lumped, scale, self.coefficients
            )
        else:
            volume = self.geometry[:, -1, :].ravel() ** 2 / (self.dim + 1)
            real = volume > 0
            inverse = np.where(real, 1.0 / np.sqrt(np.where(real, volume, 1.0)), 0.0)
            per_cell = scale.transpose(0, 2, 1).reshape(-1, self.n) * inverse[:, None]
            values = matrix_eigenvalues(self.matrices, np.tile(per_cell, (1, self.dim + 1)))
        return values.reshape(h.shape)

    def steps(self, scheme: str) -> Array:
        """Largest h per cell with h²λ_K(h) ≤ 4, shape (blocks, W); inf where nothing limits it."""
        h = np.ones(self.geometry.shape[::2])
        constant = not np.any(self.s) and (not np.any(self.d) or scheme == "symmetric")
        if scheme == HELD or constant:
            with np.errstate(divide="ignore"):
                return 2.0 / np.sqrt(np.maximum(self.eigenvalues(h, scheme), 0.0))
        # h² λ(h) grows like a power of h between 1 and 2, which √ratio finds in a few steps; beside
        # a stiff self-action (s) it hardly grows at all: then by bisection. Both in log scale.
        low, done = np.zeros_like(h), np.zeros(h.shape, dtype=bool)
        high, broken = np.full_like(h, np.inf), np.zeros(h.shape, np.bool_)
        for count in range(80):
            values = self.eigenvalues(h, scheme)
            broken |= np.isnan(values)
            if np.any(broken):
                break
            with np.errstate(divide="ignore"):
                ratio = 4.0 / (h * h * np.maximum(values, 1e-300))
            good = ratio >= 1.0
            low = np.where(good & ~done, np.maximum(low, h), low)
            high = np.where(good | done, high, np.minimum(high, h))
            unlimited = ratio > 1e200
            # √ratio overshoots upwards and is safe downwards when λ falls with h.
            change = np.where(good, np.sqrt(np.minimum(ratio, 1e12)), np.maximum(ratio, 1e-12))
            if count >= 12 and np.any(self.s):
                middle = np.sqrt(low * np.where(np.isinf(high), 16 * low, high)) / h
                change = np.where(low > 0, middle, change)
            change = np.where(unlimited, 1.0, change)
            # Each cell stops by itself: its step must not depend on who else is on this rank.
            done |= (np.abs(change - 1) < 1e-7) & (good | unlimited)
            if np.all(done):
                break
            h = np.where(done, h, h * change)
        if np.any(broken):
            return np.where(broken, np.nan, np.inf)
        return np.where(unlimited, np.inf, low)


def initial_matrices(problem: Problem, number: int) -> Array:
    """Stiffness of a region's cells by FFCx at the initial state, (cells · W, local, local).

    In the basis in which inertia and viscosity are diagonal.
    """
    rho = cell_densities(problem)[problem.disc.region == number]
    matrices = _Region(problem, number, rho).matrices
    assert matrices is not None
    return matrices


def cell_steps(problem: Problem, scheme: str = "exact") -> Array:
    """Critical step of every cell of this rank by its own pencil, shape (blocks, W) [s].

    Padding cells have infinity. With several bodies of different damping a node's effective mass
    may be less than the sum of its cells' shares; all steps are then reduced by that factor.

    Args:
        problem: The scene, made ready.
        scheme: Dissipation scheme of the recursion.

    Raises:
        IntegratorError: if the scheme cannot take a body without inertia.
        StepError: if a cell's stiffness is not finite.
    """
    disc, own = problem.disc, problem.known_steps.get(scheme)
    if own is None:
        # What is left out changes no step: with and without, a run is the same.
        every, source = _cell_steps(problem.full, scheme), problem.full.disc.source_cell
        own = np.zeros(disc.count)
        own[source[source >= 0]] = every[source >= 0]
        problem.known_steps[scheme] = own
    return np.where(disc.source_cell < 0, np.inf, disc.cell_values(own[:, None])[:, 0, :])


def _cell_steps(problem: Problem, scheme: str) -> Array:
    """The same of a problem's own components, computed; collective."""
    disc = problem.disc
    rho = cell_densities(problem)
    out = np.full((disc.blocks, disc.lanes), np.inf)
    for r in range(len(problem.scene.bodies)):
        blocks = disc.region == r
        region = _Region(problem, r, rho[blocks])
        out[blocks] = region.steps(scheme)
    out[disc.source_cell < 0] = np.inf
    bad = np.argwhere(np.isnan(out))
    found = cell_place(problem, int(bad[0, 0]), int(bad[0, 1]), np.nan) if len(bad) else None
    place = lowest(problem.comm, found)
    if place is not None:
        raise StepError(
            f"The stiffness of {place.name} is not finite at the initial state in {place}. Check "
            "the energy and the initial data there."
        )
    if len(problem.scene.bodies) > 1 and problem.masses.damped and scheme == "exact":
        out *= _shared_step(problem, float(np.min(out, initial=np.inf)), scheme)
    return out


def _shared_step(problem: Problem, h: float, scheme: str) -> float:
    """Factor below 1 that makes the smallest step h of the cells safe at nodes of several bodies.

    There M̂ is that of the averages of M and D, r times the average of the bodies' M̂ or more. As
    M̂(h)/h falls with h, 4M̂_K(h) ⪰ h²K gives 4M̂_K(h') ⪰ h'hK for h' < h: so h' ≤ r(h')h is enough.
    """
    h = float(problem.comm.allreduce(h, op=MPI.MIN))
    step = h
    for _ in range(100 if np.isfinite(h) else 0):
        safe = h * _shared_mass(problem, step, scheme)
        if safe >= step * (1 - 1e-12):
            break
        step = safe
    return step / h if np.isfinite(h) else 1.0


def _shared_mass(problem: Problem, h: float, scheme: str) -> float:
    """Smallest ratio r of an effective nodal mass to the sum of its bodies' shares, at most 1."""
    masses, disc = problem.masses, problem.disc
    parts = []
    for r, body in enumerate(problem.scene.bodies):
        basis, m, d = pencil_basis(body.inertia_matrix, body.viscosity_matrix)
        S = problem.self_stiffness[r]
        m = m + 0.25 * h * h * np.einsum("ji,jk,ki->i", basis, S, basis)
        back = np.linalg.inv(basis)
        parts.append(back.T @ np.diag(effective(m, d, h, scheme)) @ back)
    mixed = np.flatnonzero(~masses.pure)
    node = np.unique(masses.classes[:-1], return_index=True)[1][mixed]
    weight = disc.region_volume[node] / disc.volume[node, None]
    total = np.einsum("cr,rij->cij", weight, np.array(parts))
    if np.any(problem.self_stiffness):
        fixed = masses.fixed[masses.classes[:-1]]
        masses = Masses(disc, fixed, problem.self_stiffness, h, problem.dampers)
    whole = masses.effective(h, scheme)[mixed, masses.n_u :, masses.n_u :]
    ratios = np.linalg.eigvals(np.linalg.solve(total, whole)).real
    return float(problem.comm.allreduce(float(ratios.min(initial=1.0)), op=MPI.MIN))


def critical_step(
    problem: Problem, scheme: str = "exact", how: str = "cells", given: float | None = None
) -> float:
    """Largest stable synchronous step [s]: the cells' bound, or the body's own by SLEPc.

    It is that of all components, so that a plan that leaves some out changes no step, unless a
    step is given that only those left allow: what is zero and stays so cannot grow.

    Args:
        problem: The scene, made ready.
        scheme: Dissipation scheme.
        how: "cells" or "global".
        given: A step that is asked for [s].

    Returns:
        The step, the same on all ranks.

    Raises:
        StepError: if nothing limits the step (a body without stiffness).
    """
    whole, each = problem.full, cell_steps(problem, scheme)
    step = _least(problem, each)
    if given is not None and whole is not problem and given > step * (1 + 1e-9):
        whole, step = problem, _least(problem, _cell_steps(problem, scheme))
    if not np.isfinite(step) or step <= 0:
        raise StepError(
            "No finite critical step: the body has no stiffness. Give an energy, or a step."
        )
    if how == "global":
        from complexbody.spectrum import global_step

        step = global_step(whole, scheme, step)
    return step


def _least(problem: Problem, steps: Array) -> float:
    return float(problem.comm.allreduce(float(np.min(steps, initial=np.inf)), op=MPI.MIN))


def require_constant_inertia(problem: Problem, integrator: str) -> None:
    """Refuse bodies whose kinetic co-energy is a function of (ν, ν̇), recognised as no Ω.

    Raises:
        IntegratorError: naming the body and the integrators that take it.
    """
    for body in problem.inertias:
        if callable(body.inertia):
            raise IntegratorError(
                f"{integrator} needs a constant inertia, but that of {body.name} is a function of "
                "(nu, nu_dot). Use Implicit(), or give a number or a k×k matrix."
            )
