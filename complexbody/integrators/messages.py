# SPDX-License-Identifier: LGPL-3.0-or-later
"""Messages of asynchronous runs: what ranks tell each other when cells at shared nodes have acted.

Only the nodes that some cell acted on travel; which they are is known beforehand, so each lot of
nodes has its message, made once and used again whenever these act.
"""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody import native
from complexbody.halo import Halo


class Message:
    """What ranks tell each other of some shared nodes: kicks, and changes of acting forces.

    Args:
        halo: The exchange of these nodes.
        rows: The nodes, by position among the shared ones.
        world: What the C functions read; c: the functions.
    """

    def __init__(self, halo: Halo, rows: npt.NDArray[np.int32], world: Any, c: ctypes.CDLL) -> None:
        self.halo, self._rows, self._world, self._c = halo, rows, world, c
        self._sends = np.ascontiguousarray(rows[halo.sends], dtype=np.int32)
        count, place = ctypes.c_int64(len(rows)), native.pointer(rows)
        sent = ctypes.c_int64(len(self._sends)), native.pointer(self._sends)
        self._pack = world, *sent, native.pointer(halo.outgoing)
        tables = native.pointer(halo.start), native.pointer(halo.source)
        self._add = world, count, place, *tables, native.pointer(halo.incoming)
        self._apply = place, count

    def begin(self) -> None:
        """Send what this rank's cells gave to these nodes."""
        self._c.cb_pack_shared(*self._pack)
        self.halo.begin()

    def end(self, t: float, world: Any = None) -> None:
        """Apply what all ranks' cells gave, at t; to another world's records, if one is given."""
        self.halo.end()
        self._c.cb_add_shared(*self._add)
        self._c.cb_apply(world or self._world, ctypes.c_double(t), *self._apply)
