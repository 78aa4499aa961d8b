# SPDX-License-Identifier: LGPL-3.0-or-later
r"""What demos read from a snapshot: values on the grid of a mesh, and the plane waves in a field.

Of waves that have met no edge, started by a blow that the body felt at t = 0: with
â(q) = Σ (u, ν) e^{−iq·x} over nodes, and its rate, written in the polarisations a_b of
``body.dispersion(q)``, the coefficient of each branch is multiplied by exp(−iω_b t). The first
state and the last thus tell frequency and decay of every branch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import complexbody as cb


def transform(function: Any, q: Any) -> Any:
    """Σ over nodes of a field on a uniform mesh times e^{−iq·x}: (q, components); collective."""
    space = function.function_space
    owned, size = space.dofmap.index_map.size_local, space.dofmap.index_map_bs
    values, x = function.x.array[: owned * size].reshape(owned, size), space.mesh.geometry.x
    return space.mesh.comm.allreduce(np.exp(-1j * q @ x[:owned, : q.shape[1]].T) @ values)


def waves(result: cb.Result, q: Any) -> tuple[Any, Any, Any, Any]:
    """Plane waves in a run of one body; collective.

    Args:
        result: Of a scene that waves started and none has met an edge.
        q: Wave vectors (m, 2) [1/m].

    Returns:
        ω [rad/s] of all b branches, exact and measured, and their share |c_b| in the start: each of
        shape (m, b); and the exact polarisations (m, n_u + k, b).
    """
    body, t = result.scene.bodies[0], result.time
    start = cb.simulate(result.scene, until=1e-9 * t, progress=False)
    exact, a = body.dispersion(q, polarisations=True)
    modes = np.concatenate([a, -1j * exact[:, None] * a], axis=1)  # of fields and rates
    first, last = (
        np.linalg.solve(modes, np.concatenate(
            [transform(getattr(r, name), q) for name in ("u", "nu", "u_dot", "nu_dot")],
            axis=1)[..., None])[..., 0]
        for r in (start, result)
    )  # fmt: skip
    # Relative to the exact ones: no whole turns to guess.
    ratio = last / (first * np.exp(-1j * exact * t))
    return exact, exact + 1j * np.log(ratio) / t, np.abs(first), a


def on_grid(*functions: Any) -> tuple[Any, ...] | None:
    """x, y and values (ny, nx, components) of fields on a mesh of a rectangle, on rank 0 alone."""
    mesh = functions[0].function_space.mesh
    tables = [f.x.array.reshape(len(mesh.geometry.x), -1) for f in functions]
    parts = mesh.comm.gather((mesh.geometry.x[:, :2], *tables))
    if parts is None:
        return None
    x, *values = (np.concatenate(part) for part in zip(*parts, strict=True))
    size = np.abs(x).max() * 1e-9
    _, first = np.unique(np.round(x / size).astype(np.int64), axis=0, return_index=True)
    ny = int(np.sum(np.abs(x[first, 0] - x[first[0], 0]) < size))  # sorted by x, then y
    grids = (v[first].reshape(-1, ny, v.shape[1]).swapaxes(0, 1) for v in values)
    return (x[first[::ny], 0], x[first[:ny], 1], *grids)
