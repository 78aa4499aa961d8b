# SPDX-License-Identifier: LGPL-3.0-or-later
"""Images of coloured triangles by VTK, off screen, without any lettering; for one process.

Parallel projection in a given frame. Knows no body: only triangles, colours, and where from.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from complexbody._compat import Array, Ints
from complexbody.errors import MissingPackage

_FEW = 1500  # faces up to which the edges of all of them are drawn
_ASLANT = np.array([0.52, -0.73, 0.45]) / np.linalg.norm([0.52, -0.73, 0.45])
_TRIAL = """import vtkmodules.vtkRenderingOpenGL2
from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow
window = vtkRenderWindow()
window.SetOffScreenRendering(1)
window.AddRenderer(vtkRenderer())
window.Render()
"""


@cache
def require_vtk() -> None:
    """See that VTK can draw: without a GL library it crashes, so another process tries.

    Raises:
        MissingPackage: if pyvista or a GL library is missing.
    """
    if find_spec("pyvista") is None:
        raise MissingPackage("Picture: there is no pyvista. Run: pip install pyvista 'vtk<9.6'")
    trial = subprocess.run(
        [sys.executable, "-c", _TRIAL], capture_output=True, text=True, timeout=120, check=False
    )
    if trial.returncode != 0:
        raise MissingPackage(
            f"Picture: VTK cannot draw here (exit {trial.returncode}), for want of a GL library. "
            "Run: apt-get install libosmesa6 (Debian 12) or libegl1 libgl1-mesa-dri (Debian 13)"
        )


@dataclass
class View:
    """A frame and where it is looked at from.

    Attributes:
        screen: Unit vectors to the right and up, as rows (2, 3).
        low: Lower left corner in terms of these vectors [m].
        high: Upper right corner.
    """

    screen: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, points: Array, solid: bool, eye: Sequence[float] | None = None) -> View:
        """A frame around points (points, 3).

        Args:
            points: All that is to be seen.
            solid: Looked at aslant from the front, else from above.
            eye: Direction to where a solid is looked at from, instead (3,).
        """
        towards = _ASLANT if solid else np.array([0.0, 0.0, 1.0])
        if solid and eye is not None:
            towards = np.asarray(eye, dtype=float) / np.linalg.norm(eye)
        above = abs(towards[2]) > 1 - 1e-9
        right = np.cross([0.0, 1.0, 0.0] if above else [0.0, 0.0, 1.0], towards)
        right /= np.linalg.norm(right)
        screen = np.array([right, np.cross(towards, right)])
        seen = points @ screen.T
        margin = 0.02 * np.ptp(seen, axis=0).max()
        return cls(screen, seen.min(axis=0) - margin, seen.max(axis=0) + margin)

    @property
    def towards(self) -> Array:
        """Unit vector to where it is looked at from."""
        return np.cross(*self.screen)

    def and_also(self, other: View) -> View:
        """A frame around what is in this one and in another from the same direction."""
        return View(
            self.screen, np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        )

    @property
    def aspect(self) -> float:
        """Height over width."""
        width, height = self.high - self.low
        return float(height / width)


def image(
    view: View,
    height: int,
    faces: Ints,
    rest: Array,
    points: Array,
    colours: Array,
    colour_map: tuple[str, tuple[float, float]],
) -> Any:
    """Triangles (lit, if they are seen aslant), with their sharp edges and those at rest.

    Args:
        view: What of them is seen, and from where.
        height: Of the image [pixels].
        faces: Triangles (faces, 3).
        rest: Where their points are at rest (points, 3).
        points: Where they are (points, 3).
        colours: Values at points, or on faces.
        colour_map: Its name, and the values at its ends.

    Returns:
        Colours from the top, shape (height, width, 3), of type uint8.
    """
    import pyvista as pv
    from vtkmodules.vtkCommonCore import vtkLogger

    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)  # it warns that there is no X server
    towards, screen = view.towards, view.screen
    solid, few = towards[2] < 1, len(faces) <= _FEW
    size = [round(height / view.aspect), height]
    plotter = pv.Plotter(off_screen=True, window_size=size, lighting="none")
    plotter.set_background("white")
    if solid:
        lamp = towards - 0.6 * screen[0] + 0.9 * screen[1]
        for direction, intensity in ((towards, 0.42), (lamp, 0.22)):
            light = pv.Light(position=direction, light_type="scene light", intensity=intensity)
            plotter.add_light(light)
    surface = pv.PolyData.from_regular_faces(points, faces)
    preference = "point" if len(colours) == len(points) else "cell"
    (surface.point_data if preference == "point" else surface.cell_data)["shown"] = colours
    plotter.add_mesh(
        surface,
        scalars="shown",
        preference=preference,
        cmap=colour_map[0],
        clim=colour_map[1],
        nan_color="magenta",
        show_scalar_bar=False,
        lighting=solid,
        ambient=0.5 if solid else 1.0,  # colours are to be those of the bar
        diffuse=1.0 if solid else 0.0,
        smooth_shading=solid and not few,
        split_sharp_edges=solid and not few,
        show_edges=few,
        edge_color="black",
        edge_opacity=0.15,
        line_width=1,
    )
    still = pv.PolyData.from_regular_faces(rest, faces)
    still["id"] = np.arange(len(rest))
    edges = still.extract_feature_edges(
        feature_angle=35,
        boundary_edges=True,
        feature_edges=bool(np.ptp(rest[:, 2]) > 0),  # faces of flat bodies look either way
        manifold_edges=False,
        non_manifold_edges=False,
    )
    if edges.n_points:
        now = edges.copy()
        # A little nearer, so that they are not drawn inside the faces.
        now.points = points[edges["id"]] + 1e-3 * np.ptp(rest) * towards
        plotter.add_mesh(edges, color="#a6a6a6", line_width=3, lighting=False)
        plotter.add_mesh(now, color="#333333", line_width=3, lighting=False)
    middle = screen.T @ (view.low + view.high) / 2 + towards * (points @ towards).mean()
    camera = plotter.camera
    camera.focal_point = middle
    camera.position = middle + 10 * np.ptp(points, axis=0).max() * towards
    camera.up = screen[1]
    camera.parallel_projection = True
    camera.parallel_scale = (view.high - view.low)[1] / 2
    camera.reset_clipping_range()
    picture = plotter.screenshot(None, return_img=True)
    plotter.close()
    return picture
