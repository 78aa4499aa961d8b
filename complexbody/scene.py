# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a simulation is about: a mesh, bodies on it, supports, loads and initial data.

Everything here is frozen and says only what the user said. Turning it into arrays, and finding
out which nodes a predicate selects, is the business of :mod:`complexbody.discretisation`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from complexbody import _compat
from complexbody.body import Body
from complexbody.conditions import FIELDS, Absorb, PointSource, Symmetry, Value, Where, known_field
from complexbody.errors import BodyError, MeshError, SceneError, agree
from complexbody.given import is_whole, short
from complexbody.histories import Constant, History
from complexbody.kinetics import recognised
from complexbody.periodicity import Identified, Periodic, checked, identify

__all__ = [
    "FIELDS", "Absorb", "BodyForce", "Fix", "Initial", "PointSource", "Pressure", "Scene",
    "Symmetry", "Traction", "Value", "Where",
]  # fmt: skip


@dataclass(frozen=True)
class Fix:
    """Prescribed displacement or descriptor on a part ∂B_u or ∂B_ν of the body.

    Attributes:
        field: "u" or "nu".
        where: Facet tag(s), "boundary" (all of it), or a predicate of node positions x (3, npts);
            a predicate selects nodes anywhere, not only on the boundary.
        value: Prescribed value [the field's unit]; zero by default.
        components: Which components (from 0) to prescribe; all by default.
        history: Factor of time the value is multiplied by; constant by default.
    """

    field: str
    where: Where
    value: Value = 0.0
    components: Sequence[int] | int | None = None
    history: History = Constant()

    def __post_init__(self) -> None:
        known_field("Fix", self.field)


@dataclass(frozen=True)
class Traction:
    """Surface load: t per reference area [Pa] on ∂B_t, or its microscopic partner on ν.

    Attributes:
        where: Facet tag(s), "boundary", or a predicate; a facet is loaded if the predicate holds at
            all its vertices.
        vector: The load, one number per component, or a callable of x (interpolated in P1).
        history: Factor of time.
        field: "u", or "nu" for a microtraction Sn (no loading device is known: use with care).
    """

    where: Where
    vector: Value
    history: History = Constant()
    field: str = "u"

    def __post_init__(self) -> None:
        known_field("Traction", self.field)


@dataclass(frozen=True)
class Pressure:
    """Normal load t = −p n on ∂B_t, n the outward normal; ``pressure`` in Pa."""

    where: Where
    pressure: float
    history: History = Constant()


@dataclass(frozen=True)
class BodyForce:
    """Load per volume [N/m³] on u (or per unit of ν and volume), everywhere or on cell tags."""

    vector: Value
    history: History = Constant()
    where: int | Sequence[int] | None = None
    field: str = "u"

    def __post_init__(self) -> None:
        known_field("BodyForce", self.field)


@dataclass(frozen=True)
class Initial:
    """Initial fields and rates: numbers, tuples, or callables of x (3, npts) as in dolfinx."""

    u: Value | None = None
    nu: Value | None = None
    u_dot: Value | None = None
    nu_dot: Value | None = None


Load = Traction | Pressure | BodyForce | PointSource


