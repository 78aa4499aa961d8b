# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pulse in a thin notched plate of tetrahedra, graded by 32 towards the notch's tip.

An icosahedral quasicrystal in *scaled* units (not a real material,
:func:`complexbody.forms.scaled_icosahedral_quasicrystal`): u and ν with three components each, the
full coupling of the two, some viscosity. Struck on the upper edge; the lower one is a plane of
symmetry, the others are free. Small cells sit all along the tip, through the thickness. The pulse
is slow enough for meshes of some 10 000 cells to resolve its waves to one per cent; the step is the
tip's.
"""

from __future__ import annotations

from typing import Any

import complexbody as cb
from complexbody.forms import scaled_icosahedral_quasicrystal
from complexbody.meshes import Side, notched_plate

DEFAULTS = {"until": 2.5}


def scene(
    comm: Any, refine: float = 0.3, grading: float = 32.0, frequency: float = 0.5,
    thickness: float = 0.06,
) -> cb.Scene:  # fmt: skip
    """The plate, 1.6 × 1 with a notch of length 0.6 from the left.

    Args:
        comm: Communicator.
        refine: Edges far from the tip have a length of 0.03 / refine.
        grading: Edges at the tip are so many times shorter.
        frequency: Of the Ricker pulse.
        thickness: Of the plate.
    """
    size = 0.03 / refine
    mesh, cell_tags, facet_tags = notched_plate(
        comm, 1.6, 1.0, 0.6, 0.02, size, size / grading, thickness, growth=3 * size
    )
    return cb.Scene(
        mesh, scaled_icosahedral_quasicrystal(),
        supports=[cb.Fix(field, Side.BOTTOM, components=1) for field in ("u", "nu")],
        loads=[cb.Pressure(Side.TOP, 1e-2, cb.ricker(frequency))],
        cell_tags=cell_tags, facet_tags=facet_tags, name="pulse in a notched plate, scaled units",
    )  # fmt: skip
