# SPDX-License-Identifier: LGPL-3.0-or-later
"""Whether a checkpoint that is whole has what a run needs to go on: one from elsewhere need not.

For one process. What is wrong is returned in words, to be told on all ranks at once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from complexbody.given import is_finite, is_flag, is_positive, is_whole
from complexbody.integrators.snapshot import Snapshot

#: Kinds of arrays by what their rows are.
KINDS = ("nodes", "cells", "corners", "sums")
#: Their axes, where all have as many.
AXES = {"nodes": 2, "corners": 3}
#: Numbers of the books and of the clocks.
BOOKS = ("start", "put", "reference", "size", "still")
SECONDS = ("set_up", "stepping", "booking", "writing", "saving")


def _texts(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(text, str) for text in value)


def _count(value: Any) -> bool:
    return is_whole(value) and value >= 0


def _part(value: Any) -> bool:
    """A part of an identity: texts, and pairs of a sum and its size."""
    pair = (isinstance(v, list) and len(v) == 2 and all(map(_real, v)) for v in value)
    return all(isinstance(v, str) or fits for v, fits in zip(value, pair, strict=True))


def _real(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


#: What a description must have: a question about each.
ABOUT: dict[str, Callable[[Any], bool]] = {
    "identity": lambda v: isinstance(v, dict)
    and all(isinstance(part, list) and _part(part) for part in v.values()),
    "integrator": lambda v: isinstance(v, dict)
    and isinstance(v.get("class"), str)
    and isinstance(v.get("options"), dict),
    "until": is_positive,
    "time": lambda v: is_finite(v) and v >= 0,
    "step": is_positive,
    "steps": _count,
    "written": is_finite,
    "every": lambda v: is_whole(v) and v > 0,
    "noted": is_flag,
    "layout": lambda v: isinstance(v, list) and all(map(is_whole, v)),
    "arrays": lambda v: isinstance(v, dict)
    and set(v) <= set(KINDS)
    and all(map(_texts, v.values())),
    "numbers": lambda v: isinstance(v, dict) and _count(v.get("steps")),
    "books": lambda v: isinstance(v, dict)
    and all(name in v and (v[name] is None or is_finite(v[name])) for name in BOOKS),
    "statistics": lambda v: isinstance(v, dict) and all(is_finite(v.get(name)) for name in SECONDS),
}  # fmt: skip


def flaw(about: Any) -> str:
    """The first thing that a description lacks or has wrong, or ""."""
    if not isinstance(about, dict):
        return "no description"
    for name, fits in ABOUT.items():
        if name not in about or not fits(about[name]):
            return f"no sensible {name!r}"
    if about["steps"] != about["numbers"]["steps"]:
        return "two numbers of steps"
    if abs(about["time"] - about["steps"] * about["step"]) > 1e-6 * about["step"]:
        return "a time that is not that of its steps"
    return ""


def misfit(
    about: Mapping[str, Any],
    arrays: Mapping[str, Any],
    like: Snapshot,
    rows: Mapping[str, int],
    columns: int,
) -> str:
    """The first array or number that a run like this cannot have, or "".

    Args:
        about: The description, which has no flaw.
        arrays: The checkpoint's.
        like: A snapshot of the run as it begins: it may lack what later ones have.
        rows: Rows of arrays of nodes, cells and corners.
        columns: Of the ledger.
    """
    for name, value in like.numbers.items():
        known = about["numbers"].get(name)
        if is_flag(known) != is_flag(value) or not (is_flag(known) or _real(known)):
            return f"no sensible number {name!r}"
    shapes: dict[str, tuple[int, ...]] = {}
    like.mapped(lambda kind, name, array: shapes.update({f"{kind}/{name}": array.shape}))
    found = {f"{kind}/{name}" for kind, names in about["arrays"].items() for name in names}
    for name in sorted(found | set(shapes)):
        array = arrays.get(name) if name in found else None
        if array is None:
            return f"no array {name!r}"
        kind = name.split("/")[0]
        # Sums have a row for each rank that there was.
        count = rows.get(kind, len(about["layout"]))
        rest = shapes.get(name, (0, *array.shape[1:]))
        rest = rest if kind == "sums" else rest[1:]
        deep = array.ndim == AXES.get(kind, array.ndim)
        if not deep or array.shape != (count, *rest) or array.dtype.kind not in "iuf":
            return f"array {name!r} of another shape"
        if not np.isfinite(array).all():
            return f"array {name!r} with values that are not finite"
    ledger = arrays.get("ledger")
    if ledger is None or ledger.dtype.kind != "f" or ledger.shape[1:] != (columns,):
        return "no ledger of this run"
    return ""
