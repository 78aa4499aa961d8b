# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a scene needs, and what it does not: found before it runs, told in a table.

What a plan leaves out changes no result (live components; kernels, dissipation, solves, loads that
a scene has none of). What would change one, however little, is a suggestion with an estimate.
"""

from __future__ import annotations

import textwrap
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from complexbody.histories import Constant
from complexbody.instabilities import known_instabilities
from complexbody.integrators.synchronous import Synchronous
from complexbody.invariance import AXES, invariant_axes
from complexbody.precheck import Limits, limits
from complexbody.problem import Problem
from complexbody.stiffness import DELTA
from complexbody.waves import Scale, scales

if TYPE_CHECKING:
    from complexbody.scene import Scene

Array = npt.NDArray[np.float64]

#: Times of an event over a synchronous update, 2D and 3D, as docs/claims.md has them.
EVENT = {"LocalLeapfrog()": (1.2, 1.2), "AVI()": (0.9, 1.5)}


@dataclass(frozen=True)
class Finding:
    """One thing that a plan found.

    Attributes:
        rule: What was looked at.
        found: What is the case.
        why: Why leaving something out changes no result, or what makes it necessary.
        saves: What that saves, estimated; empty if nothing.
    """

    rule: str
    found: str
    why: str = ""
    saves: str = ""


@dataclass(frozen=True)
class Plan:
    """What a scene needs.

    Attributes:
        components: Names of the components that are computed.
        left_out: Names of those that stay zero.
        findings: What else was found.
        scales: Times of the fields, the loads and the run [s].
        suggestions: What would change results a little, and save much, with an estimate of both.
    """

    components: tuple[str, ...]
    left_out: tuple[str, ...]
    findings: tuple[Finding, ...]
    scales: tuple[Scale, ...] = ()
    suggestions: tuple[str, ...] = ()

    def __str__(self) -> str:
        """The table."""
        lines = []
        for f in self.findings:
            parts = [f.found, f.why, f"Saves {f.saves}" if f.saves else ""]
            lines.append(_entry(f.rule, ". ".join(p for p in parts if p)))
        if self.scales:
            lines.append("times [s], shortest first")
            for s in sorted(self.scales, key=lambda s: s.seconds):
                lines.append(_entry(s.field, f"{s.seconds:9.3g}  {s.what}"))
        lines += ["suggested, since it changes results"] if self.suggestions else []
        lines += [_entry("", text) for text in self.suggestions]
        return "\n".join(lines)


def _entry(name: str, text: str) -> str:
    return textwrap.fill(
        f"  {name:<12s}{text}", 100, subsequent_indent=" " * 14, break_long_words=False,
        break_on_hyphens=False,
    )  # fmt: skip


def plan(scene: Scene, until: float | None = None, integrator: Any = None) -> Plan:
    """Look at a scene without running it; collective.

    Args:
        scene: The scene.
        until: End of the run [s], if known.
        integrator: How it would be run; ``Synchronous()`` by default.

    Raises:
        ComplexBodyError: for a scene that cannot be run.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # null modes are `check`'s to tell
        problem = Problem(scene, reduce=True)
    method = integrator or Synchronous()
    found = limits(problem, getattr(method, "dissipation", "exact"))
    times = _scales(problem, found, until)
    made = Plan(
        *_names(problem),
        (
            *_exact(problem, method), _steps(problem, found),
            *(Finding("unstable", t) for t in known_instabilities(problem, method, until)),
        ),
        times,
        tuple(_suggestions(problem, found, times, until)),
    )  # fmt: skip
    problem.close()
    return made


def of_run(problem: Problem, method: Any) -> Plan:
    """What costs nothing to know of a run that is ready."""
    return Plan(*_names(problem), tuple(_exact(problem, method)))


def _names(problem: Problem) -> tuple[tuple[str, ...], tuple[str, ...]]:
    n_u, total = problem.whole.displacement, problem.live.total
    names = [f"u{i + 1}" if i < n_u else f"nu{i - n_u + 1}" for i in range(total)]
    live = set(problem.live.components)
    return (
        tuple(name for i, name in enumerate(names) if i in live),
        tuple(name for i, name in enumerate(names) if i not in live),
    )


