# SPDX-License-Identifier: LGPL-3.0-or-later
r"""What a chart measures errors against, and how well it is known.

*On one mesh* the exact solution of the semi-discrete equations is approached by synchronous runs of
n, 2n, 4n, … steps. They have expansions in even powers of the step, which Richardson's scheme
removes one after the other (Romberg): T_{i,0} is the run of 2^i n steps and

.. math:: T_{i,j} = T_{i,j-1} + \frac{T_{i,j-1} - T_{i-1,j-1}}{4^j - 1}.

The reference is T_{i,i}, its error estimated by T_{i,i} − T_{i,i−1}: that of the second best.
Where the expansion does not hold the estimate does not fall, and says so.
*In total*: the scene's own exact solution, or such a reference on a finer mesh.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from complexbody import _compat
from complexbody.errors import ChartError
from complexbody.integrators.implicit import Implicit
from complexbody.integrators.synchronous import Synchronous
from complexbody.norms import Norms, State, smaller, state_of
from complexbody.problem import Problem
from complexbody.scene import Scene

Array = npt.NDArray[np.float64]

#: A reference is refined until its error is this share of the smallest error charted …
SHARE = 0.1
#: … in these norms, but not beyond this many halvings, nor below this (round-off).
JUDGED, MOST, FLOOR = ("fields", "energy_norm"), 9, 1e-13
#: First safety factor, and the number of times at which a run's norms are looked at.
SAFETY, LOOKS = 0.9, 40


def quietly(scene: Scene) -> Problem:
    """A scene made ready, without the warnings that the first one gave; collective."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return Problem(scene)


class Reference(Protocol):
    """A state that errors are measured against; calls are collective."""

    def state(self, mesh: Any) -> State:
        """On the nodes of a mesh."""

    def good_for(self, errors: Mapping[str, Any]) -> bool:
        """Refine until ``errors`` can be told; False where that is out of reach."""

    def about(self) -> dict[str, Any]:
        """For the chart's file."""

    def close(self) -> None:
        """Free what it holds."""


