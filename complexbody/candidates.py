# SPDX-License-Identifier: LGPL-3.0-or-later
"""Integrators that may be worth a pilot run: their price, and how their steps are scaled.

Each at its stable limit, the default safety of its own. Knows no accuracy.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from complexbody.integrators.asynchronous import AVI
from complexbody.integrators.implicit import Implicit
from complexbody.integrators.local_leapfrog import LocalLeapfrog
from complexbody.integrators.synchronous import Synchronous
from complexbody.planning import EVENT
from complexbody.precheck import Limits
from complexbody.problem import Problem

#: Methods are tried whose expected cost is at most so many times the least …
DEAR = 3.0
#: … those with local steps only if these would save so much at best.
GAIN = 1.5
#: Updates of local steps over those of each cell's own critical step, as experience has them.
ROUNDED = {"LocalLeapfrog": 1.5, "AVI": 1.4}
#: Times of an event of plain windows over a synchronous update (2D, 3D), docs/claims.md.
PLAIN = (1.1, 1.2)


def candidates(problem: Problem, found: Limits) -> list[tuple[Any, float]]:
    """Integrators with the price of an update, the one expected to be the cheapest first.

    Args:
        problem: The scene made ready.
        found: Its cells' critical steps.
    """
    if problem.convexity is not None:
        return [(Implicit(), 1.0)]
    three = problem.disc.dim > 2
    gain = found.uniform / found.local if found.local > 0 else 1.0
    # With updates per cell and critical step of the smallest one, all in.
    out: list[tuple[Any, float, float]] = [(Synchronous(), 1.0, 1 / 0.9)]
    if gain >= GAIN:
        local, avi = EVENT["LocalLeapfrog()"][three], EVENT["AVI()"][three]
        out += [
            (LocalLeapfrog(), local, ROUNDED["LocalLeapfrog"] / gain / 0.9),
            (AVI(), avi, ROUNDED["AVI"] / gain / 0.45),
            (AVI(balanced=False), PLAIN[three], ROUNDED["AVI"] / gain / 0.45),
        ]
    out.sort(key=lambda entry: entry[1] * entry[2])
    least = out[0][1] * out[0][2]
    return [(m, price) for m, price, updates in out if price * updates <= DEAR * least]


def halved(method: Any, step: float) -> Any:
    """A method whose every step is half of what it was.

    Args:
        method: The integrator.
        step: What its step (of all cells, or the coarse one) was [s].
    """
    if isinstance(method, AVI):
        return replace(method, safety=0.5 * method.safety)
    if isinstance(method, LocalLeapfrog):
        return replace(method, safety=0.5 * method.safety, step=0.5 * step)
    return replace(method, step=0.5 * step)


def scaled(method: Any, factor: float, step: float, until: float) -> Any:
    """A method at a part of its stable limit.

    Args:
        method: The integrator at its limit.
        factor: The part, at most 1.
        step: Its step at its limit [s].
        until: End of the run [s], which steps divide.
    """
    if isinstance(method, Implicit):  # T₀ may be what limits it
        steps = np.ceil(until / (factor * step) * (1 - 1e-12))
        return replace(method, step=float(until / steps))
    return replace(method, safety=factor * method.safety) if factor < 1 else method


def name_of(method: Any) -> str:
    """What to call it in a table."""
    plain = isinstance(method, AVI) and not method.balanced
    return type(method).__name__ + (" plain" if plain else "")
