# SPDX-License-Identifier: LGPL-3.0-or-later
"""What the user says about parts of a scene beyond Fix and Traction: open ends, points, mirrors.

Frozen, and no more than said: :mod:`complexbody.dampers`, :mod:`complexbody.points` and
:mod:`complexbody.mirrors` turn them into arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from complexbody.errors import SceneError
from complexbody.histories import Constant, History

#: A facet tag, several of them, "boundary", or a predicate of x (3, npts) -> bool (npts,).
Where = int | Sequence[int] | str | Callable[[Any], Any]
#: A number, one number per component, or a callable of x (3, npts) -> (components, npts).
Value = float | Sequence[float] | Callable[[Any], Any]

FIELDS = ("u", "nu")


def known_field(what: str, name: str) -> None:
    """Refuse what is no field.

    Raises:
        SceneError: naming the two that are.
    """
    if name not in FIELDS:
        raise SceneError(f"{what}: field is {name!r}. Give 'u' or 'nu'.")


@dataclass(frozen=True)
class Absorb:
    r"""An open part of the boundary: waves that come to it square on leave the body.

    Viscous dampers on the facets, t = −Z(n)q̇ with q = (u, ν): Z(n) is the impedance matrix of the
    body's own plane waves along the normal n (:mod:`complexbody.impedance`). It couples all
    components, so that P, S and ν waves, and waves in which u and ν go together, are all matched.
    The dampers are lumped at the facets' vertices; the power they take is in the ledger's
    ``dissipated``.

    What comes back of a plane wave's energy grows with its angle to the normal, and a self-action
    or viscosity of ν makes its waves disperse: without ``frequency`` waves far above the cut-off
    √(k0/ρ̄) and the rate η/ρ̄ are matched, with it those of that frequency. Fields that vary slowly
    (below the cut-off, static, or diffusing) are not waves and do not leave; nothing holds the body
    against drifting off. Measured reflection: docs/boundaries.md.

    Attributes:
        where: Facet tag(s), "boundary", or a predicate that holds at all vertices of a facet.
        frequency: Frequency f of the waves to match [Hz], or None: the limit of high ones.
        field: "u" or "nu" to damp that field's own rates alone; both by default.
    """

    where: Where
    frequency: float | None = None
    field: str | None = None

    def __post_init__(self) -> None:
        if self.field is not None:
            known_field("Absorb", self.field)
        f = self.frequency
        if f is not None and not (np.isfinite(f) and f > 0):
            raise SceneError(f"Absorb: frequency is {f}. Give a positive number of Hz, or None.")
