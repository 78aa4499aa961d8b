# SPDX-License-Identifier: LGPL-3.0-or-later
"""The one place that knows which dolfinx this is (0.5.2 to 0.11).

Everything is probed with ``hasattr``; no other file may ask for a version.
"""

from __future__ import annotations

import ctypes
import inspect
import itertools
import logging
import os
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import cpp, fem, geometry, io, jit, la, mesh, plot

from complexbody import jitcache, native

# dolfinx 0.5's JIT logs every compilation at level INFO through the root logger.
for _handler in logging.getLogger().handlers:
    _handler.setLevel(logging.WARNING)

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


def steady_partitions() -> None:
    """Let Scotch cut a mesh as it did in the last process that made the same meshes.

    It draws random numbers from the clock, and its threads race: each run would have other parts,
    and other last bits. Does nothing where dolfinx has no Scotch.
    """
    os.environ.setdefault("SCOTCH_PTHREAD_NUMBER", "1")
    try:
        with open("/proc/self/maps") as maps:
            loaded = {line.split()[-1] for line in maps if "/libscotch-" in line}
    except OSError:
        return
    for path in loaded:
        library = ctypes.CDLL(path)
        if hasattr(library, "SCOTCH_randomSeed") and hasattr(library, "SCOTCH_randomReset"):
            library.SCOTCH_randomSeed(ctypes.c_int64(1))
            library.SCOTCH_randomReset()


steady_partitions()

#: Options for every FFCx compilation: the flags matter more than who loops (measured).
JIT_OPTIONS: dict[str, Any] = {
    "cffi_extra_compile_args": ["-O3", "-march=native", "-fno-math-errno"],
    "timeout": 120,
}


def _patient() -> None:
    """Give dolfinx's own compiles (of elements) time, a place, and no leftovers of killed ones."""
    for name in ("DOLFINX_DEFAULT_JIT_OPTIONS", "DOLFINX_DEFAULT_JIT_PARAMETERS"):
        defaults = getattr(jit, name, None)
        if defaults is not None and "timeout" in defaults:
            known = Path(str(defaults["cache_dir"][0])).expanduser()
            place = native.writable(known.parent, known.name)
            defaults["cache_dir"] = (place, defaults["cache_dir"][1])
            defaults["timeout"] = (JIT_OPTIONS["timeout"], defaults["timeout"][1])
            jitcache.wait_and_heal(place)


_patient()


def equispaced(domain: mesh.Mesh) -> None:
    """Give the mesh a coordinate element that FFCx will not rewrite.

    FFCx 0.5 replaces the coordinate element at the first compilation, which changes the signature
    of every later form: each rerun would compile one form more, and each rank for itself.
    """
    ufl_mesh = domain.ufl_domain()
    element = ufl_mesh.ufl_coordinate_element()
    if hasattr(ufl, "VectorElement") and getattr(element, "variant", lambda: "")() is None:
        ufl_mesh._ufl_coordinate_element = ufl.VectorElement(
            ufl.FiniteElement(
                element.family(), element.cell(), element.degree(), variant="equispaced"
            ),
            dim=element.value_shape()[0],
        )


def space() -> Any:
    """A UFL domain for symbols that belong to no mesh: affine tetrahedra in space."""
    if hasattr(ufl, "VectorElement"):
        return ufl.Mesh(ufl.VectorElement("Lagrange", ufl.tetrahedron, 1))
    return ufl.Mesh(import_module("basix.ufl").element("Lagrange", "tetrahedron", 1, shape=(3,)))


def vector_space(domain: mesh.Mesh, components: int) -> fem.FunctionSpace:
    """Blocked continuous P1 space with values of shape (components,)."""
    if hasattr(fem, "VectorFunctionSpace") and not hasattr(fem, "functionspace"):
        return fem.VectorFunctionSpace(domain, ("Lagrange", 1), dim=components)
    return fem.functionspace(domain, ("Lagrange", 1, (components,)))


def cell_space(domain: mesh.Mesh, shape: tuple[int, ...] = ()) -> fem.FunctionSpace:
    """Piecewise constant space with values of the given shape."""
    if not hasattr(fem, "functionspace"):
        if shape == ():
            return fem.FunctionSpace(domain, ("DG", 0))
        if len(shape) == 1:
            return fem.VectorFunctionSpace(domain, ("DG", 0), dim=shape[0])
        return fem.TensorFunctionSpace(domain, ("DG", 0), shape=shape)
    return fem.functionspace(domain, ("DG", 0, shape) if shape else ("DG", 0))


def vertex_space(domain: mesh.Mesh) -> fem.FunctionSpace:
    """Scalar continuous P1 space, whose interpolation points are the vertices of a cell."""
    maker = fem.functionspace if hasattr(fem, "functionspace") else fem.FunctionSpace
    return maker(domain, ("Lagrange", 1))


