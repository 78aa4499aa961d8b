# SPDX-License-Identifier: LGPL-3.0-or-later
"""Straight-line C for asynchronous events of cells with a constant Hessian: see quadratic.py.

At an event the nodes have drifted to t; the force there times the step is the kick, or changes the
force that acts through the step. Knows no schedule.
"""

from __future__ import annotations

from complexbody.kernels.quadratic import RegionSource


class EventSource(RegionSource):
    """Events of one region: ``event_r`` for cells that act together, ``lone_r`` for others."""

    def event(self, balanced: bool) -> str:
        """Source of ``event_r``: force at the drifted positions, a kick or a change of force."""
        d, nodes = self.dim, range(self.dim + 1)
        lines = self._gradient_lines("gather_records(s, c + a * W, q[a])")
        between = ["ahead(b, GEOMETRY);"]
        if balanced:
            between.append("vec *now = (vec *)(held + m * HELD * W); ahead(now, HELD);")
            forces = self._force_lines(between)
            give = [f"hold(s, c + {a} * W, h, f{a}, now + {a} * N, blend, mode);" for a in nodes]
        else:
            # There are fewer stresses than forces: they take the weight.
            between += [f"s_[{i}] *= h;" for i in range(self.n * d)]
            between += [f"p[{i}] *= h;" for i in range(self.n)]
            forces = self._force_lines(between, weight="h * ")
            give = [f"kick(s, c + {a} * W, (vec){{0}} + 1.0, f{a});" for a in nodes]
        return self._loop(
            f"static void event_{self.number}(int64_t blocks, const int32_t *restrict c, "
            "const double *restrict geometry, const double *restrict coefficient, "
            "double *restrict held, const double *restrict blend, const world *s, double h, "
            "int mode)",
            [*lines, *forces, *give],
        )

    def lone(self, corrected: bool) -> str:
        """Source of ``lone_r``: W cells that share no node, each drifted to its own t, and forces.

        Args:
            corrected: Take the force at q + (θh²/12) M⁻¹f(q), M the nodes' masses, soft = θh²/12:
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
