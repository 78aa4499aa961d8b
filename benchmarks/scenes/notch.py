# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pulse on a notch in two dimensions, cells graded by 64 towards its tip.

The plate of demos/graded_crack.py at sizes that a chart can afford: an icosahedral quasicrystal in
*scaled* units (not a real material, :func:`complexbody.forms.scaled_icosahedral_quasicrystal`),
struck on its upper edge by a Ricker pulse; the lower one is a plane of symmetry. Few small cells,
many large ones: one step for all is dictated by the few. There is no exact solution; at the tip the
stresses are singular, so that errors fall more slowly than by the second power of the cells' size.
"""

from __future__ import annotations

from typing import Any

import complexbody as cb
from complexbody.forms import scaled_icosahedral_quasicrystal
from complexbody.meshes import Side, notched_plate

DEFAULTS = {"until": 2.5}


def scene(
    comm: Any, refine: float = 0.5, grading: float = 64.0, frequency: float = 0.8
) -> cb.Scene:
    """The plate, 2.4 × 1 with a notch of length 0.9 from the left.

    Args:
        comm: Communicator.
        refine: Edges far from the tip have a length of 0.025 / refine.
        grading: Edges at the tip are so many times shorter.
        frequency: Of the pulse.
    """
    size = 0.025 / refine
    mesh, cell_tags, facet_tags = notched_plate(
        comm, 2.4, 1.0, 0.9, 0.02, size, size / grading, growth=2.4 * size
    )
    return cb.Scene(
        mesh, scaled_icosahedral_quasicrystal(),
        supports=[cb.Fix(field, Side.BOTTOM, components=1) for field in ("u", "nu")],
        loads=[cb.Pressure(Side.TOP, 1e-2, cb.ricker(frequency))],
        cell_tags=cell_tags, facet_tags=facet_tags, name="pulse on a notch, 2D, scaled units",
    )  # fmt: skip