def _table(adjacency: Any, rows: int, columns: int) -> Ints:
    """A dofmap as an int32 array of shape (rows, columns), from an AdjacencyList or an array."""
    flat = adjacency.array if hasattr(adjacency, "array") else np.asarray(adjacency)
    return np.asarray(flat, dtype=np.int32).reshape(rows, columns)


def is_cellwise(function: fem.Function) -> bool:
    """True for functions that are constant on each cell (DG0)."""
    element = function.function_space.ufl_element()
    degree = getattr(element, "embedded_superdegree", None)
    return int(element.degree() if degree is None else degree) == 0


def cell_count(domain: mesh.Mesh) -> tuple[int, int]:
    """Owned cells and owned plus ghost cells of this rank."""
    index_map = domain.topology.index_map(domain.topology.dim)
    return index_map.size_local, index_map.size_local + index_map.num_ghosts


def cell_nodes(domain: mesh.Mesh) -> Ints:
    """Geometry nodes of each cell, ghosts last, shape (cells, vertices per cell)."""
    return _table(domain.geometry.dofmap, cell_count(domain)[1], domain.topology.dim + 1)


def cell_dofs(space: fem.FunctionSpace) -> Ints:
    """Blocked degrees of freedom of each cell, shape (cells, dofs per cell)."""
    return _table(space.dofmap.list, cell_count(space.mesh)[1], space.dofmap.dof_layout.num_dofs)


def node_map(domain: mesh.Mesh) -> Any:
    """Index map of the geometry nodes (owned first, then ghosts)."""
    return domain.geometry.index_map()


def node_count(domain: mesh.Mesh) -> int:
    """Owned plus ghost geometry nodes of this rank."""
    index_map = domain.geometry.index_map()
    return int(index_map.size_local + index_map.num_ghosts)


def original_cells(domain: mesh.Mesh) -> npt.NDArray[np.int64]:
    """Number of each local cell in the input of the mesh: the same for every number of ranks."""
    return np.asarray(domain.topology.original_cell_index, dtype=np.int64)


def cell_name(domain: mesh.Mesh) -> str:
    """'interval', 'triangle', 'tetrahedron', or whatever else the mesh is made of."""
    cell = domain.ufl_domain().ufl_cell
    return str((cell() if callable(cell) else cell).cellname())


def geometry_degree(domain: mesh.Mesh) -> int:
    """Polynomial degree of the mesh's geometry."""
    cmap = domain.geometry
    cmap = cmap.cmap if hasattr(cmap, "cmap") else cmap.cmaps[0]
    return int(cmap.degree)


def form(expression: Any) -> Any:
    """Compile a UFL form with the project's JIT options."""
    new = hasattr(jit, "ffcx_jit") and "jit_options" in fem.form.__code__.co_varnames
    name = "jit_options" if new else "jit_params"

    def make(cache: str) -> Any:
        return fem.form(expression, **{name: {**JIT_OPTIONS, "cache_dir": cache}})

    return jitcache.compiled(expression.ufl_domains()[0].ufl_cargo().comm, make)


def expression(value: Any, space: fem.FunctionSpace) -> fem.Expression:
    """A compiled UFL expression at the interpolation points of ``space``."""
    points = space.element.interpolation_points
    points = points() if callable(points) else points
    new = "jit_options" in inspect.signature(fem.Expression.__init__).parameters
    name = "jit_options" if new else "jit_params"

    def make(cache: str) -> Any:
        return fem.Expression(value, points, **{name: {**JIT_OPTIONS, "cache_dir": cache}})

    return jitcache.compiled(space.mesh.comm, make)


def evaluate(compiled: fem.Expression, domain: mesh.Mesh, cells: Ints) -> Array:
    """Values of a compiled expression on cells, shape (cells, points × value size)."""
    try:
        values = np.asarray(compiled.eval(domain, cells))
    except TypeError:  # up to 0.6 the expression knows its mesh
        values = np.asarray(compiled.eval(cells))
    return values.reshape(len(cells), int(np.prod(values.shape[1:])))  # also of no cells


def integrals(compiled: Any, kind: int) -> list[tuple[int, Any]]:
    """(subdomain id, ufcx integral) of a compiled form; kind 0 = cells, 1 = exterior facets.

    A derivative that is identically zero compiles to a form without integrals: an empty list.
    """
    ufcx = compiled.ufcx_form
    if hasattr(ufcx, "integral_ids"):
        count = ufcx.num_integrals(kind)
        ids, table = ufcx.integral_ids(kind), ufcx.integrals(kind)
        return [(ids[i], table[i]) for i in range(count)]
    first, last = ufcx.form_integral_offsets[kind], ufcx.form_integral_offsets[kind + 1]
    return [(ufcx.form_integral_ids[i], ufcx.form_integrals[i]) for i in range(first, last)]


