# SPDX-License-Identifier: LGPL-3.0-or-later
"""What probes record during a run: (u, ν) at points every few steps, in memory and as CSV.

Rows reach the files whenever the ledger is written, so that a run that is stopped keeps them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from complexbody.files import CsvWriter
from complexbody.output import Output
from complexbody.probes import Probes
from complexbody.problem import Problem

Array = npt.NDArray[np.float64]


class Receivers:
    """Probes of a run; made, opened, recorded, flushed and closed collectively.

    Args:
        problem: The scene, made ready, whose node records are probed.
        output: Names the probes.

    Raises:
        SceneError: for points outside the body.
    """

    def __init__(self, problem: Problem, output: Output) -> None:
        scene, disc, self._problem = problem.whole, problem.disc, problem
        self.probes, self.n, self.n_u = (
            Probes(scene, output.probes), scene.components, scene.displacement,
        )  # fmt: skip
        self.names, self.stride, self.comm = list(output.probes), output.probe_steps, disc.comm
        self._nodes = disc.number[self.probes.cells_nodes]
        self._rows: list[Array] = []
        self._times: list[float] = []
        self._done: list[Array] = []  # on rank 0: (rows, 1 + probes · n)
        self._tables: list[CsvWriter] = []

    @classmethod
    def of(cls, problem: Problem, output: Output) -> Receivers | None:
        """Those of an output, None if it names no probes."""
        return cls(problem, output) if output.probes else None

    def open(self, folder: Path, resume: float | None = None) -> None:
        """Make the tables.

        Args:
            folder: Where.
            resume: Keep an earlier run's rows up to this time [s]; None keeps none.

        Raises:
            OutputError: if they cannot be written.
        """
        labels = [f"u{j + 1}" for j in range(self.n_u)]
        labels += [f"nu{j + 1}" for j in range(self.n - self.n_u)]
        columns = {"time": "s", **{a: "" if a.startswith("nu") else "m" for a in labels}}
        self._tables = [
            CsvWriter(folder / f"probe-{m}.csv", columns, self.comm, resume) for m in self.names
        ]
        if resume is not None and self.comm.rank == 0:
            rows = [np.array(t.kept).reshape(-1, 1 + self.n) for t in self._tables]
            first = [rows[0][:, :1]] if rows else []
            self._done.append(np.concatenate([*first, *(r[:, 1:] for r in rows)], axis=1))

    def record(self, time: float, positions: Array) -> None:
        """Note the values at ``time`` [s] from node records (nodes, at least n)."""
        values = positions[self._nodes][..., : self._problem.disc.n]
        found = np.einsum("pa,pan->pn", self.probes.weights, values)
        self._rows.append(self._problem.spread(found))
        self._times.append(time)

    def flush(self) -> None:
        """Bring what was recorded to rank 0 and to the files; collective."""
        count, mine = len(self._times), len(self.probes.indices)
        rows = np.array(self._rows).reshape(count, mine, self.n).transpose(1, 0, 2)
        every = self.probes.gather(rows.reshape(mine, count * self.n))
        times = np.array(self._times)
        self._rows, self._times = [], []
        block = np.zeros((0, 0))
        if every is not None:
            block = every.reshape(len(self.names), count, self.n)
            whole = np.concatenate([times[:, None], *block], axis=1)
            self._done.append(whole)
        for i, table in enumerate(self._tables):
            rows_out = np.column_stack([times, block[i]]).tolist() if every is not None else []
            table.write(rows_out)

    def table(self) -> dict[str, dict[str, Any]]:
        """{name: {"time", "u", "nu"}} of all rows so far on rank 0, empty elsewhere."""
        if self.comm.rank != 0 or not self._done:
            return {}
        data = np.concatenate(self._done)
        out = {}
        for i, name in enumerate(self.names):
            values = data[:, 1 + i * self.n : 1 + (i + 1) * self.n]
            u, nu = values[:, : self.n_u], values[:, self.n_u :]
            out[name] = {"time": data[:, 0], "u": u, "nu": nu}
        return out

    def sync(self) -> None:
        """Bring what was recorded to the files, and see that it lasts; collective."""
        self.flush()
        for table in self._tables:
            table.sync()

    def close(self) -> None:
        """Close the files."""
        for table in self._tables:
            table.close()
