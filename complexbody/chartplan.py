# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a chart is asked to show: a scene on some meshes, an end, what errors are against.

Makes scenes and references, and runs nothing.
"""

from __future__ import annotations

import hashlib
import inspect
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from complexbody import fronts
from complexbody.errors import ChartError
from complexbody.references import Exact, Finer, Reference
from complexbody.scene import Scene
from complexbody.scenefile import accepted


class Plan:
    """What is asked for, checked: the arguments of :func:`complexbody.workprecision.chart`.

    Raises:
        ChartError: for requests that make no sense, or not together.
    """

    def __init__(
        self, scene: Any, until: float, meshes: Any, exact: Any, parameters: Mapping[str, Any],
        comm: Any, steps: Any, repeats: int, norm: str,
    ) -> None:  # fmt: skip
        self.scene_, self.until, self.comm, self.exact = scene, float(until), comm, exact
        self.parameters, self.steps = dict(parameters), steps
        self.title, self.dimension = "", 0
        factory = not isinstance(scene, Scene)
        wrong = ""
        if not (np.isfinite(until) and until > 0):
            wrong = f"until is {until}. Give the end of the runs in seconds, > 0"
        elif meshes is not None and not factory:
            wrong = "meshes need a function that makes the scene. Give that, not a scene"
        elif meshes is not None and (len(meshes) != 1 or not all(len(v) for v in meshes.values())):
            wrong = f"meshes are {dict(meshes)!r}. Give one parameter and its values"
        elif not _sensible(steps):
            wrong = f"steps are {steps!r}. Give how many, or positive factors"
        elif repeats < 1:
            wrong = f"repeats is {repeats}. Give 1 or more"
        elif norm not in fronts.NORMS:
            wrong = f"norm is {norm!r}. Give one of {', '.join(fronts.NORMS)}"
        elif meshes is not None and exact is None and comm.size > 1:
            wrong = (
                "total errors against a finer mesh need one process. Run it without mpirun, give "
                "an exact solution, or a single mesh"
            )
        if wrong:
            raise ChartError(f"chart: {wrong}.")
        self.meshes: dict[str, list[Any]] = {k: list(v) for k, v in (meshes or {}).items()}

    def each(self) -> list[dict[str, Any]]:
        """Parameters of each mesh, coarse to fine."""
        return [{k: v} for k, values in self.meshes.items() for v in values] or [{}]

    def scene(self, mesh: Mapping[str, Any]) -> Scene:
        """The scene on a mesh."""
        if isinstance(self.scene_, Scene):
            made = self.scene_
        else:
            made = self.scene_(self.comm, **{**self.parameters, **mesh})
        self.title, self.dimension = made.name, made.mesh.geometry.dim
        return made

    def digest(self, source: str | bytes | None) -> str:
        """What knows the scene again."""
        if source is None:
            thing = self.scene_
            source = _source(thing)
            if isinstance(thing, Scene):
                # Addresses of functions are another each time: what they say is not.
                source = re.sub(r"0x[0-9a-f]+", "", repr(thing))
                source += "".join(_source(body.energy) for body in thing.bodies)
        data = source.encode() if isinstance(source, str) else source
        return hashlib.sha256(data).hexdigest()

    def total(self, scene: Scene, level: int) -> Reference | None:
        """What total errors are measured against, if anything."""
        if self.exact is not None:
            given = accepted(self.exact, {**self.parameters, **self.each()[0]})
            return Exact(lambda t: self.exact(t, **given), self.until, scene)
        if not self.meshes:
            return None
        (name, values), *_ = self.meshes.items()
        finer = {name: 2 * values[-1]}
        return Finer(self.scene(finer), self.until, level, label(finer))


def _source(thing: Any) -> str:
    try:
        return inspect.getsource(thing)
    except (OSError, TypeError):
        return str(getattr(thing, "__qualname__", type(thing).__name__))


def _sensible(steps: Any) -> bool:
    if isinstance(steps, int | None):
        return steps is None or steps > 0
    return len(steps) > 0 and all(np.isfinite(s) and s > 0 for s in steps)


def label(mesh: Mapping[str, Any]) -> str:
    """A mesh in words."""
    return ", ".join(f"{k}={v}" for k, v in mesh.items()) or "the scene's"
