# SPDX-License-Identifier: LGPL-3.0-or-later
"""Steps of a run: how many there are, how often books are kept, what is between two of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from complexbody.errors import StepError

Array = npt.NDArray[np.float64]

#: Whole numbers up to here are floats, so that t = n h is exact to round-off.
MOST_STEPS = 2.0**53


def steps_until(until: float, step: float) -> int:
    """Steps of a run.

    Raises:
        StepError: for more than a clock of whole steps can count to the last one.
    """
    steps = np.ceil(until / step - 1e-9)
    if not steps < MOST_STEPS:
        raise StepError(
            f"The run would take {steps:.3g} steps of {step:.3g} s. Give a larger step, or an "
            "earlier end."
        )
    return int(steps)


def default_ledger_steps(cells: int, ranks: int, steps: int) -> int:
    """Steps between ledger rows: a row costs two steps and the time of some 25 000 cell updates.

    At most some five per cent of a run goes into the books, unless it has less than 100 rows.
    """
    cheap = 40 + int(5e5 / max(cells / ranks, 1))
    return max(1, min(cheap, steps // 100))


def hermite(s: float, h: float, x0: Array, v0: Array, x1: Array, v1: Array) -> tuple[Array, Array]:
    """Cubic through (x0, v0) and (x1, v1) a step h apart, at fraction s: position and rate."""
    a, b = (1 + 2 * s) * (1 - s) ** 2, s * (1 - s) ** 2
    c, d = s * s * (3 - 2 * s), s * s * (s - 1)
    position = a * x0 + b * h * v0 + c * x1 + d * h * v1
    slope = 6 * s * (1 - s)
    rate = slope * (x1 - x0) / h + (1 - 4 * s + 3 * s * s) * v0 + (3 * s * s - 2 * s) * v1
    return position, rate
