# SPDX-License-Identifier: LGPL-3.0-or-later
"""The file of a chart: complete after every point, so that a chart can be interrupted and go on.

``chart.json`` is replaced in one go (a draft, then renamed). It is the chart of one scene, one end
and one number of ranks; points are known by method, step and mesh, and kept from run to run.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from complexbody.errors import ChartError
from complexbody.files import on_first_rank
from complexbody.fronts import NORMS

SCHEMA = "complexbody chart 1"
#: Columns of the table before the errors.
COLUMNS = (
    "method", "peer", "integrator", "mesh", "cells", "factor", "step", "status", "seconds", "wall",
    "updates", "steps", "runs", "ranks", "commit",
)  # fmt: skip


class ChartFile:
    """Rows and references of a chart, in memory and in a file; calls are collective.

    Args:
        comm: Ranks; rank 0 reads and writes.
        folder: Where ``chart.json`` is; None keeps all in memory.
        identity: What the chart is of: rows of another are refused.
        fresh: Forget what is there.

    Attributes:
        rows, references: By key, and by mesh.

    Raises:
        ChartError: if the file is of another chart, or none at all.
        OutputError: if it cannot be written.
    """

    def __init__(
        self, comm: Any, folder: Path | None, identity: Mapping[str, Any], fresh: bool = False
    ) -> None:
        self.comm, self.identity = comm, comm.bcast(_plain(identity))
        self.path = None if folder is None else Path(folder) / "chart.json"
        self.rows: dict[str, dict[str, Any]] = {}
        self.references: dict[str, Any] = {}
        self.head: dict[str, Any] = {}
        if self.path is not None and not fresh:
            self._read(self.path)

    def _read(self, path: Path) -> None:
        found: list[Any] = [None]

        def read() -> None:
            if path.exists():
                try:
                    found[0] = json.loads(path.read_text(encoding="utf-8"))
                except ValueError as error:
                    raise ChartError(
                        f"{path} is no chart ({error}). Give another folder, or --fresh."
                    ) from error

        on_first_rank(self.comm, path, read)
        data = self.comm.bcast(found[0])
        if data is None:
            return
        known = isinstance(data, dict) and data.get("schema") == SCHEMA
        differ = ["schema"]
        if known:
            differ = [k for k, v in self.identity.items() if data["identity"].get(k) != v]
        if differ:
            raise ChartError(
                f"{path} is of another chart (its {', '.join(differ)}). Give another folder, or "
                "--fresh to begin anew."
            )
        self.rows = {row["key"]: row for row in data["rows"]}
        self.references = data["references"]

    def put(self, row: Mapping[str, Any]) -> None:
        """Add a point, and write."""
        self.rows[row["key"]] = _plain(row)
        self.write()

    def write(self, **more: Any) -> None:
        """Replace the file."""
        self.head.update(_plain(more))
        path = self.path
        if path is None:
            return
        data = {
            "schema": SCHEMA, "identity": self.identity, **self.head,
            "references": _plain(self.references), "rows": list(self.rows.values()),
        }  # fmt: skip

        def write() -> None:
            path.parent.mkdir(parents=True, exist_ok=True)
            draft = path.with_name(path.name + ".part")
            draft.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
            draft.replace(path)

        on_first_rank(self.comm, path, write)


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Rows as a table; on one rank."""
    errors = [f"{kind}_{name}" for kind in ("time", "total") for name in NORMS]
    draft = path.with_name(path.name + ".part")
    with draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*COLUMNS, *errors, "message"])
        for row in rows:
            values = [row.get(name) for name in COLUMNS]
            for kind in ("time_error", "total_error"):
                values += [(row.get(kind) or {}).get(name) for name in NORMS]
            writer.writerow([*values, row.get("message")])
    draft.replace(path)


def _plain(value: Any) -> Any:
    """What JSON can hold: numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) or hasattr(value, "dtype"):
        value = value.item() if hasattr(value, "item") else value
        return value if not isinstance(value, float) or math.isfinite(value) else None
    if value is None or isinstance(value, str | int | bool):
        return value
    return repr(value)
