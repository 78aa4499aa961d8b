# SPDX-License-Identifier: LGPL-3.0-or-later
"""Who reaches an error at the least cost: fronts of points (cost, error), and winners by decade.

A method's front is what no other point of it beats in both: lower error costs more. Between two
points of a front cost and error are interpolated in their logarithms. Knows rows, and no scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

Row = Mapping[str, Any]

#: Cost: processor seconds of stepping, or element updates. Error: which of a row's two.
COSTS = ("seconds", "updates")
ERRORS = ("total", "time")
#: An error is smaller if it is this share of another at most.
GAIN = 0.98
#: Errors of a row: L2 (lumped) of each field, the larger of u and ν, energy norm, energy.
NORMS = ("fields", "u", "nu", "u_dot", "nu_dot", "energy_norm", "energy")


def points(
    rows: Iterable[Row], cost: str = "seconds", error: str = "total", norm: str = "fields"
) -> list[tuple[float, float]]:
    """(cost, error) of rows that ran to the end and have both, positive and finite."""
    out = []
    for row in rows:
        x, y = row.get(cost), (row.get(f"{error}_error") or {}).get(norm)
        if row["status"] == "done" and x and y and math.isfinite(x) and math.isfinite(y):
            out.append((float(x), float(y)))
    return out


def front(found: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that none of the others beats, by rising cost and falling error.

    An error less than 2 % smaller is no gain: there a method has reached the error of its mesh.
    """
    out: list[tuple[float, float]] = []
    for cost, error in sorted(found):
        if not out or error < GAIN * out[-1][1]:
            out.append((cost, error))
    return out


def cost_at(found: Sequence[tuple[float, float]], error: float) -> float:
    """Cost at which a front reaches ``error``: log-log between its points.

    Above the error of its cheapest point that point's cost; infinite below its smallest error.
    """
    if not found or error < found[-1][1]:
        return math.inf
    if error >= found[0][1]:
        return found[0][0]
    x, y = np.log(np.array(found)).T
    return float(np.exp(np.interp(-math.log(error), -y, x)))


def by_method(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Rows by the name of their method, in the order in which methods first come."""
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(row["method"], []).append(row)
    return out


def decades(
    rows: Iterable[Row], cost: str = "seconds", error: str = "total", norm: str = "fields"
) -> list[float]:
    """Errors at which methods are compared: powers of ten below 1, from large to small.

    From the largest error of any front down to the smallest that any reaches; where that holds one
    power of ten at most, also halfway between them.
    """
    fronts = [front(points(own, cost, error, norm)) for own in by_method(rows).values()]
    errors = [y for f in fronts for _, y in f]
    if not errors:
        return []
    first, last = (math.log10(v) for v in (max(errors), min(errors)))
    for part in (1, 2):
        top = min(math.floor(part * first), -1)
        down = range(top, math.ceil(part * last - 1e-12) - 1, -1)
        if len(down) > 1 or part == 2:
            break
    return [10.0 ** (k / part) for k in down]


def winners(
    rows: Iterable[Row], cost: str = "seconds", error: str = "total", norm: str = "fields"
) -> list[dict[str, Any]]:
    """For each decade of error the cheapest method, and its margins.

    Returns:
        One dict per power of ten: ``error``; ``winner`` and its ``cost``; ``peer``: whether the
        winner is one of the peers; ``second`` and ``margin``, its cost over the winner's (None if
        no other reaches the error); ``best_own``, ``best_peer`` and ``over_peer``, the cost of the
        best peer over that of the best of ours: below 1 where a peer is cheaper (None if one of
        the two is missing); ``open``: the winner's cheapest point is already as accurate;
        ``short``: methods that stop above the error at a smaller cost: a smaller step might win.
    """
    rows = list(rows)
    methods = by_method(rows)
    peers = {name for name, own in methods.items() if own[0].get("peer")}
    fronts = {name: front(points(own, cost, error, norm)) for name, own in methods.items()}
    out = []
    for level in decades(rows, cost, error, norm):
        costs = {name: cost_at(f, level) for name, f in fronts.items()}
        # Equal costs (of updates, often) are told apart by nothing but round-off: rows decide.
        known = [(c, name) for name, c in costs.items() if math.isfinite(c)]
        ranked = sorted(known, key=lambda pair: float(f"{pair[0]:.6g}"))
        if not ranked:
            continue
        least, winner = ranked[0]
        own = next(((c, n) for c, n in ranked if n not in peers), None)
        peer = next(((c, n) for c, n in ranked if n in peers), None)
        out.append({
            "error": level, "winner": winner, "cost": least, "peer": winner in peers,
            "second": ranked[1][1] if len(ranked) > 1 else None,
            "margin": ranked[1][0] / least if len(ranked) > 1 else None,
            "best_own": own[1] if own else None,
            "best_peer": peer[1] if peer else None,
            "over_peer": peer[0] / own[0] if peer and own else None,
            "open": level >= fronts[winner][0][1],
            "short": [n for n, f in fronts.items() if f and f[-1][1] > level and f[-1][0] < least],
        })  # fmt: skip
    return out


def _few(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) < 3 else f"{names[0]} and {len(names) - 1} more"


def table(found: Sequence[Mapping[str, Any]], unit: str = "s") -> str:
    """Winners as text: "over peer" is the best peer's cost over that of the best of ours."""
    if not found:
        return "no method ran to an error that is known"
    head = (
        "error", "cheapest", f"cost [{unit}]", "second", "margin", "best peer", "over peer",
        "not run as far",
    )  # fmt: skip
    lines = [head]
    for w in found:
        lines.append((
            f"{w['error']:.1e}".replace(".0e", "e"), w["winner"] + (" (peer)" if w["peer"] else ""),
            f"{w['cost']:.3g}" + (" or less" if w["open"] else ""), w["second"] or "none",
            "" if w["margin"] is None else f"{w['margin']:.2f}", w["best_peer"] or "none",
            "" if w["over_peer"] is None else f"{w['over_peer']:.2f}", _few(w["short"]),
        ))  # fmt: skip
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    rows = ["  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)) for line in lines]
    return "\n".join(row.rstrip() for row in rows)
