# SPDX-License-Identifier: LGPL-3.0-or-later
"""A scene's homogeneous part, from rough data: what growth is measured on.

Without loads and constant forces, supports held at zero: a linear scene's runs then are linear maps
of their state. Of a scene that is not linear two are made, at rest at its initial fields and
slightly disturbed; their difference grows as the linearised map does.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import meshes
from complexbody.growth import ENOUGH, weights
from complexbody.problem import Problem
from complexbody.scene import Fix, Initial, Scene
from complexbody.timesets import critical_step

Array = npt.NDArray[np.float64]

#: Of a scene that is not linear: strains of the disturbance, and growth up to which it is small.
SMALL, STILL_SMALL = 1e-7, 1e4


class Disturbed(Problem):
    """A scene without what drives it; collective.

    Args:
        scene: The scene.
        disturbed: Begin with rough positions and rates of all free components, the same for every
            number of ranks; else at rest.

    Attributes:
        unit: The cells' bound of the critical step [s], a scale of time.
        linear: Whether forces are linear; initial fields are then zero.
        mappable: Whether runs on this communicator are linear maps on one rank.
        enough: Growth at which a long run may end.
    """

    def __init__(self, scene: Scene, disturbed: bool = True) -> None:
        self._disturbed, self.unit, self.linear = disturbed, 1.0, False
        supports = [
            replace(fix, value=_zero(fix.value)) if isinstance(fix, Fix) else fix
            for fix in scene.supports
        ]
        given = scene.initial
        start = Initial(given.u, given.nu)
        super().__init__(replace(scene, loads=(), supports=supports, initial=start))
        self.linear = self.kernels.densities.linear
        self.unit = critical_step(self)
        self.arrange()

    @classmethod
    def pair(cls, scene: Scene) -> list[Disturbed]:
        """One problem if the scene is linear, else a disturbed one and the same undisturbed."""
        first = cls(scene)
        return [first] if first.linear else [first, cls(scene, disturbed=False)]

    @property
    def mappable(self) -> bool:
        """Whether a run is a linear map that one rank has the whole of."""
        return self.linear and self.comm.size == 1

    @property
    def enough(self) -> float:
        """Growth at which a long run may end."""
        return ENOUGH if self.linear else STILL_SMALL

    def anew(self) -> None:
        """Forget what a run made of it: groups, and inertia of a self-action; collective."""
        self.node_step = 0.0
        self.arrange()

    def arrange(self, group: npt.NDArray[np.int64] | None = None) -> None:
        """As :meth:`Problem.arrange`, then without constant forces, and disturbed."""
        super().arrange(group)
        self.kernels.constant, self.kernels.state.constant = None, None
        if self.linear:
            self.initial_fields[:] = 0.0
        if self._disturbed:
            rough = self._rough()
            self.initial_rates += rough / self.unit
            self.initial_fields += rough

    def _rough(self) -> Array:
        """Changes of position over ``unit`` of about equal kinetic energy per volume (nodes, n)."""
        disc, n = self.disc, self.disc.n
        inertia = weights(self, self.unit)[self.masses.classes[:-1]]
        x = disc.position[:-1] / (self._extent() or 1.0)
        angle = x @ np.array([[12.9898], [78.233], [37.719]]) + 1.37 * np.arange(1, n + 1)
        hashed = np.modf(np.sin(angle) * 43758.5453)[0]
        out = np.where(inertia > 0, hashed / np.sqrt(np.where(inertia > 0, inertia, 1.0)), 0.0)
        if not self.linear:
            n_u = self.scene.displacement
            size = self._least(float(meshes.altitudes(self.scene.mesh).min(initial=np.inf)))
            own = -self._least(-float(np.abs(self.initial_fields[:, n_u:]).max(initial=0.0)))
            scale = np.where(np.arange(n) < n_u, size, own or 1.0)
            most = -self._least(-float(np.abs(out / scale).max(initial=0.0)))
            out *= SMALL / (most or 1.0)
        return out

    def _extent(self) -> float:
        x = self.scene.mesh.geometry.x
        return -self._least(-float(np.abs(x).max(initial=0.0)))

    def _least(self, value: float) -> float:
        return min(self.comm.allgather(value))


def _zero(value: Any) -> Any:
    """Zero of the same shape as a support's value."""
    return (lambda x: 0.0 * np.asarray(value(x))) if callable(value) else 0.0 * np.asarray(value)
