# SPDX-License-Identifier: LGPL-3.0-or-later
"""What an event of an asynchronous integrator costs, beside a synchronous cell update.

    python benchmarks/avi.py [--quick] [--dim 2 3] [--grade 64] [--viscosity 0]

Same kernel, same graded mesh, one process and core, taken in turn; the least processor time of the
repeats counts. *Heap* is the AVI of the literature, compiled as well: a binary heap, one cell at a
time. An event's cost is all in; *of it* tells the share of renewing loads. Speed-ups over
synchronous stepping at 0.9 of its critical step: *ideal*, every cell at its own critical step;
*scheduled*, in updates; *realised*, in time. *Set-up* is its share in a run of 1000 windows. Read
the ratios: a time on its own says nothing.
"""

from __future__ import annotations

import argparse
import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mpi4py import MPI

import complexbody as cb
from complexbody import meshes, native
from complexbody.forms import isotropic_two_field, scaled_icosahedral_quasicrystal
from complexbody.integrators.asynchronous import AVI
from complexbody.kernels import events
from complexbody.problem import Problem
from complexbody.timesets import cell_steps

#: What is measured besides synchronous stepping and the heap; one more schedule is one more line.
METHODS: dict[str, Any] = {
    "plain windows": AVI(balanced=False),
    "balanced windows": AVI(),
    "real steps": AVI(schedule="exact", corrected=False),
    "real, corrected": AVI(schedule="exact"),
}
#: Parts of a balanced window whose share is told.
PARTS = {"load": "loads"}
UNTIL = 50.0  # long beside any window

TRIAD = """
void triad(long n, double *restrict a, const double *b, const double *c) {
  for (long i = 0; i < n; i++) a[i] = b[i] + 0.5 * c[i];
}
"""
HEAP = """
#include <math.h>
#include <stdint.h>
#include <string.h>
#define W 1
#define INLINE static inline __attribute__((always_inline))
#pragma GCC diagnostic ignored "-Wmissing-braces"
typedef double vec;
typedef struct { double *record, *inverse_mass; } world; /* [node]{x (N), v (N), time, 1/volume} */
typedef struct { double time; int64_t cell; } entry;
#define RECORD (2 * N + 2)
INLINE void gather_records(const world *s, const int32_t *c, vec *out) {
  memcpy(out, s->record + *c * RECORD, N * sizeof(double));
}
INLINE void kick(const world *s, const int32_t *c, double weight, const vec *f) {
  double *r = s->record + *c * RECORD;
  for (int i = 0; i < N; i++) r[N + i] += weight * r[2 * N + 1] * s->inverse_mass[i] * f[i];
}
#define ahead(p, size)
%s
static void sift(entry *heap, int64_t size, int64_t at) {
  const entry moved = heap[at];
  for (int64_t child; (child = 2 * at + 1) < size; at = child) {
    child += child + 1 < size && heap[child + 1].time < heap[child].time;
    if (heap[child].time >= moved.time) break;
    heap[at] = heap[child];
  }
  heap[at] = moved;
}
void start(entry *heap, int64_t cells) {
  for (int64_t i = cells / 2; i-- > 0;) sift(heap, cells, i);
}
void run(const world *s, entry *heap, int64_t cells, const int32_t *nodes, const double *geometry,
         const double *step, int64_t *count, int64_t events) {
  while (events-- > 0) {
    const int64_t k = heap->cell;
    const int32_t *c = nodes + k * (DIM + 1);
    for (int a = 0; a <= DIM; a++) {
      double *r = s->record + c[a] * RECORD, dt = heap->time - r[2 * N];
      for (int i = 0; i < N; i++) r[i] += dt * r[N + i];
      r[2 * N] = heap->time;
    }
    event_0(1, c, geometry + k * GEOMETRY, 0, 0, 0, s, step[k], 0);
    heap->time = ++count[k] * step[k];
    sift(heap, cells, 0);
  }
}
"""


