# SPDX-License-Identifier: LGPL-3.0-or-later
"""Still pictures of a body: coloured by a field, deformed by another, several panels side by side.

Ranks send rank 0 what can be seen (in three dimensions the surface), and rank 0 draws it. Knows
functions on a mesh, and no scene.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from complexbody import _compat
from complexbody._compat import Ints
from complexbody.drawing import draw
from complexbody.errors import MissingPackage, OutputError
from complexbody.files import on_first_rank
from complexbody.rendering import require_vtk
from complexbody.scales import Panel, Visible

__all__ = ["Panel", "still"]


def still(
    path: str | Path,
    functions: Mapping[str, Any],
    panels: Panel | Sequence[Panel],
    title: str = "",
    time: float | None = None,
) -> None:
    """Draw a picture, 1600 pixels wide; collective.

    Args:
        path: The PNG file; its folder is made if it is missing.
        functions: Blocked P1 Functions, or piecewise constant ones, on one mesh, by name.
        panels: What to show.
        title: Stands above, in front of the time.
        time: Time stamp [s].

    Raises:
        OutputError: if a panel shows what is not there, or the file cannot be written.
        MissingPackage: if matplotlib, pyvista or a GL library is missing.
    """
    panels = (panels,) if isinstance(panels, Panel) else tuple(panels)
    _check(panels, functions)
    domain = next(iter(functions.values())).function_space.mesh
    file, dim = Path(path), domain.topology.dim
    on_first_rank(domain.comm, file, lambda: require_tools(dim))
    used = {name for panel in panels for name in (panel.field, panel.warp)}
    body = _visible(domain, {name: functions[name] for name in functions if name in used})

    def write() -> None:
        if body is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            draw(file, body, panels, title, time)

    on_first_rank(domain.comm, file, write)


def _check(panels: Sequence[Panel], functions: Mapping[str, Any]) -> None:
    known = ", ".join(functions)
    if not panels or not functions:
        raise OutputError("Picture: there is nothing to show. Give functions and a Panel.")
    for panel in panels:
        if panel.field not in functions:
            raise OutputError(f"Picture: there is no field {panel.field!r}. Give one of {known}.")
        # "u" is only the default: not every body has it at hand.
        if panel.warp not in (None, "u", *functions):
            raise OutputError(f"Picture: warp={panel.warp!r} is no field. Give one of {known}.")
        warp = functions.get(panel.warp or "")
        if warp is not None and _compat.is_cellwise(warp):
            raise OutputError(f"Picture: warp={panel.warp!r} has no nodal values. Give a P1 field.")
        count = functions[panel.field].function_space.dofmap.index_map_bs
        chosen = panel.component
        if chosen not in (None, "norm") and not (isinstance(chosen, int) and 0 <= chosen < count):
            raise OutputError(
                f"Picture: {panel.field!r} has no component {chosen!r}. Give 'norm', or a number "
                f"from 0 to {count - 1}."
            )


def require_tools(dim: int) -> None:
    """See that bodies of ``dim`` dimensions can be drawn.

    Raises:
        MissingPackage: if something is missing.
    """
    if find_spec("matplotlib") is None:
        raise MissingPackage("Picture: there is no matplotlib. Run: pip install matplotlib")
    if dim > 1:
        require_vtk()


def _visible(domain: Any, functions: Mapping[str, Any]) -> Visible | None:
    """What can be seen, on rank 0; None elsewhere. Collective."""
    dim = domain.topology.dim
    nodes, faces, cells = _compat.node_map(domain), *_faces(domain)
    used, local = np.unique(faces, return_inverse=True)
    values = {}
    for name, function in functions.items():
        function.x.scatter_forward()
        table = function.x.array.reshape(-1, function.function_space.dofmap.index_map_bs)
        values[name] = table[cells if _compat.is_cellwise(function) else used]
    numbers = nodes.local_to_global(used.astype(np.int32))
    part = (numbers, domain.geometry.x[used], numbers[local].reshape(faces.shape), values)
    parts = domain.comm.gather(part)
    if parts is None:
        return None
    # Ranks share nodes: each is to be there once.
    numbers, first = np.unique(np.concatenate([part[0] for part in parts]), return_index=True)
    gathered = {name: np.concatenate([part[3][name] for part in parts]) for name in functions}
    cellwise = frozenset(name for name in functions if _compat.is_cellwise(functions[name]))
    return Visible(
        dim,
        np.concatenate([part[1] for part in parts])[first],
        np.searchsorted(numbers, np.concatenate([part[2] for part in parts])),
        {name: table if name in cellwise else table[first] for name, table in gathered.items()},
        cellwise,
    )


def _faces(domain: Any) -> tuple[Ints, Ints]:
    """Nodes of this rank's visible faces (faces, 2 or 3), and the cell that each belongs to.

    Surface triangles are seen anticlockwise from outside.
    """
    tdim, nodes = domain.topology.dim, _compat.cell_nodes(domain)
    if tdim < 3:
        cells = np.arange(_compat.cell_count(domain)[0], dtype=np.int32)
        return nodes[cells], cells
    facets = _compat.exterior_facets(domain)
    domain.topology.create_connectivity(tdim, tdim - 1)
    to_cell = domain.topology.connectivity(tdim - 1, tdim)
    to_facet = domain.topology.connectivity(tdim, tdim - 1).array.reshape(-1, tdim + 1)
    cells = to_cell.array[to_cell.offsets[facets]]
    # Facet i of a simplex lies opposite to its vertex i.
    opposite = to_facet[cells] == facets[:, None]
    faces = nodes[cells][~opposite].reshape(-1, tdim)
    corner, *others = np.moveaxis(domain.geometry.x[faces], 1, 0)
    inside = domain.geometry.x[nodes[cells][opposite]] - corner
    normal = np.cross(*(other - corner for other in others))
    inward = np.einsum("fi,fi->f", normal, inside) > 0
    faces[inward] = faces[inward, ::-1]
    return faces, cells