def _exact(problem: Problem, method: Any) -> list[Finding]:
    """What is left out without changing a result."""
    live, left = _names(problem)
    sources = problem.live.sources
    every = (*live, *left)
    out = []
    if left:
        order = sorted(every, key=lambda name: (name.startswith("nu"), name))
        moved = ", ".join(f"{order[i]} by {why}" for i, why in sorted(sources.items()))
        out.append(Finding(
            "components", f"{', '.join(live)} move; {', '.join(left)} stay zero",
            f"Sources ({moved}) reach them through no coupling of H, w, inertia, viscosity or "
            "supports", f"a factor of about {len(every) / len(live):.2g} in time and memory",
        ))  # fmt: skip
    else:
        out.append(Finding("components", f"all {len(live)} are needed"))
    out.append(_kernels(problem))
    viscous = any(np.any(b.viscosity_matrix) for b in problem.scene.bodies)
    out.append(
        Finding("dissipation", f'viscosity, by the scheme "{getattr(method, "dissipation", "-")}"')
        if viscous else Finding("dissipation", "none", "η = 0: no code for it runs")
    )  # fmt: skip
    general = any(callable(b.inertia) for b in problem.inertias)
    out.append(
        Finding("inertia", "a general χ(ν, ν̇)", "a nonlinear solve per node and step") if general
        else Finding("inertia", "quadratic χ", "No solve: lumped masses are inverted once")
    )  # fmt: skip
    if problem.whole.identified is not None:
        out.append(_faces(problem))
    return [*out, _loads(problem)]


def _kernels(problem: Problem) -> Finding:
    densities, n, dim = problem.kernels.densities, problem.disc.n, problem.disc.dim
    parts, generated = [], True
    for r, body in enumerate(problem.scene.bodies):
        if densities.generated[r]:
            count = len(densities.total(r))
            size = n * (dim + 1)
            parts.append(f"{body.name}: constant Hessian, {count} of {size * size} entries")
        else:
            generated = False
            parts.append(f"{body.name}: not quadratic, or coefficients that vary within cells")
    why = "Straight-line code of the non-zeros" if generated else "FFCx's kernels, cell by cell"
    saves = "8 to 13 times against assembly by dolfinx" if generated else ""
    return Finding("energy", "; ".join(parts), why, saves)


def _faces(problem: Problem) -> Finding:
    found, disc = problem.whole.identified, problem.disc
    assert found is not None
    nodes, count = problem.comm.allreduce(int(disc.owned.sum())), len(found.number)
    along = ", ".join(AXES[axis] for axis in found.axes)
    what = f"along {along}" if found.boxed else "by given vectors"
    return Finding("periodic", f"{what}: {count} of {nodes} nodes have copies",
                   "All copies of a node share its record, mass and force")  # fmt: skip


def _loads(problem: Problem) -> Finding:
    comm = problem.comm
    entries = comm.allreduce(len(problem.load_value))
    affine = comm.allreduce(int(problem.kernels.constant is not None))
    if not entries and not affine:
        return Finding("loads", "none", "Nothing is added to the forces")
    steady = all(isinstance(h, Constant) for h in problem.loads.histories)
    what = "constant in time" if steady else f"{len(problem.loads.histories)} histories"
    return Finding("loads", f"{what}, at {entries} components of nodes",
                   "One vector for each history, assembled once")  # fmt: skip


def _steps(problem: Problem, found: Limits) -> Finding:
    if not np.isfinite(found.smallest):
        return Finding("steps", "nothing limits them")
    gain = found.uniform / found.local
    return Finding(
        "steps", f"critical ones from {found.smallest:.3g} to {found.largest:.3g} s, median "
        f"{found.median:.3g} s; one for each cell would save updates by a factor of {gain:.2g}",
    )  # fmt: skip


def sizes(problem: Problem) -> tuple[float, float]:
    """Size of the median cell, |K|^(1/d), and of the body's box [m]; collective."""
    disc, comm = problem.disc, problem.comm
    volume = disc.geometry[:, -1, :][disc.source_cell >= 0] ** 2
    parts = comm.allgather(volume)
    cell = float(np.median(np.concatenate(parts))) ** (1 / disc.dim)
    x = np.asarray(problem.scene.mesh.geometry.x)[:, : disc.dim]
    low = np.min(comm.allgather(x.min(axis=0, initial=np.inf)), axis=0)
    high = np.max(comm.allgather(x.max(axis=0, initial=-np.inf)), axis=0)
    return cell, float(np.max(high - low))


