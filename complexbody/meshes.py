# SPDX-License-Identifier: LGPL-3.0-or-later
"""Meshes that scenes often need: boxes, graded intervals, scattered vertices, plates by gmsh.

All are straight simplices, the same for every number of ranks. Knows nothing of bodies.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from enum import IntEnum
from typing import Any

import numpy as np
from dolfinx import fem
from dolfinx import mesh as dmesh

from complexbody import _compat
from complexbody._compat import Array, Ints
from complexbody.errors import MeshError, MissingPackage, agree
from complexbody.partition import balanced

__all__ = [
    "Side", "altitudes", "balanced", "box", "graded_interval", "interval", "jiggled",
    "notched_plate", "perforated_plate", "rectangle",
]  # fmt: skip

#: Facet tags: x = 0 and length, y = 0 and width, z = 0 and thickness; walls of a hole or a notch.
Side = IntEnum("Side", "LEFT RIGHT BOTTOM TOP BACK FRONT HOLE NOTCH")

#: Delaunay: HXT makes another mesh every time. Optimiser: Netgen's takes three times as long.
_GMSH = {
    "General.Terminal": 0, "General.NumThreads": 1, "Mesh.MeshSizeExtendFromBoundary": 0,
    "Mesh.MeshSizeFromPoints": 0, "Mesh.Algorithm3D": 1, "Mesh.OptimizeThreshold": 0.5,
}  # fmt: skip


def interval(comm: Any, lower: float, upper: float, cells: int) -> dmesh.Mesh:
    """Uniform interval of ``cells`` cells."""
    return dmesh.create_interval(comm, cells, [lower, upper], ghost_mode=dmesh.GhostMode.none)


def rectangle(comm: Any, lower: Sequence[float], upper: Sequence[float], cells: Any) -> dmesh.Mesh:
    """Rectangle of ``cells`` per axis (a number or a pair), two right triangles each."""
    n = np.broadcast_to(cells, 2).tolist()
    return dmesh.create_rectangle(comm, [lower, upper], n, ghost_mode=dmesh.GhostMode.none)


def box(comm: Any, lower: Sequence[float], upper: Sequence[float], cells: Any) -> dmesh.Mesh:
    """Box of ``cells`` per axis (a number or a triple), six tetrahedra each."""
    n = np.broadcast_to(cells, 3).tolist()
    return dmesh.create_box(comm, [lower, upper], n, ghost_mode=dmesh.GhostMode.none)


def graded_interval(comm: Any, sizes: Sequence[float] | Array, start: float = 0.0) -> dmesh.Mesh:
    """Interval from ``start`` on, of cells of the ``sizes`` [m]; MeshError unless all are > 0."""
    h = np.asarray(sizes, dtype=np.float64)
    if h.ndim != 1 or h.size == 0 or not (np.isfinite(h).all() and h.min() > 0):
        raise MeshError("graded_interval: sizes are not a list of positive numbers. Give one.")
    cells = np.arange(h.size, dtype=np.int64)[:, None] + np.array([0, 1])
    points = start + np.concatenate([[0.0], np.cumsum(h)])[:, None]
    mine = slice(None if comm.rank == 0 else 0)  # rank 0 gives the whole mesh
    return _compat.create_mesh(comm, cells[mine], points[mine])


def altitudes(mesh: dmesh.Mesh) -> Array:
    """Smallest altitude of each owned cell [m]; over the wave speed, about its critical step."""
    inverse = np.linalg.inv(_edges(mesh)[0])  # its columns are gradients of shape functions
    return 1.0 / np.linalg.norm(np.dstack([inverse, -inverse.sum(axis=2)]), axis=1).max(axis=1)


def jiggled(mesh: dmesh.Mesh, amount: float = 0.2, seed: int = 0) -> dmesh.Mesh:
    """The mesh, its interior vertices moved at random, the same for every number of ranks.

    Args:
        mesh: A mesh of straight simplices, moved in place; its boundary stays.
        amount: Largest move along each axis, over the size (d!|K|)^(1/d) of cells averaged around
            the vertex. Below 0.25 no cell of a box turns over.
        seed: Another seed gives other moves.

    Raises:
        MeshError: if a cell would turn over (on all ranks; the mesh is then as it was).
    """
    _compat.equispaced(mesh)
    x, dim, space = mesh.geometry.x, mesh.geometry.dim, _compat.vector_space(mesh, 2)
    edges, nodes = _edges(mesh)
    before = np.linalg.det(edges)
    sums = fem.Function(space)  # per node: sizes of its cells, and their number
    table = sums.x.array.reshape(-1, 2)
    for column, weights in enumerate((np.repeat(np.abs(before) ** (1.0 / dim), dim + 1), None)):
        table[:, column] = np.bincount(nodes.ravel(), weights, len(x))
    _compat.accumulate(sums)
    move = amount * table[:, 0] / table[:, 1]
    move[fem.locate_dofs_topological(space, dim - 1, _compat.exterior_facets(mesh))] = 0.0
    key, old = np.asarray(mesh.geometry.input_global_indices, dtype=np.uint64), x.copy()
    for axis in range(dim):
        x[:, axis] += move * _random(key * np.uint64(dim) + np.uint64(axis), seed)
    turned = mesh.comm.allreduce(int(np.sum(np.linalg.det(_edges(mesh)[0]) * before <= 0)))
    if turned:
        x[:] = old
        raise MeshError(f"jiggled: {turned} cells would turn over. Give amount < {amount:g}.")
    return mesh


def perforated_plate(
    comm: Any, length: float, width: float, thickness: float, radius: float, size: float,
    size_at_hole: float, centre: Sequence[float] | None = None, growth: float = 0.25,
) -> tuple[dmesh.Mesh, Any, Any]:  # fmt: skip
    """Plate (0, length) × (0, width) × (0, thickness) with a round hole along z, by gmsh.

    Args:
        comm: Communicator; rank 0 makes the mesh.
        length: Of the plate, along x [m].
        width: Along y.
        thickness: Along z.
        radius: Of the hole [m].
        size: Length of edges far from the hole [m].
        size_at_hole: The same at the hole.
        centre: (x, y) of the hole's axis; the plate's middle by default.
        growth: Growth of the edges' length per distance from the hole; 0.1 to 0.3 is smooth.

    Returns:
        Mesh, cell tags (all 1) and facet tags (:data:`Side`).

    Raises:
        MeshError: if the hole is not inside the plate, or gmsh fails (on all ranks).
        MissingPackage: if gmsh cannot be imported.
    """
    x, y = (length / 2, width / 2) if centre is None else centre
    given = np.array([length, width, thickness, x, y, radius, size, size_at_hole, growth * length])
    inside = radius < min(x, y, length - x, width - y) and size_at_hole <= size
    if not (np.all((given > 0) & np.isfinite(given)) and inside):
        raise MeshError(
            f"perforated_plate: no hole of radius {radius:g} at ({x:g}, {y:g}) with these sizes. "
            "Give positive numbers, size_at_hole ≤ size and a hole inside the plate."
        )
    # In units of the length, for the tolerances of gmsh's geometry are absolute.
    scaled = (given / length).reshape(3, 3).tolist()
    return _by_gmsh(comm, lambda gmsh: _draw(gmsh, *scaled), length)


def notched_plate(
    comm: Any, length: float, width: float, notch: float, opening: float, size: float,
    size_at_tip: float, thickness: float | None = None, growth: float = 0.25,
) -> tuple[dmesh.Mesh, Any, Any]:  # fmt: skip
    """Plate (0, length) × (0, width) with a sharp notch from the left, by gmsh.

    The notch is a wedge along y = width/2, of the given opening at x = 0 and with its tip at
    x = notch. Edges grow linearly with the distance from the tip.

    Args:
        comm: Communicator; rank 0 makes the mesh.
        length: Of the plate, along x [m].
        width: Along y.
        notch: Length of the notch.
        opening: Of the notch at the plate's edge; small for a slit.
        size: Length of edges far from the tip [m].
        size_at_tip: The same at the tip.
        thickness: Along z, of a three-dimensional plate; None makes a mesh of triangles.
        growth: Growth of the edges' length per distance from the tip; 0.1 to 0.3 is smooth.

    Returns:
        Mesh, cell tags (all 1) and facet tags (:data:`Side`).

    Raises:
        MeshError: if the notch is not inside the plate, or gmsh fails (on all ranks).
        MissingPackage: if gmsh cannot be imported.
    """
    z = 1.0 if thickness is None else thickness
    given = np.array([length, width, notch, opening, size, size_at_tip, z, growth])
    inside = notch < length and opening < width and size_at_tip <= size
    if not (np.all((given > 0) & np.isfinite(given)) and inside):
        raise MeshError(
            f"notched_plate: no notch of {notch:g} × {opening:g} in a plate of {length:g} × "
            f"{width:g} with these sizes. Give positive numbers, size_at_tip ≤ size and a notch "
            "inside the plate."
        )
    scaled, depth = given[1:6] / length, None if thickness is None else thickness / length

    def draw(gmsh: Any) -> None:
        _draw_notched(gmsh, scaled.tolist(), depth, growth)

    return _by_gmsh(comm, draw, length, 2 if thickness is None else 3)


def _by_gmsh(
    comm: Any, draw: Callable[[Any], None], length: float, dim: int = 3
) -> tuple[dmesh.Mesh, Any, Any]:
    """Mesh, cell tags and facet tags of what ``draw`` makes on rank 0 in units of ``length``."""
    error: Exception | None = None
    with ExitStack() as stack:
        # gmsh changes what Ctrl-C does: 4.8 when it is imported, later ones when they start.
        stack.callback(signal.signal, signal.SIGINT, signal.getsignal(signal.SIGINT))
        try:
            import gmsh

            if comm.rank == 0:
                _start(gmsh, stack)
                draw(gmsh)
        except (ImportError, OSError) as problem:  # the latter for a missing shared library
            error = MissingPackage(f"No gmsh: {problem}. Install it: apt install python3-gmsh.")
        except Exception as problem:  # gmsh raises nothing more special
            error = MeshError(f"gmsh cannot mesh this plate: {problem}. Try other sizes.")
        agree(comm, error)
        mesh, cell_tags, facet_tags = _compat.mesh_from_gmsh(gmsh.model, comm, gdim=dim)
        mesh.geometry.x[:] *= length
        return mesh, cell_tags, facet_tags


def _draw(gmsh: Any, plate: Sequence[float], hole: Sequence[float], sizes: Sequence[float]) -> None:
    """Geometry, tags, sizes and mesh of a perforated plate in gmsh's current model."""
    (x, y, radius), (size, fine, growth), occ = hole, sizes, gmsh.model.occ
    solid, drill = occ.addBox(0, 0, 0, *plate), occ.addCylinder(x, y, 0, 0, 0, plate[2], radius)
    occ.cut([(3, solid)], [(3, drill)])
    occ.synchronize()
    _tag(gmsh, 3, plate, Side.HOLE)
    distance = f"Sqrt((x-({x:.17g}))^2+(y-({y:.17g}))^2)-{radius:.17g}"
    _grow(gmsh, distance, size, fine, growth)
    gmsh.model.mesh.generate(3)


