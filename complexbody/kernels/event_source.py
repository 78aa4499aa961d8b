# SPDX-License-Identifier: LGPL-3.0-or-later
"""Straight-line C for asynchronous events of cells with a constant Hessian: see quadratic.py.

At an event the nodes have drifted to t; the stress there, or what it differs from the reference by,
times the step is the kick. Knows no schedule.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from complexbody.kernels.quadratic import RegionSource, entry_text


class EventSource(RegionSource):
    """Events of one region: ``event_r`` for cells that act together, ``lone_r`` for others."""

    def stress_rows(self) -> list[tuple[Any, ...]]:
        """What each of the n·d stresses is made of: equal rows are equal stresses."""
        own = self.gradients + self.values
        return [
            tuple((j, entry_text(self.total[i, j])) for j in own if (i, j) in self.total)
            for i in self.gradients
        ]

    def event(self, slots: Sequence[int], values: bool) -> str:
        """Source of ``event_r``: force at the drifted positions (against the reference), kick.

        Args:
            slots: Place of each of the n·d stresses among the references; none without a reference.
            values: n mean self-actions z stand behind them.
        """
        d, n, nodes = self.dim, self.n, range(self.dim + 1)
        lines = self._gradient_lines("gather_records(s, c + a * W, q[a])")
        between = ["ahead(b, GEOMETRY);"]
        if slots:
            kept = {slot: f"left[{slot}] = s_[{i}];" for i, slot in enumerate(slots)}
            against = [f"s_[{i}] -= reference[{slot}];" for i, slot in enumerate(slots)]
            if values:
                first = len(kept)
                kept |= {first + i: f"left[{first + i}] = z[{i}];" for i in range(n)}
                at = [f"reference[{first + i}] * b[{d * d}] / {d + 1}.0" for i in range(n)]
                against += [f"p[{i}] -= {at[i]};" for i in range(n)]
            between += [
                "const vec *reference = (const vec *)(held + m * REFERENCES * W);",
                "ahead(reference, REFERENCES);",
                f"if (mode & KEEP) {{ vec left[REFERENCES]; {' '.join(kept.values())}",
                f"  keep(s, c, b[{d * d}], left); }}",
                f"if (mode & AGAINST) {{ {' '.join(against)} }}",
            ]
        # There are fewer stresses than forces: they take the weight.
        between += [f"s_[{i}] *= weight;" for i in range(n * d)]
        between += [f"p[{i}] *= weight;" for i in range(n)]
        return self._loop(
            f"static void event_{self.number}(int64_t blocks, const int32_t *restrict c, "
            "const double *restrict geometry, const double *restrict coefficient, "
            "const double *restrict held, const world *s, double weight, int mode)",
            [
                *lines,
                *self._force_lines(between, with_values=values and bool(slots), weight="weight * "),
                *(f"kick(s, c + {a} * W, (vec){{0}} + 1.0, f{a});" for a in nodes),
            ],
        )

    def lone(self, corrected: bool) -> str:
        """Source of ``lone_r``: W cells that share no node, each drifted to its own t, and forces.

        Args:
            corrected: Take the force at q + (h²/12) M⁻¹f(q), M the nodes' masses, ``soft`` = h²/12:
                to leading order that of the softer potential V_K − (h²/24) ∇V_K·M⁻¹∇V_K.
        """
        first, *gradients = self._gradient_lines("drift_gather(s, c + a * W, t, q[a])")
        forces, nodes = [*gradients, *self._force_lines([])], range(self.dim + 1)
        soften = [f"soften(s, c + {a} * W, soft, f{a}, q[{a}]);" for a in nodes]
        give = [f"memcpy(out[{a}], f{a}, sizeof f{a});" for a in nodes]
        body = [first, *(["{", *forces, *soften, "}"] if corrected else []), *forces, *give]
        return (
            f"static void lone_{self.number}(const world *s, const int32_t *restrict c, "
            "const vec *restrict b, const vec *restrict k, const vec t, const vec soft, "
            "vec out[DIM + 1][NR]) {\n  (void)b, (void)k, (void)soft;\n  "
            + "\n  ".join(body) + "\n}\n"
        )  # fmt: skip
