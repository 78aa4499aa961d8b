# SPDX-License-Identifier: LGPL-3.0-or-later
"""What asking for an accuracy gives back, and what pilot runs are told by."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Accuracy:
    """What was asked for, and what was found.

    Attributes:
        asked: The relative error; norm: of what.
        method: What ran; factor: its steps over those at its stable limit.
        predicted: Error in time before the run; verified: by halving steps in windows of the run.
        mesh: Estimate of the mesh's own error; a few tens of per cent off where waves span many
            cells, too small where singularities rule it.
        met: Whether ``verified`` and ``mesh`` together are at most what was asked.
        tried: Methods, with the cost (over the least) at which they would meet the request.
        updates, share: Cell updates of all pilot runs over those of the run; the same in time.
        restarts: How often the run began anew.
    """

    asked: float
    norm: str
    method: Any
    factor: float
    predicted: float
    verified: float
    mesh: float
    met: bool
    tried: dict[str, float] = field(default_factory=dict)
    updates: float = 0.0
    share: float = 0.0
    restarts: int = 0

    def __str__(self) -> str:
        others = ", ".join(f"{name} {cost:.2g}" for name, cost in self.tried.items())
        return (
            f"asked {self.asked:.3g} ({self.norm}); in time {self.verified:.2g} by halved steps "
            f"({self.predicted:.2g} expected), of the mesh about {self.mesh:.2g}: "
            f"{'met' if self.met else 'MISSED'}; {type(self.method).__name__} at "
            f"{self.factor:.3g} of its stable limit (costs: {others}); pilot runs "
            f"{self.updates:.2g} of the run's updates, {self.share:.2g} of its time"
            + (f"; begun anew {self.restarts} times" if self.restarts else "")
        )


@dataclass(frozen=True)
class Parting:
    """Amplitudes of u and ν (2,) by which two runs part at a window's middle and end.

    ``own`` are those of the motion itself there.
    """

    middle: Array
    end: Array
    own: Array

    def __mul__(self, factor: float) -> Parting:
        return Parting(self.middle * factor, self.end * factor, self.own)