def _draw_notched(gmsh: Any, lengths: Sequence[float], depth: float | None, growth: float) -> None:
    """Geometry, tags, sizes and mesh of a notched plate of length 1 in gmsh's current model."""
    width, notch, opening, size, fine = lengths
    occ, y, half = gmsh.model.occ, width / 2, opening / 2
    outline = [(0, 0), (1, 0), (1, width), (0, width), (0, y + half), (notch, y), (0, y - half)]
    points = [occ.addPoint(*corner, 0) for corner in outline]
    lines = [occ.addLine(p, q) for p, q in zip(points, points[1:] + points[:1], strict=True)]
    face = occ.addPlaneSurface([occ.addCurveLoop(lines)])
    if depth is not None:
        occ.extrude([(2, face)], 0, 0, depth)
    occ.synchronize()
    _tag(gmsh, 2 if depth is None else 3, (1.0, width, depth or 1.0), Side.NOTCH)
    _grow(gmsh, f"Sqrt((x-({notch:.17g}))^2+(y-({y:.17g}))^2)", size, fine, growth)
    gmsh.model.mesh.generate(2 if depth is None else 3)


def _tag(gmsh: Any, dim: int, plate: Sequence[float], other: Side) -> None:
    """Physical groups: the body, the plate's sides, and all else that bounds it."""
    gmsh.model.addPhysicalGroup(dim, [tag for _, tag in gmsh.model.getEntities(dim)], 1)
    sides: dict[int, list[int]] = {}
    for _, tag in gmsh.model.getEntities(dim - 1):
        # The middle of a wall of hole or notch lies on no side.
        at = np.array(gmsh.model.occ.getCenterOfMass(dim - 1, tag)[:dim]) / plate[:dim]
        planes = np.abs(np.stack([at, at - 1], axis=1).ravel()) < 1e-6
        side = int(planes.argmax()) + 1 if planes.any() else int(other)
        sides.setdefault(side, []).append(tag)
    for side, tags in sides.items():
        gmsh.model.addPhysicalGroup(dim - 1, tags, side)


