# SPDX-License-Identifier: LGPL-3.0-or-later
"""Supports and initial data as nodal arrays of a scene: where, and what.

Here predicates and tags become nodes or facets, and prescribed values targets. Loads stand in
:mod:`complexbody.loading`. Knows no time step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx import mesh as dmesh

from complexbody import _compat
from complexbody.action import Action
from complexbody.amplitudes import Amplitudes, try_histories
from complexbody.conditions import Symmetry
from complexbody.errors import SceneError, agree
from complexbody.given import is_whole, numbers, short
from complexbody.histories import Constant, History
from complexbody.mirrors import fixed_components, mirror_plane
from complexbody.predicates import mask as _mask
from complexbody.scene import FIELDS, Fix, Scene

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[Any]  # int32 from dolfinx, int64 from numpy


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
        components: Any = fix.components
        several = isinstance(components, Sequence | np.ndarray)
        given = list(components) if several else [components]
        ok = given and all(map(is_whole, given)) and set(given) <= set(chosen)
        if not ok or len(set(given)) < len(given):
            return SceneError(
                f"Fix({fix.field!r}): components={short(fix.components)} are none of this field, "
                f"which has {len(all_components)}, counted from 0. Give some of those, each once."
            )
        chosen = np.array(given, dtype=np.int64)
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
    """Values (points, count) of numbers or a callable of x; None if they misfit.

    A single number, of all points or each, is that of all components.
    """
    if not len(points):
        return np.zeros((0, count))  # ranks without points have nothing to ask
    if callable(value):
        # With as many points as components, a number for each of the ones passed for the others.
        x = points if len(points) != count else np.vstack([points, points[-1:]])
        found = value(x.T)
        mask = np.asarray(found).dtype == np.bool_  # a predicate means 0 and 1
        given = numbers(np.asarray(found, dtype=np.int64) if mask else found)
        fits = given is not None and given.shape in ((), (len(x),), (count, len(x)))
    else:
        given, x = numbers(value), points
        fits = given is not None and given.shape in ((), (count,))
        given = None if given is None else given[..., None]
    if given is None or not fits or not np.all(np.isfinite(given)):
        return None
    return np.array(np.broadcast_to(given, (count, len(x))).T[: len(points)])


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
