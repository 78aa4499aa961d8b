# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a finished run gives back: fields, ledger, probes, and what it cost."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from complexbody.integrators.timetable import TimeSets
from complexbody.ledger import Ledger
from complexbody.planning import Plan
from complexbody.scene import Scene

Array = npt.NDArray[np.float64]


@dataclass
class Statistics:
    """What a run cost.

    Attributes:
        step, critical: Step and critical step [s]; steps: number of steps.
        cells, nodes: Of the whole body; ranks: processes.
        updates: Cell updates done by all ranks; rate: per second of stepping.
        quiet: Share of cell updates that were skipped, since all nodes of these cells were at zero.
        set_up, stepping, booking, writing, saving: Seconds of the slowest rank; the last ones on
            checkpoints. Of a run that was resumed, of all its parts up to their checkpoints.
        bytes_per_cell: Memory beside dolfinx's own mesh.
    """

    step: float = 0.0
    critical: float = 0.0
    steps: int = 0
    cells: int = 0
    nodes: int = 0
    ranks: int = 1
    updates: int = 0
    quiet: float = 0.0
    rate: float = 0.0
    set_up: float = 0.0
    stepping: float = 0.0
    booking: float = 0.0
    writing: float = 0.0
    saving: float = 0.0
    bytes_per_cell: float = 0.0


@dataclass
class Result:
    """A finished run: fields at the final time, ledger, probes, statistics.

    Attributes:
        u, nu, u_dot, nu_dot: dolfinx Functions, all at ``time`` [s].
        ledger: Energies and momenta; ``ledger["stored"]`` is a column.
        probes: {name: {"time": (m,), "u": (m, n_u), "nu": (m, k)}} on rank 0, empty elsewhere.
        stats: What it cost.
        scene: What was simulated; folder: where output went, or None.
        integrator: How.
        time_sets: Who acted when, and what that saves; None where all cells act together.
        plan: What was left out since it changes no result; None if nothing was to be.
        accuracy: What was asked for and what was found, where an accuracy was asked for.
        solving: What implicit steps took and γ, Ξ and T₀ of the inertia, in words; "" if explicit.
    """

    u: fem.Function
    nu: fem.Function
    u_dot: fem.Function
    nu_dot: fem.Function
    time: float
    ledger: Ledger
    stats: Statistics
    scene: Scene
    probes: dict[str, dict[str, Array]] = field(default_factory=dict)
    folder: Path | None = None
    integrator: Any = None
    time_sets: TimeSets | None = None
    solving: str = ""
    plan: Plan | None = None
    accuracy: Any = None
