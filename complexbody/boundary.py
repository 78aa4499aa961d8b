# SPDX-License-Identifier: LGPL-3.0-or-later
"""Supports, loads and initial data as nodal arrays of a scene.

Here predicates and tags become nodes, prescribed values become targets, and loads become vectors
assembled once, each with a history. Knows no time step.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx import mesh as dmesh

from complexbody import _compat
from complexbody.action import Action
from complexbody.conditions import PointSource, Symmetry
from complexbody.errors import SceneError, agree
from complexbody.given import numbers
from complexbody.histories import Constant, History
from complexbody.mirrors import fixed_components, mirror_plane
from complexbody.points import point_load
from complexbody.predicates import mask as _mask
from complexbody.scene import FIELDS, BodyForce, Fix, Scene

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[Any]  # int32 from dolfinx, int64 from numpy


class Amplitudes:
    """Factors of a user's histories, any of which may fail at any time.

    A rank that raised alone in mid-run would leave the others waiting: here it goes on with NaN,
    which the next ledger row finds on all ranks.

    Attributes:
        failure: What the first failure on this rank was.
    """

    failure: SceneError | None = None

    def factors(self, history: History, times: Array) -> Array:
        """Factors at the times [s], shape (times,); NaN where they cannot be had."""
        try:
            out = numbers(history(times))
            if out is None:
                self._failed("returned no real numbers")
            elif out.shape in ((), times.shape):
                if not np.all(np.isfinite(out)):
                    worst = times[np.flatnonzero(~np.isfinite(np.broadcast_to(out, times.shape)))]
                    self._failed(f"is not finite at t = {worst[0]:.6g} s")
                return out
            else:
                self._failed(f"returned shape {out.shape} for times of shape {times.shape}")
        except Exception as found:  # a user's callable may fail in any way
            self._failed(f"cannot be evaluated: {type(found).__name__}: {found}")
        return np.full(times.shape, np.nan)

    def _failed(self, what: str) -> None:
        if self.failure is None:
            self.failure = SceneError(
                f"The history of a load or support {what}. Give a function of an array of times "
                "[s] that returns finite factors of the same shape."
            )


#: Times at which histories are tried before a run.
TRIED = 257


def try_histories(comm: Any, histories: list[History], until: float) -> None:
    """Evaluate histories at many times of a run, before it; collective.

    Raises:
        SceneError: if one fails, misfits or is not finite, on any rank (on all ranks).
    """
    amplitudes = Amplitudes()
    for history in histories:
        for times in (np.linspace(0.0, until, TRIED), np.zeros(1)):
            amplitudes.factors(history, times)
    agree(comm, amplitudes.failure)


@dataclass
class Supports(Amplitudes):
    """Prescribed components of this rank's geometry nodes.

    Attributes:
        fixed: True where a component is prescribed, shape (geometry nodes, n).
        value: Prescribed value at factor 1, same shape.
        history: Index into ``histories`` per entry, same shape (0 where not prescribed).
        histories: The histories; index 0 is constant.
        mirrors: Planes of symmetry among them, and the axis that each is perpendicular to.
    """

    fixed: npt.NDArray[np.bool_]
    value: Array
    history: npt.NDArray[np.int32]
    histories: list[History]
    mirrors: list[tuple[Symmetry, int]] = field(default_factory=list)

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """True where a prescribed component depends on time."""
        return self.fixed & (self.history > 0)

    def targets(self, rows: Any, columns: Any, t: float) -> Array:
        """Prescribed values of entries (rows, columns) at time t [s]."""
        at = np.array([t], dtype=np.float64)
        factors = np.concatenate([np.atleast_1d(self.factors(h, at)) for h in self.histories])
        return self.value[rows, columns] * factors[self.history[rows, columns]]


def entities(scene: Scene, thing: Any) -> Ints | None:
    """Facets of this rank that a support or surface load names; None for a node predicate.

    Faces of a periodic scene that are one with another are no boundary. Collective.

    Raises:
        SceneError: if a predicate of facets fails, or a load is on such a face (on all ranks).
    """
    mesh, where = scene.mesh, thing.where
    exterior = _compat.exterior_facets(mesh)
    if isinstance(where, str):
        return exterior if scene.identified is None else scene.identified.outer(exterior)
    if callable(where):
        if isinstance(thing, Fix):
            return None
        errors: list[Exception | None] = [None]

        def marker(x: Array) -> Any:
            mask, error = _mask(type(thing).__name__, where, x)
            errors.append(error)
            return mask

        found = dmesh.locate_entities_boundary(mesh, mesh.topology.dim - 1, marker)
        agree(mesh.comm, next((e for e in errors if e is not None), None))
    else:
        tags = np.atleast_1d(np.asarray(where))
        found = scene.facet_tags.indices[np.isin(scene.facet_tags.values, tags)]
        if isinstance(thing, Fix):
            return found
    found = np.intersect1d(found, exterior)
    if scene.identified is not None:
        scene.identified.refuse_load(type(thing).__name__, found)
    return found


def supports(scene: Scene, action: Action) -> Supports:
    """Resolve the supports of a scene; collective.

    Raises:
        SceneError: if a support selects nothing, has the wrong number of components, or clashes
            with another one, also across periodic faces (on all ranks).
    """
    mesh, comm = scene.mesh, scene.mesh.comm
    x = np.asarray(mesh.geometry.x)
    shape = (len(x), scene.components)
    out = Supports(np.zeros(shape, bool), np.zeros(shape), np.zeros(shape, np.int32), [Constant()])
    error: Exception | None = None
    for support in scene.supports:
        facets = entities(scene, support)
        what = type(support).__name__
        if isinstance(support, Symmetry):
            fixes = _mirror(scene, support, facets, out)
        else:
            fixes, what = [support], f"Fix({support.field!r})"
        if facets is None:
            mask, problem = _mask(what, support.where, x.T)
            agree(comm, problem)
            nodes = np.flatnonzero(mask)
        else:
            dim = mesh.topology.dim - 1
            mesh.topology.create_connectivity(dim, dim + 1)
            nodes = np.asarray(fem.locate_dofs_topological(action.space, dim, facets))
        if comm.allreduce(len(nodes)) == 0 and error is None:
            error = SceneError(
                f"{what} with where={support.where!r} selects no node. Check the predicate's "
                "tolerance or the tag."
            )
        for fix in fixes:
            error = error or _prescribe(scene, out, fix, nodes, x)
    agree(comm, error)
    if scene.identified is not None:
        scene.identified.join_supports(out)
    try_histories(comm, out.histories, 0.0)
    return out


def _mirror(scene: Scene, support: Symmetry, facets: Any, out: Supports) -> list[Fix]:
    """What a plane of symmetry fixes; collective."""
    if scene.mesh.comm.allreduce(len(facets)) == 0:
        return []  # which is refused
    axis = mirror_plane(scene, support, facets)
    out.mirrors.append((support, axis))
    fixed = fixed_components(scene, support, axis)
    return [
        Fix(name, support.where, components=components.tolist())
        for name, components in fixed.items()
        if len(components)
    ]


def _prescribe(scene: Scene, out: Supports, fix: Fix, nodes: Any, x: Any) -> Exception | None:
    all_components = scene.components_of(fix.field)
    chosen = np.arange(len(all_components))
    if fix.components is not None:
        chosen = np.atleast_1d(np.asarray(fix.components))
        if not np.all(np.isin(chosen, np.arange(len(all_components)))) or chosen.size == 0:
            return SceneError(
                f"Fix({fix.field!r}): components {fix.components} do not exist; the field has "
                f"{len(all_components)}, counted from 0. Give some of those."
            )
    chosen = chosen.astype(np.int64)
    try:
        values = _values(fix.value, x[nodes], len(chosen))
    except Exception as found:  # a user's callable may fail in any way
        return SceneError(
            f"Fix({fix.field!r}): value cannot be evaluated: {type(found).__name__}: {found}. Give "
            "numbers, or a callable of x (3, npts) -> (components, npts)."
        )
    if values is None:
        return SceneError(
            f"Fix({fix.field!r}): value {fix.value!r} does not give {len(chosen)} finite "
            "component(s). Give one number per prescribed component, or a callable of x."
        )
    number = 0
    if not isinstance(fix.history, Constant):
        if fix.history not in out.histories:
            out.histories.append(fix.history)
        number = out.histories.index(fix.history)
    rows, columns = nodes[:, None], all_components[chosen][None, :]
    before = out.fixed[rows, columns]
    scale = max(np.abs(values).max(initial=0.0), np.abs(out.value).max(initial=0.0), 1e-300)
    differs = np.abs(out.value[rows, columns] - values) > 1e-12 * scale
    differs |= out.history[rows, columns] != number
    if np.any(before & differs):
        at = x[nodes[np.flatnonzero((before & differs).any(axis=1))[0]]]
        return SceneError(
            f"Two supports of {fix.field!r} prescribe different values at {at.tolist()}. Let them "
            "not overlap, or give them the same value there."
        )
    out.fixed[rows, columns] = True
    out.value[rows, columns] = values
    out.history[rows, columns] = number
    return None


def _values(value: Any, points: Array, count: int) -> Array | None:
    """Values (points, count) of a number, a sequence or a callable of x; None if they misfit."""
    if not len(points):
        return np.zeros((0, count))  # ranks without points have nothing to ask
    found = value(points.T) if callable(value) else value
    mask = callable(value) and np.asarray(found).dtype == np.bool_  # a predicate means 0 and 1
    given = numbers(np.asarray(found, dtype=np.int64) if mask else found)
    if given is None:
        return None
    try:
        if callable(value):
            given = np.broadcast_to(np.atleast_2d(given), (count, len(points))).T
        else:
            given = np.broadcast_to(given, (len(points), count))
    except ValueError:
        return None
    return given if np.all(np.isfinite(given)) else None


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


def initial(scene: Scene, action: Action) -> tuple[Array, Array]:
    """Initial fields and rates over geometry nodes, shapes (geometry nodes, n); collective.

    Raises:
        SceneError: if an initial field has the wrong shape or non-finite values, or differs at
            nodes that are one (on all ranks).
    """
    x = np.asarray(scene.mesh.geometry.x)
    fields = np.zeros((len(x), scene.components))
    rates = np.zeros_like(fields)
    error: Exception | None = None
    for target, suffix in ((fields, ""), (rates, "_dot")):
        for name in FIELDS:
            value = getattr(scene.initial, name + suffix)
            if value is None:
                continue
            columns = scene.components_of(name)
            if hasattr(value, "function_space"):
                array = np.asarray(value.x.array)
                fits = array.size == len(x) * len(columns) and np.all(np.isfinite(array))
                given = array.reshape(len(x), len(columns)) if fits else None
            else:
                try:
                    given = _values(value, x, len(columns))
                except Exception as found:  # a user's callable may fail in any way
                    given, error = (
                        None,
                        error
                        or SceneError(
                            f"Initial: {name}{suffix} cannot be evaluated: {type(found).__name__}: "
                            f"{found}. Give a callable of x (3, npts)."
                        ),
                    )
            if given is None:
                error = error or SceneError(
                    f"Initial: {name}{suffix} does not give {len(columns)} finite component(s) at "
                    "every node. Give numbers, or a callable of x (3, npts) -> (components, npts)."
                )
            else:
                target[:, columns] = given
    agree(scene.mesh.comm, error)
    if scene.identified is not None:
        scene.identified.join_initial(fields, "fields")
        scene.identified.join_initial(rates, "rates")
    return fields, rates