def scene(
    dim: int, cells: int, grade: float, viscosity: float, comm: Any = MPI.COMM_SELF
) -> cb.Scene:
    """A coupled body of 2·dim components; cell sizes grow by ``grade`` along each axis."""
    m = max(2, round((cells / (6 if dim == 3 else 2)) ** (1 / dim)))
    make = meshes.box if dim == 3 else meshes.rectangle
    mesh = meshes.jiggled(make(comm, [0] * dim, [1] * dim, m), 0.15, 1)
    x = mesh.geometry.x
    if grade > 1:
        x[:, :dim] = np.expm1(np.log(grade) * x[:, :dim]) / (grade - 1)
    bodies = {2: lambda: isotropic_two_field(d=2, viscosity=viscosity),
              3: lambda: scaled_icosahedral_quasicrystal(viscosity=viscosity)}  # fmt: skip
    wave = lambda x: 1e-3 * np.sin(7 * x[:1] + 3 * x[1:2]) * np.ones((dim, 1))  # noqa: E731
    return cb.Scene(mesh, bodies[dim](), initial=cb.Initial(u=wave, nu=wave))


def whole(values: Any) -> Any:
    """A copy in one piece, on the pages our own arrays have."""
    out = native.aligned(values.shape, values.dtype)
    out[:] = values
    return out


class Heap:
    """Events by a binary heap, scalar code, no damping: plain AVI with real h_K."""

    def __init__(self, problem: Problem, safety: float) -> None:
        disc, kernels = problem.disc, problem.kernels
        region, n = events.regions(kernels)[0], disc.n
        assert region is not None
        defines = {"N": n, "NR": n, "DIM": disc.dim, "GEOMETRY": disc.dim**2 + 1, "COEFFICIENTS": 0}
        text = "\n".join(f"#define {key} {value}" for key, value in defines.items())
        self.c = native.load(text + HEAP % region.event(False))
        real = disc.source_cell >= 0
        self.step = whole(safety * cell_steps(problem)[real])
        self.nodes = whole(disc.cells.transpose(0, 2, 1)[real])
        self.geometry = whole(disc.geometry.transpose(0, 2, 1)[real])
        self.record = native.aligned((disc.nodes, 2 * n + 2))
        self.record[:, :n], self.record[:, -1] = problem.initial_fields, 1.0 / disc.volume
        masses = problem.masses
        self.inverse = 1.0 / np.diag(masses.full(masses.inertia, masses.density)[0])
        self.count = np.ones(len(self.step), np.int64)
        self.heap = whole(np.zeros(len(self.step), [("time", "f8"), ("cell", "i8")]))
        self.heap["time"], self.heap["cell"] = self.step, np.arange(len(self.step))
        self.c.start(native.pointer(self.heap), ctypes.c_int64(len(self.step)))
        self.rate = float(np.sum(1.0 / self.step))  # events per second of the body's time
        self._world = (ctypes.c_void_p * 2)(self.record.ctypes.data, self.inverse.ctypes.data)

    def events(self, count: int) -> None:
        """The next ``count`` events."""
        parts = map(native.pointer, (self.nodes, self.geometry, self.step, self.count))
        cells, heap = ctypes.c_int64(len(self.step)), native.pointer(self.heap)
        self.c.run(self._world, heap, cells, *parts, ctypes.c_int64(count))

    def bytes(self) -> int:
        """Memory of its arrays."""
        return sum(a.nbytes for a in vars(self).values() if isinstance(a, np.ndarray))


def spent(call: Callable[[], Any]) -> float:
    """Processor time of a call [s]."""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def watch(run: Any) -> dict[str, float]:
    """Processor time of the run's PARTS from now on, by name."""
    shares: dict[str, float] = {}

    def booked(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any) -> Any:
            begun = time.process_time()
            out = call(*args)
            shares[name] += time.process_time() - begun
            return out

        return timed

    balance = getattr(run, "balance", None)
    for attribute, name in PARTS.items() if balance else ():
        shares[name] = 0.0
        setattr(balance, attribute, booked(name, getattr(balance, attribute)))
    return shares


@dataclass
class Row:
    """A line of the table: ``call`` works, ``done`` counts updates, ``rate`` is what it needs."""

    call: Callable[[], None]
    done: Callable[[], float]  # updates so far
    rate: float  # updates per unit of the body's time
    bytes: float
    setup: float = 0.0  # [s]
    shares: dict[str, float] = field(default_factory=dict)
    best: float = np.inf  # seconds per update
    told: dict[str, float] = field(default_factory=dict)

    def take(self) -> None:
        """Once more."""
        self.shares.update(dict.fromkeys(self.shares, 0.0))
        before = self.done()
        taken = spent(self.call)
        each = taken / (self.done() - before)
        if each < self.best:
            self.best, self.told = each, {p: s / taken for p, s in self.shares.items() if s}


