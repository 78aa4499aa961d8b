# SPDX-License-Identifier: LGPL-3.0-or-later
"""Whether two scenes are the same, for all that a run's future depends on.

Numbers are compared, not objects: weighted sums over nodes and cells, energies at a made-up state,
histories at some times. They do not depend on the number of ranks, but for round-off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from complexbody import _compat
from complexbody.numbering import Numbering, weights
from complexbody.problem import Problem

#: Relative difference that is no difference.
CLOSE = 1e-9
#: What is compared, in this order, and what a difference means.
PARTS = {
    "mesh": "another mesh", "bodies": "other bodies", "supports": "other supports",
    "loads": "other loads", "initial": "other initial data",
}  # fmt: skip


def identity(problem: Problem, numbering: Numbering) -> dict[str, list[Any]]:
    """Numbers and words that tell a scene from others; collective, the same on all ranks.

    Each number comes with the size of what it is the sum of. Made before an integrator is prepared.

    Args:
        problem: The scene, made ready.
        numbering: Of its arrays.
    """
    disc, comm = problem.disc, problem.comm
    real = disc.source_cell >= 0
    volume = np.zeros(disc.count)
    volume[disc.source_cell[real]] = (disc.geometry[:, -1, :] ** 2)[real]
    mesh = problem.scene.mesh
    corners = _compat.cell_nodes(mesh)[: disc.count]
    middle = np.asarray(mesh.geometry.x)[corners].mean(axis=1)  # of each cell, also if periodic
    cells, nodes = comm.allreduce(disc.count), comm.allreduce(int(disc.owned.sum()))
    supports, at = problem.supports, disc.dof
    held = [supports.fixed[at], supports.value[at], supports.history[at]]
    return {
        "mesh": [
            f"{disc.dim}D, {cells} cells, {nodes} nodes",
            numbering.cell_sum(middle), numbering.cell_sum(volume),
        ],
        "bodies": _bodies(problem, numbering),
        "supports": [numbering.node_sum(values) for values in held],
        "loads": [_loads(problem)],
        "initial": [
            numbering.node_sum(problem.initial_fields), numbering.node_sum(problem.initial_rates)
        ],
    }  # fmt: skip


def _bodies(problem: Problem, numbering: Numbering) -> list[Any]:
    """Components, materials' numbers, and energies at a made-up state; collective."""
    disc, kernels, n = problem.disc, problem.kernels, problem.disc.n
    out: list[Any] = [f"n_u = {problem.scene.displacement}, components {problem.live.components}"]
    for body in problem.inertias:
        rho = None if hasattr(body.density, "function_space") else float(body.density)
        omega = None if callable(body.inertia) else body.inertia_matrix.tolist()
        out.append(f"{body.name}: {rho}, {omega}, {body.viscosity_matrix.tolist()}")
    out.append(numbering.node_sum(disc.volume * disc.density()))
    if problem.convexity is not None:
        known = vars(problem.kinetic_range).values()
        out += [[v, abs(v)] for v in known if not isinstance(v, str)]  # places are words
    # Gradients of some thousandths, whatever the mesh.
    cells = problem.comm.allreduce(disc.count)
    size = (problem.comm.allreduce(float(disc.volume[disc.owned].sum())) / cells) ** (1 / disc.dim)
    kept = kernels.x.copy()
    for column in range(n):
        scale = 1e-3 * (size if column < problem.scene.displacement else 1.0)
        kernels.x[:-1, column] = scale * weights(numbering.nodes, 1000 + column)
    energies = problem.comm.allreduce(kernels.energies())
    kernels.x[:] = kept
    out += [[float(v), abs(float(v))] for v in energies.ravel()]
    return out


def _loads(problem: Problem) -> list[float]:
    """Σ w·f over the load vectors of all ranks, which are partial, and Σ |f|; collective."""
    loads, disc = problem.loads, problem.disc
    mesh = problem.scene.mesh
    numbers = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)[loads.node]
    w = weights(numbers * (disc.n + 1) + loads.component) + weights(loads.group, 7)
    mine = np.array([float(w @ loads.value), float(np.abs(loads.value).sum())])
    return [float(v) for v in problem.comm.allreduce(mine)]


def histories(problem: Problem, until: float) -> dict[str, list[Any]]:
    """Histories of supports and loads: as they describe themselves, else by values up to a time.

    Args:
        problem: The scene, made ready.
        until: Time up to which they have acted [s].
    """
    times = until * np.array([0.0, 0.113, 0.371, 0.672, 1.0])
    sources = {"supports": problem.supports.histories, "loads": problem.loads.histories}
    return {name: _histories(found, times) for name, found in sources.items()}


def _histories(found: Sequence[Any], times: Any) -> list[Any]:
    out: list[Any] = []
    for history in found:
        if is_dataclass(history) and not any(callable(v) for v in vars(history).values()):
            told = {f.name: np.asarray(getattr(history, f.name)).tolist() for f in fields(history)}
            out.append(f"{type(history).__name__} {told}")
            continue
        values = np.asarray(history(times), dtype=np.float64) * np.ones(len(times))
        out += [[float(v), abs(float(v))] for v in values]
    return out


def difference(one: Mapping[str, list[Any]], other: Mapping[str, list[Any]]) -> str:
    """What is different in another identity: a key's meaning in :data:`PARTS`, or ""."""
    for part, meaning in PARTS.items():
        first, second = one.get(part, []), other.get(part, [])
        if len(first) != len(second) or not all(map(_alike, first, second)):
            return meaning
    return ""


def _alike(one: Any, other: Any) -> bool:
    if isinstance(one, str) or isinstance(other, str):
        return bool(one == other)
    (a, size), (b, other_size) = one, other
    if not (np.isfinite(a) and np.isfinite(b)):
        return bool(a == b or (np.isnan(a) and np.isnan(b)))
    return bool(abs(a - b) <= CLOSE * max(size, other_size))
