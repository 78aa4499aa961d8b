# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Periodic scenes: parts of the boundary that are one, and which nodes become one node by that.

A node at x on one face and the node at x + v on the other are copies of one degree of freedom:
cells on both sides add to its mass and force, each with the coordinates of its own vertices, so
that gradients know nothing of it. Nodes on several faces (edges, corners of a box) have as many
copies as chains of faces lead to. dolfinx keeps the copies as nodes of their own; here they are
found, and what is known of one is made common to all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from complexbody import _compat
from complexbody.errors import IntegratorError, MeshError, SceneError, agree
from complexbody.given import finite, is_whole, short
from complexbody.matching import Boundary, match
from complexbody.predicates import mask

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Data of one node given at several copies may differ by this share of the largest.
SAME = 1e-9


@dataclass(frozen=True)
class Periodic:
    """Two parts of the boundary that are one: what leaves the body at x + vector enters it at x.

    Attributes:
        where: One of the two: facet tag(s), or a predicate of x (3, npts) -> bool (npts,); a facet
            belongs to it if the predicate holds at all its vertices.
        vector: From there to the other part, one number per dimension of the mesh [m].

    Raises:
        SceneError: for a vector that is none.
    """

    where: int | Sequence[int] | Callable[[Any], Any]
    vector: Sequence[float]

    def __post_init__(self) -> None:
        v = finite(self.vector)
        if v is None or v.ndim != 1 or not np.any(v):
            raise SceneError(
                f"Periodic: vector is {short(self.vector)}. Give one number per dimension of "
                "the mesh, not all of them zero."
            )


def checked(periodic: Any, dim: int) -> tuple[int | Periodic, ...]:
    """What a scene was given as ``periodic``, as a tuple.

    Raises:
        SceneError: for what is no axis of the mesh, is given twice, or is no vector in its space.
    """
    things = tuple(periodic) if isinstance(periodic, Sequence | np.ndarray) else (periodic,)
    out: list[int | Periodic] = []
    for thing in things:
        if isinstance(thing, Periodic):
            if len(thing.vector) != dim:
                raise SceneError(
                    f"Periodic: vector {tuple(thing.vector)} has {len(thing.vector)} numbers for a "
                    f"mesh in {dim}D. Give one per dimension."
                )
            out.append(thing)
            continue
        if not is_whole(thing) or not 0 <= thing < dim or int(thing) in out:
            raise SceneError(
                f"Scene: periodic has {short(thing)}. Give each axis of the mesh (0 to {dim - 1}) "
                "once, or cb.Periodic(where, vector)."
            )
        out.append(int(thing))
    return tuple(out)


def require_unrepeated(scene: Any, name: str) -> None:
    """Refuse periodic scenes for what assembles with dolfinx.

    Raises:
        IntegratorError: naming integrators that take them.
    """
    if scene.periodic:
        raise IntegratorError(
            f"{name} assembles with dolfinx, to whose meshes the copies of a node are different "
            "nodes, and the scene is periodic. Use Synchronous(), AVI(), LocalLeapfrog(), or "
            "Implicit() with the vertex rule."
        )