def _grow(gmsh: Any, distance: str, size: float, fine: float, growth: float) -> None:
    """Edges of length ``fine`` at distance 0, growing to ``size``."""
    field = gmsh.model.mesh.field
    measured, graded = field.add("MathEval"), field.add("Threshold")  # exact; "Distance" samples
    field.setString(measured, "F", distance)
    ends = {"SizeMin": fine, "SizeMax": size, "DistMin": 0.0, "DistMax": (size - fine) / growth}
    for name, value in (("InField", measured), *ends.items()):
        field.setNumber(graded, name, value)
    field.setAsBackgroundMesh(graded)


def _start(gmsh: Any, stack: ExitStack) -> None:
    """Begin a model in gmsh with our options; ``stack`` leaves gmsh as it was, running or not."""
    gmsh.initialize([], readConfigFiles=False)  # does nothing if it is running
    if gmsh.model.list() == [""]:  # it was not
        stack.callback(gmsh.finalize)
    else:
        for name in _GMSH:
            stack.callback(gmsh.option.setNumber, name, gmsh.option.getNumber(name))
        stack.callback(gmsh.model.remove)
    for name, value in _GMSH.items():
        gmsh.option.setNumber(name, value)
    gmsh.model.add("complexbody")


def _edges(mesh: dmesh.Mesh) -> tuple[Array, Ints]:
    """Edges from the first vertex of each owned cell, shape (cells, d, d), and the cells' nodes."""
    x, nodes = mesh.geometry.x, _compat.cell_nodes(mesh)[: _compat.cell_count(mesh)[0]]
    return (x[nodes[:, 1:]] - x[nodes[:, :1]])[..., : mesh.geometry.dim], nodes


def _random(keys: Any, seed: int) -> Array:
    """A number in [-1, 1) for each key: the splitmix64 hash of key and seed."""
    z = keys + np.uint64((seed + 1) * 0x9E3779B97F4A7C15 % 2**64)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        z = (z ^ (z >> np.uint64(shift))) * np.uint64(factor)
    return (z >> np.uint64(11)).astype(np.float64) * 2.0**-52 - 1.0
