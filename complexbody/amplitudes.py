# SPDX-License-Identifier: LGPL-3.0-or-later
"""Factors of users' histories in time: tried before a run, and never fatal to one rank alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.errors import SceneError, agree
from complexbody.given import numbers
from complexbody.histories import History

Array = npt.NDArray[np.float64]

#: Times at which histories are tried before a run.
TRIED = 257


class Amplitudes:
    """Factors of a user's histories, any of which may fail at any time.

    A rank that raised alone in mid-run would leave the others waiting: here it goes on with NaN,
    which the next ledger row finds on all ranks.

    Attributes:
        failure: What the first failure on this rank was.
    """

    failure: SceneError | None = None

    def factors(self, history: History, times: Array) -> Array:
        """Factors at the times [s], shape (times,); NaN where they cannot be had."""
        try:
            out = numbers(history(times))
            if out is None:
                self._failed("returned no real numbers")
            elif out.shape in ((), times.shape):
                if not np.all(np.isfinite(out)):
                    worst = times[np.flatnonzero(~np.isfinite(np.broadcast_to(out, times.shape)))]
                    self._failed(f"is not finite at t = {worst[0]:.6g} s")
                return out
            else:
                self._failed(f"returned shape {out.shape} for times of shape {times.shape}")
        except Exception as found:  # a user's callable may fail in any way
            self._failed(f"cannot be evaluated: {type(found).__name__}: {found}")
        return np.full(times.shape, np.nan)

    def _failed(self, what: str) -> None:
        if self.failure is None:
            self.failure = SceneError(
                f"The history of a load or support {what}. Give a function of an array of times "
                "[s] that returns finite factors of the same shape."
            )


def try_histories(comm: Any, histories: list[History], until: float) -> None:
    """Evaluate histories at many times of a run, before it; collective.

    Raises:
        SceneError: if one fails, misfits or is not finite, on any rank (on all ranks).
    """
    amplitudes = Amplitudes()
    for history in histories:
        for times in (np.linspace(0.0, until, TRIED), np.zeros(1)):
            amplitudes.factors(history, times)
    agree(comm, amplitudes.failure)
