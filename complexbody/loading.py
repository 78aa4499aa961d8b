# SPDX-License-Identifier: LGPL-3.0-or-later
"""Loads as nodal vectors of a scene, assembled once, each with a history. Knows no time step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx import mesh as dmesh

from complexbody import _compat
from complexbody.action import Action
from complexbody.amplitudes import Amplitudes, try_histories
from complexbody.boundary import Ints, entities
from complexbody.conditions import PointSource
from complexbody.errors import SceneError, agree
from complexbody.histories import History
from complexbody.points import point_load
from complexbody.scene import BodyForce, Scene

Array = npt.NDArray[np.float64]


@dataclass
class Loads(Amplitudes):
    """Partial load vectors of this rank: entry i adds ``factor[group[i]]·value[i]`` at its node.

    Attributes:
        node: Geometry node of each entry.
        component: Component within the record.
        group: Index into ``histories``.
        value: Force at factor 1 [N, or its partner on ν].
        histories: One per group.
    """

    node: Ints
    component: Ints
    group: npt.NDArray[np.int32]
    value: Array
    histories: list[History]

    def amplitudes(self, times: Array) -> Array:
        """Factors at the times [s], shape (times, groups)."""
        out = np.ones((len(times), max(len(self.histories), 1)))
        for i, history in enumerate(self.histories):
            out[:, i] = self.factors(history, times)
        return out


def loads(scene: Scene, action: Action) -> Loads:
    """The loads of a scene, by dolfinx but for those at points, before any halo sum; collective.

    Raises:
        SceneError: if a load selects nothing or its vector misfits (on all ranks).
    """
    rows: list[tuple[Any, ...]] = []
    histories: list[History] = []
    for load in scene.loads:
        if isinstance(load, PointSource):
            node, component, value = point_load(scene, load)
        else:
            node, component, value = _distributed(scene, action, load)
        if load.history not in histories:
            histories.append(load.history)
        group = np.full(len(node), histories.index(load.history), np.int32)
        rows.append((node, component, group, value))
    if not rows:
        empty = np.zeros(0, np.int64)
        return Loads(empty, empty, empty.astype(np.int32), np.zeros(0), [])
    try_histories(scene.mesh.comm, histories, 0.0)
    node, component, group, value = (np.concatenate(c) for c in zip(*rows, strict=True))
    return Loads(node.astype(np.int64), component.astype(np.int64), group, value, histories)


def _distributed(scene: Scene, action: Action, load: Any) -> tuple[Ints, Ints, Array]:
    """Nodes, components and values of a load on facets or cells, at factor 1; collective."""
    comm, mesh = scene.mesh.comm, scene.mesh
    tags = None
    if not isinstance(load, BodyForce):
        facets = np.sort(entities(scene, load)).astype(np.int32)  # type: ignore[arg-type]
        if comm.allreduce(len(facets)) == 0:
            raise SceneError(
                f"{type(load).__name__}(where={load.where!r}) selects no boundary facet. Check "
                "the predicate's tolerance or the tag."
            )
        ones = np.full(len(facets), 1, dtype=np.int32)
        tags = dmesh.meshtags(mesh, mesh.topology.dim - 1, facets, ones)
    error: Exception | None = None
    form = None
    try:
        form = action.load_form(load, tags, 1)
    except SceneError as found:
        error = found
    except Exception as found:  # a user's callable may fail in any way
        error = SceneError(
            f"{type(load).__name__}: vector cannot be evaluated: {type(found).__name__}: "
            f"{found}. Give numbers, or a callable of x (3, npts) -> (components, npts)."
        )
    agree(comm, error)
    vector = np.zeros(_compat.node_count(mesh) * scene.components)
    fem.assemble_vector(vector, _compat.form(form))
    if not np.all(np.isfinite(vector)):
        error = SceneError(
            f"{type(load).__name__}: the load is not finite everywhere. Check its vector or "
            "pressure."
        )
    agree(comm, error)
    entry = np.flatnonzero(vector)
    return entry // scene.components, entry % scene.components, vector[entry]