def asynchronous(method: Any, problem: Callable[[], Problem]) -> tuple[Row, Any]:
    """The row of an asynchronous method, and its run."""
    begun = time.process_time()
    run = method.prepare(problem(), UNTIL)
    setup = time.process_time() - begun
    run.advance(1)
    before = run.updates
    run.advance(1)
    beats = max(1, round(3e6 / (run.updates - before)))
    rate = (run.updates - before) / run.step
    if hasattr(run, "steps_of"):  # real steps: spans differ in their events
        rate = float(np.sum(1.0 / run.steps_of))
    parts = [run, *(getattr(run, name, None) for name in ("plan", "balance", "schedule"))]
    own = [value for part in parts if part is not None for value in vars(part).values()]
    arrays = {id(a): a.nbytes for a in own if isinstance(a, np.ndarray)}
    size = run.problem.kernels.bytes_per_cell() + sum(arrays.values()) / run.problem.disc.count
    shares = watch(run)
    return Row(lambda: run.advance(beats), lambda: run.updates, rate, size, setup, shares), run


def measure(dim: int, cells: int, grade: float, viscosity: float, repeats: int) -> None:
    """Everything on one mesh, in turn, and the table."""
    problem = lambda: Problem(scene(dim, cells, grade, viscosity))  # noqa: E731
    one = cb.Synchronous().prepare(problem(), UNTIL)
    count, size = one.problem.disc.count, one.problem.kernels.bytes_per_cell()
    steps = max(1, round(3e6 / count))
    sync = Row(lambda: one.advance(steps), lambda: one.steps * count, count / one.step, size)
    rows, sets = {"synchronous": sync}, None
    for name, method in METHODS.items():
        rows[name], run = asynchronous(method, problem)
        sets = sets or run.time_sets  # those of windows: spans of real steps are short
    if viscosity == 0:
        heap = Heap(one.problem, AVI().safety)
        call = lambda: heap.events(10**6)  # noqa: E731
        rows["heap"] = Row(call, lambda: heap.count.sum(), heap.rate, heap.bytes() / count)
    arrays = [native.aligned((1 << 23,)) for _ in range(3)]
    triad, addresses = native.load(TRIAD).triad, [native.pointer(a) for a in arrays]
    sweep, seconds = (lambda: triad(ctypes.c_long(1 << 23), *addresses)), np.inf
    for _ in range(repeats):
        for row in rows.values():
            row.take()
        seconds = min(seconds, spent(sweep))
    assert sets is not None
    print(
        f"\n{dim}D, {count} cells, {2 * dim} components, steps 1 to {sets.asynchronicity:.0f}, "
        f"ideal speed-up {sets.ideal:.2f}, triad {24e-9 * (1 << 23) / seconds:.1f} GB/s"
    )
    print(
        f"{'':18}{'ns':>7}{'updates':>9}{'M/s':>7}{'scheduled':>11}{'realised':>10}"
        f"{'bytes/cell':>12}{'set-up':>9}   of it"
    )
    for name, row in rows.items():
        each, scheduled = row.best / sync.best, sync.rate / row.rate
        setup = 100 * row.setup / (1000 * sets.window * row.rate * row.best)
        parts = ", ".join(f"{part} {100 * share:.0f} %" for part, share in row.told.items())
        print(
            f"{name:18}{row.best * 1e9:7.1f}{each:9.2f}{1e-6 / row.best:7.1f}{scheduled:11.2f}"
            f"{scheduled / each:10.2f}{row.bytes:12.0f}{setup:7.1f} %   {parts}".rstrip(),
            flush=True,
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--cells", type=int, help="216000 in 3D, 106000 in 2D")
    parser.add_argument("--dim", type=int, nargs="+", default=[3, 2], choices=[2, 3])
    parser.add_argument("--grade", type=float, default=64.0, help="largest over smallest size")
    parser.add_argument("--viscosity", type=float, default=0.0)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--quick", action="store_true", help="small meshes, few repeats")
    options = parser.parse_args()
    for dim in options.dim:
        cells = options.cells or {2: 106000, 3: 216000}[dim] // (10 if options.quick else 1)
        repeats = 3 if options.quick else options.repeats
        measure(dim, cells, options.grade, options.viscosity, repeats)


if __name__ == "__main__":
    main()
