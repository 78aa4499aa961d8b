# SPDX-License-Identifier: LGPL-3.0-or-later
"""What the user says about parts of a scene beyond Fix and Traction: open ends, points, mirrors.

Frozen, and no more than said: :mod:`complexbody.dampers`, :mod:`complexbody.points` and
:mod:`complexbody.mirrors` turn them into arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from complexbody.errors import SceneError
from complexbody.given import finite, is_positive, short
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
    Of an energy that is not quadratic, small waves about the initial state are matched.
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
        if f is not None and not is_positive(f):
            raise SceneError(
                f"Absorb: frequency is {short(f)}. Give a positive number of Hz, or None."
            )


@dataclass(frozen=True)
class PointSource:
    r"""A force at a point, or a moment: Fδ(x − x_s) − Div(Mδ(x − x_s)) times a history.

    Its nodal forces are consistent with P1 fields: the total force is F to round-off. What the
    source radiates converges with the mesh everywhere but at the point itself, and so do powers
    (each finite on a given mesh).

    Attributes:
        at: The point x_s [m], anywhere in the body; one coordinate per dimension of the mesh.
        vector: F, one number per component of the field [N in 3D, N/m in 2D, N/m² in 1D, or their
            partners on ν].
        history: Factor of time.
        field: "u" or "nu".
        moment: M [N m and so on], one row per component of the field and one column per direction:
            symmetric for a moment tensor on u (m₀(e₁⊗e₂ + e₂⊗e₁) is a double couple). Its nodal
            forces have that moment exactly, spread over the cells around the point.
    """

    at: Sequence[float] | float
    vector: Sequence[float] | float | None = None
    history: History = Constant()
    field: str = "u"
    moment: Any = None

    def __post_init__(self) -> None:
        known_field("PointSource", self.field)
        if self.vector is None and self.moment is None:
            raise SceneError("PointSource: it has no vector and no moment. Give one of them.")
        if finite(self.at) is None:
            raise SceneError(
                f"PointSource: at={short(self.at)} is no point. Give finite coordinates."
            )


@dataclass(frozen=True)
class Symmetry:
    r"""A plane of symmetry among a scene's supports: the body goes on behind it as in a mirror.

    On the plane, components that the mirror turns round are fixed to zero, and the others are free.
    The mirror I − 2n⊗n acts on u as on a vector, and on ν by its parity R: what is fixed are the
    components with R = −1. That the body's energy, inertia, viscosity and potential do not change
    under the mirror is checked; that initial data and loads do not is the user's matter.

    The plane must be perpendicular to a coordinate axis, since supports fix components.

    Attributes:
        where: Facet tag(s), "boundary", or a predicate that holds at all vertices of a facet.
        parity: How ν goes under the mirror Q: "polar" (a vector, Qν), "axial" (a rotation, −Qν),
            "even" or "odd" (scalars), "tensor" (k = d² components ν_ij row by row, QνQᵀ), or the
            k×k matrix R itself, or ``f(Q)`` giving it. By default what the body says
            (:attr:`complexbody.Body.parity`).
        normal: The axis, as a vector; by default the facets' normal.
        u: The same for u: "polar" by default; of one component in more than one dimension "even" or
            "odd" must be given.
    """

    where: Where
    parity: Any = None
    normal: Sequence[float] | None = None
    u: Any = "polar"