class Semidiscrete:
    """The exact motion of one mesh's lumped equations, as nearly as needed.

    Args:
        scene: The scene.
        until: The time [s].
        level: Halvings of the step to start with, at least 1.

    Attributes:
        norms: Norms on this mesh, with the reference's largest as scales.
        critical: Critical step of all cells together [s].
        level: Halvings done; steps: of the finest run.
        estimate: Estimated error, in all norms.
    """

    def __init__(self, scene: Scene, until: float, level: int = 1) -> None:
        self.scene, self.until, self.level = scene, until, -1
        self.norms = Norms(quietly(scene))
        self._row: list[State] = []
        self.estimate: dict[str, float | None] = {}
        self.critical, self.steps = 0.0, 0
        while self.level < max(level, 1):
            self.refine()

    def _method(self, steps: int) -> Any:
        general = self.norms.problem.convexity is not None
        kind = Implicit if general else Synchronous
        return kind(self.until / steps if steps else None, safety=SAFETY)

    def refine(self) -> None:
        """Halve the step once more; collective."""
        problem = quietly(self.scene)
        run = self._method(2 * self.steps).prepare(problem, self.until)
        self.critical, first = run.critical, self.level < 0
        self.steps = round(self.until / run.step)
        stride = max(1, self.steps // LOOKS) if first else self.steps
        if first:
            self.norms.see(*state_of(run, problem))
        while run.steps < self.steps:
            run.advance(min(stride, self.steps - run.steps))
            reached = state_of(run, problem)
            if first:
                self.norms.see(*reached)
        row = [reached[0]]
        for j, before in enumerate(self._row, 1):
            row.append(row[-1] + (row[-1] - before) * (1.0 / (4.0**j - 1.0)))
        run.close()
        problem.close()
        self._row, self.level = row, self.level + 1
        if len(row) > 1:
            found = self.norms.errors(row[-1], row[-2])
            # Round-off of thousands of steps is in both.
            self.estimate = {n: None if e is None else max(e, FLOOR) for n, e in found.items()}

    def state(self, mesh: Any = None) -> State:
        """T_{i,i}, on the nodes of the scene's own mesh."""
        return self._row[-1]

    def good_for(self, errors: Mapping[str, Any]) -> bool:
        """Refine until its error is a tenth of ``errors`` (in L2 and energy norm); collective.

        Returns:
            Whether it is: not if round-off or the largest number of steps come first.
        """
        bounds = {n: SHARE * e for n, e in errors.items() if e is not None and np.isfinite(e)}
        while not smaller(self.estimate, bounds, JUDGED):
            if self.level >= MOST or smaller(self.estimate, dict.fromkeys(JUDGED, FLOOR), JUDGED):
                return False
            self.refine()
        return True

    def about(self) -> dict[str, Any]:
        """Level, steps, estimate."""
        kind = "Implicit" if self.norms.problem.convexity is not None else "Synchronous"
        return {
            "kind": f"{kind}, Richardson extrapolation", "level": self.level, "steps": self.steps,
            "estimate": self.estimate, "scale": self.norms.scale,
        }  # fmt: skip

    def close(self) -> None:
        """Free communicators; collective."""
        self.norms.problem.close()


class Exact:
    """The scene's own exact solution.

    Args:
        function: ``exact(t)``, a dict with some of u, nu, u_dot, nu_dot, callables of x (3, npts)
            giving (components, npts), and ``energy``, a number.
        until: The time [s].
        scene: One of the scenes: for the numbers of components.

    Raises:
        ChartError: for what is no such dict.
    """

    def __init__(self, function: Callable[[float], Any], until: float, scene: Scene) -> None:
        self._found, self._scene = function(until), scene
        known = ("u", "nu", "u_dot", "nu_dot", "energy")
        if not isinstance(self._found, Mapping) or not set(self._found) <= set(known):
            raise ChartError(
                f"exact() gave {self._found!r:.80}. Return a dict with some of {', '.join(known)}."
            )

    def state(self, mesh: Any) -> State:
        """Its values at the nodes; NaN where it says nothing."""
        x, scene = np.asarray(mesh.geometry.x, dtype=np.float64).T, self._scene
        out = np.full((2, x.shape[1], scene.components), np.nan)
        for values, suffix in zip(out, ("", "_dot"), strict=True):
            for name in ("u", "nu"):
                if name + suffix not in self._found:
                    continue
                columns = scene.components_of(name)
                got = np.asarray(self._found[name + suffix](x), dtype=np.float64)
                if got.shape != (len(columns), x.shape[1]):
                    raise ChartError(
                        f"exact(): {name + suffix} has shape {got.shape}, not "
                        f"{(len(columns), x.shape[1])}. Return (components, points)."
                    )
                values[:, columns] = got.T
        return State(out[0], out[1], float(self._found.get("energy", np.nan)))

    def good_for(self, errors: Mapping[str, Any]) -> bool:
        """It is exact."""
        return True

    def about(self) -> dict[str, Any]:
        """That it is exact."""
        return {"kind": "the exact solution"}

    def close(self) -> None:
        """Nothing to free."""


class Finer:
    """A semi-discrete reference on a finer mesh, interpolated: P1 at the coarse mesh's nodes.

    Its own error in space is not estimated: for order p it is about 2^−p of that of a mesh twice
    as coarse. Nodes outside the finer mesh (of curved boundaries) take the nearest cell's values
    on.

    Args:
        scene: The scene on the finer mesh; one process.
        until: The time [s].
        level: As for :class:`Semidiscrete`.
        label: Which mesh it is.
    """

    def __init__(self, scene: Scene, until: float, level: int, label: str) -> None:
        self.fine, self._label = Semidiscrete(scene, until, level), label
        self._places: dict[int, tuple[Any, Array, Any]] = {}

    def state(self, mesh: Any) -> State:
        """Interpolated to the nodes of ``mesh``."""
        if id(mesh) not in self._places:
            self._places[id(mesh)] = (*_located(self.fine.scene.mesh, mesh.geometry.x), mesh)
        nodes, weights, _ = self._places[id(mesh)]
        fine = self.fine.state()
        fields, rates = (
            np.einsum("pa,pai->pi", weights, values[nodes]) for values in (fine.fields, fine.rates)
        )
        return State(fields, rates, fine.energy)

    def good_for(self, errors: Mapping[str, Any]) -> bool:
        """Refine its steps until their error is a tenth of ``errors``."""
        return self.fine.good_for(errors)

    def about(self) -> dict[str, Any]:
        """Which mesh, and what its own time steps leave."""
        return {**self.fine.about(), "kind": f"the mesh with {self._label}"}

    def close(self) -> None:
        """Free what it holds."""
        self.fine.close()


def _located(mesh: Any, points: Array) -> tuple[Any, Array]:
    """Nodes (points, d+1) of the cell nearest to each point, and its barycentric coordinates."""
    cells, dim = _compat.closest_cells(mesh, points), mesh.geometry.dim
    nodes = _compat.cell_nodes(mesh)[cells]
    x = mesh.geometry.x[nodes][..., :dim]
    edges = (x[:, 1:] - x[:, :1]).transpose(0, 2, 1)
    inner = np.linalg.solve(edges, (points[:, :dim] - x[:, 0])[..., None])[..., 0]
    return nodes, np.hstack([1.0 - inner.sum(axis=1, keepdims=True), inner])