@dataclass(frozen=True, eq=False)
class Identified:
    """Nodes that are one, by *class* of copies; classes are numbered alike on all ranks.

    Attributes:
        local: For each geometry node of this rank the one of its class that stands for it here:
            one of this rank's owned cells if any is.
        nodes, klass: Geometry nodes of this rank that have copies anywhere, and their classes.
        number: Global number (dolfinx's) that a class goes by: of its first copy, by coordinates.
        place: Coordinates of that copy, shape (classes, 3): the same for every number of ranks.
        source: Rows of ``nodes`` that are first copies and owned by this rank.
        facets: This rank's facets that are no boundary any more, sorted.
        mesh, x: The mesh, and its geometry nodes' coordinates.
        axes: Axes along which the body repeats itself, whole face to whole face.
        boxed: Whether all identifications are of such axes.
    """

    mesh: Any
    x: Array
    local: Ints
    nodes: Ints
    klass: Ints
    number: Ints
    place: Array
    source: Ints
    facets: npt.NDArray[np.int32]
    axes: tuple[int, ...]
    boxed: bool

    @property
    def comm(self) -> Any:
        """The mesh's ranks."""
        return self.mesh.comm

    # --- numbers and places of nodes -----------------------------------------------------------

    def named(self, numbers: Ints, nodes: Ints) -> Ints:
        """Global numbers of geometry nodes, those of classes in the place of their copies' own."""
        classes = self._classes(nodes)
        return np.where(classes < 0, numbers, self.number[classes])

    def placed(self, nodes: Ints) -> Array:
        """Coordinates of geometry nodes (nodes, 3): of the first copy of each."""
        classes = self._classes(nodes)
        return np.where(classes[:, None] < 0, self.x[nodes], self.place[classes])

    def _classes(self, nodes: Ints) -> Ints:
        """Class of each node, −1 for those without copies."""
        out = np.full(len(self.local), -1, np.int64)
        out[self.nodes] = self.klass
        return out[nodes]

    # --- boundary ------------------------------------------------------------------------------

    def outer(self, facets: Any) -> Any:
        """Those of the facets that are boundary."""
        return np.setdiff1d(facets, self.facets)

    def refuse_load(self, what: str, facets: Any) -> None:
        """Refuse a surface load on a face inside the repeated body; collective.

        Raises:
            SceneError: naming a place (on all ranks).
        """
        lost = np.intersect1d(facets, self.facets)
        error: Exception | None = None
        if lost.size:
            corners = self.x[_compat.facet_nodes(self.mesh, lost[:1].astype(np.int32))[0]]
            error = SceneError(
                f"{what}: a facet at {np.round(corners.mean(axis=0), 9).tolist()} is on a periodic "
                "face, which has no outside. Give a predicate or tags of the other boundary only."
            )
        agree(self.comm, error)

    # --- data ----------------------------------------------------------------------------------

    def join_initial(self, values: Array, what: str) -> None:
        """Give all copies the first one's values (geometry nodes, n), in place; collective.

        Raises:
            SceneError: where copies differ (on all ranks).
        """
        table = np.zeros((len(self.number), values.shape[1]))
        table[self.klass[self.source]] = values[self.nodes[self.source]]
        self.comm.Allreduce(MPI.IN_PLACE, table, op=MPI.SUM)
        mine, common = values[self.nodes], table[self.klass]
        scale = np.abs(values).max(axis=0, initial=0.0)
        self.comm.Allreduce(MPI.IN_PLACE, scale, op=MPI.MAX)
        bad = np.argwhere(np.abs(mine - common) > SAME * scale)
        error: Exception | None = None
        if len(bad):
            row, column = bad[0]
            error = SceneError(
                f"Initial: {what} differ at nodes that are one: component {column} of (u, ν) is "
                f"{mine[row, column]:.9g} at {self.x[self.nodes[row]].tolist()} and "
                f"{common[row, column]:.9g} at {self.place[self.klass[row]].tolist()}. Give "
                "initial data that are periodic."
            )
        agree(self.comm, error)
        values[self.nodes] = common

    def join_supports(self, supports: Any) -> None:
        """Prescribe at all copies what is prescribed at one, in place; collective.

        Args:
            supports: A :class:`complexbody.boundary.Supports`.

        Raises:
            SceneError: where copies are prescribed different motions (on all ranks).
        """
        mine = supports.fixed[self.nodes]

        def largest(values: Array) -> Array:
            """Of the prescribed values (geometry nodes, n) of each class, −∞ if there are none."""
            table = np.full((len(self.number), mine.shape[1]), -np.inf)
            np.maximum.at(table, self.klass, np.where(mine, values[self.nodes], -np.inf))
            self.comm.Allreduce(MPI.IN_PLACE, table, op=MPI.MAX)
            return table

        numbers = supports.history.astype(np.float64)
        value, history = largest(supports.value), largest(numbers)
        least, first = -largest(-supports.value), -largest(-numbers)
        fixed = np.isfinite(value)
        scale = np.array(np.abs(supports.value).max(initial=1e-300))
        self.comm.Allreduce(MPI.IN_PLACE, scale, op=MPI.MAX)
        clash = fixed & ((value > least + 1e-12 * scale) | (history != first))
        error: Exception | None = None
        if clash.any():
            row, column = np.argwhere(clash)[0]
            error = SceneError(
                f"Two supports prescribe component {column} of (u, ν) differently at the node "
                f"{self.place[row].tolist()} and a copy of it across a periodic face. Prescribe "
                "the same on both."
            )
        agree(self.comm, error)
        supports.fixed[self.nodes] = fixed[self.klass]
        supports.value[self.nodes] = np.where(fixed, value, 0.0)[self.klass]
        supports.history[self.nodes] = np.where(fixed, history, 0.0)[self.klass].astype(np.int32)


