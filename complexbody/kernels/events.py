# SPDX-License-Identifier: LGPL-3.0-or-later
"""The library of asynchronous events of a scene: its regions' event functions and their replay."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

from complexbody import native
from complexbody.kernels.event_source import EventSource
from complexbody.kernels.ffcx import TabulatedRecord
from complexbody.kernels.library import Kernels
from complexbody.masses import SCHEMES

if TYPE_CHECKING:
    from complexbody.integrators.asynchronous import AVI

#: Blocks of cells whose nodes drift together before the cells act: less than an L1 cache full.
CHUNK = 8
#: Nodes that are moved to a window's end together, or are quiet together; a multiple of W.
RANGE = 16


def regions(kernels: Kernels) -> list[EventSource | None]:
    """Source generators of the regions with generated code; None for the others."""
    d, disc, scene = kernels.densities, kernels.disc, kernels.action.scene
    lumped = scene.lumped
    out: list[EventSource | None] = []
    for r, generated in enumerate(d.generated):
        stored = d.stored[r]
        if not generated or stored is None:
            out.append(None)
            continue
        out.append(EventSource(r, stored, d.potential[r], disc.n, disc.dim, lumped, d.coefficients))
    return out


class Forms:
    """Forces of the regions FFCx takes, as the loops read them."""

    def __init__(self, kernels: Kernels) -> None:
        bodies = range(len(kernels.action.scene.bodies))
        generated = kernels.densities.generated
        self._keep = {r: kernels.tabulated[r][0] for r in bodies if not generated[r]}
        self.records = (TabulatedRecord * len(bodies))()
        for r, force in self._keep.items():
            self.records[r] = force.record


def record_size(components: int, record: int, third: bool) -> tuple[int, int, int]:
    """(doubles per node, slot of its time, slot of 1/volume), as in drifts.h.

    Args:
        components: N.
        record: NR.
        third: Whether there is more than position and rate.
    """
    parts = 3 if third else 2
    if record - components >= 2:
        return parts * record, components, components + 1
    return (parts + (2 if record < 2 else 1)) * record, parts * record, parts * record + 1


def load(kernels: Kernels, method: AVI, damped: bool, slow: bool) -> ctypes.CDLL:
    """Compile the events of a scene.

    Args:
        kernels: The scene's kernels.
        method: The integrator: balanced or not, its dissipation scheme.
        damped: There is viscosity.
        slow: Components of ν differ in η/ρ̄, lack inertia, or are coupled by Ω or η.
    """
    disc, scene = kernels.disc, kernels.action.scene
    exact = method.schedule == "exact"
    coefficients = len(kernels.densities.coefficients)
    defines = {
        "N": disc.n, "NU": scene.displacement, "NR": disc.record, "W": disc.lanes,
        "DIM": disc.dim, "GEOMETRY": disc.dim**2 + 1, "COEFFICIENTS": coefficients,
        "BALANCED": int(bool(method.balanced)), "DAMPED": int(damped),
        "SLOW": int(slow), "SCHEME": SCHEMES.index(method.dissipation),
        "CORRECTED": int(bool(method.corrected)), "PACKED": packed_size(kernels),
        "CHUNK": CHUNK, "RANGE": RANGE, "EXACT": int(exact),
    }  # fmt: skip
    parts = [f"#define {name} {value}" for name, value in defines.items()]
    files = ("vectors.h", "tabulated.h", "quiet.h", "drifts.h", "events.h")
    parts += [native.template(name) for name in files]
    if exact:
        parts.append(native.template("lone.h"))
    cases = ""
    for r, region in enumerate(regions(kernels)):
        forms = f"(s)->forms + {r}"
        if exact:
            arguments = f"{forms}, s, c, cell, t, soft, count, out"
            call = f"tabulated_lone({arguments})"
            if region is not None:
                parts.append(region.lone(bool(method.corrected)))
                call = f"lone_{r}(s, c, b, k, t, soft, out)"
        elif region is not None:
            parts.append(region.event(bool(method.balanced)))
            call = f"event_{r}(blocks, c, g, k, held, blend, s, h, mode)"
        else:
            call = f"tabulated_event({forms}, blocks, first, c, held, blend, s, h, mode)"
        cases += f"case {r}: {call}; break; "
    head = "EVENT(region, blocks, first, c, g, k, held, blend, s, h, mode)"
    if exact:
        head = "LONE(region, s, c, cell, b, k, t, soft, count, out)"
    parts += [f"#define {head} switch (region) {{ {cases}}}", native.template("events.c")]
    parts += [native.template(name) for name in ("exact.c", "reached.c") if exact]
    return native.load("\n".join(parts))


def packed_size(kernels: Kernels) -> int:
    """Doubles per cell of an exact schedule: geometry, coefficients, step, nodes, alone."""
    disc = kernels.disc
    used = disc.dim**2 + 1 + len(kernels.densities.coefficients) + 1 + -(-(disc.dim + 2) // 2)
    return -(-used // disc.lanes) * disc.lanes
