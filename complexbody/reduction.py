# SPDX-License-Identifier: LGPL-3.0-or-later
"""A scene without the components that stay zero: the same bodies, seen with fewer unknowns.

Densities are the user's own, called with zeros where components are left out. ν or u may be left
out as a whole: their parts of a record are empty then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl

from complexbody.body import Body
from complexbody.boundary import Supports
from complexbody.live import Live
from complexbody.loading import Loads
from complexbody.scene import Initial, Scene

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ReducedBody(Body):
    """A body with some of another one's components; k or n_u may be zero.

    Its densities take None for what has no component.
    """

    def __post_init__(self) -> None:
        """Checks are the whole body's."""


def _whole(part: Any, rows: Sequence[int], count: int, columns: int) -> Any:
    """A vector (columns = 0) or tensor of ``count`` rows: those of ``part``, zero elsewhere."""
    zero = ufl.as_ufl(0.0)
    at = {row: i for i, row in enumerate(rows)}
    if not columns:
        return ufl.as_vector([part[at[i]] if i in at else zero for i in range(count)])
    return ufl.as_tensor(
        [[part[at[i], j] if i in at else zero for j in range(columns)] for i in range(count)]
    )


def reduced_body(body: Body, u: Sequence[int], nu: Sequence[int]) -> Body:
    """The body with components ``u`` and ``nu`` (each counted from 0) alone."""
    n_u, k = int(body.displacement), int(body.descriptor)

    def energy(U: Any, v: Any, N: Any) -> Any:
        return body.energy(_whole(U, u, n_u, 3), _whole(v, nu, k, 0), _whole(N, nu, k, 3))

    def outer(x: Any, v: Any) -> Any:
        assert body.potential is not None
        return body.potential(_whole(x, u, n_u, 0), _whole(v, nu, k, 0))

    ix = np.ix_(nu, nu)
    return ReducedBody(
        len(nu), energy, body.density,
        # A general χ keeps all of ν (complexbody.live).
        body.inertia if callable(body.inertia) else body.inertia_matrix[ix],
        body.viscosity_matrix[ix], None if body.potential is None else outer, len(u),
        body.quadrature_degree, body.name, body.constants, orientation=body.orientation,
    )  # fmt: skip


def reduced_scene(scene: Scene, live: Live) -> Scene:
    """The scene with live components alone; supports, loads and initial data are arrays' matter."""
    n_u = scene.displacement
    u = [i for i in live.components if i < n_u]
    nu = [i - n_u for i in live.components if i >= n_u]
    bodies = [reduced_body(body, u, nu) for body in scene.bodies]
    body: Body | dict[int, Body] = bodies[0]
    if not isinstance(scene.body, Body):
        body = dict(zip(sorted(scene.body), bodies, strict=True))
    return replace(scene, body=body, supports=(), loads=(), absorbing=(), initial=Initial())


def reduced_data(
    live: Live, supports: Supports, loads: Loads, start: tuple[Array, Array]
) -> tuple[Supports, Loads, tuple[Array, Array]]:
    """Supports, loads and initial fields and rates of live components alone."""
    columns = list(live.components)
    place = np.full(live.total, -1)
    place[columns] = np.arange(len(columns))
    mine = place[loads.component] >= 0
    held = Supports(
        supports.fixed[:, columns], supports.value[:, columns], supports.history[:, columns],
        supports.histories,
    )  # fmt: skip
    kept = Loads(
        loads.node[mine], place[loads.component[mine]], loads.group[mine], loads.value[mine],
        loads.histories,
    )  # fmt: skip
    return held, kept, (start[0][:, columns], start[1][:, columns])