def coefficient_positions(compiled: Any) -> list[int]:
    """Position in the original UFL form of each coefficient that the kernel reads."""
    ufcx = compiled.ufcx_form
    if hasattr(ufcx, "original_coefficient_positions"):
        return [ufcx.original_coefficient_positions[i] for i in range(ufcx.num_coefficients)]
    return [ufcx.original_coefficient_position[i] for i in range(ufcx.num_coefficients)]


def petsc_vector(function: fem.Function) -> Any:
    """The PETSc Vec that shares the function's storage."""
    return function.x.petsc_vec if hasattr(function.x, "petsc_vec") else function.vector


def free_vector(function: fem.Function) -> None:
    """Destroy the Vec of :func:`petsc_vector`, if there is one: dolfinx 0.5 never does."""
    for holder in (function, function.x):
        vector = getattr(holder, "_petsc_x", None)
        if vector is not None:
            vector.destroy()
            holder._petsc_x = None


def mesh_from_gmsh(model: Any, comm: Any, rank: int = 0, gdim: int = 3) -> tuple[Any, Any, Any]:
    """Mesh, cell tags and facet tags of a gmsh model that ``rank`` holds; collective."""
    # Not imported by dolfinx.io itself: it needs gmsh.
    name = "gmsh" if find_spec("dolfinx.io.gmsh") else "gmshio"
    module = import_module(f"dolfinx.io.{name}")
    out = module.model_to_mesh(model, comm, rank, gdim=gdim)
    if hasattr(out, "mesh"):
        return out.mesh, out.cell_tags, out.facet_tags
    return out[0], out[1], out[2]


def create_mesh(comm: Any, cells: Any, points: Array, ranks: Ints | None = None) -> mesh.Mesh:
    """A simplicial mesh from global cells (int64) and points (float64) given by each rank.

    ``ranks`` says where each of the cells given by this rank goes; else a graph partitioner does.
    """
    tdim = cells.shape[1] - 1
    name = {1: "interval", 2: "triangle", 3: "tetrahedron"}[tdim]
    gdim = points.shape[1]
    if hasattr(ufl, "VectorElement"):
        element = ufl.VectorElement(
            ufl.FiniteElement("Lagrange", name, 1, variant="equispaced"), dim=gdim
        )
    else:
        from basix.ufl import element as basix_element

        element = basix_element("Lagrange", name, 1, shape=(gdim,))
    domain = ufl.Mesh(element)
    none = mesh.GhostMode.none
    if "ghost_mode" in inspect.signature(mesh.create_mesh).parameters:  # 0.5
        given = {}
        if ranks is not None:
            given["partitioner"] = lambda *asked: _with_neighbours(comm, ranks, asked[3], asked[2])
        return mesh.create_mesh(comm, cells, points, domain, ghost_mode=none, **given)
    partitioner = mesh.create_cell_partitioner(none)
    if ranks is not None:
        offsets = np.arange(len(ranks) + 1, dtype=np.int32)
        partitioner = lambda *_: cpp.graph.AdjacencyList_int32(ranks, offsets)  # noqa: E731
    try:
        return mesh.create_mesh(comm, cells, points, domain, partitioner=partitioner)
    except TypeError:  # 0.10 moved the element before the points
        return mesh.create_mesh(comm, cells, domain, points, partitioner=partitioner)


def _with_neighbours(comm: Any, ranks: Ints, cells: Any, tdim: int) -> Any:
    """Ranks of cells, and of their neighbours over facets, as 0.5 wants them; collective.

    It finds out which ranks share a node from ghost cells, which it then removes.
    """
    graph = cpp.mesh.build_dual_graph(comm, cells, tdim)
    neighbours = np.asarray(graph.array)
    own = np.repeat(np.arange(len(ranks)), np.diff(graph.offsets))
    first = np.concatenate([[0], np.cumsum(comm.allgather(len(ranks)))])
    wanted, at = np.unique(neighbours, return_inverse=True)
    cut = np.searchsorted(wanted, first)
    asked = comm.alltoall([wanted[a:b] for a, b in itertools.pairwise(cut)])
    heard = comm.alltoall([ranks[part - first[comm.rank]] for part in asked])
    beside = np.concatenate(heard)[at]
    ghost = beside != ranks[own]
    pairs = np.unique(np.stack([own[ghost], beside[ghost]]), axis=1)
    # The owner comes first.
    cell = np.concatenate([np.arange(len(ranks)), pairs[0]])
    order = np.argsort(cell, kind="stable")
    offsets = np.searchsorted(cell[order], np.arange(len(ranks) + 1)).astype(np.int32)
    out = np.concatenate([ranks, pairs[1]])[order].astype(np.int32)
    return cpp.graph.AdjacencyList_int32(out, offsets)


