# SPDX-License-Identifier: LGPL-3.0-or-later
"""What can be seen of a whole mesh in one process: in three dimensions its surface, or a cut.

:mod:`complexbody.picture` does the same for a mesh that ranks share. Knows arrays alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from complexbody._compat import Array, Ints
from complexbody.errors import ResultsError
from complexbody.scales import Visible


class Surface:
    """Faces that can be seen, chosen once for all values.

    Args:
        points: Nodes (nodes, 3).
        cells: Node numbers of cells (cells, dim+1).
        clip: Axis (0, 1, 2) and coordinate [m] of a plane that cuts a solid open.
        eye: The solid's part towards this direction is taken away (3,).

    Raises:
        ResultsError: if the plane leaves nothing.
    """

    def __init__(
        self,
        points: Array,
        cells: Ints,
        clip: tuple[int, float] | None = None,
        eye: Array | None = None,
    ) -> None:
        self.dim = cells.shape[1] - 1
        self._points, self._clip = points, clip
        if self.dim < 3:
            self._seen, self._faces, self._owners = None, cells, np.arange(len(cells))
            return
        import pyvista as pv

        corner, *others = np.moveaxis(points[cells], 1, 0)
        edges = np.stack([other - corner for other in others], axis=1)
        turned = np.linalg.det(edges) < 0  # faces are to look outwards
        cells = np.where(turned[:, None], cells[:, [1, 0, 2, 3]], cells)
        self._grid = pv.UnstructuredGrid({pv.CellType.TETRA: cells}, points)
        self._seen = None
        if clip is None:
            surface = self._extracted(self._grid)
            self._seen = np.asarray(surface["vtkOriginalPointIds"])
            self._faces = surface.faces.reshape(-1, 4)[:, 1:]
            self._owners = np.asarray(surface["vtkOriginalCellIds"])
            return
        axis, at = clip
        towards = np.array([1.0, -1.0, 1.0]) if eye is None else np.asarray(eye)
        self._origin, self._normal = np.zeros(3), np.zeros(3)
        self._origin[axis], self._normal[axis] = at, 1.0 if towards[axis] >= 0 else -1.0
        if ((points - self._origin) @ self._normal > 0).all():
            low, high = points[:, axis].min(), points[:, axis].max()
            raise ResultsError(
                f"Clip at {'xyz'[axis]} = {at:g} m leaves nothing of the body. Give a coordinate "
                f"between {low:g} and {high:g} m."
            )

    @staticmethod
    def _extracted(grid: Any) -> Any:
        return grid.extract_surface(algorithm="dataset_surface").triangulate()

    def see(self, fields: Mapping[str, tuple[Array, bool]]) -> Visible:
        """The visible part of values.

        Args:
            fields: By name, values (nodes or cells, components), and whether they are per cell.
        """
        cellwise = frozenset(name for name, (_, per_cell) in fields.items() if per_cell)
        if self._clip is None:
            points = self._points if self._seen is None else self._points[self._seen]
            nodes = slice(None) if self._seen is None else self._seen
            values = {
                name: table[self._owners if per_cell else nodes]
                for name, (table, per_cell) in fields.items()
            }
            return Visible(self.dim, points, self._faces, values, cellwise)
        grid = self._grid.copy(deep=False)
        for name, (table, per_cell) in fields.items():
            (grid.cell_data if per_cell else grid.point_data)[name] = table
        # Values at points of the plane are those of P1 there.
        cut = self._extracted(grid.clip(normal=self._normal, origin=self._origin))
        cut = cut.clean(tolerance=1e-7)  # a plane through nodes makes triangles without an area
        faces = cut.faces.reshape(-1, 4)[:, 1:]
        values = {}
        for name, (table, per_cell) in fields.items():
            data = np.asarray((cut.cell_data if per_cell else cut.point_data)[name])
            # What is left of such triangles, points and lines, stands before the others.
            data = data[cut.n_cells - len(faces) :] if per_cell else data
            values[name] = data.reshape(-1, table.shape[1])
        return Visible(3, np.asarray(cut.points), faces, values, cellwise)
