# SPDX-License-Identifier: LGPL-3.0-or-later
r"""Straight-line C for the force and the energy of P1 cells with a Hessian constant on each cell.

With the cell's shape gradients scaled by the root of its volume, B̃_a = B_a √|K|, and
G̃ = Σ_a q_a ⊗ B̃_a, v̄ = √|K| mean(q), the density ½ g·Hg of g = (∇q, q) gives

    s̃ = H_GG G̃ + H_Gv v̄,  z̃ = H_vG G̃,
    f_a = − s̃ B̃_a − z̃ √|K|/(d+1) − |K|/((d+1)(d+2)) H_vv (q_a + Σ_b q_b)      ("consistent")

and −|K|/(d+1) H_vv q_a for the last term if it is lumped. Only the non-zeros of H are written out;
equal rows and columns (those of U12 and U21, say) are merged. Knows H and d, no mesh.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from complexbody.hessian import Quadratic

Entry = Any  # a float, or the name of a vector of cell-wise coefficients


def entry_text(entry: Entry) -> str:
    """An entry in C."""
    return repr(entry) if isinstance(entry, float) else str(entry)


def straight_line(
    matrix: dict[tuple[int, int], Entry],
    rows: Sequence[int],
    columns: Sequence[int],
    inputs: Sequence[str],
    outputs: Sequence[str],
    tag: str,
) -> list[str]:
    """C statements ``outputs = matrix @ inputs``, equal (or opposite) rows and columns merged.

    Args:
        matrix: Non-zeros by (row, column).
        rows: Row numbers, one per output.
        columns: Column numbers, one per input.
        inputs: C expressions of the inputs.
        outputs: C lvalues; each is assigned once, the empty sum as zero.
        tag: Makes names of temporaries unique.
    """
    lines: list[str] = []
    merged: dict[tuple[tuple[int, Entry], ...], list[tuple[int, int]]] = {}
    for position, column in enumerate(columns):
        pattern = tuple((r, matrix[r, column]) for r in rows if (r, column) in matrix)
        if not pattern:
            continue
        negated = tuple((r, -e if isinstance(e, float) else ("-", e)) for r, e in pattern)
        if negated in merged:
            merged[negated].append((position, -1))
        else:
            merged.setdefault(pattern, []).append((position, +1))
    terms: dict[int, list[str]] = {r: [] for r in rows}
    for number, (pattern, members) in enumerate(merged.items()):
        text = "".join(
            (" + " if s > 0 else " - ") + inputs[p] if i else inputs[p]
            for i, (p, s) in enumerate(members)
        )
        if len(members) > 1:
            lines.append(f"const vec {tag}{number} = {text};")
            text = f"{tag}{number}"
        for row, entry in pattern:
            terms[row].append(text if entry == 1.0 else f"{entry_text(entry)} * {text}")
    seen: dict[str, str] = {}
    for row, output in zip(rows, outputs, strict=True):
        value = " + ".join(terms[row]) or "(vec){0}"
        lines.append(f"{output} = {seen.get(value, value)};")
        seen.setdefault(value, output.removeprefix("vec "))
    return lines


class RegionSource:
    """C functions of one region: ``force_r`` and ``energy_r``.

    Args:
        number: The region's number r.
        stored: The stored density ρe.
        potential: The external potential ρw, or None.
        n: Components per node.
        dim: Dimension d of the mesh.
        lumped: Lump the self-action by the vertex rule.
        coefficients: UFL expressions of all cell-wise coefficients of the scene, in storage order.
    """

    def __init__(
        self,
        number: int,
        stored: Quadratic,
        potential: Quadratic | None,
        n: int,
        dim: int,
        lumped: bool,
        coefficients: Sequence[Any],
    ) -> None:
        self.number, self.n, self.dim, self.lumped = number, n, dim, lumped
        self.coefficients = list(coefficients)
        parts = [stored] if potential is None else [stored, potential]
        self.parts = [self._named(p) for p in parts]
        total: dict[tuple[int, int], Entry] = {}
        self.extra: list[str] = []
        for _, _, hessian in self.parts:
            for key, entry in hessian.items():
                total[key] = self._add(total.get(key), entry)
        self.total = total
        self.gradients = [3 * i + j for i in range(n) for j in range(dim)]
        self.values = [3 * n + i for i in range(n)]

    def _named(self, q: Quadratic) -> tuple[Entry, dict[int, Entry], dict[tuple[int, int], Entry]]:
        def name(value: Any) -> Entry:
            if isinstance(value, float):
                return value
            return f"k[{self.coefficients.index(value)}]"

        return (
            name(q.constant),
            {i: name(v) for i, v in q.linear.items()},
            {ij: name(v) for ij, v in q.hessian.items()},
        )

    @staticmethod
    def _add(a: Entry | None, b: Entry) -> Entry:
        if a is None:
            return b
        if isinstance(a, float) and isinstance(b, float):
            return a + b
        return f"({entry_text(a)} + {entry_text(b)})"

    @property
    def needs_volume(self) -> bool:
        """True if √|K| is read: self-action, values coupled to gradients, affine densities."""
        affine = any(c != 0.0 or linear for c, linear, _ in self.parts)
        return affine or self.has_values

    @property
    def has_values(self) -> bool:
        """True if forces depend on (u, ν) themselves, not only on gradients."""
        return any(i in self.values or j in self.values for i, j in self.total)

    def _gradient_lines(self, gather: str = "gather(x, c + a * W, q[a])") -> list[str]:
        d, n = self.dim, self.n
        lines = [f"vec q[{d + 1}][NR]; for (int a = 0; a <= {d}; a++) {gather};"]
        for i in range(n):
            for a in range(1, d + 1):
                lines.append(f"const vec e{i}_{a} = q[{a}][{i}] - q[0][{i}];")
            for j in range(d):
                terms = " + ".join(f"e{i}_{a} * b[{(a - 1) * d + j}]" for a in range(1, d + 1))
                lines.append(f"const vec g{i}_{j} = {terms};")
        return lines

    def _inputs(self, values: bool) -> list[str]:
        names = [f"g{i}_{j}" for i in range(self.n) for j in range(self.dim)]
        return names + ([f"m{i}" for i in range(self.n)] if values else [])

    def _mean_lines(self) -> list[str]:
        d = self.dim
        sums = [
            f"const vec t{i} = {' + '.join(f'q[{a}][{i}]' for a in range(d + 1))};"
            for i in range(self.n)
        ]
        return [*sums, *(f"const vec m{i} = t{i} * (r / {d + 1}.0);" for i in range(self.n))]

    def force(self) -> str:
        """Source of ``force_r(number of blocks, nodes, geometry, coefficients, x, f)``."""
        nodes = range(self.dim + 1)
        return self._loop(
            f"static void force_{self.number}(int64_t blocks, const int32_t *restrict c, "
            "const double *restrict geometry, const double *restrict coefficient, "
            "const double *restrict x, double *restrict f)",
            [
                *self._gradient_lines(),
                *self._force_lines([]),
                *(f"scatter(f, c + {a} * W, f{a});" for a in nodes),
            ],
        )

    def _force_lines(self, between: list[str], weight: str = "") -> list[str]:
        """Statements from gradients g, positions q to nodal forces f0 … fd.

        Args:
            between: Statements between stresses s_ and forces.
            weight: A factor of forces that come of values alone, in C.
        """
        d, n = self.dim, self.n
        grads, vals = self.gradients, self.values
        vv = {k: e for k, e in self.total.items() if k[0] in vals and k[1] in vals}
        rest = {k: e for k, e in self.total.items() if k not in vv}
        mixed = any(k[0] in vals or k[1] in vals for k in rest)
        own = mixed
        body: list[str] = []
        if vv or own:
            body += [f"const vec r = b[{d * d}];", *self._mean_lines()]
        columns = grads + (vals if mixed else [])
        body.append(f"vec s_[{n * d}];")
        body += straight_line(
            rest, grads, columns, self._inputs(mixed), [f"s_[{i}]" for i in range(n * d)], "h"
        )
        body.append("vec p[NR] = {{0}};")
        if mixed:
            outputs = [f"p[{i}]" for i in range(n)]
            body += straight_line(rest, vals, columns, self._inputs(True), outputs, "z")
        body += [f"p[{i}] *= r / {d + 1}.0;" for i in range(n)] if mixed else []
        body += between
        body += [f"vec f{a}[NR] = {{{{0}}}};" for a in range(d + 1)]
        body += [f"f0[{i}] = -p[{i}];" for i in range(n)] if own else []
        for a in range(1, d + 1):
            for i in range(n):
                terms = " + ".join(f"s_[{i * d + j}] * b[{(a - 1) * d + j}]" for j in range(d))
                body.append(f"const vec y{a}_{i} = {terms}; f0[{i}] += y{a}_{i};")
                body.append(f"f{a}[{i}] = -y{a}_{i}{f' - p[{i}]' if own else ''};")
        if vv:
            factor = f"{d + 1}.0" if self.lumped else f"{(d + 1) * (d + 2)}.0"
            body.append(f"const vec w = {weight}r * r / {factor};")
            present = sorted({row - 3 * n for row, _ in vv})
            for a in range(d + 1):
                at = [f"q[{a}][{i}]" if self.lumped else f"(q[{a}][{i}] + t{i})" for i in range(n)]
                outputs = [f"vec v{a}_{i}" for i in present]
                rows = [3 * n + i for i in present]
                body += straight_line(vv, rows, vals, at, outputs, f"c{a}_")
                body += [f"f{a}[{i}] -= w * v{a}_{i};" for i in present]
        return body

    def energy(self) -> str:
        """Source of ``energy_r(blocks, …, x, out)``: adds stored and potential energy [J]."""
        d, n = self.dim, self.n
        body = self._gradient_lines()
        if self.needs_volume:
            body += [f"const vec r = b[{d * d}];", *self._mean_lines()]
        names = self._inputs(self.needs_volume)
        order = self.gradients + (self.values if self.needs_volume else [])
        for number, (constant, linear, hessian) in enumerate(self.parts):
            body.append("{ vec e = {0};")
            vv = {k: e for k, e in hessian.items() if k[0] in self.values and k[1] in self.values}
            rest = {k: e for k, e in hessian.items() if k not in vv}
            outputs = [f"vec a{i}" for i in range(len(order))]
            body += straight_line(rest, order, order, names, outputs, "h")
            body += [f"e += 0.5 * a{i} * {name};" for i, name in enumerate(names)]
            if vv:
                factor = f"{d + 1}.0" if self.lumped else f"{(d + 1) * (d + 2)}.0"
                at = [[f"q[{a}][{i}]" for i in range(n)] for a in range(d + 1)]
                if not self.lumped:
                    at.append([f"t{i}" for i in range(n)])
                for a, inputs in enumerate(at):
                    outputs = [f"vec c{a}_{i}" for i in range(n)]
                    body += straight_line(vv, self.values, self.values, inputs, outputs, f"d{a}_")
                    body += [
                        f"e += 0.5 * r * r / {factor} * c{a}_{i} * {inputs[i]};" for i in range(n)
                    ]
            body += [
                f"e += r * {entry_text(v)} * {names[order.index(i)]};"
                for i, v in linear.items()
                if i in order
            ]
            if constant != 0.0:
                body.append(f"e += r * r * {entry_text(constant)};")
            body.append(f"for (int l = 0; l < W; l++) out[{number}] += e[l]; }}")
        return self._loop(
            f"static void energy_{self.number}(int64_t blocks, const int32_t *restrict c, "
            "const double *restrict geometry, const double *restrict coefficient, "
            "const double *restrict x, double *restrict out)",
            body,
        )

    def _loop(self, head: str, body: list[str]) -> str:
        start = [
            "const vec *b = (const vec *)(geometry + m * GEOMETRY * W);",
            "const vec *k = (const vec *)(coefficient + m * COEFFICIENTS * W); (void)k;",
        ]
        inner = "\n".join("    " + line for line in [*start, *body])
        step = f"c += {self.dim + 1} * W"
        return f"{head} {{\n  for (int64_t m = 0; m < blocks; m++, {step}) {{\n{inner}\n  }}\n}}\n"
