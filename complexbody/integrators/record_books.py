# SPDX-License-Identifier: LGPL-3.0-or-later
"""The books of an asynchronous run: energies and works at the end of a beat."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from complexbody.integrators import activity
from complexbody.integrators.entries import Entries, energies
from complexbody.kernels.library import State

if TYPE_CHECKING:
    from complexbody.integrators.records import RecordRun


def entries(run: RecordRun) -> Entries:
    """Energies and works at the last beat's end; collective."""
    _, rates = run.sample()
    watched = _Watched(run) if run.skips_energies else None
    common = energies(run.problem, run.mass, rates, watched.state if watched else None)
    dissipated = run.dissipated()
    kinetic = common["kinetic_u"] + common["kinetic_nu"]
    given = run.work + run.support_work - dissipated
    return Entries(
        **common, work=run.work, support_work=run.support_work, dissipated=dissipated,
        surplus=kinetic + common["stored"] + common["potential"] - given,
        discrete=0.0, flows=0.0, size=0.0, variation_u=np.nan, variation_nu=np.nan,
    )  # fmt: skip


class _Watched:
    """What the kernels read, with the quiet cells of the run in their own chunks."""

    def __init__(self, run: RecordRun) -> None:
        disc, watch = run.problem.disc, run.activity
        assert watch is not None
        # Cells that may have moved without having acted yet are near others.
        seen = np.repeat(watch.flags["awake"] | watch.flags["near"], watch.blocks)
        self._awake = np.maximum.reduceat(seen, disc.chunks[:, 0])
        self._stirred: npt.NDArray[np.uint8] = np.ones(len(disc.chunks), np.uint8)
        self._chunks = activity.State(1, len(disc.chunks))
        self._chunks.awake = self._awake.ctypes.data
        self._chunks.stirred = self._stirred.ctypes.data
        self.state = State.from_buffer_copy(run.problem.kernels.state)
        self.state.activity = ctypes.addressof(self._chunks)