def facet_nodes(domain: mesh.Mesh, facets: Ints) -> Ints:
    """Geometry nodes of facets of a simplicial mesh, shape (facets, d)."""
    tdim = domain.topology.dim
    domain.topology.create_connectivity(tdim - 1, tdim)
    domain.topology.create_connectivity(tdim, tdim - 1)
    to_cell = domain.topology.connectivity(tdim - 1, tdim)
    to_facet = domain.topology.connectivity(tdim, tdim - 1).array.reshape(-1, tdim + 1)
    cells = to_cell.array[to_cell.offsets[facets]]
    # Facet i of a simplex lies opposite to its vertex i, but that of an interval is vertex i.
    beside = (to_facet[cells] != np.asarray(facets)[:, None]) ^ (tdim == 1)
    return cell_nodes(domain)[cells][beside].reshape(-1, tdim)


def tags_from_nodes(domain: mesh.Mesh, dim: int, nodes: Any, values: Any) -> Any:
    """Tags of entities that any rank gives by the input numbers of their nodes; collective."""
    given = np.ascontiguousarray(nodes, dtype=np.int64), np.asarray(values, dtype=np.int32)
    # In 0.5 it is the C++ function itself.
    entities, values = io.distribute_entity_data(getattr(domain, "_mesh", domain), dim, *given)
    domain.topology.create_connectivity(dim, 0)
    domain.topology.create_connectivity(dim, domain.topology.dim)
    table = cpp.graph.AdjacencyList_int32(np.asarray(entities, dtype=np.int32))
    return mesh.meshtags_from_entities(domain, dim, table, np.asarray(values, dtype=np.int32))


def vtk_mesh(domain: mesh.Mesh) -> tuple[Any, Any, Any]:
    """Topology, cell types and points of this rank's mesh, as pyvista takes them."""
    maker = plot.vtk_mesh if hasattr(plot, "vtk_mesh") else plot.create_vtk_mesh
    return maker(domain, domain.topology.dim)


def exterior_facets(domain: mesh.Mesh) -> Ints:
    """Owned facets on the boundary of the body."""
    tdim = domain.topology.dim
    domain.topology.create_connectivity(tdim - 1, tdim)
    if tdim > 1:
        return np.asarray(mesh.exterior_facet_indices(domain.topology), dtype=np.int32)
    # Without ghost cells, 0.9 takes points between two ranks for the boundary of an interval.
    domain.topology.create_connectivity(1, 0)
    points, cells = domain.topology.index_map(0), cell_count(domain)[0]
    ends = domain.topology.connectivity(1, 0).array[: 2 * cells]
    touching = la.vector(points)
    touching.array[:] = np.bincount(ends, minlength=len(touching.array))
    mode = la.ScatterMode.add if hasattr(la, "ScatterMode") else la.InsertMode.add
    touching.scatter_reverse(mode)
    return np.flatnonzero(touching.array[: points.size_local] == 1).astype(np.int32)


def add_ghosts(function: fem.Function) -> None:
    """Add what ghosts hold to their owners; ghosts keep what they hold."""
    mode = la.ScatterMode.add if hasattr(la, "ScatterMode") else la.InsertMode.add
    function.x.scatter_reverse(mode)


def accumulate(function: fem.Function) -> None:
    """Add what ghosts hold to their owners, then give all copies the owners' values."""
    add_ghosts(function)
    function.x.scatter_forward()


def expression_kernel(value: Any, points: Array, comm: Any) -> tuple[Any, Any]:
    """A UFL expression compiled at reference points: what keeps it alive, and its C function."""
    old = "form_compiler_params" in inspect.signature(jit.ffcx_jit).parameters  # up to 0.5
    compiler: tuple[str, str] = "form_compiler_options", "jit_options"
    own: Any = np.float64
    if old:
        compiler, own = ("form_compiler_params", "jit_params"), "double"

    def make(cache: str) -> Any:
        options = {compiler[0]: {"scalar_type": own},
                   compiler[1]: {**JIT_OPTIONS, "cache_dir": cache}}  # fmt: skip
        return jit.ffcx_jit(comm, (value, points), **options)

    made = jitcache.compiled(comm, make)
    return made, made[0].tabulate_tensor_float64


def closest_cells(domain: mesh.Mesh, points: Array) -> Ints:
    """This rank's cell nearest to each point (points, 3): the one that it lies in, if any."""
    tdim = domain.topology.dim
    make = geometry.bb_tree if hasattr(geometry, "bb_tree") else geometry.BoundingBoxTree
    middles = geometry.create_midpoint_tree(
        domain, tdim, np.arange(cell_count(domain)[0], dtype=np.int32)
    )
    return geometry.compute_closest_entity(make(domain, tdim), middles, domain, points)
