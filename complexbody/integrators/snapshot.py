# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a run is between two steps: all that its future depends on, and no more.

Rows are those of this rank's nodes and cells; who saves them knows their numbers. What follows from
the scene, the step and the options is not in it: a run is prepared anew and then takes a snapshot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.discretisation import Discretisation

Array = npt.NDArray[Any]


@dataclass
class Snapshot:
    """A run between two steps.

    Attributes:
        numbers: What is the same on all ranks: ``steps`` done, flags.
        nodes: Arrays by node (nodes, m), equal on all ranks that share one.
        cells: Arrays by owned cell, in dolfinx's order (cells, …).
        corners: Arrays by owned cell and corner (cells, d + 1, m).
        sums: Sums over this rank's share of the body (m,): the whole is their sum over ranks.
    """

    numbers: dict[str, Any]
    nodes: dict[str, Array] = field(default_factory=dict)
    cells: dict[str, Array] = field(default_factory=dict)
    corners: dict[str, Array] = field(default_factory=dict)
    sums: dict[str, Array] = field(default_factory=dict)

    def mapped(self, change: Callable[[str, str, Array], Any]) -> Snapshot:
        """The same with each array changed by ``change(kind, name, array)``, in one fixed order."""
        parts = {
            kind: {name: change(kind, name, array) for name, array in getattr(self, kind).items()}
            for kind in ("nodes", "cells", "corners", "sums")
        }
        return Snapshot(dict(self.numbers), **parts)

    def copy(self) -> Snapshot:
        """A snapshot that no step changes."""
        return self.mapped(lambda kind, name, array: np.array(array))

    @property
    def finite(self) -> bool:
        """Whether all numbers of this rank are."""
        found: list[bool] = []
        self.mapped(lambda kind, name, array: found.append(bool(np.isfinite(array).all())))
        return all(found)


def to_cells(disc: Discretisation, blocks: Array) -> Array:
    """Rows of owned cells in dolfinx's order from those in blocks (blocks, W, …)."""
    real = disc.source_cell >= 0
    out = np.zeros((disc.count, *blocks.shape[2:]), blocks.dtype)
    out[disc.source_cell[real]] = blocks[real]
    return out


def to_blocks(disc: Discretisation, rows: Array) -> Array:
    """The inverse of :func:`to_cells`; zero for padding."""
    real = disc.source_cell >= 0
    out = np.zeros((*disc.source_cell.shape, *rows.shape[1:]), rows.dtype)
    out[real] = rows[disc.source_cell[real]]
    return out