@dataclass(frozen=True)
class Scene:
    """A mesh with bodies, supports, loads and initial data.

    Attributes:
        mesh: A dolfinx mesh of intervals, triangles or tetrahedra with straight cells.
        body: One :class:`Body`, or ``{cell tag: Body}`` together with ``cell_tags``.
        supports: :class:`Fix` and :class:`Symmetry` objects.
        loads: :class:`Traction`, :class:`Pressure`, :class:`BodyForce` and :class:`PointSource`
            objects.
        absorbing: :class:`Absorb` objects: where waves leave the body.
        initial: Initial data; zero by default.
        cell_tags: dolfinx MeshTags of cells, needed where bodies or loads name cell tags.
        facet_tags: dolfinx MeshTags of facets, needed where supports or loads name facet tags.
        self_action: "consistent" integrates the quadratic self-action of P1 fields exactly,
            "lumped" by the vertex rule; "implicit" lumps it and steps over it where it is faster
            than waves across a cell (:mod:`complexbody.stiffness`).
        name: What to call it in tables and files.
        periodic: Axes (0, 1, 2) along which opposite faces of a box are one, and
            :class:`Periodic` pairs of other parts of the boundary.

    Raises:
        SceneError: if the parts do not fit together (on all ranks).
        MeshError: if the mesh is not one of straight simplices, or has no cells.
    """

    mesh: Any
    body: Body | Mapping[int, Body]
    supports: Sequence[Fix | Symmetry] = ()
    loads: Sequence[Load] = ()
    initial: Initial = field(default_factory=Initial)
    cell_tags: Any = None
    facet_tags: Any = None
    self_action: str = "consistent"
    name: str = "scene"
    absorbing: Sequence[Absorb] = ()
    periodic: Sequence[int | Periodic] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "supports", _several(self.supports, "supports", Fix | Symmetry))
        object.__setattr__(self, "loads", _several(self.loads, "loads", Load))
        object.__setattr__(self, "absorbing", _several(self.absorbing, "absorbing", Absorb))
        self._check_mesh()
        object.__setattr__(self, "periodic", checked(self.periodic, self.mesh.geometry.dim))
        _compat.equispaced(self.mesh)
        self._check_tag_kinds()
        self._check_bodies()
        self._recognise()
        self._check_tags()
        if not isinstance(self.initial, Initial):
            raise SceneError("Scene: initial is not an Initial. Give initial=cb.Initial(u=…).")
        if not isinstance(self.name, str):
            raise SceneError(f"Scene: name is {short(self.name)}. Give a text.")
        known = ("consistent", "lumped", "implicit")
        if not isinstance(self.self_action, str) or self.self_action not in known:
            raise SceneError(
                f"Scene: self_action is {short(self.self_action)}. Give 'consistent', 'lumped' or "
                "'implicit'."
            )

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The bodies, in the order of their tags."""
        if isinstance(self.body, Body):
            return (self.body,)
        return tuple(self.body[tag] for tag in sorted(self.body))

    @cached_property
    def identified(self) -> Identified | None:
        """Which nodes are one, None without periodic faces; collective when first asked for.

        Raises:
            MeshError, SceneError: if faces do not match (on all ranks).
        """
        return identify(self.mesh, self.periodic, self.facet_tags) if self.periodic else None

    @property
    def lumped(self) -> bool:
        """Whether the self-action is lumped at the vertices."""
        return self.self_action != "consistent"

    @property
    def displacement(self) -> int:
        """n_u, the number of components of u."""
        return int(self.bodies[0].displacement)

    @property
    def descriptor(self) -> int:
        """k, the number of components of ν."""
        return int(self.bodies[0].descriptor)

    @property
    def components(self) -> int:
        """n_u + k."""
        return self.bodies[0].components

    def regions(self) -> np.ndarray:
        """Index into :attr:`bodies` of every owned cell of this rank, shape (owned cells,)."""
        owned = _compat.cell_count(self.mesh)[0]
        region = np.zeros(owned, dtype=np.int32)
        if not isinstance(self.body, Body):
            for index, tag in enumerate(sorted(self.body)):
                cells = self.cell_tags.indices[self.cell_tags.values == tag]
                region[cells[cells < owned]] = index
        return region

    def components_of(self, name: str) -> np.ndarray:
        """Components of "u" or "nu" within a node's record (u first, then ν)."""
        n_u = self.displacement
        return np.arange(n_u) if name == "u" else np.arange(n_u, self.components)

    def _check_mesh(self) -> None:
        mesh = self.mesh
        if not hasattr(mesh, "topology"):
            raise SceneError("Scene: mesh is not a dolfinx mesh. Make one with dolfinx.mesh.")
        name = _compat.cell_name(mesh)
        if name not in ("interval", "triangle", "tetrahedron") or _compat.geometry_degree(mesh) > 1:
            raise MeshError(
                f"Scene: the mesh has cells '{name}' of geometric degree "
                f"{_compat.geometry_degree(mesh)}. Make a mesh of straight intervals, triangles or "
                "tetrahedra."
            )
        if mesh.geometry.dim != mesh.topology.dim:
            raise MeshError(
                f"Scene: cells of dimension {mesh.topology.dim} in a space of dimension "
                f"{mesh.geometry.dim}. Make a flat mesh (gdim equal to the cells' dimension): "
                "missing directions are taken care of by the body."
            )

    def _check_bodies(self) -> None:
        if isinstance(self.body, Body):
            return
        if not isinstance(self.body, Mapping) or not self.body:
            raise SceneError(
                "Scene: body is neither a Body nor {cell tag: Body}. Give one of them."
            )
        if not all(is_whole(tag) for tag in self.body):
            raise SceneError(
                f"Scene: a tag of body={{tag: …}} is no whole number: {short(list(self.body))}. "
                "Give the tags of cell_tags."
            )
        if not all(isinstance(body, Body) for body in self.body.values()):
            raise SceneError("Scene: a value of body={tag: …} is not a Body. Give Body objects.")
        shapes = {(body.displacement, body.descriptor) for body in self.bodies}
        if len(shapes) > 1:
            raise SceneError(
                f"Scene: the bodies have different (displacement, descriptor) counts {shapes}. "
                "Give all of them the same, filling in inert components where needed."
            )
        if self.cell_tags is None:
            raise SceneError("Scene: body={tag: Body} needs cell_tags. Give the cells' MeshTags.")
        owned = _compat.cell_count(self.mesh)[0]
        tags = self.cell_tags
        mine = tags.indices < owned
        tagged = tags.indices[mine][np.isin(tags.values[mine], sorted(self.body))]
        missing = owned - np.unique(tagged).size
        comm = self.mesh.comm
        total = comm.allreduce(missing)
        if total:
            raise SceneError(
                f"Scene: {total} cells have no body: their tag is none of {sorted(self.body)}. "
                "Tag them, or give bodies for their tags."
            )
        for tag in self.body:
            if comm.allreduce(int(np.sum(tags.values[mine] == tag))) == 0:
                raise SceneError(
                    f"Scene: no cell has tag {tag}, for which a body is given. Check cell_tags."
                )

    def _recognise(self) -> None:
        """Give bodies whose χ(ν, ν̇) is ½ν̇·Ων̇ that Ω for their inertia."""
        if not any(callable(body.inertia) for body in self.bodies):
            return
        known: Any = None
        error: Exception | None = None
        try:
            if isinstance(self.body, Body):
                known = recognised(self.body, self.mesh)
            else:
                known = {tag: recognised(body, self.mesh) for tag, body in self.body.items()}
        except BodyError as found:
            error = found
        agree(self.mesh.comm, error)
        object.__setattr__(self, "body", known)

    def _check_tag_kinds(self) -> None:
        cell = self.mesh.topology.dim
        for name, dim in (("cell_tags", cell), ("facet_tags", cell - 1)):
            tags = getattr(self, name)
            if tags is not None and getattr(tags, "dim", None) != dim:
                raise SceneError(
                    f"Scene: {name} are not MeshTags of entities of dimension {dim}. Make them "
                    "with dolfinx.mesh.meshtags."
                )

    def _check_tags(self) -> None:
        comm = self.mesh.comm
        error: Exception | None = None
        pairs = [thing for thing in self.periodic if isinstance(thing, Periodic)]
        for thing in (*self.supports, *self.loads, *self.absorbing, *pairs):
            if isinstance(thing, PointSource):
                continue
            where = thing.where
            cells = isinstance(thing, BodyForce)
            tags, kind = (self.cell_tags, "cell_tags") if cells else (self.facet_tags, "facet_tags")
            if where is None and cells:
                continue
            if not cells and (callable(where) or (isinstance(where, str) and where == "boundary")):
                continue
            if where is None or isinstance(where, str) or callable(where):
                known = "cell tags" if cells else "a tag, a predicate, or 'boundary'"
                error = SceneError(
                    f"{type(thing).__name__}: where={where!r} is not known. Give {known}."
                )
                break
            if tags is None:
                error = SceneError(
                    f"{type(thing).__name__}: where={where} is a tag, but the scene has no {kind}. "
                    f"Give Scene(…, {kind}=…), or a predicate."
                )
                break
            for tag in np.atleast_1d(np.asarray(where)):
                if comm.allreduce(int(np.sum(tags.values == tag))) == 0:
                    error = SceneError(
                        f"{type(thing).__name__}: no entity has tag {tag} in {kind}. Check the tag."
                    )
        agree(comm, error)


def _several(given: Any, name: str, kind: Any) -> tuple[Any, ...]:
    things = tuple(given) if isinstance(given, Sequence) else (given,)
    for thing in things:
        if not isinstance(thing, kind):
            raise SceneError(f"Scene: {thing!r} in {name} does not belong there. Check its type.")
    return things