def identify(mesh: Any, periodic: Sequence[int | Periodic], tags: Any = None) -> Identified:
    """Find the copies of nodes; collective. Messages and tables are as large as the faces.

    Args:
        mesh: A mesh of straight simplices.
        periodic: As :func:`checked` gives it.
        tags: MeshTags of facets, if ``periodic`` names tags.

    Raises:
        SceneError: if a face has no facet, or its predicate fails.
        MeshError: if faces do not match node by node and facet by facet, or a cell touches both
            (all on all ranks).
    """
    boundary = Boundary(mesh)
    x = boundary.x
    pairs, facets = [], []
    for thing in periodic:
        if isinstance(thing, Periodic):
            chosen, name = _chosen(boundary, thing, tags), f"Periodic(where={thing.where!r})"
            vector, other = np.zeros(3), None
            vector[: len(thing.vector)] = thing.vector
        else:
            chosen, other, vector = _ends(boundary, thing)
            name = f"periodic={thing}"
        found, inner = match(boundary, chosen, vector, name, other)
        pairs.append(found)
        facets.append(inner)
    members, label, where = _classes(np.concatenate(pairs), mesh.comm)
    # First copies: by coordinates, which do not depend on who has which node.
    order = np.lexsort((*where.T[::-1], label))
    first = order[np.searchsorted(label[order], np.arange(label.max(initial=-1) + 1))]

    index_map = _compat.node_map(mesh)
    numbers = np.asarray(index_map.local_to_global(np.arange(len(x), dtype=np.int32)), np.int64)
    at = np.minimum(np.searchsorted(members, numbers), max(len(members) - 1, 0))
    nodes = np.flatnonzero(members[at] == numbers)
    row = at[nodes]
    klass = label[row]
    source = np.flatnonzero((first[klass] == row) & (nodes < index_map.size_local))
    cells = _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
    local = _representatives(nodes, klass, cells, len(x))
    _check_cells(mesh, local[cells], x[cells])
    axes = tuple(thing for thing in periodic if not isinstance(thing, Periodic))
    inner = np.unique(np.concatenate(facets)).astype(np.int32)
    return Identified(
        mesh, x, local, nodes, klass, members[first], where[first], source, inner, axes,
        len(axes) == len(periodic),
    )  # fmt: skip


def _chosen(boundary: Boundary, thing: Periodic, tags: Any) -> npt.NDArray[np.bool_]:
    """Which boundary facets a :class:`Periodic` names; collective."""
    if not callable(thing.where):
        wanted = tags.indices[np.isin(tags.values, np.atleast_1d(np.asarray(thing.where)))]
        return np.isin(boundary.facets, wanted)
    count, corners = boundary.corners.shape[:2]
    points = boundary.corners.reshape(-1, 3).T
    found, error = mask("Periodic", thing.where, points)
    agree(boundary.comm, error)
    return np.asarray(found.reshape(count, corners).all(axis=1))


def _ends(boundary: Boundary, axis: int) -> tuple[Any, Any, Array]:
    """Facets at the lower and the upper end of the body along an axis, and the vector between."""
    x, comm = boundary.x[:, axis], boundary.comm
    low = comm.allreduce(float(x.min(initial=np.inf)), op=MPI.MIN)
    high = comm.allreduce(float(x.max(initial=-np.inf)), op=MPI.MAX)
    tiny, at = 1e-9 * (high - low), boundary.corners[:, :, axis]
    vector = np.zeros(3)
    vector[axis] = high - low
    lower, upper = (np.all(np.abs(at - end) < tiny, axis=1) for end in (low, high))
    return lower, upper, vector


def _classes(pairs: Array, comm: Any) -> tuple[Ints, Ints, Array]:
    """Global numbers of all nodes with copies, sorted, their classes and coordinates; collective.

    Args:
        pairs: Rows of this rank: number, coordinates of a node, and the same of its copy (·, 8).
        comm: Ranks.
    """
    every = np.concatenate(comm.allgather(pairs)).reshape(-1, 4)
    members, start, place = np.unique(
        every[:, 0].astype(np.int64), return_index=True, return_inverse=True
    )
    links = place.reshape(-1, 2)
    graph = coo_matrix((np.ones(len(links)), links.T), shape=(len(members),) * 2)
    _, label = connected_components(graph, directed=False)
    return members, label.astype(np.int64), every[start, 1:]


def _representatives(nodes: Ints, klass: Ints, cells: Any, count: int) -> Ints:
    """For each geometry node the one of its class that stands for it on this rank."""
    touched = np.zeros(count, np.bool_)
    touched[cells] = True
    order = np.lexsort((nodes, ~touched[nodes], klass))
    _, start, back = np.unique(klass[order], return_index=True, return_inverse=True)
    local = np.arange(count, dtype=np.int64)
    local[nodes[order]] = nodes[order][start][back.ravel()]
    return local


def _check_cells(mesh: Any, cells: Ints, corners: Array) -> None:
    """Refuse cells that have a node twice: they are as long as the body's period; collective."""
    each = np.sort(cells, axis=1)
    bad = np.flatnonzero((each[:, 1:] == each[:, :-1]).any(axis=1))
    error: Exception | None = None
    if bad.size:
        error = MeshError(
            f"The cell at {np.round(corners[bad[0]].mean(axis=0), 6).tolist()} goes from one "
            "periodic face to its copy. Make the mesh two cells long at least in that direction."
        )
    agree(mesh.comm, error)