def _matrices(problem: Problem, number: int) -> tuple[Array, Array, Array] | None:
    """H, M and D of a region, one of its cells; None where H depends on the state or varies."""
    samples = problem.hessian_samples(number)
    body, n_u = problem.scene.bodies[number], problem.scene.displacement
    if not len(samples) or callable(body.inertia):
        return None
    H = samples[len(samples) // 2].copy()
    outer = problem.kernels.densities.potential[number]
    for (i, j), value in (outer.hessian if outer is not None else {}).items():
        H[i, j] += value if isinstance(value, float) else 0.0
    rho = body.density if isinstance(body.density, int | float) else None
    if rho is None:
        dofs = np.asarray(body.density.x.array)
        rho = float(np.median(np.concatenate(problem.comm.allgather(dofs))))
    M, D = np.zeros((problem.disc.n,) * 2), np.zeros((problem.disc.n,) * 2)
    M[range(n_u), range(n_u)] = rho
    M[n_u:, n_u:], D[n_u:, n_u:] = body.inertia_matrix, body.viscosity_matrix
    return H, M, D


def _scales(problem: Problem, found: Limits, until: float | None) -> tuple[Scale, ...]:
    cell, size = sizes(problem)
    best: dict[tuple[str, str], float] = {}
    for r in range(len(problem.scene.bodies)):
        # Samples differ between ranks; rank 0 has some region's only where it has its cells.
        matrices = next((m for m in problem.comm.allgather(_matrices(problem, r)) if m), None)
        if matrices is None:
            continue
        H, M, D = matrices
        for s in scales(H, M, D, problem.scene.displacement, cell, size, problem.disc.dim):
            key = s.field, s.what
            best[key] = min(s.seconds, best.get(key, np.inf))
    out = [Scale(*key, seconds) for key, seconds in best.items()]
    for history in problem.loads.histories:
        name = type(history).__name__.lower()
        frequency, duration = (getattr(history, a, None) for a in ("frequency", "duration"))
        if frequency:
            out.append(Scale("load", f"a period of {name}", 1 / frequency))
        elif duration:
            out.append(Scale("load", name, duration))
    if np.isfinite(found.smallest):
        out.append(Scale("step", "the smallest cell's critical step", found.smallest))
    if until is not None:
        out.append(Scale("run", "the whole of it", until))
    return tuple(out)


def _suggestions(
    problem: Problem, found: Limits, times: tuple[Scale, ...], until: float | None
) -> list[str]:
    out = [
        f"Lower dimension: nothing varies along {AXES[axis]}. The same bodies, supports and loads "
        "on a mesh of the cross-section give the same fields."
        for axis in invariant_axes(problem)
    ]
    of = {(s.field, s.what): s.seconds for s in times}
    dim = problem.disc.dim
    if np.isfinite(found.smallest):
        gain = found.uniform / found.local
        for name, costs in EVENT.items():
            saved = gain / costs[dim > 2] * (0.5 if name == "AVI()" else 1.0)
            if saved > 1.3:
                out.append(
                    f"Local steps: {name} should take about {1 / saved:.2g} of the time of one "
                    "step for all. Its error in time is another one: docs/charts."
                )
    optical = of.get(("nu", "optical modes, a period"))
    wave = min((of[k] for k in of if k[1] == "a wave crosses a cell"), default=np.inf)
    if optical is not None and optical < 2 * wave and problem.scene.self_action != "implicit":
        out.append(
            f"Stiff self-action: optical modes ({optical:.3g} s) limit the step more than waves "
            f"across a cell ({wave:.3g} s). Scene(self_action='implicit') steps over them; motions "
            f"of frequency ω see ν's inertia grow by {1 + 1 / DELTA:.2g}(ωh)²/4 of the self-action."
        )
    if until is not None:
        out += _frozen(of, until)
    if not problem.live.all and np.isfinite(found.smallest):
        own = limits(_alone(problem), "exact").smallest
        if own > 1.05 * found.smallest:
            out.append(
                f"The step is that of all components, so that results are the same. Those left "
                f"would allow steps {own / found.smallest:.3g} times as long: give step={own:.3g} "
                "times your safety factor."
            )
    return out


def _alone(problem: Problem) -> Problem:
    """The reduced problem, with critical steps of its own components."""
    problem.release()
    return problem


def _frozen(of: dict[tuple[str, str], float], until: float) -> list[str]:
    """ν that hardly moves in the run, or follows at once."""
    own = min(of.get(("nu", what), np.inf) for what in ("optical modes, a period", "relaxation"))
    ways = ("a wave crosses a cell", "diffusion across a cell")
    across = min(of.get(("nu", way), np.inf) for way in ways)
    wave, out = of.get(("u", "a wave crosses a cell"), np.inf), []
    moving = min(across, own)
    if np.isfinite(moving) and until < 0.02 * moving:
        share = until / moving
        out.append(
            f"Frozen ν: the run lasts {share:.2g} of the time in which ν moves across a cell, or "
            "relaxes. Fixed where it starts (cb.Fix('nu', …) everywhere), what it gives to u would "
            f"be wrong by about that share of the coupling ({share:.2g})."
        )
    if own < 0.01 * wave:
        out.append(
            f"Quasi-static ν: it follows in {own:.3g} s, {own / wave:.2g} of the time in which a "
            "wave of u crosses a cell; inertia=0, or self_action='implicit', leaves an error of "
            "about that size where waves span several cells."
        )
    return out
