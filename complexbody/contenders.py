# SPDX-License-Identifier: LGPL-3.0-or-later
"""The methods of a chart: how each is made from a step, and how large its steps may be.

Steps are told as *factors* of the stable limit: of each cell's or node's own critical step for
integrators that choose their steps (``safety``), else of the synchronous critical step. A method's
factors are a geometric series from its limit downwards; implicit ones start above it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from complexbody.errors import CommandError
from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.implicit import Implicit
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.peers import AssembledLeapfrog, Newmark, PetscTS
from complexbody.integrators.synchronous import Synchronous

#: A method from the factor and the step [s], which divides the run.
Make = Callable[[float, float], Any]


@dataclass(frozen=True)
class Contender:
    """A method of a chart.

    Attributes:
        key: What ``--methods`` calls it.
        name: What the chart calls it.
        make: The integrator from the factor and from the step [s], which divides the run.
        limit: The largest factor.
        ratio: Of two factors that follow each other.
        peer: Whether it is what users would take elsewhere, not one of ours.
        general: Left out by default where the inertia is constant: it would be Synchronous there.
        colour, line, marker: How it is drawn.
    """

    key: str
    name: str
    make: Make
    limit: float = 0.9
    ratio: float = 2.0
    peer: bool = False
    general: bool = False
    colour: str = "0.4"
    line: str = "-"
    marker: str = "o"

    def factors(self, count: int) -> list[float]:
        """``count`` factors of the stable limit, falling."""
        return [self.limit / self.ratio**i for i in range(count)]


_OURS = (
    Contender(
        "synchronous", "Synchronous", lambda factor, step: Synchronous(step),
        colour="#0072B2", marker="o",
    ),
    Contender(
        "avi", "AVI, balanced octaves", lambda factor, step: AVI(factor), 0.45,
        colour="#D55E00", marker="s",
    ),
    Contender(
        "avi-windows", "AVI, plain windows", lambda factor, step: AVI(factor, balanced=False), 0.45,
        colour="#E69F00", marker="D",
    ),
    Contender(
        "avi-exact", "AVI, real steps corrected", lambda factor, step: AVI(factor, "exact"), 0.45,
        colour="#CC79A7", marker="^",
    ),
    Contender(
        "avi-published", "AVI as published", lambda factor, step: AVI.as_published(factor), 0.45,
        colour="#8C510A", marker="v",
    ),
    Contender(
        "local-leapfrog", "LocalLeapfrog", lambda factor, step: LocalLeapfrog(factor),
        colour="#000000", marker="P",
    ),
    Contender(
        "implicit", "Implicit", lambda factor, step: Implicit(step), general=True,
        colour="#56B4E9", marker="X",
    ),
)  # fmt: skip

#: Implicit peers: from far above the stable limit, where a large step must pay for its solve.
_FAR, _RATIO = 64.0, 4.0
_PEERS = (
    Contender(
        "assembly", "leapfrog, dolfinx assembly",
        lambda factor, step: AssembledLeapfrog("assembly", step),
        peer=True, colour="#666666", line="--", marker="o",
    ),
    Contender(
        "matrix", "leapfrog, PETSc matrix", lambda factor, step: AssembledLeapfrog("matrix", step),
        peer=True, colour="#009E73", line="--", marker="s",
    ),
    Contender(
        "petsc-rk4", "PETSc TS, Runge–Kutta 4", lambda factor, step: PetscTS("rk4", safety=factor),
        peer=True, colour="#332288", line="--", marker="D",
    ),
    Contender(
        "petsc-alpha2", "PETSc TS, generalised α",
        lambda factor, step: PetscTS("alpha2", step), _FAR, _RATIO,
        peer=True, colour="#AA4499", line="--", marker="^",
    ),
    Contender(
        "petsc-cn", "PETSc TS, Crank–Nicolson",
        lambda factor, step: PetscTS("cn", step), _FAR, _RATIO,
        peer=True, colour="#999933", line="--", marker="v",
    ),
    Contender(
        "newmark", "Newmark", lambda factor, step: Newmark(step), _FAR, _RATIO,
        peer=True, colour="#44AA99", line="--", marker="P",
    ),
)  # fmt: skip


def contenders() -> dict[str, Contender]:
    """All methods by key: ours first, then the peers."""
    return {c.key: c for c in (*_OURS, *_PEERS)}


def chosen(methods: Sequence[str | Contender] | None, general: bool) -> list[Contender]:
    """The methods asked for; by default all that say something new.

    Args:
        methods: Keys or contenders; None for all.
        general: Whether the scene's kinetic co-energy is a general χ(ν, ν̇).

    Raises:
        CommandError: for unknown keys, or one method twice.
    """
    known = contenders()
    if methods is None:
        return [c for c in known.values() if general or not c.general]
    out: list[Contender] = []
    for method in methods:
        if isinstance(method, Contender):
            out.append(method)
        elif method in known:
            out.append(known[method])
        else:
            raise CommandError(f"No method {method!r} to chart. Give some of {', '.join(known)}.")
    if len({c.key for c in out}) < len(out) or not out:
        raise CommandError("chart: a method is named twice, or none is. Give each once.")
    return out
